"""The service's settings: where they come from, which of them count, and what is said of wrong ones."""

import re
import tomllib
from pathlib import Path

import pytest

from lightpage.errors import InvalidInputError
from lightpage.runtime.service.settings import TABLES, Effective, Given, ServiceSettings, service_settings

ROOT = Path(__file__).resolve().parents[3]
EXAMPLE = ROOT / "docs" / "service-example.toml"
DECODES = "LIGHTPAGE_LIMITS__CONCURRENT_DECODES"


def of_file(folder: Path, text: str, *options: Given, **environment: str) -> Effective:
    file = folder / "service.toml"
    file.write_text(text)
    return service_settings(file, environment, options)


def refused(folder: Path, text: str, *options: Given, **environment: str) -> InvalidInputError:
    with pytest.raises(InvalidInputError) as raised:
        of_file(folder, text, *options, **environment)
    return raised.value


def test_the_example_is_the_defaults() -> None:
    assert service_settings(EXAMPLE, {}).settings == ServiceSettings() == service_settings(None, {}).settings


def test_the_example_has_every_key_and_its_examples_are_right() -> None:
    text = EXAMPLE.read_text("utf-8")
    whole = tomllib.loads(re.sub(r"^# (\w+ = )", r"\1", text, flags=re.MULTILINE))
    keys = {name: set(table.model_fields) for name, table in TABLES.items()}
    assert {name: set(table) for name, table in whole.items()} == keys
    assert ServiceSettings.model_validate(whole).service.threads == 2


def test_options_count_before_the_environment_and_that_before_the_file(tmp_path: Path) -> None:
    text, option = "[limits]\nconcurrent_decodes = 3", Given("option --decodes", ("limits", "concurrent_decodes"), 7)
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
            "LIGHTPAGE_SELF_CALIBRATION__PAGES": "1, 2",
            "LIGHTPAGE_SELF_CALIBRATION__LEAST_S": "5",
            "LIGHTPAGE_HEALTH_TARGET": "of another program",
        },
    ).settings
    assert (settings.self_calibration.pages, settings.self_calibration.least_s) == ((1, 2), 5.0)
    assert settings.self_calibration.is_on
    assert settings.audit_file == Path("123/audit.jsonl")


def test_the_short_name_of_the_store_counts_less_than_the_long_one() -> None:
    short = {"LIGHTPAGE_STORE": "short"}
    assert service_settings(None, short).settings.service.store == Path("short")
    assert service_settings(None, {**short, "LIGHTPAGE_SERVICE__STORE": "a"}).settings.service.store == Path("a")


@pytest.mark.parametrize(
    ("text", "got", "wanted"),
    [
        ("[limits]\nconcurent_decodes = 1", "limits.concurent_decodes", "limits.concurrent_decodes"),
        ("[limts]\nstall_s = 1", "limts", "[limits]"),
        ("[service]\nport = 9100", "service.port", "metrics.port"),
        ("limits = 3", "limits = 3", "table"),
        ("[limits]\nconcurrent_decodes = 0", "limits.concurrent_decodes = 0", "at least 1"),
        ("[limits]\nstall_s = nan", "limits.stall_s = nan", "finite"),
        ("[limits]\nchunk_bytes = 4194304", "chunk_bytes = 4194304", "limits.message_bytes"),
        ("[limits]\npair_bytes = 2000000000", "", "limits.pair_bytes"),
        ("[limits]\nstall_s = 31", "stall_s = 31.0", "limits.receive_s"),
        ("[limits]\nconnection_grace_s = 9", "connection_grace_s = 9.0", "limits.connection_age_s"),
        ("[service]\naddress = 'here'", "service.address = 'here'", "HOST:PORT"),
        ("[service]\npages = 'p.h5'", "service.pages = 'p.h5'", "service.source"),
        ("[self_calibration]\npages = [1, -2]", "calibration.pages.1 = -2", "at least 0"),
        ("[self_calibration]\nenabled = true", "enabled = true", "service.source"),
        ("[self_calibration]\nlongest_s = 5", "longest_s = 5.0", "self_calibration.least_s"),
        ("[traces]\nendpoint = 'collector:4317'", "traces.endpoint = 'collector:4317'", "http://HOST:PORT"),
        ("[service", "", "TOML"),
    ],
)
def test_a_wrong_setting_is_named_with_what_came_and_what_was_wanted(
    text: str, got: str, wanted: str, tmp_path: Path
) -> None:
    error = refused(tmp_path, text)
    assert got in str(error.got)
    assert wanted in str(error.expected)
    assert "service.toml" in str(error)
    assert "\n" not in str(error)


