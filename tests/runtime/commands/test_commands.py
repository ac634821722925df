"""The command line: loads little, says much, ends in one line, and stops when told."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import click
import h5py
import numpy as np
import pytest

from lightpage.cli import main as cli_main
from lightpage.cli.main import RESUME_KEY, LazyGroup, lightpage
from lightpage.errors import CalibrationError, LightpageError
from lightpage.page.pilots import Pilots
from lightpage.recording.reader import Recording, RecordingWriter
from runtime.acquisition.sources import open_source
from runtime.bundle.bundle import Bundle
from runtime.client.client import LightpageClient
from runtime.commands import recalibrate as cli_recalibrate
from runtime.commands.serve import stop_signals
from runtime.decoding.decoder import Decoder
from runtime.decoding.tracking import NoTracker
from runtime.rpc.server import LightpageServer
from runtime.service.dataplane import DataPlane
from runtime.service.recalibrator import Recalibrator
from runtime.service.registry import ModelRegistry
from runtime.service.store import ModelStore
from runtime.wire.pages import RemotePage
from tests.runtime import toy

ROOT = Path(__file__).resolve().parents[3]


def run(arguments: Sequence[str | Path], group: click.Group = lightpage) -> int:
    return cli_main.run(group, [str(argument) for argument in arguments])


@click.command()
def interrupted() -> None:
    click.get_current_context().meta[RESUME_KEY] = "call it with --resume"
    raise KeyboardInterrupt


@click.command()
def plainly_interrupted() -> None:
    raise KeyboardInterrupt


@click.command()
def terminated() -> None:
    os.kill(os.getpid(), signal.SIGTERM)
    signal.pause()


@click.command()
def needs_torch() -> None:
    raise ModuleNotFoundError("No module named 'torch'", name="torch")


@click.command()
def hungry() -> None:
    raise MemoryError("Unable to allocate 7 TiB")


@click.command()
def broken() -> None:
    raise ZeroDivisionError


def group_of(**points: str) -> LazyGroup:
    return LazyGroup([EntryPoint(name, value, cli_main.GROUP) for name, value in points.items()], name="lightpage")


HERE = "tests.runtime.commands.test_commands"


def test_the_overview_imports_no_command(capsys: pytest.CaptureFixture[str]) -> None:
    group = group_of(train="no_such_package.cli:train", serve="no_such_package.cli:serve")
    assert run(["--help"], group) == 0
    shown = capsys.readouterr().out
    assert "Train a decoder" in shown
    assert "Run the service" in shown


def test_a_missing_extra_is_named(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    for module, extra in (("torch", "train"), ("onnxruntime", "cpu")):
        (tmp_path / f"wants_{module}.py").write_text(f"import {module}.not_there\n")
        monkeypatch.setitem(sys.modules, module, None)
        assert run(["x"], group_of(x=f"wants_{module}:x")) == 2
        assert f"'lightpage[{extra}]'" in capsys.readouterr().err
    assert run(["x"], group_of(x=f"{HERE}:needs_torch")) == 2
    assert "'lightpage[train]'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "status", "said"),
    [
        ("interrupted", 130, "call it with --resume"),
        ("plainly_interrupted", 130, "run the same command"),
        ("terminated", 143, "run the same command"),
        ("hungry", 2, "7 TiB"),
    ],
)
def test_what_ends_a_command_is_told_by_status_and_line(
    command: str, status: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = signal.getsignal(signal.SIGTERM)
    assert run(["x"], group_of(x=f"{HERE}:{command}")) == status
    assert said in capsys.readouterr().err
    assert signal.getsignal(signal.SIGTERM) == before


def test_nothing_that_is_read_is_written_and_nothing_is_written_twice(
    toy_zip: Path, recording: tuple[Path, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before, other = recording[0].read_bytes(), tmp_path / "folder" / ".." / recording[0].name
    (tmp_path / "folder").mkdir()
    both = tmp_path / "both"
    for arguments, named in (
        (["evaluate", "--bundle", toy_zip, "--recording", recording[0], "--json", other], "--json"),
        (["decode", "--target", "127.0.0.1:1", "--recording", recording[0], "--out", recording[0]], "--out"),
        (["recalibrate", "--bundle", toy_zip, "--recording", recording[0], "--out", both, "--json", both], "--out"),
        (["recalibrate", "--bundle", toy_zip, "--recording", recording[0], "--json", toy_zip], "--json"),
    ):
        assert run(arguments) == 2
        assert f"error: {named}" in capsys.readouterr().err
    assert recording[0].read_bytes() == before
    assert not both.exists()


def test_an_unforeseen_error_keeps_its_traceback() -> None:
    with pytest.raises(ZeroDivisionError):
        run(["x"], group_of(x=f"{HERE}:broken"))


def test_wrong_usage_is_status_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["nonsense"]) == 2
    assert run(["evaluate"]) == 2
    assert "--recording" in capsys.readouterr().err


def test_the_installed_command_finds_the_runtimes_subcommands() -> None:
    assert {"serve", "decode", "evaluate", "recalibrate", "rollback"} <= set(lightpage.points)  # type: ignore[attr-defined]
    for name in ("serve", "decode", "evaluate", "recalibrate", "rollback"):
        assert isinstance(lightpage.points[name].load(), click.Command)  # type: ignore[attr-defined]


@pytest.fixture
def recording(tmp_path: Path) -> tuple[Path, np.ndarray]:
    return tmp_path / "r.h5", toy.write_toy_recording(tmp_path / "r.h5", toy.ToyDevice(noise=30.0), 16, 4)


def evaluate(bundle: Path, recording: Path, out: Path) -> dict[str, Any]:
    assert run(["evaluate", "--bundle", bundle, "--recording", recording, "--json", out, "--threads", "1"]) == 0
    data: dict[str, Any] = json.loads(out.read_text())
    return data


def test_evaluate_writes_the_promised_figures(
    toy_zip: Path, recording: tuple[Path, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = evaluate(toy_zip, recording[0], tmp_path / "e.json")
    data_symbols = toy.PAGE[0] * toy.PAGE[1] - int(Bundle.open(toy_zip).pilot_mask.sum())
    assert (data["pages"], data["pages_left_out"], data["levels"]) == (4, 0, 16)
    assert data["symbols_per_page"] == data_symbols
    air = data["air_bits_per_symbol"]
    assert isinstance(air, float)
    assert 2 < air <= 4
    assert data["page_kB"] == pytest.approx(air * data_symbols / 8000)
    for key in ("own_mi_bits_per_symbol", "gmi_bits_per_symbol", "symbol_error_rate", "ece", "seconds_per_page"):
        assert isinstance(data[key], float)
    assert "AIR" in capsys.readouterr().out


def test_evaluate_leaves_out_pages_that_the_bundle_has_seen_and_says_so(
    recording: tuple[Path, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with Recording.open(recording[0]) as file:
        hashes = [file.page_hash(index) for index in range(4)]
    some = toy.write_toy_bundle(tmp_path / "some.zip", calibrated_pages=hashes[:1], trained_pages=hashes[1:2])
    data = evaluate(some, recording[0], tmp_path / "e.json")
    assert (data["pages"], data["pages_left_out"]) == (2, 2)
    every = toy.write_toy_bundle(tmp_path / "all.zip", trained_pages=hashes)
    assert run(["evaluate", "--bundle", every, "--recording", recording[0]]) == 2
    assert f"recording {recording[0]}" in capsys.readouterr().err


COUNTS = ("in_phase", "quadrature", "reference_in_phase", "reference_quadrature")


def change(path: Path, edit: Callable[[np.ndarray], np.ndarray]) -> None:
    """Store other counts in a recording."""
    with h5py.File(path, "r+") as file:
        for name in COUNTS:
            data = edit(file[name][()])
            del file[name]
            file[name] = data


def test_evaluate_takes_eight_bit_counts_in_sixteen_bits(
    toy_zip: Path, recording: tuple[Path, np.ndarray], tmp_path: Path
) -> None:
    narrow = evaluate(toy_zip, recording[0], tmp_path / "n.json")
    change(recording[0], lambda counts: counts.astype(np.uint16))
    wide = evaluate(toy_zip, recording[0], tmp_path / "w.json")
    assert wide["air_bits_per_symbol"] == narrow["air_bits_per_symbol"]


def test_evaluate_uses_the_recordings_own_pilots(toy_zip: Path, tmp_path: Path) -> None:
    """A device whose symbols know nothing of the seeded pattern."""
    symbols = np.random.default_rng(3).integers(16, size=(2, *toy.PAGE)).astype(np.uint8)
    mask = np.zeros(toy.PAGE, bool)
    mask[::5, ::5] = True
    device = toy.ToyDevice()
    pairs = [device.page(page, 16, 1.0 + index) for index, page in enumerate(symbols)]
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file.attrs.update({"format": "lightpage-recording", "version": 1, "camera_bit_depth": 8, "levels": 16})
        file["symbols"], file["pilots"] = symbols, mask
        file["in_phase"] = np.stack([pair.in_phase for pair in pairs])
        file["quadrature"] = np.stack([pair.quadrature for pair in pairs])
        references = device.references()
        file["reference_in_phase"], file["reference_quadrature"] = references.in_phase, references.quadrature
    data = evaluate(toy_zip, tmp_path / "foreign.h5", tmp_path / "e.json")
    assert data["symbol_error_rate"] == 0
    assert data["symbols_per_page"] == int((~mask).sum())


def without_symbols(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file["symbols"]


def of_ten_bits(path: Path) -> None:
    change(path, lambda counts: counts.astype(np.uint16))
    with h5py.File(path, "r+") as file:
        file.attrs["camera_bit_depth"] = 10


def black(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["quadrature"][...] = 0


@pytest.mark.parametrize(
    ("edit", "named"),
    [
        (without_symbols, "no symbols"),
        (of_ten_bits, "10 bits"),
        (lambda path: path.write_bytes(path.read_bytes()[:5000]), "HDF5"),
        (black, "page 1: quad"),
        (lambda path: change(path, lambda counts: counts[..., :90]), "pixels"),
    ],
)
def test_evaluate_refuses_what_it_cannot_measure_in_one_line(
    edit: Callable[[Path], None],
    named: str,
    toy_zip: Path,
    recording: tuple[Path, np.ndarray],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path, out = recording[0], tmp_path / "e.json"
    edit(path)
    assert run(["evaluate", "--bundle", toy_zip, "--recording", path, "--json", out]) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "error:" in line]
    assert named in line
    if edit is black:  # each page was looked at, and the reasons are kept
        assert [page["page"] for page in json.loads(out.read_text())["refused_pages"]] == [0, 1, 2, 3]
    else:
        assert not out.exists()


def test_evaluate_warns_where_a_bundle_reads_nothing(
    toy_zip: Path, recording: tuple[Path, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for worth in (True, False):
        assert (evaluate(toy_zip, recording[0], tmp_path / "e.json")["air_bits_per_symbol"] > 0) is worth
        assert ("carry nothing" in capsys.readouterr().err) is not worth
        with h5py.File(recording[0], "r+") as file:
            shuffle_data(file)


def shuffle_data(file: h5py.File) -> None:
    """Write down other symbols than were written, the pilots left as they are."""
    symbols, data = file["symbols"][()], ~Pilots.of_profile(toy.PROFILE, 16).mask
    symbols[:, data] = np.random.default_rng(0).permutation(symbols[:, data], axis=1)
    file["symbols"][...] = symbols


def test_evaluate_names_and_counts_pages_whose_pilots_contradict_what_was_decoded(
    toy_zip: Path, recording: tuple[Path, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with h5py.File(recording[0], "r+") as file:
        symbols = file["symbols"][()]
        symbols[1] = np.random.default_rng(0).integers(16, size=toy.PAGE)
        file["symbols"][...] = symbols
        pages = len(symbols)
    where, report = ["--bundle", toy_zip, "--recording", recording[0]], tmp_path / "e.json"
    assert run(["evaluate", *where, "--json", report]) == 2
    assert f"got 1 of {pages}" in capsys.readouterr().err
    figures = json.loads(report.read_text())
    assert (figures["pages"], figures["pages_unconfirmed"]) == (pages - 1, 1)
    refused = [(page["page"], page["loss"], page["recalibration_due"]) for page in figures["refused_pages"]]
    assert refused == [(1, "PILOTS_DISAGREE", True)]
    assert figures["air_bits_per_symbol"] > 2
    with h5py.File(recording[0], "r+") as file:
        file["symbols"][...] = np.random.default_rng(0).integers(16, size=(pages, *toy.PAGE))
    assert run(["evaluate", *where, "--json", report]) == 2
    figures = json.loads(report.read_text())
    assert (figures["pages"], figures["pages_unconfirmed"], len(figures["refused_pages"])) == (0, pages, pages)


@pytest.fixture
def with_bad_pages(recording: tuple[Path, np.ndarray]) -> Path:
    """The recording with a black page and one whose counts lie in no 8 bits."""
    change(recording[0], lambda counts: counts.astype(np.uint16))
    with h5py.File(recording[0], "r+") as file:
        file["quadrature"][1] = 0
        file["in_phase"][3, 5, 5] = 256
    return recording[0]


def test_evaluate_goes_on_after_bad_pages_and_ends_with_their_names(
    toy_zip: Path, with_bad_pages: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "e.json"
    assert run(["evaluate", "--bundle", toy_zip, "--recording", with_bad_pages, "--json", out, "--threads", "1"]) == 2
    data = json.loads(out.read_text())
    assert (data["pages"], data["pages_left_out"], len(data["air_per_page"])) == (2, 0, 2)
    assert [page["page"] for page in data["refused_pages"]] == [1, 3]
    assert "black" in data["refused_pages"][0]["reason"]
    assert "256" in data["refused_pages"][1]["reason"]
    shown = capsys.readouterr()
    assert "AIR" in shown.out
    assert f"{with_bad_pages}: got 2" in shown.err
    assert "page 1: " in shown.err
    assert "page 3: " in shown.err


def test_offline_recalibration_writes_a_better_bundle(
    toy_zip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cli_recalibrate, "refit", toy.fit_references)
    toy.write_toy_recording(tmp_path / "d.h5", toy.ToyDevice((150.0, 62.0)), 16, 5)
    arguments = ["recalibrate", "--bundle", toy_zip, "--recording", tmp_path / "d.h5", "--out", tmp_path / "new.zip"]
    assert run([*arguments, "--json", tmp_path / "r.json"]) == 0
    data = json.loads((tmp_path / "r.json").read_text())
    assert (data["version"], data["pages_used"], data["angle_deg"]) == ("toy-1+r1", 2, 0.5)
    assert (data["coherence_before"], data["coherence_after"]) == (0.4, 0.9)
    assert data["seconds"] > 0
    before = evaluate(toy_zip, tmp_path / "d.h5", tmp_path / "b.json")
    after = evaluate(tmp_path / "new.zip", tmp_path / "d.h5", tmp_path / "a.json")
    assert after["pages_left_out"] == 2
    assert after["air_bits_per_symbol"] > before["air_bits_per_symbol"] + 0.5  # type: ignore[operator]
    assert run(arguments) == 2  # never overwrites


def test_offline_recalibration_writes_nothing_for_wrong_pilots_or_an_impossible_version(
    toy_zip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli_recalibrate, "refit", toy.fit_references)
    toy.write_toy_recording(tmp_path / "d.h5", toy.ToyDevice(), 16, 3)
    arguments = ["recalibrate", "--bundle", toy_zip, "--recording", tmp_path / "d.h5", "--out", tmp_path / "new.zip"]
    for more, named in ((["--version", "v 2"], "--version: got 'v 2'"), (["--timeout", "5"], "--timeout: got")):
        assert run([*arguments, *more]) == 2
        assert named in capsys.readouterr().err
    assert run(arguments[:3]) == 2
    assert "--out" in capsys.readouterr().err
    with h5py.File(tmp_path / "d.h5", "r+") as file:
        file["symbols"][...] = np.random.default_rng(0).integers(16, size=file["symbols"].shape)
    assert run(arguments) == 2
    assert not (tmp_path / "new.zip").exists()


@pytest.fixture
def service(toy_zip: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LightpageServer]:
    """A service that reads toy pages, and has a recording to recalibrate from."""
    toy.write_toy_recording((folder := tmp_path_factory.mktemp("known")) / "known.h5", toy.ToyDevice(), 16, 5)
    plane = DataPlane(ModelRegistry(Decoder(Bundle.open(toy_zip), threads=1)), toy.ToySource(toy.ToyDevice()))
    with LightpageServer(plane, Recalibrator(plane, toy.fit_references, folder)) as server:
        yield server


def test_decode_sends_a_recording_and_keeps_the_symbols(
    service: LightpageServer, recording: tuple[Path, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, report = tmp_path / "decoded.h5", tmp_path / "d.json"
    where = ["--target", service.target, "--recording", recording[0]]
    assert run(["decode", *where, "--out", out, "--json", report]) == 0
    with h5py.File(out) as file:
        assert file["symbols"].shape == file["confidence"].shape == (4, *toy.PAGE)
        assert (file["symbols"][()] == recording[1]).mean() > 0.9
        assert dict(file.attrs) == {"format": "lightpage-decoded", "version": 1, "levels": 16}
        assert set(file) == {"symbols", "confidence", "pages", "model_versions"}
        assert file["pages"][()].tolist() == [0, 1, 2, 3]
        assert file["model_versions"].asstr()[()].tolist() == ["toy-1"] * 4
    assert out.stat().st_mode & 0o777 == 0o644
    pages = json.loads(report.read_text())["pages"]
    assert [page["page"] for page in pages] == [0, 1, 2, 3]
    assert all(0 < page["air_bits_per_symbol"] <= 4 and page["total_s"] > 0 for page in pages)
    assert "toy-1" in capsys.readouterr().out


def test_decode_leaves_the_pages_of_an_interrupted_recording_of_that_name_alone(
    service: LightpageServer, recording: tuple[Path, np.ndarray], tmp_path: Path
) -> None:
    references = toy.ToyDevice().references()
    begun = RecordingWriter(tmp_path / "out.h5", toy.PROFILE, 16, 8, references)
    begun.append(None, references)
    begun.abandon()
    where = ["--target", service.target, "--recording", recording[0]]
    assert run(["decode", *where, "--out", tmp_path / "out.h5"]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.h5", "out.h5.partial", "r.h5"]
    resumed = RecordingWriter.resume(tmp_path / "out.h5", toy.PROFILE, 16, 8, references)
    assert resumed.pages == 1
    resumed.abandon()


def test_decode_goes_on_after_bad_pages_and_ends_with_their_names(
    service: LightpageServer, with_bad_pages: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, report = tmp_path / "decoded.h5", tmp_path / "d.json"
    where = ["--target", service.target, "--recording", with_bad_pages]
    assert run(["decode", *where, "--out", out, "--json", report]) == 2
    data = json.loads(report.read_text())
    assert [page["page"] for page in data["pages"]] == [0, 2]
    assert [page["page"] for page in data["refused_pages"]] == [1, 3]
    with h5py.File(out) as file:
        assert file["symbols"].shape == (2, *toy.PAGE)
        assert list(file["pages"]) == [0, 2]
    assert f"{with_bad_pages}: got 2" in capsys.readouterr().err
    black(with_bad_pages)
    out.unlink()
    assert run(["decode", *where, "--out", out, "--json", report]) == 2
    data = json.loads(report.read_text())
    assert (data["pages"], len(data["refused_pages"]), data["pages_unconfirmed"]) == ([], 4, 0)
    assert not out.exists()


def test_decode_warns_of_symbols_that_are_not_the_pages_and_refuses_those_of_another_page_shape(
    service: LightpageServer, recording: tuple[Path, np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    where = ["decode", "--target", service.target, "--recording", recording[0]]
    assert run([*where, "--pages", "9"]) == 2
    assert "got 4 pages" in capsys.readouterr().err
    with h5py.File(recording[0], "r+") as file:
        symbols = file["symbols"][()]
        shuffle_data(file)
    assert run(where) == 0
    assert "carry nothing" in capsys.readouterr().err
    with h5py.File(recording[0], "r+") as file:
        del file["symbols"]
        file["symbols"] = symbols[:, 1:]
    assert run(where) == 2
    assert f"{symbols.shape[1] - 1} x {symbols.shape[2]}" in capsys.readouterr().err


def test_decode_reads_the_services_source(service: LightpageServer, tmp_path: Path) -> None:
    report = tmp_path / "d.json"
    assert run(["decode", "--target", service.target, "--source", "--pages", "3", "--json", report]) == 0
    pages = json.loads(report.read_text())["pages"]
    assert [page["page"] for page in pages] == [0, 1, 2]
    assert all(page["symbol_error_rate"] == 0 for page in pages)


def test_decode_uses_the_devices_own_pilots_and_refuses_pages_where_they_disagree(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
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
            if name in file:
                del file[name]
    decoder = Decoder.load(toy.write_own_pilots_bundle(tmp_path / "own.zip"), threads=1)
    plane = DataPlane(ModelRegistry(decoder), open_source(f"recording:{path}"))
    out = tmp_path / "out.h5"
    with LightpageServer(plane, Recalibrator(plane, toy.fit_references)) as server:
        for where in (["--recording", path], ["--source", "--pages", "2"]):
            assert run(["decode", "--target", server.target, *where, "--out", out]) == 2
            with h5py.File(out) as file:
                assert (file["symbols"][0] == symbols[0])[~toy.OWN_MASK].all()
                assert list(file["pages"]) == [0]
            (error,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("lightpage: error")]
            assert "1 of 2" in error
            assert "page 1" in error


def test_recalibrate_and_rollback_work_on_a_running_service(service: LightpageServer, tmp_path: Path) -> None:
    report = tmp_path / "r.json"
    for more, version in (([], "toy-1+r1"), (["--recording", "known.h5"], "toy-1+r2")):
        assert run(["recalibrate", "--target", service.target, *more, "--pages", "3", "--json", report]) == 0
        told = json.loads(report.read_text())
        assert (told["version"], told["pages_used"]) == (version, 3)
    assert run(["rollback", "--target", service.target]) == 0
    assert run(["rollback", "--target", service.target]) == 0
    assert run(["rollback", "--target", service.target]) == 2


def test_recalibrate_waits_for_a_service_as_long_as_it_is_told(toy_zip: Path) -> None:
    go = threading.Event()

    def waits(*arguments: object) -> object:
        go.wait()
        return toy.fit_references(*arguments)  # type: ignore[arg-type]

    plane = DataPlane(ModelRegistry(Decoder(Bundle.open(toy_zip), threads=1)), toy.ToySource(toy.ToyDevice()))
    with LightpageServer(plane, Recalibrator(plane, waits)) as server:  # type: ignore[arg-type]
        for seconds in ("0.2", "0"):
            assert run(["recalibrate", "--target", server.target, "--timeout", seconds]) == 2
        go.set()


@pytest.mark.parametrize("end", [KeyboardInterrupt, LightpageError("service", "no connection", "one")])
def test_pages_of_the_source_that_came_before_the_end_are_kept(
    end: BaseException | type[BaseException],
    service: LightpageServer,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """It would show other pages the next time."""
    read, count = LightpageClient.read_page, iter(range(100))

    def ending(self: LightpageClient, **options: Any) -> RemotePage:
        if next(count) == 2:
            raise end
        return read(self, **options)

    monkeypatch.setattr(LightpageClient, "read_page", ending)
    out, figures = tmp_path / "decoded.h5", tmp_path / "d.json"
    arguments = ["decode", "--target", service.target, "--source", "--pages", "5", "--out", out, "--json", figures]
    assert run(arguments) == (130 if end is KeyboardInterrupt else 2)
    told = capsys.readouterr()
    assert "2 of 5" in told.err
    assert len(json.loads(figures.read_text())["pages"]) == 2
    with h5py.File(out) as file:
        assert file["symbols"].shape[0] == 2
    assert ("before is kept" in told.err) == (end is KeyboardInterrupt)


def test_what_is_interrupted_leaves_nothing_half_written(
    service: LightpageServer,
    recording: tuple[Path, np.ndarray],
    toy_zip: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupting(*_: object) -> None:
        raise KeyboardInterrupt

    figures, frames = ["--json", tmp_path / "figures.json"], Recording.frames
    monkeypatch.setattr(Recording, "frames", lambda file, page: interrupting() if page == 2 else frames(file, page))
    decode = ["decode", "--target", service.target, "--out", tmp_path / "decoded.h5"]
    for command in (["evaluate", "--bundle", toy_zip], decode):
        assert run([*command, "--recording", recording[0], *figures]) == 130
    monkeypatch.setattr(LightpageServer, "start", interrupting)
    assert run(["bench", "--bundle", toy_zip, *figures]) == 130
    assert [path.name for path in tmp_path.iterdir()] == ["r.h5"]


def test_a_command_without_a_service_or_a_choice_says_so(
    recording: tuple[Path, np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["decode", "--target", "127.0.0.1:9", "--recording", recording[0]]) == 2
    assert "no connection" in capsys.readouterr().err
    assert run(["decode", "--target", "127.0.0.1:9"]) == 2
    assert "neither --recording" in capsys.readouterr().err


class Served:
    """`lightpage serve` in a process of its own."""

    def __init__(self, *arguments: str | Path) -> None:
        command = [sys.executable, "-u", "-m", "lightpage.cli.main", "serve", "--address", "127.0.0.1:0"]
        self.process = subprocess.Popen(
            [*command, *map(str, arguments)], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def target(self) -> str:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if found := re.search(r"serving .* at (\S+)", line):
                return found[1]
        raise AssertionError(self.process.communicate(timeout=30)[1])

    def end(self, kind: signal.Signals) -> tuple[int, str, str]:
        self.process.send_signal(kind)
        out, err = self.process.communicate(timeout=30)
        return self.process.returncode, out, err


def test_serve_decodes_by_the_model_that_was_in_service_until_it_is_told_to_stop(
    toy_zip: Path, recording: tuple[Path, np.ndarray], tmp_path: Path
) -> None:
    store = ModelStore(tmp_path / "store", Bundle.open(toy_zip))
    store.remember(toy.write_toy_bundle(store.path_of("toy-1+r1"), version="toy-1+r1"))
    source = f"recording:{recording[0]}"
    served = Served("--bundle", toy_zip, "--source", source, "--metrics-port", "0", "--store", tmp_path / "store")
    try:
        with LightpageClient(served.target(), timeout_s=20) as client:
            assert (client.read_page(want_written=True).symbols == recording[1][0]).mean() > 0.9
            assert client.describe().model.version == "toy-1+r1"
            assert client.rollback()[0] == "toy-1"
        status, out, err = served.end(signal.SIGTERM)
        assert (status, "stopping" in out, "Traceback" in err) == (0, True, False)
    finally:
        served.process.kill()
        served.process.wait()
    assert store.last() is None


@pytest.mark.parametrize("kind", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_each_signal_stops_and_leaves_the_handlers_that_were_there(kind: signal.Signals) -> None:
    before = signal.getsignal(kind)
    with stop_signals() as wait_for_stop:
        os.kill(os.getpid(), kind)
        wait_for_stop()
    assert signal.getsignal(kind) == before


_STOPPED_AT_ANY_MOMENT = """
import os, random, signal, threading
from runtime.commands.serve import stop_signals

