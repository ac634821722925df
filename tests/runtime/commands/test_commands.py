"""The commands of the runtime: figures and files that they write, what they refuse, and how they end."""

import json
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import click
import h5py
import numpy as np
import pytest

from lightpage.cli import main as cli_main
from lightpage.cli.main import RESUME_KEY, LazyGroup, lightpage
from lightpage.errors import LightpageError, SurroundingsError
from lightpage.page.pilots import Pilots
from lightpage.recording.decoded_file import DecodedWriter
from lightpage.recording.reader import Recording
from lightpage.recording.writer import RecordingWriter
from lightpage.runtime.client.answers import RemotePage
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.client.pages import PagesClient
from lightpage.runtime.commands.client import recalibrate as cli_recalibrate
from lightpage.runtime.device.acquisition.source import open_source
from lightpage.runtime.model.bundle.bundle import Bundle
from tests.lightpage.full_disk import full_disk
from tests.lightpage.small import EXPLAINED
from tests.runtime import toy
from tests.runtime.service.stage import Running, Start
from tests.runtime.slow_fit import SlowFit
from tests.waiting import eventually


def run(*arguments: str | Path, group: click.Group = lightpage) -> int:
    return cli_main.run(group, [str(argument) for argument in arguments])


@click.command()
def interrupted() -> None:
    click.get_current_context().meta[RESUME_KEY] = "call it with --resume"
    raise KeyboardInterrupt


@click.command()
def broken() -> None:
    raise ZeroDivisionError


def group_of(**points: str) -> LazyGroup:
    return LazyGroup([EntryPoint(name, value, cli_main.GROUP) for name, value in points.items()], name="lightpage")


HERE = "tests.runtime.commands.test_commands"


def test_the_overview_imports_no_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--help", group=group_of(train="no_such_package.cli:train")) == 0
    assert "Train a decoder" in capsys.readouterr().out


