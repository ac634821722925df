"""The service's settings: where they come from, which of them count, and what is said of wrong ones."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from lightpage.device.profile import TomlTable
from lightpage.errors import InvalidInputError
from runtime.service.limits import Limits
from runtime.service.settings import Effective, Option, Secret, ServiceSettings, read_settings, service_settings

ROOT = Path(__file__).resolve().parents[3]
EXAMPLE = ROOT / "docs" / "service-example.toml"
DECODES = "LIGHTPAGE_LIMITS__CONCURRENT_DECODES"


def of_file(folder: Path, text: str, *options: Option, **environment: str) -> Effective[ServiceSettings]:
    file = folder / "service.toml"
    file.write_text(text)
    return service_settings(file, environment, options)


def refused(folder: Path, text: str, *options: Option, **environment: str) -> InvalidInputError:
    with pytest.raises(InvalidInputError) as raised:
        of_file(folder, text, *options, **environment)
    return raised.value


def test_the_example_is_the_defaults() -> None:
    assert service_settings(EXAMPLE, {}).settings == ServiceSettings() == service_settings(None, {}).settings


def test_the_example_has_every_key_and_its_examples_are_right() -> None:
    text = EXAMPLE.read_text("utf-8")
    whole = tomllib.loads(re.sub(r"^# (\w+ = )", r"\1", text, flags=re.MULTILINE))
    tables = {name: field.annotation.model_fields for name, field in ServiceSettings.model_fields.items()}  # type: ignore[union-attr]
    assert {name: set(table) for name, table in whole.items()} == {name: set(keys) for name, keys in tables.items()}
    assert ServiceSettings.model_validate(whole).service.threads == 2


def test_every_limit_can_be_set(tmp_path: Path) -> None:
    defaults = {name: 7.0 if value is None else value for name, value in Limits().model_dump().items()}
    wanted = {name: 0.5 * value if isinstance(value, float) else value // 2 for name, value in defaults.items()}
    text = "[limits]\n" + "\n".join(f"{name} = {value}" for name, value in wanted.items())
    assert of_file(tmp_path, text).settings.limits.model_dump() == wanted
    variables = {f"LIGHTPAGE_LIMITS__{name.upper()}": str(value) for name, value in wanted.items()}
    assert of_file(tmp_path, "", **variables).settings.limits.model_dump() == wanted


def test_options_count_before_the_environment_and_that_before_the_file(tmp_path: Path) -> None:
    text, option = "[limits]\nconcurrent_decodes = 3", Option("--decodes", ("limits", "concurrent_decodes"), 7)
    seen = [
        of_file(tmp_path, ""),
        of_file(tmp_path, text),
        of_file(tmp_path, text, **{DECODES: "5"}),
        of_file(tmp_path, text, **{DECODES: ""}),
        of_file(tmp_path, text, option, **{DECODES: "5"}),
    ]
    assert [each.settings.limits.concurrent_decodes for each in seen] == [2, 3, 5, 3, 7]
    file = f"file {tmp_path / 'service.toml'}"
    key = ("limits", "concurrent_decodes")
    origins = [each.origins.get(key) for each in seen]
    assert origins == [None, file, f"environment {DECODES}", file, "option --decodes"]


def test_the_environment_gives_every_type_and_paths_that_look_like_numbers() -> None:
    settings = service_settings(
        None,
        {
            "LIGHTPAGE_SERVICE__STORE": "123",
            "LIGHTPAGE_SERVICE__SOURCE": "simulator:bench",
            "LIGHTPAGE_SERVICE__TRACKING": "false",
            "LIGHTPAGE_SELF_CALIBRATION__PAGES": "1, 2",
            "LIGHTPAGE_SELF_CALIBRATION__LEAST_S": "5",
            "LIGHTPAGE_METRICS__PORT": "0",
            "LIGHTPAGE_HEALTH_TARGET": "of another program",
        },
    ).settings
    assert (settings.service.store, settings.service.tracking, settings.metrics.port) == (Path("123"), False, 0)
    assert (settings.self_calibration.pages, settings.self_calibration.least_s) == ((1, 2), 5.0)
    assert settings.self_calibrates
    assert settings.audit_file == Path("123/audit.jsonl")


def test_the_short_name_of_the_store_counts_less_than_the_long_one() -> None:
    short = {"LIGHTPAGE_STORE": "short"}
    assert service_settings(None, short).settings.service.store == Path("short")
    assert service_settings(None, {**short, "LIGHTPAGE_SERVICE__STORE": "a"}).settings.service.store == Path("a")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (
            "[limits]\nconcurent_decodes = 1",
            r"unknown limits\.concurent_decodes, wanted limits\.concurrent_decodes",
        ),
        ("[limts]\nstall_s = 1", r"got unknown limts, wanted table \[limits\]"),
        ("[service]\nport = 9100", r"got unknown service\.port, wanted metrics\.port"),
        ("limits = 3", r"got limits = 3, wanted a table"),
        ("[limits]\nconcurrent_decodes = 0", r"got limits\.concurrent_decodes = 0, wanted at least 1"),
        ("[limits]\nconcurrent_decodes = true", r"got limits\.concurrent_decodes = true, wanted a whole number"),
        ("[limits]\nstall_s = '5'", r"got limits\.stall_s = '5', wanted a number"),
        ("[limits]\nstall_s = nan", r"got limits\.stall_s = nan, wanted a finite number"),
        ("[limits]\nchunk_bytes = 4194304", r"chunk_bytes = 4194304, wanted at least 1024 less than limits\.message_"),
        ("[limits]\npair_bytes = 2000000000", r"wanted at least limits\.pair_bytes"),
        ("[limits]\nstall_s = 31", r"stall_s = 31\.0, wanted at most limits\.receive_s, which is 30"),
        ("[limits]\nconnection_grace_s = 9", r"connection_grace_s = 9\.0, wanted limits\.connection_age_s too"),
        ("[service]\naddress = 'here'", r"got service\.address = 'here', wanted HOST:PORT"),
        ("[service]\nstore = ''", r"service\.store = '', wanted a path that is not empty"),
        ("[service]\npages = 'p.h5'", r"service\.pages = 'p\.h5', wanted service\.source"),
        ("[logs]\nlevel = 'loud'", r"logs\.level = 'loud', wanted debug, info, warning or error"),
        (
            "[self_calibration]\npages = [1, -2]",
            r"calibration\.pages\.1 = -2, wanted at least 0",
        ),
        ("[self_calibration]\npages = [1]", r"pages = \[1\], wanted at least 2 that differ"),
        ("[self_calibration]\nenabled = true", r"enabled = True, wanted service\.source"),
        ("[self_calibration]\nlongest_s = 5", r"longest_s = 5\.0, wanted at least self_calibration\.least_s"),
        ("[traces]\nendpoint = 'collector:4317'", r"traces\.endpoint = 'collector:4317', wanted http://HOST:PORT or"),
        ("[traces]\nendpoint = 'http://collector'", r"traces\.endpoint = 'http://collector', wanted http://HOST:PORT"),
        ("[traces]\nshare = 1.5", r"traces\.share = 1\.5, wanted at most 1"),
        ("[service", "wanted a TOML file that can be read"),
    ],
)
def test_a_wrong_setting_is_named_with_what_came_and_what_was_wanted(text: str, told: str, tmp_path: Path) -> None:
    error = str(refused(tmp_path, text))
    assert re.search(told, error), error
    assert "service.toml" in error
    assert "\n" not in error


def test_all_wrong_settings_are_named_at_once_with_where_they_come_from(tmp_path: Path) -> None:
    option = Option("--threads", ("service", "threads"), 0)
    told = str(refused(tmp_path, "[limits]\nstall_s = -1", option, LIGHTPAGE_LOGS__FORMAT="xml"))
    assert told.startswith("LIGHTPAGE_LOGS__FORMAT: got 'xml', wanted text or json")
    told = str(refused(tmp_path, "[limits]\nstall_s = -1", option))
    assert "limits.stall_s = -1 (file " in told
    assert "service.threads = 0 (option --threads), wanted at least 1" in told


@pytest.mark.parametrize(
    ("variable", "value", "told"),
    [
        (DECODES, "many", "wanted a whole number"),
        (DECODES, "0", "wanted at least 1"),
        ("LIGHTPAGE_LIMITS__CONCURENT_DECODES", "1", "wanted limits.concurrent_decodes"),
        ("LIGHTPAGE_LIMIT__STALL_S", "1", "wanted table [limits]"),
    ],
)
def test_a_wrong_variable_is_named(variable: str, value: str, told: str, tmp_path: Path) -> None:
    error = str(refused(tmp_path, "", **{variable: value}))
    assert variable in error
    assert told in error


def test_a_missing_file_and_missing_paths_are_named(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="No such file"):
        service_settings(tmp_path / "none.toml", {})
    text = f"[service]\nsource = 'simulator:bench'\nrecordings = '{tmp_path}/gone'"
    with pytest.raises(InvalidInputError, match=r"service\.recordings.*wanted a folder"):
        of_file(tmp_path, text).settings.check_paths()
    with pytest.raises(InvalidInputError, match=r"service\.pages.*wanted a file"):
        of_file(tmp_path, text.replace("recordings", "pages")).settings.check_paths()


def test_printed_settings_are_the_settings_and_say_where_each_comes_from(tmp_path: Path) -> None:
    text = "[service]\nsource = 'simulator:bench'\nstore = 'a \"b\"'\n[self_calibration]\npages = [3, 4]"
    effective = of_file(tmp_path, text, Option("--threads", ("service", "threads"), 3), **{DECODES: "1"})
    printed = effective.to_toml()
    assert ServiceSettings.model_validate(tomllib.loads(printed)) == effective.settings
    lines = printed.splitlines()
    assert "threads = 3  # option --threads" in lines
    assert f"concurrent_decodes = 1  # environment {DECODES}" in lines
    assert f"pages = [3, 4]  # file {tmp_path / 'service.toml'}" in lines
    assert "tracking = true  # default" in lines
    assert "# recordings is not set  # default" in lines


class Login(TomlTable):
    key: Secret | None = None
    keys: tuple[Secret, ...] = ()


class Toy(TomlTable):
    login: Login = Login()


def test_a_secret_is_never_shown(tmp_path: Path) -> None:
    file = tmp_path / "toy.toml"
    file.write_text('[login]\nkey = "hunter2"\nkeys = ["hunter3"]')
    effective = read_settings(Toy, file, {})
    assert effective.settings.login.key is not None
    assert effective.settings.login.key.get_secret_value() == "hunter2"
    assert "hunter" not in effective.to_toml()
    assert 'key = "********"' in effective.to_toml()
    assert "hunter" not in repr(effective)
    by_environment = read_settings(Toy, None, {"LIGHTPAGE_LOGIN__KEY": "hunter2"})
    assert by_environment.settings.login.key == effective.settings.login.key
    for wrong in ("key = 5012345", 'keys = "5012345"', "keys = [5012345]", "key = 5012345\nother = 1"):
        file.write_text(f"[login]\n{wrong}")
        with pytest.raises(InvalidInputError) as raised:
            read_settings(Toy, file, {})
        assert "5012345" not in str(raised.value)


TLS = {"ca": "ca.pem", "certificate": "service.pem", "key": "service.key"}
"""What may be set for TLS."""


@pytest.mark.parametrize("lacking", list(TLS))
def test_certificates_go_together(tmp_path: Path, lacking: str) -> None:
    text = "".join(f"{name} = '{path}'\n" for name, path in TLS.items() if name != lacking)
    assert refused(tmp_path, f"[tls]\n{text}").expected == f"tls.{lacking} too"


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("[service]\naddress = '0.0.0.0:50051'\n", "service.address"),
        ("[service]\naddress = 'device.example:50051'\n", "service.address"),
        ("[service]\naddress = '[::]:50051'\n", "service.address"),
        ("[service]\nhealth_address = '0.0.0.0:50052'\n", "service.health_address"),
        ("[metrics]\nhost = '0.0.0.0'\nport = 9100\n", "metrics.host"),
    ],
)
def test_what_others_reach_needs_certificates(tmp_path: Path, text: str, key: str) -> None:
    error = refused(tmp_path, text)
    assert key in error.got
    assert "[tls]" in error.expected
    secured = of_file(tmp_path, text + "[tls]\n" + "".join(f"{name} = '{path}'\n" for name, path in TLS.items()))
    assert secured.settings.tls.files() is not None
    assert of_file(tmp_path, text, LIGHTPAGE_SERVICE__INSECURE="true").settings.service.insecure


@pytest.mark.parametrize("address", ["127.0.0.1:0", "localhost:50051", "[::1]:50051", "127.3.2.1:50051", "unix:/run/a"])
def test_this_machine_alone_needs_none(tmp_path: Path, address: str) -> None:
    assert of_file(tmp_path, f"[service]\naddress = '{address}'\n").settings.service.address == address
