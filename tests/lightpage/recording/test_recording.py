"""Recordings: what is written comes back, what is damaged is refused by name, an interruption loses nothing."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import h5py
import numpy as np
import pytest

from lightpage.device.profile import Profile, load_profile, parse_profile
from lightpage.errors import PageError, ProfileError, RecordingError
from lightpage.page.symbols import pilot_mask, random_symbols
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import hash_frames
from lightpage.recording.reader import Recording
from lightpage.recording.writer import RecordingWriter
from tests.lightpage.refused import refused

LEVELS = 16
PAGES = 3


def small_profile() -> Profile:
    bench = load_profile("bench")
    return bench.model_copy(
        update={
            "page": bench.page.model_copy(update={"columns": 9, "rows": 6}),
            "camera": bench.camera.model_copy(update={"columns_px": 20, "rows_px": 14}),
        }
    )


def random_frames(seed: int, bit_depth: int = 12) -> FramePair:
    rng = np.random.default_rng(seed)
    dtype = np.uint8 if bit_depth == 8 else np.uint16
    return FramePair(*rng.integers(0, 2**bit_depth, size=(2, 14, 20), dtype=dtype))


def write_foreign(path: Path) -> Path:
    """A valid recording by plain h5py, as other software writes it."""
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        file.attrs["format"] = "lightpage-recording"
        file.attrs["version"] = 1
        file.attrs["camera_bit_depth"] = 12
        file.attrs["levels"] = LEVELS
        file["symbols"] = rng.integers(0, LEVELS, size=(PAGES, 6, 9), dtype=np.uint8)
        file["pilots"] = rng.random((6, 9)) < 0.2
        for name in ("in_phase", "quadrature"):
            data = rng.integers(0, 4096, size=(PAGES, 14, 20), dtype=np.uint16)
            file.create_dataset(name, data=data, chunks=(1, 14, 20))
            file[f"reference_{name}"] = data[0]
    return path


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    return write_foreign(tmp_path / "foreign.h5")


def write_own(path: Path, pages: int = PAGES, bit_depth: int = 12) -> np.ndarray:
    profile = small_profile()
    symbols = random_symbols(profile, LEVELS, pages, np.random.default_rng(1))
    references = random_frames(100, bit_depth)
    with RecordingWriter(path, profile, LEVELS, bit_depth, references, pilot_mask(profile)) as writer:
        for page in range(pages):
            writer.append(symbols[page], random_frames(page, bit_depth))
    return symbols


class TestReading:
    def test_a_recording_by_other_software_is_read_whole(self, foreign: Path) -> None:
        with Recording.open(foreign) as recording, h5py.File(foreign) as file:
            assert recording.path == foreign
            assert (recording.pages, recording.levels, recording.bit_depth) == (PAGES, LEVELS, 12)
            assert (recording.frame_shape, recording.page_shape, recording.has_symbols) == ((14, 20), (6, 9), True)
            assert recording.header.profile_text is None
            for name in ("in_phase", "quadrature"):
                frames = [getattr(recording[page], name) for page in (*range(PAGES - 1), -1)]
                assert np.array_equal(frames, file[name])
                assert np.array_equal(getattr(recording.references(), name), file[f"reference_{name}"])
            assert np.array_equal([recording.symbols(page) for page in range(PAGES)], file["symbols"])
            assert np.array_equal(recording.pilots(), file["pilots"])

    def test_symbols_pilots_and_levels_may_be_absent(self, foreign: Path) -> None:
        with h5py.File(foreign, "r+") as file:
            del file["symbols"], file["pilots"], file.attrs["levels"]
        with Recording.open(foreign) as recording:
            assert (recording.levels, recording.has_symbols) == (256, False)
            assert [recording.page_shape, recording.symbols(0), recording.pilots()] == [None] * 3
            recording.header.check_against(small_profile())

    def test_pilots_alone_and_as_numbers_tell_the_page_shape(self, foreign: Path) -> None:
        with h5py.File(foreign, "r+") as file:
            mask = file["pilots"][()]
            del file["symbols"], file["pilots"]
            file["pilots"] = mask.astype(np.uint8)
        with Recording.open(foreign) as recording:
            assert recording.page_shape == (6, 9)
            pilots = recording.pilots()
            assert pilots is not None
            assert pilots.dtype == np.bool_
            assert np.array_equal(pilots, mask)

    def test_counts_of_the_other_byte_order_come_back_in_this_machines(self, foreign: Path) -> None:
        with Recording.open(foreign) as recording:
            before, page_hash = recording.frames(1).in_phase, recording.page_hash(1)
        with h5py.File(foreign, "r+") as file:
            data = file["in_phase"][()]
            del file["in_phase"]
            file.create_dataset("in_phase", data=data, dtype=data.dtype.newbyteorder("S"))
        with Recording.open(foreign) as recording:
            assert recording.frames(1).in_phase.dtype.isnative
            assert np.array_equal(recording.frames(1).in_phase, before)
            assert recording.page_hash(1) == page_hash

    @pytest.mark.parametrize("black", [0, 200, 4094])
    def test_the_black_level_is_taken_off_frames_and_references(self, foreign: Path, black: int) -> None:
        with h5py.File(foreign, "r+") as file:
            file.attrs["black_level"] = black
        with Recording.open(foreign) as recording, h5py.File(foreign) as file:
            assert recording.header.black_level == black
            for got, prefix, where in ((recording.frames(1), "", 1), (recording.references(), "reference_", ())):
                for name in ("in_phase", "quadrature"):
                    counts = file[prefix + name][where].astype(int)
                    assert getattr(got, name).dtype == np.uint16
                    assert np.array_equal(getattr(got, name), np.clip(counts - black, 0, None))

    def test_the_hash_of_a_page_is_that_of_the_frames_that_a_decoder_is_given(self, foreign: Path) -> None:
        stored = "57c2f4abdcaafa11965f6992bf7c1820bab85ff13fb5cb69c75309ec5f375f3c"
        with Recording.open(foreign) as recording:
            assert recording.page_hash(0) == hash_frames(recording.frames(0)) == stored
        with h5py.File(foreign, "r+") as file:
            file.attrs["black_level"] = 100
        with Recording.open(foreign) as recording:
            assert recording.page_hash(0) == hash_frames(recording.frames(0)) != stored

    def test_it_tells_where_its_own_profile_says_otherwise(self, foreign: Path) -> None:
        profile = small_profile()
        other = profile.model_copy(update={"pipe": profile.pipe.model_copy(update={"length_m": 0.2})})
        for text, own in ((other.to_toml(), other), (profile.to_toml(), profile), ("somebody else's notes", None)):
            with h5py.File(foreign, "r+") as file:
                file.attrs["profile"] = text
            with Recording.open(foreign) as recording:
                if own is None:
                    with refused("attribute 'profile'", kind=ProfileError):
                        recording.header.device(None)
                else:
                    assert recording.header.device(None) == own
                told: list[str] = []
                assert recording.header.device(profile, told.append) == profile
                assert [("pipe.length_m = 0.2 (profile bench" in each) for each in told] == [True] * (own is other)
                laid_out = profile.model_copy(update={"page": profile.page.model_copy(update={"pilot_seed": 7})})
                if own is not None:
                    with refused("attribute 'profile'", "page.pilot_seed = 0", RecordingError):
                        recording.header.device(laid_out)

    def test_left_aligned_counts_are_told_of_once(self, foreign: Path, caplog: pytest.LogCaptureFixture) -> None:
        with h5py.File(foreign, "r+") as file:
            file.attrs["camera_bit_depth"] = 16
            for name in ("in_phase", "quadrature", "reference_in_phase", "reference_quadrature"):
                file[name][...] = file[name][...] << 4
        with Recording.open(foreign) as recording:
            recording.references()
            recording.frames(0)
        assert [record.message.count("multiples of 16") for record in caplog.records] == [1]

    def test_a_page_that_is_not_there_is_refused(self, foreign: Path) -> None:
        pages: list[Any] = [-1, PAGES, 1.0, "a"]
        with Recording.open(foreign) as recording:
            for page in pages:
                with refused("page", page, RecordingError):
                    recording.frames(page)
        with refused("foreign.h5", "closed", RecordingError):
            recording.frames(0)

    def test_a_profile_of_another_camera_or_page_is_refused(self, foreign: Path) -> None:
        profile = small_profile()
        camera = profile.camera.model_copy(update={"rows_px": 15})
        page = profile.page.model_copy(update={"columns": 8})
        with Recording.open(foreign) as recording:
            recording.header.check_against(profile)
            with refused(got="14 x 20", kind=RecordingError):
                recording.header.check_against(profile.model_copy(update={"camera": camera}))
            with refused(got="6 x 9", kind=RecordingError):
                recording.header.check_against(profile.model_copy(update={"page": page}))


def attribute(name: str, value: object) -> Callable[[h5py.File], None]:
    return lambda file: file.attrs.__setitem__(name, value)


def array(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[h5py.File], None]:
    def edit(file: h5py.File) -> None:
        data = change(file[name][()])
        del file[name]
        file[name] = data

    return edit


BAD = [
    (attribute("format", "other"), "attribute 'format'", "'other'"),
    (attribute("version", 2), "attribute 'version'", "2"),
    (lambda file: file.attrs.__delitem__("camera_bit_depth"), "attribute 'camera_bit_depth'", "none"),
    (attribute("black_level", -1), "attribute 'black_level'", "-1"),
    (attribute("black_level", 4095), "attribute 'black_level'", "4095"),
    (attribute("camera_bit_depth", 7), "attribute 'camera_bit_depth'", "7"),
    (attribute("camera_bit_depth", 17), "attribute 'camera_bit_depth'", "17"),
    (attribute("levels", 1), "attribute 'levels'", "1"),
    (attribute("levels", 257), "attribute 'levels'", "257"),
    (attribute("levels", 15), "dataset 'symbols'", "15"),
    (attribute("profile", 3), "attribute 'profile'", "int"),
    (lambda file: file.__delitem__("quadrature"), "dataset 'quadrature'", "none"),
    (lambda file: [file.__delitem__("quadrature"), file.create_group("quadrature")], "dataset 'quadrature'", "group"),
    (array("in_phase", lambda d: d.astype(np.uint32)), "dataset 'in_phase'", "uint32"),
    (array("in_phase", lambda d: d.astype(np.uint8)), "dataset 'in_phase'", "uint8"),
    (array("quadrature", lambda d: d[:2]), "dataset 'quadrature'", (2, 14, 20)),
    (array("in_phase", lambda d: d[0]), "dataset 'in_phase'", (14, 20)),
    (array("reference_in_phase", lambda d: d[None]), "dataset 'reference_in_phase'", (1, 14, 20)),
    (array("reference_in_phase", lambda d: d.T), "dataset 'reference_in_phase'", (20, 14)),
    (array("in_phase", lambda d: d[:, :0]), "dataset 'in_phase'", (3, 0, 20)),
    (array("symbols", lambda d: d.astype(np.uint16)), "dataset 'symbols'", "uint16"),
    (array("symbols", lambda d: d[:2]), "dataset 'symbols'", (2, 6, 9)),
    (array("pilots", lambda d: d.T), "dataset 'pilots'", (9, 6)),
    (array("pilots", np.zeros_like), "dataset 'pilots'", "0 pilots"),
    (array("pilots", np.ones_like), "dataset 'pilots'", "54 pilots"),
    (array("pilots", lambda d: d.astype(np.float64)), "dataset 'pilots'", "float64"),
    (array("in_phase", lambda d: d[:0]), "dataset 'in_phase'", (0, 14, 20)),
]


class TestBadFiles:
    @pytest.mark.parametrize(("edit", "subject", "got"), BAD)
    def test_an_inconsistent_recording_is_refused_with_what_is_wrong_and_what_came(
        self, foreign: Path, edit: Callable[[h5py.File], None], subject: str, got: object
    ) -> None:
        with h5py.File(foreign, "r+") as file:
            edit(file)
        with refused(f"foreign.h5: {subject}", got, RecordingError):
            Recording.open(foreign)

    def test_a_text_a_missing_file_and_a_folder_are_refused(self, tmp_path: Path) -> None:
        text = tmp_path / "text.h5"
        text.write_text("no HDF5 here")
        for path in (text, tmp_path / "missing.h5", tmp_path):
            with refused(str(path), kind=RecordingError):
                Recording.open(path)

    def test_counts_beyond_the_bit_depth_are_refused_when_the_page_is_read(self, foreign: Path) -> None:
        with h5py.File(foreign, "r+") as file:
            file["quadrature"][1, 0, 0] = 4096
        with Recording.open(foreign) as recording:
            recording.frames(0)
            with refused("'quadrature' page 1", 4096, RecordingError):
                recording.frames(1)


class TestWriting:
    @pytest.mark.parametrize("bit_depth", [8, 12, 16])
    def test_what_is_written_comes_back(self, tmp_path: Path, bit_depth: int) -> None:
        path = tmp_path / "own.h5"
        symbols = write_own(path, bit_depth=bit_depth)
        with Recording.open(path) as recording:
            assert (recording.pages, recording.levels, recording.bit_depth) == (PAGES, LEVELS, bit_depth)
            recording.header.check_against(small_profile())
            assert parse_profile(recording.header.profile_text or "") == small_profile()
            assert np.array_equal(recording.pilots(), pilot_mask(small_profile()))
            assert np.array_equal(recording.references().quadrature, random_frames(100, bit_depth).quadrature)
            for page in range(PAGES):
                assert np.array_equal(recording.symbols(page), symbols[page])
                assert np.array_equal(recording.frames(page).in_phase, random_frames(page, bit_depth).in_phase)
                assert recording.frames(page).quadrature.dtype == (np.uint8 if bit_depth == 8 else np.uint16)

    def test_the_layout_is_the_documented_one(self, tmp_path: Path) -> None:
        path = tmp_path / "own.h5"
        write_own(path)
        with h5py.File(path) as file:
            frames = {"in_phase", "quadrature"}
            assert set(file) == {*frames, *(f"reference_{name}" for name in frames), "symbols", "pilots"}
            assert set(file.attrs) == {"format", "version", "camera_bit_depth", "levels", "profile"}
            assert file["in_phase"].chunks == (1, 14, 20)
            assert file["quadrature"].chunks == (1, 14, 20)
            assert file["symbols"].dtype == np.uint8

    def test_the_truth_of_a_simulated_device_is_kept_apart(self, tmp_path: Path) -> None:
        path = tmp_path / "truth.h5"
        facet = np.exp(1j * np.linspace(0, 1, 12)).reshape(3, 4).astype(np.complex64)
        with RecordingWriter(path, small_profile(), 256, 12, random_frames(9)) as writer:
            writer.add_note("truth", {"device": "[geometry]\npipe_angle_deg = 1.0\n"})
            for page in range(2):
                writer.append(None, random_frames(page), truth={"facet_field": facet * (page + 1)})
        with h5py.File(path) as file:
            assert file["truth"].attrs["device"] == "[geometry]\npipe_angle_deg = 1.0\n"
            assert file["truth/facet_field"].dtype == np.complex64
            assert np.array_equal(file["truth/facet_field"][1], facet * 2)
        with Recording.open(path) as recording:
            assert recording.pages == 2
            assert not recording.has_symbols
            assert recording.pilots() is None

    @pytest.mark.parametrize(
        ("frame", "got"),
        [
            (np.zeros((14, 19), np.uint16), (14, 19)),
            (np.zeros((14, 20), np.float64), "float64"),
            (np.full((14, 20), 4096, np.uint16), "4096"),
            (np.full((14, 20), -1, np.int32), "-1"),
        ],
    )
    def test_wrong_frames_and_symbols_are_refused_and_leave_the_recording_sound(
        self, tmp_path: Path, frame: np.ndarray, got: object
    ) -> None:
        path = tmp_path / "own.h5"
        with RecordingWriter(path, small_profile(), LEVELS, 12, random_frames(9)) as writer:
            writer.append(None, random_frames(0))
            with refused("quadrature", got, RecordingError):
                writer.append(None, FramePair(random_frames(1).in_phase, frame))
            for symbols in (np.full((6, 9), LEVELS), np.zeros((9, 6), np.uint8), np.zeros((1, 6, 9), np.uint8)):
                with pytest.raises(PageError):
                    writer.append(symbols, random_frames(0))
            writer.append(None, random_frames(2))
        with Recording.open(path) as recording:
            assert recording.pages == 2
            assert np.array_equal(recording.frames(1).quadrature, random_frames(2).quadrature)

    def test_symbols_on_some_pages_only_are_refused(self, tmp_path: Path) -> None:
        with RecordingWriter(tmp_path / "own.h5", small_profile(), LEVELS, 12, random_frames(9)) as writer:
            writer.append(np.zeros((6, 9), np.uint8), random_frames(0))
            with pytest.raises(RecordingError):
                writer.append(None, random_frames(1))

    def test_wrong_arguments_are_refused(self, tmp_path: Path) -> None:
        path, profile, references = tmp_path / "own.h5", small_profile(), random_frames(9)
        with refused("bit depth", 17, RecordingError):
            RecordingWriter(path, profile, LEVELS, 17, references)
        with refused("pilots", (9, 6), RecordingError):
            RecordingWriter(path, profile, LEVELS, 12, references, np.zeros((9, 6), np.bool_))
        with refused("reference_in_phase", kind=RecordingError):
            RecordingWriter(path, load_profile("bench"), LEVELS, 12, references)
        assert list(tmp_path.iterdir()) == []


ARGUMENTS = small_profile(), LEVELS, 12, random_frames(100), pilot_mask(small_profile())


def interrupted(path: Path, pages: int) -> None:
    """Record `pages` pages, then press Ctrl-C."""
    with suppress(KeyboardInterrupt), RecordingWriter(path, *ARGUMENTS) as writer:
        for page in range(pages):
            writer.append(np.full((6, 9), page, np.uint8), random_frames(page))
        raise KeyboardInterrupt


def resumed(path: Path) -> RecordingWriter:
    return RecordingWriter(path, *ARGUMENTS, resume=True)


class TestInterruption:
    @pytest.mark.parametrize("cut", [False, True])
    @pytest.mark.parametrize("more", [0, 1])
    def test_ctrl_c_leaves_no_final_file_but_a_partial_one_to_go_on_from(
        self, tmp_path: Path, cut: bool, more: int
    ) -> None:
        path = tmp_path / "own.h5"
        interrupted(path, 2)
        assert not path.exists()
        if cut:  # in the middle of a page
            with h5py.File(tmp_path / "own.h5.partial", "r+") as file:
                file["in_phase"].resize(3, axis=0)
        with resumed(path) as writer:
            assert writer.pages == 2
            for page in range(2, 2 + more):
                writer.append(np.full((6, 9), page, np.uint8), random_frames(page))
        with Recording.open(path) as recording:
            assert recording.pages == 2 + more
            for page in range(2 + more):
                assert (recording.symbols(page) == page).all()
                assert np.array_equal(recording.frames(page).in_phase, random_frames(page).in_phase)

    @pytest.mark.parametrize(
        ("place", "other"),
        [
            (0, small_profile().model_copy(update={"name": "other"})),
            (1, 8),
            (2, 16),
            (3, random_frames(101)),
            (4, None),
        ],
    )
    def test_a_partial_file_of_other_arguments_is_not_gone_on_with(
        self, tmp_path: Path, place: int, other: object
    ) -> None:
        path, arguments = tmp_path / "own.h5", list[Any](ARGUMENTS)
        interrupted(path, 2)
        arguments[place] = other
        with RecordingWriter(path, *arguments, resume=True) as writer:
            assert writer.pages == 0

    @pytest.mark.parametrize("damaged", [False, True])
    def test_without_a_whole_partial_file_resuming_starts_anew(self, tmp_path: Path, damaged: bool) -> None:
        path, partial = tmp_path / "own.h5", tmp_path / "own.h5.partial"
        if damaged:
            interrupted(path, 2)
            partial.write_bytes(partial.read_bytes()[:1000])
        with resumed(path) as writer:
            assert writer.pages == 0
            writer.append(None, random_frames(0))
        with Recording.open(path) as recording:
            assert recording.pages == 1

    def test_pages_outlive_an_interruption_while_the_file_is_completed(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        path, profile = tmp_path / "own.h5", small_profile()
        with monkeypatch.context() as patch:
            patch.setattr("lightpage.recording.writer.move_into_place", Mock(side_effect=KeyboardInterrupt))
            writer = RecordingWriter(path, profile, LEVELS, 12, random_frames(100))
            for page in range(3):
                writer.append(None, random_frames(page))
            with pytest.raises(KeyboardInterrupt):
                writer.commit()
        with RecordingWriter(path, profile, LEVELS, 12, random_frames(100), resume=True) as writer:
            assert writer.pages == 3
            writer.append(None, random_frames(3))
        with Recording.open(path) as recording:
            assert recording.pages == 4
            assert np.array_equal(recording.frames(2).in_phase, random_frames(2).in_phase)

    @pytest.mark.parametrize("resume", [False, True])
    def test_pages_that_are_being_written_are_neither_gone_on_with_nor_destroyed(
        self, tmp_path: Path, resume: bool
    ) -> None:
        path, profile = tmp_path / "own.h5", small_profile()
        with RecordingWriter(path, profile, LEVELS, 12, random_frames(100)) as writer:
            writer.append(None, random_frames(0))
            with refused("own.h5.partial", kind=RecordingError):
                RecordingWriter(path, profile, LEVELS, 12, random_frames(100), resume=resume)
            writer.append(None, random_frames(1))
        with Recording.open(path) as recording:
            assert recording.pages == 2
            assert np.array_equal(recording.frames(0).in_phase, random_frames(0).in_phase)

    def test_a_partial_file_that_cannot_be_read_is_left_alone(self, tmp_path: Path) -> None:
        partial = tmp_path / "own.h5.partial"
        partial.mkdir()
        with refused("own.h5.partial", kind=RecordingError):
            resumed(tmp_path / "own.h5")
        assert partial.exists()