def test_a_missing_extra_is_named(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    for module, extra in (("torch", "train"), ("onnxruntime", "cpu")):
        (tmp_path / f"wants_{module}.py").write_text(f"import {module}.not_there\n")
        monkeypatch.setitem(sys.modules, module, None)
        assert run("x", group=group_of(x=f"wants_{module}:x")) == 2
        assert f"'lightpage[{extra}]'" in capsys.readouterr().err


def test_an_interrupted_command_says_how_it_goes_on_and_an_unforeseen_error_is_raised(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run("x", group=group_of(x=f"{HERE}:interrupted")) == 130
    assert "--resume" in capsys.readouterr().err
    with pytest.raises(ZeroDivisionError):
        run("x", group=group_of(x=f"{HERE}:broken"))


@pytest.fixture
def recording(tmp_path: Path) -> tuple[Path, np.ndarray]:
    return tmp_path / "r.h5", toy.write_toy_recording(tmp_path / "r.h5", toy.ToyDevice(noise=30.0), 16, 4)


def evaluate(bundle: Path, recording: Path, status: int = 0) -> dict[str, Any]:
    out = recording.with_suffix(".json")
    assert run("evaluate", "--bundle", bundle, "--recording", recording, "--json", out, "--threads", "1") == status
    data: dict[str, Any] = json.loads(out.read_text())
    return data


def test_evaluate_writes_the_promised_figures_and_warns_where_a_bundle_reads_nothing(
    toy_zip: Path, recording: tuple[Path, np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    data = evaluate(toy_zip, recording[0])
    data_symbols = toy.PAGE[0] * toy.PAGE[1] - int(Bundle.open(toy_zip).pilot_mask.sum())
    assert (data["pages"], data["pages_left_out"], data["levels"]) == (4, 0, 16)
    assert data["symbols_per_page"] == data_symbols
    air = data["air_bits_per_symbol"]
    assert 2 < air <= 4
    assert data["page_kB"] == pytest.approx(air * data_symbols / 8000)
    for key in ("own_mi_bits_per_symbol", "gmi_bits_per_symbol", "symbol_error_rate", "ece", "seconds_per_page"):
        assert isinstance(data[key], float)
    assert "carry nothing" not in capsys.readouterr().err
    shuffle_data(recording[0])
    assert evaluate(toy_zip, recording[0])["air_bits_per_symbol"] <= 0
    assert "carry nothing" in capsys.readouterr().err


def shuffle_data(path: Path) -> None:
    """Write down other symbols than were written, the pilots left as they are."""
    data = ~Pilots.of_profile(toy.PROFILE, 16).mask
    with h5py.File(path, "r+") as file:
        symbols = file["symbols"][()]
        symbols[:, data] = np.random.default_rng(0).permutation(symbols[:, data], axis=1)
        file["symbols"][...] = symbols


def test_json_goes_to_stdout_alone_and_all_else_to_stderr(
    toy_zip: Path, recording: tuple[Path, np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("evaluate", "--bundle", toy_zip, "--recording", recording[0], "--json", "-") == 0
    told = capsys.readouterr()
    assert json.loads(told.out)["pages"] == 4
    assert "AIR" in told.err
    assert not Path("-").exists()


def test_evaluate_leaves_out_pages_that_the_bundle_has_seen_and_says_so(
    recording: tuple[Path, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with Recording.open(recording[0]) as file:
        hashes = [file.page_hash(index) for index in range(4)]
    some = toy.write_toy_bundle(tmp_path / "some.zip", calibrated_pages=hashes[:1], trained_pages=hashes[1:2])
    data = evaluate(some, recording[0])
    assert (data["pages"], data["pages_left_out"]) == (2, 2)
    every = toy.write_toy_bundle(tmp_path / "all.zip", trained_pages=hashes)
    assert run("evaluate", "--bundle", every, "--recording", recording[0]) == 2
    assert f"recording {recording[0]}" in capsys.readouterr().err


COUNTS = ("in_phase", "quadrature", "reference_in_phase", "reference_quadrature")


def store_as_sixteen_bits(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        for name in COUNTS:
            data = file[name][()].astype(np.uint16)
            del file[name]
            file[name] = data


def test_evaluate_uses_the_recordings_own_pilots_and_refuses_another_bit_depth(toy_zip: Path, tmp_path: Path) -> None:
    """A device whose symbols know nothing of the seeded pattern."""
    symbols = np.random.default_rng(3).integers(16, size=(2, *toy.PAGE)).astype(np.uint8)
    device, path = toy.ToyDevice(), tmp_path / "foreign.h5"
    with RecordingWriter(path, toy.PROFILE, 16, 8, device.references()) as writer:
        for index, page in enumerate(symbols):
            writer.append(page, device.page(page, 16, 1.0 + index))
    with h5py.File(path, "r+") as file:
        file.pop("pilots", None)
        file["pilots"] = toy.OWN_MASK
    data = evaluate(toy_zip, path)
    assert data["symbol_error_rate"] == 0
    assert data["symbols_per_page"] == int((~toy.OWN_MASK).sum())
    store_as_sixteen_bits(path)
    with h5py.File(path, "r+") as file:
        file.attrs["camera_bit_depth"] = 10
    assert run("evaluate", "--bundle", toy_zip, "--recording", path) == 2


@pytest.fixture
def with_bad_pages(recording: tuple[Path, np.ndarray]) -> Path:
    """The recording with a black page and one whose counts lie in no 8 bits."""
    store_as_sixteen_bits(recording[0])
    with h5py.File(recording[0], "r+") as file:
        file["quadrature"][1] = 0
        file["in_phase"][3, 5, 5] = 256
    return recording[0]


def test_evaluate_goes_on_after_bad_pages_and_names_and_counts_them(
    toy_zip: Path, with_bad_pages: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    random = np.random.default_rng(0).integers(16, size=(4, *toy.PAGE))
    with h5py.File(with_bad_pages, "r+") as file:
        file["symbols"][2] = random[2]
    data = evaluate(toy_zip, with_bad_pages, 2)
    assert (data["pages"], data["pages_unconfirmed"], data["pages_left_out"], len(data["air_per_page"])) == (1, 1, 0, 1)
    refused = [(page["page"], page["loss"], page["recalibration_due"]) for page in data["refused_pages"]]
    assert [page for page, _, _ in refused] == [1, 2, 3]
    assert refused[1] == (2, "PILOTS_DISAGREE", True)
    assert data["air_bits_per_symbol"] > 2
    told = capsys.readouterr().err
    assert f"{with_bad_pages}: got 3" in told
    for page in (1, 2, 3):
        assert f"page {page}: " in told
    with h5py.File(with_bad_pages, "r+") as file:
        file["symbols"][...] = random
    data = evaluate(toy_zip, with_bad_pages, 2)
    assert (data["pages"], data["pages_unconfirmed"], len(data["refused_pages"])) == (0, 2, 4)


def test_offline_recalibration_writes_a_better_bundle(
    toy_zip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cli_recalibrate, "refit", toy.fit_references)
    toy.write_toy_recording(tmp_path / "d.h5", toy.ToyDevice((150.0, 62.0)), 16, 5)
    arguments = ["recalibrate", "--bundle", toy_zip, "--recording", tmp_path / "d.h5", "--out", tmp_path / "new.zip"]
    assert run(*arguments, "--json", tmp_path / "r.json") == 0
    data = json.loads((tmp_path / "r.json").read_text())
    assert (data["version"], data["pages_used"], data["angle_deg"]) == ("toy-1+r1", 2, 0.5)
    assert (data["coherence_before"], data["coherence_after"]) == (0.4, 0.9)
    assert (data["verdict"], data["bits_lost"]) == (EXPLAINED.verdict, EXPLAINED.bits_lost)
    before, after = (evaluate(bundle, tmp_path / "d.h5") for bundle in (toy_zip, tmp_path / "new.zip"))
    assert after["pages_left_out"] == 2
    assert after["air_bits_per_symbol"] > before["air_bits_per_symbol"] + 0.5
    assert run(*arguments) == 2  # never overwrites


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ("recalibrate --bundle B", "--out"),
        ("recalibrate --bundle B --recording R --out both --json both", "--out"),
        ("recalibrate --bundle B --recording R --out X --version v/2", "--version"),
        ("recalibrate --target 127.0.0.1:9 --send", "--send"),
        ("recalibrate --target 127.0.0.1:9 --bundle B", "--target"),
        ("recalibrate --bundle B --detach", "--detach"),
        ("recalibrate --bundle B --timeout 5", "--timeout"),
        ("jobs --target 127.0.0.1:9 --watch a --cancel b", "--watch"),
        ("encode F --out P.h5", "--bundle"),
        ("encode F --out P.h5 --bundle B --profile bench", "--profile"),
        ("encode F --out P.h5 --profile bench", "--code"),
        ("encode F --out P.h5 --profile bench --code gone.toml", "gone.toml"),
        ("bulk recalibrate OUT --steps 20", "--steps"),
        ("bulk recalibrate OUT --deep --recordings b.h5", "--deep"),
        ("bulk decode OUT --part 2/2", "--part"),
        ("bulk decode OUT --address auto", "--address"),
        ("bulk decode OUT --metrics 0.0.0.0:0", "--metrics"),
        ("bulk decode OUT --metrics unix:/tmp/x", "--metrics"),
        ("bulk decode OUT --metrics-file bulk.txt", "--metrics-file"),
        ("decode --target 127.0.0.1:9", "--recording"),
        ("decode --target 127.0.0.1:9 --source --out -", "--out -"),
    ],
)
def test_options_that_contradict_each_other_are_named(
    arguments: str, named: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(*arguments.split()) == 2
    assert list(tmp_path.iterdir()) == []
    assert named in capsys.readouterr().err


def test_decode_sends_a_recording_and_keeps_the_symbols(
    service: Running, recording: tuple[Path, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, report = tmp_path / "decoded.h5", tmp_path / "d.json"
    where = ["decode", "--target", service.server.target, "--recording", recording[0]]
    assert run(*where, "--out", out, "--json", report) == 0
    with h5py.File(out) as file:
        assert file["symbols"].shape == file["confidence"].shape == (4, *toy.PAGE)
        assert (file["symbols"][()] == recording[1]).mean() > 0.9
        assert dict(file.attrs) == {"format": "lightpage-decoded", "version": 1, "levels": 16}
        assert set(file) == {"symbols", "confidence", "pages", "model_versions"}
        assert file["pages"][()].tolist() == [0, 1, 2, 3]
        assert file["model_versions"].asstr()[()].tolist() == ["toy-1"] * 4
    pages = json.loads(report.read_text())["pages"]
    assert [page["page"] for page in pages] == [0, 1, 2, 3]
    assert all(0 < page["air_bits_per_symbol"] <= 4 and page["total_s"] > 0 for page in pages)
    assert "carry nothing" not in capsys.readouterr().err
    assert run(*where, "--out", out) == 2
    assert run(*where, "--pages", "5") == 2
    shuffle_data(recording[0])
    assert run(*where) == 0
    assert "carry nothing" in capsys.readouterr().err


@pytest.mark.parametrize("room", [0, 3_000, 20_000])
def test_a_full_disk_leaves_the_earlier_file_and_no_other(tmp_path: Path, room: int) -> None:
    path = tmp_path / "d.h5"
    path.write_text("earlier")
    writing = pytest.raises(SurroundingsError, match=r"d\.h5")
    with full_disk(room), writing, DecodedWriter(path, 16) as writer:
        for seed in range(3):
            rng = np.random.default_rng(seed)
            symbols = rng.integers(0, 16, (40, 50), dtype=np.uint8)
            writer.append(symbols, rng.random((40, 50), np.float32), "1", None)
    assert path.read_text() == "earlier"
    assert list(tmp_path.iterdir()) == [path]


def test_decode_goes_on_after_bad_pages_and_ends_with_their_names(
    service: Running, with_bad_pages: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, report = tmp_path / "decoded.h5", tmp_path / "d.json"
    where = ["decode", "--target", service.server.target, "--recording", with_bad_pages, "--out", out, "--json", report]
    assert run(*where) == 2
    data = json.loads(report.read_text())
    assert [page["page"] for page in data["pages"]] == [0, 2]
    assert [page["page"] for page in data["refused_pages"]] == [1, 3]
    with h5py.File(out) as file:
        assert list(file["pages"]) == [0, 2]
    assert f"{with_bad_pages}: got 2" in capsys.readouterr().err
    with h5py.File(with_bad_pages, "r+") as file:
        file["quadrature"][...] = 0
    out.unlink()
    assert run(*where) == 2
    data = json.loads(report.read_text())
    assert (data["pages"], len(data["refused_pages"]), data["pages_unconfirmed"]) == ([], 4, 0)
    assert not out.exists()


def test_decode_uses_the_devices_own_pilots_and_refuses_pages_where_they_disagree(
    start: Start, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Pages of a device whose pilots are fixed phases, sent and read, without a word of what was written."""
    device, path = toy.ToyDevice(noise=2.0), tmp_path / "own.h5"
    symbols = np.random.default_rng(3).integers(16, size=(2, *toy.PAGE)).astype(np.uint8)
    good = toy.own_pilots_page(device, symbols[0], 16, 2.0)
    lost = device.page(symbols[1], 16, 2.0)
    with RecordingWriter(path, toy.PROFILE, 16, 8, device.references()) as writer:
        for page, pair in zip(symbols, (good, lost), strict=True):
            writer.append(page, pair)
    with h5py.File(path, "r+") as file:
        for name in ("symbols", "pilots"):
            file.pop(name, None)
    bundle, out = toy.write_own_pilots_bundle(tmp_path / "own.zip"), tmp_path / "out.h5"
    service = start(bundle, source=open_source(f"recording:{path}"))
    for where in (["--recording", path], ["--source", "--pages", "2"]):
        assert run("decode", "--target", service.server.target, *where, "--out", out, "--force") == 2
        with h5py.File(out) as file:
            assert (file["symbols"][0] == symbols[0])[~toy.OWN_MASK].all()
            assert list(file["pages"]) == [0]
        assert "1 of 2" in capsys.readouterr().err


@pytest.mark.parametrize("end", [KeyboardInterrupt, LightpageError("service", "no connection", "one")])
def test_pages_of_the_source_that_came_before_the_end_are_kept(
    end: BaseException | type[BaseException],
    start: Start,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """It would show other pages the next time."""
    read, count = PagesClient.read, iter(range(100))

    def ending(self: PagesClient, **options: Any) -> RemotePage:
        if next(count) == 2:
            raise end
        return read(self, **options)

    monkeypatch.setattr(PagesClient, "read", ending)
    out, figures = tmp_path / "decoded.h5", tmp_path / "d.json"
    asked = ["decode", "--target", start().server.target, "--source", "--pages", "5", "--out", out, "--json", figures]
    assert run(*asked) == (130 if end is KeyboardInterrupt else 2)
    told = capsys.readouterr()
    assert "2 of 5" in told.err
    pages = json.loads(figures.read_text())["pages"]
    assert [(page["page"], page["symbol_error_rate"]) for page in pages] == [(0, 0), (1, 0)]
    with h5py.File(out) as file:
        assert file["symbols"].shape[0] == 2
    assert ("before is kept" in told.err) == (end is KeyboardInterrupt)


def test_recalibrate_and_rollback_work_on_a_running_service(
    start: Start, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    service, report = start(), tmp_path / "r.json"
    toy.write_toy_recording(tmp_path / "known.h5", toy.ToyDevice(), 16, 5)
    sent = ["--recording", tmp_path / "known.h5", "--send"]
    for more, version in (([], "toy-1+r1"), (["--recording", "known.h5"], "toy-1+r2"), (sent, "toy-1+r3")):
        assert run("recalibrate", "--target", service.server.target, *more, "--pages", "3", "--json", report) == 0
        told = json.loads(report.read_text())
        assert (told["version"], told["pages_used"]) == (version, 3)
    assert [run("rollback", "--target", service.server.target) for _ in range(3)] == [0, 0, 0]
    monkeypatch.setenv("LIGHTPAGE_CLIENT_TARGET", service.server.target)
    capsys.readouterr()
    for line, known in (
        ("models --json -", "models"),
        ("models list --json -", "models"),
        ("models forward --json -", "previous_version"),
        ("rollback --json -", "previous_version"),
        ("models pin toy-1 --json -", "pinned"),
        ("jobs --json -", "jobs"),
    ):
        assert run(*line.split()) == 0
        assert known in json.loads(capsys.readouterr().out)
    assert run("rollback") == 2
    assert run("recalibrate", "--bundle", "toy.zip") == 2  # offline, whatever service the environment names
    assert "no --recording, --out" in capsys.readouterr().err


def test_a_detached_job_is_named_listed_cancelled_and_watched(
    start: Start, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def told(*arguments: str | Path) -> str:
        assert run(*arguments, "--target", target) == 0
        return capsys.readouterr().out

    fit = SlowFit()
    target = start(fit=fit).server.target
    assert told("jobs") == "no jobs\n"
    job = told("recalibrate", "--detach", "--json", tmp_path / "j.json").strip()
    assert json.loads((tmp_path / "j.json").read_text()) == {"job": job}
    assert fit.entered.wait(60)
    assert f"{job}  running" in told("jobs")
    assert f"{job}  cancelled" in told("jobs", "--cancel", job)
    assert run("jobs", "--target", target, "--watch", job) == 2
    assert "cancelled" in capsys.readouterr().err
    fit.go.set()
    job = told("recalibrate", "--detach").strip()
    assert "toy-1+r1\n" in told("jobs", "--watch", job)
    line = told("jobs").splitlines()[0]
    assert line.startswith(f"{job}  done  ")
    assert "source  toy-1+r1" in line


def test_a_sent_recalibration_ends_with_its_command(
    start: Start, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    server = start(fit=SlowFit()).server
    toy.write_toy_recording(tmp_path / "here.h5", toy.ToyDevice(), 16, 2)
    where = ("--target", server.target, "--recording", tmp_path / "here.h5")
    assert run("recalibrate", *where, "--send", "--timeout", "1.5") == 2
    assert "deadline" in capsys.readouterr().err
    with LightpageClient(server.target) as client:
        assert eventually(lambda: {job.state for job in client.jobs.list()} <= {"CANCELLED"})
