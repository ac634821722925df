"""`lightpage import` and `unpack`: what other programs have written becomes the same recording, whatever its form."""

import json
import os
import shlex
import shutil
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click
import h5py
import numpy as np
import pytest
import tifffile
from click.testing import CliRunner
from PIL import Image
from scipy.io import savemat

from lightpage.calibration.calibrate import ORIENTATIONS, UPRIGHT
from lightpage.cli.import_frames import import_frames
from lightpage.cli.main import lightpage
from lightpage.errors import BlackFrameError, FrameError, FramesDisagreeError, InvalidInputError, PageError
from lightpage.foreign import import_job
from lightpage.foreign.frames import Arrangement, Pages, Upright, both_cameras
from lightpage.foreign.opening import open_array
from lightpage.foreign.unpacking import Form
from lightpage.recording.reader import Recording
from tests.lightpage.refused import refused
from tests.runtime import coded, toy

LEVELS, PAGES = 16, 4
COUNTS = ("in_phase", "quadrature", "reference_in_phase", "reference_quadrature")
Arrays = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("toy") / "R.h5"
    toy.write_toy_recording(path, toy.ToyDevice(), LEVELS, PAGES)
    with h5py.File(path, "r+") as file:
        file.attrs["code"] = '{"volume": 9}'
    return path


@pytest.fixture(scope="module")
def arrays(recording: Path) -> Arrays:
    with h5py.File(recording) as file:
        return {name: item[()] for name, item in file.items()}