def ask(go, looks):
    go.wait()
    for _ in range(looks):
        pass
    os.kill(os.getpid(), signal.SIGTERM)

draw = random.Random(7)
for _ in range(1000):
    with stop_signals() as wait_for_stop:
        go = threading.Event()
        asking = threading.Thread(target=ask, args=(go, draw.randrange(5000)), daemon=True)
        asking.start()
        go.set()
        wait_for_stop()
        asking.join()
"""


def test_a_signal_is_never_missed_whenever_it_comes() -> None:
    stopped = subprocess.run([sys.executable, "-c", _STOPPED_AT_ANY_MOMENT], cwd=ROOT, timeout=60, check=False)
    assert stopped.returncode == 0


def test_a_stored_model_whose_calibration_is_bad_leaves_the_base_in_service(
    decoder: Decoder, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def tracker(made: Decoder) -> NoTracker:
        if made is not decoder:
            raise CalibrationError("bundle toy-1+r1: calibration", "no table", "a calibration document")
        return NoTracker(made)

    store, registry = ModelStore(tmp_path / "store", decoder.bundle), ModelRegistry(decoder, tracker)
    store.remember(toy.write_toy_bundle(store.path_of("toy-1+r1"), version="toy-1+r1"))
    DataPlane(registry, store=store).models.resume()
    assert [model.version for model in registry.models] == ["toy-1"]
    assert "bundle toy-1+r1: calibration" in caplog.text


def test_serve_refuses_a_damaged_bundle_and_a_folder_of_bundles_without_a_store_in_one_line(
    toy_zip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = bytearray(toy_zip.read_bytes())
    data[len(data) // 2] ^= 1
    (damaged := tmp_path / "damaged.zip").write_bytes(data)
    for options, named in (([damaged], str(damaged)), ([toy_zip, "--incoming", tmp_path], "--incoming")):
        assert run(["serve", "--bundle", *options]) == 2
        told = capsys.readouterr()
        assert (told.out, len(told.err.splitlines()), named in told.err) == ("", 1, True)


def test_a_hangup_that_was_to_be_ignored_is() -> None:
    """As nohup has it."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_signals() as wait_for_stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
            os.kill(os.getpid(), signal.SIGTERM)
            wait_for_stop()
    finally:
        signal.signal(signal.SIGHUP, before)
