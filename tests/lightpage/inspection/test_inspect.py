"""`lightpage inspect`: of any file it says what it is or what is wrong with it; nothing is trusted, nothing crashes."""

import io
import json
import os
import zipfile
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from PIL import Image
from scipy.io import savemat

from lightpage.cli import main
from lightpage.inspection.command import inspect
from lightpage.recording.decoded_file import DecodedWriter
from tests.lightpage.small import small_profile
from tests.runtime import coded, toy

FRAMES = np.random.default_rng(1).integers(0, 4000, (3, 40, 60), dtype=np.uint16)


def bomb(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("manifest.json", b" " * (1 << 26))


def huge_symbols(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.attrs["format"] = "lightpage-recording"
        file.create_dataset("symbols", (4, 1 << 18, 1 << 18), np.uint8, chunks=(1, 1024, 1024), compression="gzip")


def npy_of(path: Path, shape: str) -> None:
    header = f"{{'descr': '|u1', 'fortran_order': False, 'shape': {shape}}}\n".encode()
    path.write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)


def cut(path: Path, made: bytes, share: float = 0.5) -> None:
    path.write_bytes(made[: int(share * len(made))])


def mat73(path: Path) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        file["stack"] = FRAMES


def decoded(path: Path) -> None:
    with DecodedWriter(path, 16) as writer:
        writer.append(np.zeros((4, 5), np.uint8), np.ones((4, 5), np.float32), "v", None)


def zipped(**arrays: np.ndarray) -> bytes:
    packed = io.BytesIO()
    np.savez_compressed(packed, **arrays)
    return packed.getvalue()


def png_folder(path: Path) -> None:
    path.mkdir()
    for number, frame in enumerate(FRAMES):
        Image.fromarray(frame).save(path / f"{number}.png")


def run_folder(path: Path) -> None:
    path.mkdir()
    (path / "begun.json").write_text(json.dumps({"--profile": small_profile().to_toml()}))


def loop(path: Path) -> None:
    path.symlink_to(path.name)


def folder_loop(path: Path) -> None:
    path.mkdir()
    (path / "inner").symlink_to(path)


def sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 36)


def pages(path: Path) -> None:
    folder = path.parent / "coded"
    folder.mkdir()
    coded.pages(coded.bundle(folder / "coded.zip"), folder)
    (folder / "pages.h5").rename(path)


