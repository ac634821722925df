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

from lightpage.calibration.sampling_table import APART
from lightpage.cli import main
from lightpage.errors import InvalidInputError, LightpageError, StorageError, SurroundingsError, WorkerError
from lightpage.helper_process import Helper, HelperProcess
from lightpage.inspection import apart
from lightpage.inspection.apart import look_apart
from lightpage.inspection.command import inspect, table
from lightpage.inspection.documents import SERVICE_TABLES
from lightpage.inspection.folders import planes_of
from lightpage.inspection.look import look
from lightpage.recording.decoded_file import DecodedWriter
from lightpage.runtime.model.bundle.shipped import bundle_path
from lightpage.runtime.service.settings import ServiceSettings
from tests.lightpage.refused import refused
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


def pages(path: Path) -> None:
    folder = path.parent / "coded"
    folder.mkdir()
    coded.pages(coded.bundle(folder / "coded.zip"), folder)
    (folder / "pages.h5").rename(path)


def hollow(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("x", (10**11, 1000, 1000), "u1", chunks=(1, 1000, 1000))


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
    "7.mat": ("MATLAB file", 0, lambda p: h5py.File(p, "w", userblock_size=512).create_dataset("x", data=FRAMES)),
    "png": ("folder of pictures", 0, png_folder),
    "e.json": ("figures of an evaluation", 0, lambda path: path.write_text('{"bundle_version": "v", "pages": 6}')),
    "s.toml": ("settings of a service", 0, lambda path: path.write_text("[inference]\n")),
    "left.npy": ("full scale 65520", 2, lambda path: np.save(path, np.minimum(2 * FRAMES, 4095) << 4)),
    "bright.npy": ("values from 1e+20", 2, lambda path: np.save(path, np.full((2, 9, 9), 1e20))),
    "two.npz": ("two.npz::b", 0, lambda path: path.write_bytes(zipped(a=[[1.0]], b=FRAMES))),
    "rgb.tif": ("RGB", 2, lambda path: tifffile.imwrite(path, np.zeros((40, 60, 3), np.uint8), photometric="rgb")),
    "colour.npy": ("colour", 2, lambda path: np.save(path, np.stack([FRAMES] * 3, -1))),
    "dark.npy": ("page 1 black", 2, lambda path: np.save(path, FRAMES * np.array([1, 0, 1], np.uint16)[:, None, None])),
    "a.h5::x": ("array", 0, lambda path: h5py.File(path.parent / "a.h5", "w").create_dataset("x", data=FRAMES)),
    "pics/*.png": ("0, 1, 2", 0, lambda path: png_folder(path.parent)),
    "note.txt": ("neither TOML", 2, lambda path: path.write_text("note: well")),
    "half.npy": ("all of shape", 2, lambda path: path.write_bytes(SAVED.getvalue()[:-9])),
    "half.tif": ("TIFF", 2, lambda path: path.write_bytes(b"II*\0\x08\0\0\0\x01\0\x02\0")),
    "half.npz": ("whole", 2, lambda path: path.write_bytes(zipped(one=FRAMES)[:-99])),
    "wrong.toml": ("did you mean angle_deg", 2, lambda path: path.write_text(PROFILE.replace("angle", "angel"))),
    "nan.npy": ("no numbers", 2, lambda path: np.save(path, np.full((2, 9, 9), np.nan))),
    "black.npy": ("black", 2, lambda path: np.save(path, np.zeros((2, 9, 9), np.uint16))),
    "empty": ("an empty file", 2, lambda path: path.touch()),
    "hollow.h5": ("no data for page 0 to 99999999999", 2, hollow),
    "cut.h5": ("complete HDF5 file", 2, lambda path: path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(200))),
    "pickle.npy": ("pickled", 2, lambda path: np.save(path, np.array([object, {}], object))),
    "negative.npy": ("shape (-5", 2, lambda path: npy_of(path, "(-5, 9, 9)")),
    "large.npy": ("all of shape", 2, lambda path: npy_of(path, "(9999999999, 9, 9)")),
    "bomb.zip": ("manifest.json", 2, bomb),
    "huge.h5": ("GB", 2, huge_symbols),
    "deep.toml": ("recursion", 2, lambda path: path.write_text("a = " + "[" * 100_000)),
    "deep.json": ("recursion", 2, lambda path: path.write_text("[" * 100_000)),
    "pipe": ("a pipe", 2, os.mkfifo),
    "loop": ("too many levels", 2, lambda path: path.symlink_to(path.name)),
    "folders": ("inner", 2, lambda path: (path / "inner").mkdir(parents=True)),
    "new\nline": ("new\\nline", 2, lambda path: path.write_bytes(b"\0\1\2")),
    "zero": ("a device", 2, lambda path: path.symlink_to("/dev/zero")),
    "none": ("no such file", 2, lambda path: None),
}  # fmt: skip