def test_all_wrong_settings_are_named_at_once_with_where_they_come_from(tmp_path: Path) -> None:
    option = Given("option --threads", ("service", "threads"), 0)
    error = refused(tmp_path, "[limits]\nstall_s = -1", option, LIGHTPAGE_LOGS__FORMAT="xml")
    for one in ("stall_s = -1 (file", "threads = 0 (option --threads)", "format = 'xml' (environment LIGHTPAGE_LOGS"):
        assert one in str(error.got)
    wrong = refused(tmp_path, "", LIGHTPAGE_LIMITS__CONCURENT_DECODES="1")
    assert "LIGHTPAGE_LIMITS__CONCURENT_DECODES" in str(wrong)
    assert "limits.concurrent_decodes" in str(wrong.expected)
    assert "LIGHTPAGE_LIMTS__STALL_S" in str(refused(tmp_path, "", LIGHTPAGE_LIMTS__STALL_S="1"))
    assert re.search("receive_s.*age_s", str(refused(tmp_path, "[limits]\nstall_s = 31\nconnection_grace_s = 9").got))


def test_a_variable_with_one_underscore_too_few_is_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    service_settings(environment={"LIGHTPAGE_LIMITS_CONCURRENT_DECODES": "1", "LIGHTPAGE_CLIENT_CA": "x"})
    assert "LIGHTPAGE_LIMITS__CONCURRENT_DECODES" in caplog.text
    assert "CLIENT" not in caplog.text


def test_a_missing_file_and_missing_paths_are_named(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=re.escape(str(tmp_path / "none.toml"))):
        service_settings(tmp_path / "none.toml", {})
    text = f"[service]\nsource = 'simulator:bench'\nrecordings = '{tmp_path}/gone'"
    for key, kind in (("recordings", "folder"), ("pages", "file")):
        with pytest.raises(InvalidInputError, match=rf"service\.{key}") as error:
            of_file(tmp_path, text.replace("recordings", key)).settings.check_paths()
        assert kind in str(error.value.expected)


def test_printed_settings_are_the_settings_and_say_where_each_comes_from(tmp_path: Path) -> None:
    text = "[service]\nsource = 'simulator:bench'\nstore = 'a \"b\"'\n[self_calibration]\npages = [3, 4]"
    effective = of_file(tmp_path, text, Given("option --threads", ("service", "threads"), 3), **{DECODES: "1"})
    printed = effective.to_toml()
    assert ServiceSettings.model_validate(tomllib.loads(printed)) == effective.settings
    lines = printed.splitlines()
    assert "threads = 3  # option --threads" in lines
    assert f"concurrent_decodes = 1  # environment {DECODES}" in lines
    assert f"pages = [3, 4]  # file {tmp_path / 'service.toml'}" in lines
    assert "tracking = true  # default" in lines
    assert "# recordings is not set  # default" in lines


TLS = {"ca": "ca.pem", "certificate": "service.pem", "key": "service.key"}
"""What may be set for TLS."""


def with_tls(*names: str) -> str:
    return "[tls]\n" + "".join(f"{name} = '{TLS[name]}'\n" for name in names)


@pytest.mark.parametrize("lacking", list(TLS))
def test_certificates_go_together(tmp_path: Path, lacking: str) -> None:
    assert refused(tmp_path, with_tls(*TLS.keys() - {lacking})).expected == f"tls.{lacking} too"


@pytest.mark.parametrize(
    ("key", "table", "value"),
    [
        *(("service.address", "[service]\naddress = ", at) for at in ("device.example:1", "[::]:1")),
        ("service.health_address", "[service]\nhealth_address = ", "0.0.0.0:50052"),
        ("metrics.host", "[metrics]\nport = 9100\nhost = ", "0.0.0.0"),
    ],
)
def test_what_others_reach_needs_certificates(tmp_path: Path, key: str, table: str, value: str) -> None:
    text = f"{table}'{value}'\n"
    error = refused(tmp_path, text)
    assert key in error.got
    assert "[tls]" in error.expected
    assert of_file(tmp_path, text + with_tls(*TLS)).settings.tls.files() is not None
    assert of_file(tmp_path, text, LIGHTPAGE_SERVICE__INSECURE="true").settings.service.insecure


def test_this_machine_alone_needs_none(tmp_path: Path) -> None:
    for address in ("127.0.0.1:0", "localhost:50051", "[::1]:50051", "127.3.2.1:50051", "unix:/run/a"):
        assert of_file(tmp_path, f"[service]\naddress = '{address}'\n").settings.service.address == address


@pytest.mark.parametrize(
    ("most", "more"),
    [
        ("service.source = 'simulator:bench'\nlimits.recalibration_pages = 2\nself_calibration.pages = [1, 2]", ", 3]"),
        ("[limits]\nreply_bytes = 2147483647", "8"),
    ],
)
def test_a_limit_itself_is_taken_and_one_more_is_not(most: str, more: str, tmp_path: Path) -> None:
    of_file(tmp_path, most)
    refused(tmp_path, most[:-1] + more)