SAVED = io.BytesIO()
np.save(SAVED, FRAMES)
PROFILE = small_profile().to_toml()
MADE: dict[str, tuple[str, int, Callable[[Path], object]]] = {
    "B.zip": ("bundle", 0, toy.write_toy_bundle),
    "B": ("bundle", 0, toy.write_toy_bundle),
    "pages.h5": ("pages to write", 0, pages),
    "decoded.h5": ("decoded pages", 0, decoded),
    "run": ("unfinished training run", 2, run_folder),
    "p.toml": ("profile", 0, lambda path: path.write_text(PROFILE)),
    "code.toml": ("code of pages", 0, lambda path: path.write_text(coded.CODE.to_toml())),
    "rough.toml": ("state of a simulated device", 0, lambda path: path.write_text("[slm]\nphase_noise_rad = 0.1\n")),
    "stack.tif": ("TIFF", 0, lambda path: tifffile.imwrite(path, FRAMES, photometric="minisblack")),
    "a.npy": ("array of NumPy", 0, lambda path: path.write_bytes(SAVED.getvalue())),
    "a.npz": ("arrays of NumPy", 0, lambda path: path.write_bytes(zipped(one=FRAMES, two=FRAMES[0]))),
    "five.mat": ("MATLAB file", 0, lambda path: savemat(path, {"stack": FRAMES})),
    "seven.mat": ("MATLAB file", 0, mat73),
    "png": ("folder of pictures", 0, png_folder),
    "e.json": ("figures of an evaluation", 0, lambda path: path.write_text('{"air_bits_per_symbol": 6}')),
    "rgb.tif": ("RGB", 2, lambda path: tifffile.imwrite(path, np.zeros((40, 60, 3), np.uint8), photometric="rgb")),
    "half.npy": ("all of shape", 2, lambda path: cut(path, SAVED.getvalue())),
    "half.tif": ("TIFF", 2, lambda path: path.write_bytes(b"II*\0\x08\0\0\0\x01\0\x02\0")),
    "half.npz": ("whole", 2, lambda path: cut(path, zipped(one=FRAMES))),
    "wrong.toml": ("did you mean angle_deg", 2, lambda path: path.write_text(PROFILE.replace("angle", "angel"))),
    "nan.npy": ("no numbers", 2, lambda path: np.save(path, np.full((2, 9, 9), np.nan))),
    "black.npy": ("black", 2, lambda path: np.save(path, np.zeros((2, 9, 9), np.uint16))),
    "empty": ("an empty file", 2, lambda path: path.touch()),
    "cut.h5": ("complete HDF5 file", 2, lambda path: path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(200))),
    "pickle.npy": ("pickled", 2, lambda path: np.save(path, np.array([object, {}], object))),
    "negative.npy": ("negative.npy", 2, lambda path: npy_of(path, "(-5, 9, 9)")),
    "large.npy": ("all of shape", 2, lambda path: npy_of(path, "(9999999999, 9, 9)")),
    "bomb.zip": ("manifest.json", 2, bomb),
    "huge.h5": ("GB", 2, huge_symbols),
    "deep.toml": ("deep.toml", 2, lambda path: path.write_text("a = " + "[" * 100_000)),
    "deep.json": ("deep.json", 2, lambda path: path.write_text("[" * 100_000)),
    "pipe": ("a pipe", 2, os.mkfifo),
    "loop": ("loop", 2, loop),
    "folders": ("inner", 2, folder_loop),
    "new\nline": ("\\nline", 2, lambda path: path.write_bytes(b"\0\1\2")),
    "sparse": ("bytes that begin with", 2, sparse),
    "none": ("none", 2, lambda path: None),
}  # fmt: skip


@pytest.mark.parametrize("name", MADE)
def test_it_says_what_a_file_is_or_what_is_wrong(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    told, status, make = MADE[name]
    make(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    assert main.run(inspect, [name]) == status
    said = capsys.readouterr()
    assert told in (said.out + said.err).replace("new line", "new\\nline")


def test_a_device_is_no_file(capsys: pytest.CaptureFixture[str]) -> None:
    assert main.run(inspect, ["/dev/zero"]) == 2


class TestRecording:
    @pytest.fixture
    def recording(self, small_device: list[str]) -> str:
        return small_device[small_device.index("--recording") + 1]

    def test_it_is_ready_for_calibrate_and_drawn(self, recording: str, tmp_path: Path) -> None:
        options = ["--json", str(tmp_path / "J"), "--picture", str(tmp_path / "P.png")]
        assert main.run(inspect, [recording, *options]) == 0
        told = json.loads((tmp_path / "J").read_text())
        assert told["kind"] == "recording"
        assert told["profile"] == "small"
        assert "lightpage calibrate --recording" in told["next"][0]
        shares = told["histograms"]["in_phase"]["shares"]
        assert sum(shares) == pytest.approx(1)
        with Image.open(tmp_path / "P.png") as drawn:
            assert np.asarray(drawn.convert("L")).std() > 10

    def test_another_profile_and_a_black_page_are_problems(self, recording: str, tmp_path: Path) -> None:
        spoilt = tmp_path / "R.h5"
        spoilt.write_bytes(Path(recording).read_bytes())
        with h5py.File(spoilt, "r+") as file:
            file["quadrature"][0] = 0
        assert main.run(inspect, [str(spoilt), "--profile", "bench", "--json", str(tmp_path / "J")]) == 2
        fit, black = json.loads((tmp_path / "J").read_text())["problems"]
        assert "bench" in fit
        assert "page 0" in black