@pytest.mark.parametrize("name", MADE)
def test_it_says_what_a_file_is_or_what_is_wrong(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told, status, make = MADE[name]
    make(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    try:
        found = look(Path(name))
        said, problems = table(found), bool(found.problems)
    except InvalidInputError as error:
        said, problems = ascii(str(error)), True
    assert told in said
    assert problems == (status == 2)


def test_a_file_that_is_never_read_to_its_end_is_given_up(tmp_path: Path) -> None:
    (tmp_path / "p.toml").write_text(PROFILE)
    with refused("p.toml", "0 s", StorageError):
        look_apart(tmp_path / "p.toml", None, drawn=False, longest_s=0.0)


def test_settings_of_a_service_are_known_by_any_of_their_tables() -> None:
    assert ServiceSettings.model_fields.keys() == SERVICE_TABLES


class Dies(Helper):
    """The helper that ends as a path says."""

    def look(self, path: Path, *_: object) -> None:
        """End by a signal, or by an error that nobody foresaw."""
        os.kill(os.getpid(), int(path.name))


@pytest.mark.parametrize(
    ("signal", "kind"), [("11", InvalidInputError), ("9", SurroundingsError), ("999", WorkerError)]
)  # fmt: skip
def test_a_file_is_blamed_only_where_reading_it_crashes(
    signal: str, kind: type[LightpageError], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(apart, "HelperProcess", lambda _, **told: HelperProcess(f"{__name__}:Dies", **told))
    with pytest.raises(kind) as caught:
        look_apart(Path(signal), None, drawn=False)
    assert type(caught.value) is kind


def test_a_recording_is_looked_at_and_drawn(small_device: list[str], tmp_path: Path) -> None:
    recording, told = tmp_path / "R.h5", tmp_path / "J"
    recording.write_bytes(Path(small_device[small_device.index("--recording") + 1]).read_bytes())
    assert main.run(inspect, [str(recording), "--json", str(told), "--picture", str(tmp_path / "P.png")]) == 0
    found = json.loads(told.read_text())
    assert (found["kind"], found["profile"]) == ("recording", "small")
    assert "lightpage calibrate --recording" in found["next"][0]
    assert found["facts"]["frames"] == {"rows": 456, "columns": 684, "bit_depth": 8}
    assert 0 < found["facts"]["in_phase_contrast_of_fringes"] < 1
    assert sum(found["histograms"]["in_phase"]["shares"]) == pytest.approx(1)
    with Image.open(tmp_path / "P.png") as drawn:
        assert np.asarray(drawn.convert("L")).std() > 10
    with h5py.File(recording, "r+") as file:
        file["quadrature"][0], file["quadrature"][1] = 0, file["in_phase"][1]
    assert main.run(inspect, [str(recording), "--profile", "bench", "--json", str(told)]) == 2
    found = json.loads(told.read_text())
    fit, same, black = found["problems"]
    assert found["next"] == []
    assert "page 1" in same
    assert "bench" in fit
    assert "page 0" in black


def test_a_bundle_states_what_its_graphs_compute_and_how_it_was_judged(tmp_path: Path) -> None:
    told = tmp_path / "J"
    assert main.run(inspect, [str(bundle_path("bench")), "--json", str(told)]) == 0
    facts = json.loads(told.read_text())["facts"]
    assert (facts["decoder"], facts["planes"]) == ("fitted waves", "one for both cameras")
    assert facts["calibration"].startswith("a good fit")


@pytest.mark.parametrize(
    ("inputs", "planes"),
    [
        ((), "one for both cameras"),
        (APART[:1], "each camera its own"),
        (APART, "each camera its own, tilted against the other's"),
    ],
)
def test_planes_are_those_whose_tensors_a_table_has(inputs: tuple[str, ...], planes: str) -> None:
    assert planes_of(["parameters", *inputs]) == planes