@pytest.fixture
def folder(arrays: Arrays, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of each array as NAME.npy, and of the profile; the current one."""
    for name, data in arrays.items():
        np.save(tmp_path / f"{name}.npy", data)
    (tmp_path / "toy.toml").write_text(toy.PROFILE_TOML)
    monkeypatch.chdir(tmp_path)
    return tmp_path


FRAMES = "--in-phase in_phase.npy --quadrature quadrature.npy"
REFERENCES = "--reference-in-phase reference_in_phase.npy --reference-quadrature reference_quadrature.npy"
REST = f"--symbols symbols.npy --levels {LEVELS} --profile toy.toml --out new.h5"


def bring(words: str) -> None:
    CliRunner().invoke(import_frames, shlex.split(words), standalone_mode=False, catch_exceptions=False)


def contents(path: Path) -> tuple[Arrays, dict[str, Any]]:
    with h5py.File(path) as file:
        return {name: item[()] for name, item in file.items()}, dict(file.attrs)


def check_same(path: Path, arrays: Arrays) -> None:
    found, _ = contents(path)
    assert found.keys() == arrays.keys()
    for name, data in arrays.items():
        np.testing.assert_array_equal(found[name], data, err_msg=name)


@pytest.mark.parametrize("form", list(Form))
def test_a_recording_comes_back_from_every_form(
    form: Form, recording: Path, arrays: Arrays, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["unpack", str(recording), "--out", form.value, "--form", form.value]
    told = CliRunner().invoke(lightpage, words, catch_exceptions=False).output
    bring(told.splitlines()[-1].removeprefix("lightpage import"))
    check_same(tmp_path / "R.h5", arrays)
    assert contents(tmp_path / "R.h5")[1] == contents(recording)[1]
    assert Recording.open(tmp_path / "R.h5").header.device(None) == toy.PROFILE


def turned(a: Arrays) -> None:
    for name in ("quadrature", "reference_quadrature"):
        np.save(f"{name}.npy", np.rot90(a[name], 1, (-2, -1))[..., ::-1])


def compressed_tiff(a: Arrays) -> None:
    with tifffile.TiffWriter("both.tif", byteorder=">", bigtiff=True) as file:
        for pair in zip(a["in_phase"], a["quadrature"], strict=True):
            file.write(np.hstack(pair), photometric="minisblack", compression="zlib", rowsperstrip=7)


def pictures(a: Arrays) -> None:
    Path("both").mkdir()
    for page, pair in enumerate(zip(a["in_phase"], a["quadrature"], strict=True)):
        Image.fromarray(np.vstack(pair)).save(f"both/frame{page + 8}.png")  # 8, 9, 10, 11


def matlab(a: Arrays) -> None:
    stack = np.stack([a["in_phase"], a["quadrature"]]).transpose(2, 3, 1, 0)
    savemat("both.mat", {"other": 1, "stack": stack.astype(float)})


def hdf5(a: Arrays) -> None:
    with h5py.File("both.h5", "w") as linking, h5py.File("data.h5", "w") as file:
        linking["run"] = h5py.ExternalLink("data.h5", "run")
        file.create_dataset("run/all", data=np.concatenate([a["in_phase"], a["quadrature"]]), chunks=(3, 64, 96))
        file["run/short"] = [1]


def archive(a: Arrays) -> None:
    np.savez_compressed("both.npz", frames=np.stack([a["in_phase"], a["quadrature"]], axis=1), other=a["symbols"])


@pytest.mark.parametrize(
    ("write", "options"),
    [
        (lambda a: [np.save(f"{name}.npy", a[name].astype(">u2") << 8) for name in COUNTS], FRAMES),
        (turned, f"{FRAMES} --flip-quadrature x --turn-quadrature 90"),
        (compressed_tiff, "--frames both.tif"),
        (pictures, "--frames both"),
        (matlab, "--frames both.mat::stack"),
        (hdf5, "--frames both.h5 --arrangement halves"),
        (archive, "--frames both.npz::frames"),
    ],
)
def test_frames_may_lie_in_many_ways(
    write: Callable[[Arrays], object], options: str, folder: Path, arrays: Arrays
) -> None:
    write(arrays)
    bring(f"{options} {REFERENCES} {REST}")
    check_same(folder / "new.h5", arrays)


@pytest.mark.parametrize(
    ("factor", "options", "depth"), [(16, "", 12), (16, " --bit-depth 12", 12), (2, "", 10), (1, " --bit-depth 10", 10)]
)
def test_counts_that_fit_stay_as_they_are_though_they_are_multiples(
    factor: int, options: str, depth: int, folder: Path, arrays: Arrays
) -> None:
    scaled = arrays | {name: arrays[name].astype(np.uint16) * factor for name in COUNTS}
    for name, data in scaled.items():
        np.save(f"{name}.npy", data)
    bring(f"{FRAMES} {REFERENCES} {REST}{options}")
    check_same(folder / "new.h5", scaled)
    assert contents(folder / "new.h5")[1]["camera_bit_depth"] == depth


class TestShapesThatAreReadInTwoWays:
    """Cubes, square frames, and axes of which two are two."""

    def test_pages_of_matlab_lie_along_the_last_axis(self, tmp_path: Path) -> None:
        cube = np.arange(27, dtype=np.uint8).reshape(3, 3, 3)
        savemat(tmp_path / "cube.mat", {"cube": cube})
        np.testing.assert_array_equal(Pages(open_array(str(tmp_path / "cube.mat")), (3, 3), "").page(1), cube[:, :, 1])

    @pytest.mark.parametrize(
        ("shape", "arrangement", "kind"),
        [((2, 3, 4, 5), "interleaved", "two cameras"), ((3, 2, 4, 5), "halves", "two cameras"),
         ((8, 4, 4), None, "--arrangement")],
    )  # fmt: skip
    def test_an_arrangement_that_the_axes_contradict_or_leave_open(
        self, shape: tuple[int, ...], arrangement: str | None, kind: str, tmp_path: Path
    ) -> None:
        np.save(tmp_path / "a.npy", np.zeros(shape, np.uint8))
        way = None if arrangement is None else Arrangement(arrangement)
        with refused("a.npy", wanted=kind):
            both_cameras(open_array(str(tmp_path / "a.npy")), shape[-2:], (Upright(), Upright()), way, "")


def test_the_pages_that_were_encoded_bring_profile_levels_and_code(folder: Path) -> None:
    bundle = coded.bundle(folder / "coded.zip")
    symbols = coded.pages(bundle, folder)
    device = toy.ToyDevice()
    pairs = [device.page(page, coded.CODE.levels) for page in symbols]
    np.save("in_phase.npy", [pair.in_phase for pair in pairs])
    np.save("quadrature.npy", [pair.quadrature for pair in pairs])
    bring(f"{FRAMES} {REFERENCES} --symbols pages.h5 --out new.h5")
    with Recording.open(folder / "new.h5") as made:
        assert made.levels == coded.CODE.levels
        assert made.header.device(None) == toy.PROFILE
        assert json.loads(made.header.code_text or "")["volume"] == 9


class TestRefused:
    """Refusals name file and frame; nothing is left under the final name."""

    @pytest.fixture(autouse=True)
    def nothing_is_written(self, folder: Path) -> Iterator[None]:
        yield
        assert not (folder / "new.h5").exists()

    @pytest.mark.parametrize(
        ("file", "change", "subject", "kind"),
        [
            ("in_phase", lambda a: a[:, :-1], "in_phase.npy", InvalidInputError),
            ("in_phase", lambda a: a[0, 0], "in_phase.npy", InvalidInputError),
            ("quadrature", lambda a: a[:-1], "quadrature.npy", InvalidInputError),
            ("quadrature", lambda a: a / 7, "quadrature.npy: frame 0", FrameError),
            ("quadrature", lambda a: np.where(a == a.max(), np.nan, a), "quadrature.npy: frame", FrameError),
            ("quadrature", lambda a: a.astype(int) - 200, "quadrature.npy: frame 0", FrameError),
            ("quadrature", lambda a: a + 1j, "quadrature.npy: frame 0", FrameError),
            ("in_phase", lambda a: a * (np.arange(PAGES) != 2)[:, None, None], "in_phase.npy: page 2", BlackFrameError),
            ("reference_quadrature", lambda a: a * 0, "reference_quadrature.npy", BlackFrameError),
            ("symbols", lambda a: a[:2], "symbols.npy", InvalidInputError),
            ("symbols", lambda a: a.swapaxes(1, 2), "symbols.npy", InvalidInputError),
            ("symbols", lambda a: a + 1, "symbols.npy: page 0", PageError),
            ("symbols", lambda a: a + 0.5, "symbols.npy: page 0", PageError),
        ],
    )
    def test_what_does_not_fit(
        self, file: str, change: Callable[[np.ndarray], np.ndarray], subject: str, kind: Any, arrays: Arrays
    ) -> None:
        np.save(f"{file}.npy", change(arrays[file]))
        with refused(subject, kind=kind):
            bring(f"{FRAMES} {REFERENCES} {REST}")

    @pytest.mark.parametrize(
        ("options", "subject", "got"),
        [
            (f"{FRAMES} --frames in_phase.npy {REFERENCES}", "options", "--frames"),
            (FRAMES, "options", "no references"),
            (f"--frames in_phase.npy {REFERENCES}", "in_phase.npy", "does not tell"),
            (f"{FRAMES.replace('in_phase', 'all')} {REFERENCES}", "all.npy", "no such file"),
            (f"{FRAMES} {REFERENCES} --black-level 300", "--black-level 300", "8 bits"),
            (f"{FRAMES} {REFERENCES} --pilots ones.npy", "ones.npy", "pilots of"),
            (f"{FRAMES} {REFERENCES} --pilots page.npy", "page.npy", f"{LEVELS} different values"),
        ],
    )
    def test_options_that_do_not_go_together(self, options: str, subject: str, got: str, arrays: Arrays) -> None:
        np.save("page.npy", arrays["symbols"][0])
        np.save("ones.npy", np.ones_like(arrays["symbols"][0]))
        with refused(subject, got):
            bring(f"{options} {REST}")

    def test_a_picture_of_another_kind_or_size_is_named(self, folder: Path) -> None:
        (folder / "p").mkdir()
        Image.new("L", (96, 64)).save("p/1.png")
        for mode, size in (("RGB", (96, 64)), ("L", (95, 64))):
            Image.new(mode, size).save("p/2.png")
            with refused("p/2.png"):
                open_array("p").take(0, 0, 2)


@pytest.mark.parametrize("name", UPRIGHT)
def test_each_orientation_that_calibrate_finds_is_set_upright_by_the_options_it_names(name: str) -> None:
    shown = ORIENTATIONS[name]
    options = UPRIGHT[name].format("in-phase").split()
    values = dict(zip(options[::2], options[1::2], strict=True))
    upright = Upright(values.get("--flip-in-phase", ""), int(values.get("--turn-in-phase", "0")))
    page, seen = np.arange(9).reshape(3, 3), np.zeros((3, 3), int)
    for row, column in np.ndindex(3, 3):
        at = np.array(shown) @ (column - 1, row - 1) + 1
        seen[at[1], at[0]] = page[row, column]
    np.testing.assert_array_equal(upright(seen), page)


def test_levels_and_a_black_level_that_seem_wrong_are_told(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    bring(f"{FRAMES} {REFERENCES} {REST.replace(f'--levels {LEVELS}', '--black-level 60')}")
    assert all(f"{name} {value}" in caplog.text for name, value in (("--levels", LEVELS), ("--black-level", 60)))


def test_unlit_frames_are_taken_and_told_where_that_is_asked_for(folder: Path, arrays: Arrays) -> None:
    np.save("quadrature.npy", arrays["quadrature"] * (np.arange(PAGES) != 1).astype(np.uint8)[:, None, None])
    bring(f"{FRAMES} {REFERENCES} {REST} --keep-unlit --black-level 3 --json J")
    told = json.loads((folder / "J").read_text())
    assert [each["page"] for each in told["unlit"]] == [1]
    assert (told["bit_depth"], told["told"], contents(folder / "new.h5")[1]["black_level"]) == (8, False, 3)


def test_an_interrupted_import_goes_on_with_the_same_files_alone(
    folder: Path, arrays: Arrays, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = import_job.Material.page_symbols

    def stops(self: import_job.Material, page: int) -> np.ndarray:
        if page == 2:
            raise KeyboardInterrupt
        return whole(self, page)

    arrays = {**arrays, "in_phase": arrays["in_phase"] * (np.arange(PAGES) != 0).astype(np.uint8)[:, None, None]}
    Path("pics").mkdir()
    for page, frame in enumerate(arrays["in_phase"]):
        Image.fromarray(frame).save(picture := Path(f"pics/{page}.png"))
    given = f"{FRAMES.replace('in_phase.npy', 'pics/*.png')} {REFERENCES} {REST} --keep-unlit --json J"
    stamp = picture.stat()
    with monkeypatch.context() as patched:
        patched.setattr(import_job.Material, "page_symbols", stops)
        with pytest.raises(click.Abort):
            bring(given)
    assert contents(folder / "new.h5.partial")[1]["pages_complete"] == 2
    with refused("new.h5", "other settings"):
        bring(f"{given} --bit-depth 10")
    picture.touch()
    with refused("new.h5", "other settings"):
        bring(given)
    os.utime(picture, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    bring(given)
    check_same(folder / "new.h5", arrays)
    assert [each["page"] for each in json.loads((folder / "J").read_text())["unlit"]] == [0]
    assert not list(folder.glob("*.partial*"))


def test_a_refused_import_is_not_in_the_way_of_the_corrected_command(folder: Path, arrays: Arrays) -> None:
    arrays["in_phase"][:] = np.load("in_phase.npy") * (np.arange(PAGES) != 1).astype(np.uint8)[:, None, None]
    np.save("in_phase.npy", arrays["in_phase"])
    with refused("page 1", "black"):
        bring(f"{FRAMES} {REFERENCES} {REST}")
    assert not list(folder.glob("new*"))
    bring(f"{FRAMES} {REFERENCES} {REST} --keep-unlit")


def test_equal_frames_of_both_cameras_are_refused(folder: Path) -> None:
    shutil.copy("in_phase.npy", "quadrature.npy")
    with refused("quadrature.npy", "in_phase.npy", kind=FramesDisagreeError):
        bring(f"{FRAMES} {REFERENCES} {REST}")


def test_a_recording_never_takes_the_place_of_its_source(folder: Path, recording: Path) -> None:
    shutil.copy(recording, "in.h5")
    given = f"{FRAMES} {REFERENCES} {REST}".replace("in_phase.npy", "in.h5::in_phase", 1).replace("new.h5", "in.h5")
    with refused("--out in.h5", "--in-phase"):
        bring(f"{given} --force")
    check_same(folder / "in.h5", contents(recording)[0])


@pytest.mark.parametrize("name", ["stack.npy", "stack.tif"])
def test_a_stack_larger_than_memory_is_read_in_parts(name: str, tmp_path: Path) -> None:
    path, shape = tmp_path / name, (4000, 1000, 1000)
    if name.endswith(".npy"):
        np.lib.format.open_memmap(path, "w+", np.uint16, shape)[-1] = 7  # the rest is a hole
    else:
        tifffile.memmap(path, shape=shape, dtype=np.uint16, bigtiff=True, photometric="minisblack")[-1] = 7
    tracemalloc.start()
    try:
        pages = Pages(open_array(str(path)), shape[1:], "frames")
        assert [int(pages.page(number).max()) for number in (0, 1, 2000, 3999)] == [0, 0, 0, 7]
        assert tracemalloc.get_traced_memory()[1] < 300e6
    finally:
        tracemalloc.stop()
