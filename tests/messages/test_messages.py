"""Messages of the command line in the failures that people meet most, in one snapshot that `make messages` writes."""

import shlex
import socket
from collections.abc import Iterator
from pathlib import Path

import h5py
import pytest
from syrupy.assertion import SnapshotAssertion

from lightpage.cli import main as cli_main
from lightpage.device.profile import load_profile
from tests.lightpage.full_disk import full_disk
from tests.runtime import coded, toy

COMMANDS = {
    "no such option": "evaluate --bundel toy.zip",
    "a number out of range": "simulate --profile bench --pages 0 --out new.h5",
    "an option left out": "evaluate --bundle toy.zip",
    "no such file": "evaluate --bundle toy.zip --recording nowhere.h5",
    "not a recording": "evaluate --bundle toy.zip --recording text.h5",
    "a truncated recording": "evaluate --bundle toy.zip --recording truncated.h5",
    "a recording without symbols": "evaluate --bundle toy.zip --recording unknown.h5",
    "a recording of another camera": "evaluate --bundle toy.zip --recording narrow.h5",
    "a black page": "evaluate --bundle toy.zip --recording black.h5",
    "a saturated page": "evaluate --bundle toy.zip --recording saturated.h5",
    "cameras exchanged": "evaluate --bundle toy.zip --recording swapped.h5",
    "pages of a device that has drifted": "evaluate --bundle toy.zip --recording drifted.h5",
    "an output that exists": "simulate --profile bench --pages 1 --out good.h5",
    "an output in no folder": "simulate --profile bench --pages 1 --out nowhere/new.h5",
    "an output that is read": "evaluate --bundle toy.zip --recording good.h5 --json good.h5",
    "no such profile": "simulate --profile bensch --pages 1 --out new.h5",
    "a profile with a wrong word": "simulate --profile misspelt.toml --pages 1 --out new.h5",
    "a profile that no device can have": "simulate --profile impossible.toml --pages 1 --out new.h5",
    "a device with a wrong word": "simulate --profile bench --set slm.levls=3 --pages 1 --out new.h5",
    "not a bundle": "evaluate --bundle text.zip --recording good.h5",
    "a damaged bundle": "evaluate --bundle damaged.zip --recording good.h5",
    "a bundle without a code": "encode text.txt --bundle toy.zip --out pages.h5",
    "a recording of other levels": "recover --bundle coded.zip --recording good.h5 --out back",
    "too few known pages": "recalibrate --bundle toy.zip --recording one.h5 --out new.zip",
    "a service that is not there": "decode --target 127.0.0.1:{closed} --source",
    "an address that is taken": "serve --bundle toy.zip --address 127.0.0.1:{taken}",
    "settings with a wrong word": "serve --config misspelt-service.toml",
    "no such source": "record --source camra:cameras.toml --pages 1 --out new.h5",
    "cameras that nobody configured": "record --source camera:nowhere.toml --pages 1 --out new.h5",
    "a full disk": "simulate --profile bench --pages 1 --out full.h5",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files of a toy device, good ones and bad ones."""
    folder = tmp_path_factory.mktemp("messages")
    toy.write_toy_bundle(folder / "toy.zip")
    coded.bundle(folder / "coded.zip")
    (folder / "text.txt").write_text("no pages")
    for name in ("text.h5", "text.zip"):
        (folder / name).write_text("neither pages nor a bundle")
    (folder / "damaged.zip").write_bytes(_spoilt((folder / "toy.zip").read_bytes()))
    bench = load_profile("bench").to_toml()
    (folder / "misspelt.toml").write_text(bench.replace("pitch_m", "pich_m", 1))
    (folder / "impossible.toml").write_text(bench.replace("refractive_index = 1", "refractive_index = 0", 1))
    (folder / "misspelt-service.toml").write_text('bundel = "toy.zip"\n')
    for name, device, pages in (
        ("good", toy.ToyDevice(), 3),
        ("one", toy.ToyDevice(), 1),
        ("drifted", toy.ToyDevice((150.0, 62.0)), 3),
    ):
        toy.write_toy_recording(folder / f"{name}.h5", device, 16, pages)
    good = (folder / "good.h5").read_bytes()
    (folder / "truncated.h5").write_bytes(good[:5000])
    for name in ("unknown", "narrow", "black", "saturated", "swapped"):
        (folder / f"{name}.h5").write_bytes(good)
        with h5py.File(folder / f"{name}.h5", "r+") as file:
            _spoil(file, name)
    return folder


def _spoilt(archive: bytes) -> bytes:
    """The archive with one byte of its first file changed."""
    middle = archive.index(b"PK\x01\x02") // 3
    return archive[:middle] + bytes([archive[middle] ^ 1]) + archive[middle + 1 :]


def _spoil(file: h5py.File, name: str) -> None:
    frames = ("in_phase", "quadrature", "reference_in_phase", "reference_quadrature")
    if name == "unknown":
        del file["symbols"]
    elif name == "black":
        file["quadrature"][...] = 0
    elif name == "saturated":
        file["in_phase"][...] = 255
    else:
        kept = {frame: file[frame][()] for frame in frames}
        for number, frame in enumerate(frames):
            del file[frame]
            file[frame] = kept[frame][..., :90] if name == "narrow" else kept[frames[number ^ 1]]


@pytest.fixture
def ports() -> Iterator[dict[str, int]]:
    """A port of this machine where nobody listens, and one where somebody does."""
    with socket.socket() as closed, socket.socket() as taken:
        for each in (closed, taken):
            each.bind(("127.0.0.1", 0))
        taken.listen()
        yield {"closed": closed.getsockname()[1], "taken": taken.getsockname()[1]}


@pytest.mark.parametrize("situation", COMMANDS)
def test_what_a_failure_says(
    situation: str,
    folder: Path,
    ports: dict[str, int],
    snapshot: SnapshotAssertion,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setenv("COLUMNS", "100")
    words = shlex.split(COMMANDS[situation].format(**ports))
    with full_disk(100_000 if situation == "a full disk" else 1 << 30):
        status = cli_main.run(cli_main.lightpage, words)
    said = capsys.readouterr().err.replace(str(folder), "FOLDER")
    for name, port in ports.items():
        said = said.replace(str(port), name.upper())
    assert f"lightpage {COMMANDS[situation]}\n{said.strip()}\nstatus {status}\n" == snapshot
