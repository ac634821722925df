"""What is opened is what it says: nothing that HDF5 fills in, finds elsewhere or cannot decode is believed."""

import errno
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import h5py
import numpy as np
import pytest

from lightpage.errors import LightpageError, RecordingError, StorageError, SurroundingsError
from lightpage.progress import reporting
from lightpage.recording import hdf5, stored
from lightpage.recording.joined import join
from lightpage.recording.reader import Recording
from tests.clock import HandClock
from tests.lightpage.recording.test_recording import LEVELS, PAGES, write_foreign
from tests.lightpage.refused import refused
from tests.runtime import toy
from tests.told import Told

UNLIMITED = h5py.h5s.UNLIMITED
FRAME = (14, 20)


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    return write_foreign(tmp_path / "foreign.h5")


@pytest.fixture
def paused(monkeypatch: pytest.MonkeyPatch) -> Callable[[], float]:
    """How long further tries have waited, seconds."""
    clock = HandClock(0.0)
    monkeypatch.setattr(hdf5, "clock", clock)
    return clock.now


def replace(path: Path, name: str, put: Callable[[h5py.File, np.ndarray], object]) -> np.ndarray:
    """Take a dataset out of a recording, and have `put` put it back in another way."""
    with h5py.File(path, "r+") as file:
        data = file[name][()]
        del file[name]
        put(file, data)
    return data


def show(
    file: h5py.File, name: str, source: Path | str, data: np.ndarray, *, shown: object = (), taken: object = ()
) -> None:
    """Put a virtual dataset of `data`'s shape into a file, which shows the dataset `d` of another one."""
    layout = h5py.VirtualLayout(data.shape, data.dtype)
    whole = h5py.VirtualSource(str(source), "d", data.shape, data.dtype)
    layout[shown] = whole if taken == () else whole[taken]
    file.create_virtual_dataset(name, layout)


def external(path: Path, name: str = "in_phase", raw: str = "frames.raw", size: int = UNLIMITED) -> np.ndarray:
    def put(file: h5py.File, data: np.ndarray) -> None:
        file.create_dataset(name, data=data, external=[(str(path.with_name(raw)), 0, size)])

    return replace(path, name, put)


def virtual(path: Path, name: str = "in_phase", source: str = "source.h5") -> np.ndarray:
    """Move a dataset into a file beside the recording, which shows it there."""

    def put(file: h5py.File, data: np.ndarray) -> None:
        with h5py.File(path.with_name(source), "w") as other:
            other["d"] = data
        show(file, name, source, data)

    return replace(path, name, put)


def assert_shows(path: Path, data: np.ndarray) -> None:
    """The in-phase frames of a recording are `data`."""
    with Recording.open(path) as recording:
        np.testing.assert_array_equal([recording.frames(page).in_phase for page in range(PAGES)], data)


def refusal(path: Path, kind: type[LightpageError] = RecordingError) -> LightpageError:
    """The error with which opening a recording ends; it names the recording."""
    with pytest.raises(kind) as caught:
        Recording.open(path)
    assert str(path) in str(caught.value)
    return caught.value


EVERY = ["in_phase", "quadrature", "reference_in_phase", "symbols", "pilots"]


def link_to(link: object) -> Callable[[Path, str], object]:
    return lambda path, name: replace(path, name, lambda file, _: file.__setitem__(name, link))


def without_source(path: Path, name: str) -> None:
    virtual(path, name)
    path.with_name("source.h5").unlink()


def cut_short(path: Path, name: str) -> None:
    os.truncate(path.with_name("frames.raw"), int(0.9 * external(path, name).nbytes))


def never_written(path: Path, name: str) -> None:
    replace(path, name, lambda file, data: file.create_dataset(name, data.shape, data.dtype))


LACKING: dict[str, Callable[[Path, str], object]] = {
    "a source that was not copied along": without_source,
    "a file of raw data that is cut short": cut_short,
    "a link within the file": link_to(h5py.SoftLink("/nowhere")),
    "a link to no file": link_to(h5py.ExternalLink("gone.h5", "d")),
    "an array that was never written": never_written,
}


@pytest.mark.parametrize("name", EVERY)
@pytest.mark.parametrize("lack", LACKING)
def test_an_array_whose_data_lack_is_named(foreign: Path, name: str, lack: str) -> None:
    LACKING[lack](foreign, name)
    subject = refusal(foreign).subject
    assert f"dataset '{name}'" in subject
    for told in ("source", "raw"):
        assert (told in subject) == (told in lack)


class TestVirtualDatasets:
    def test_a_source_without_the_dataset_or_with_too_little_or_of_another_type_is_named(self, foreign: Path) -> None:
        data = virtual(foreign)
        for content in (
            {"other": data},
            {"d": data[:2]},
            {"d": data[:, :7]},
            {"d": 1 - data.astype(int)},
            {"d": data.astype("i4")},
        ):
            with h5py.File(foreign.with_name("source.h5"), "w") as other:
                other.update(content)
            assert "source.h5: dataset 'd'" in refusal(foreign).subject

    def test_sources_beside_the_recording_are_found_from_any_folder(
        self, foreign: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        data = virtual(foreign)
        elsewhere = tmp_path_factory.mktemp("elsewhere")
        monkeypatch.chdir(foreign.parent)
        with Recording.open(foreign.name) as recording:
            monkeypatch.chdir(elsewhere)
            assert recording.stored_page_bytes >= data[0].nbytes
            np.testing.assert_array_equal(recording.frames(1).in_phase, data[1])
        link = elsewhere / "link.h5"
        link.symlink_to(foreign)
        assert_shows(link, data)

    def test_sources_are_looked_for_where_the_environment_says(
        self, foreign: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        data = virtual(foreign)
        foreign.with_name("moved").mkdir()
        foreign.with_name("source.h5").rename(foreign.parent / "moved" / "source.h5")
        refusal(foreign)
        monkeypatch.setenv("HDF5_VDS_PREFIX", "/missing:${ORIGIN}/moved")
        assert_shows(foreign, data)

    def test_sources_named_by_a_path_that_is_gone_are_found_beside_the_recording(self, foreign: Path) -> None:
        replace(foreign, "in_phase", lambda file, data: show(file, "in_phase", "/gone/source.h5", data))
        with h5py.File(foreign) as file, h5py.File(foreign.with_name("source.h5"), "w") as other:
            other["d"] = data = file["quadrature"][()]
        assert_shows(foreign, data)

    def test_a_source_in_the_same_file_and_one_behind_another_are_read(self, foreign: Path) -> None:
        data = virtual(foreign)
        with h5py.File(foreign.with_name("outer.h5"), "w") as outer:
            show(outer, "d", "source.h5", data)
        with h5py.File(foreign, "r+") as file:
            del file["in_phase"]
            show(file, "in_phase", "outer.h5", data)
            file["d"] = data + 1
            del file["quadrature"]
            show(file, "quadrature", ".", data)
        with Recording.open(foreign) as recording:
            np.testing.assert_array_equal(recording.frames(1).in_phase, data[1])
            np.testing.assert_array_equal(recording.frames(1).quadrature, data[1] + 1)
        with h5py.File(foreign.with_name("source.h5"), "w") as other:
            show(other, "d", "source.h5", data)  # leads back to itself
        assert "source.h5" in refusal(foreign).subject
        foreign.with_name("source.h5").unlink()
        assert "outer.h5: dataset 'd': source" in refusal(foreign).subject

    @pytest.mark.parametrize(("there", "told"), [(np.s_[:2], "page 2"), (np.s_[:, :, :19], "")])
    def test_pages_and_parts_of_pages_without_a_source_are_refused(
        self, foreign: Path, there: tuple[slice, ...] | slice, told: str
    ) -> None:
        data = virtual(foreign)
        with h5py.File(foreign, "r+") as file:
            del file["in_phase"]
            show(file, "in_phase", "source.h5", data, shown=there, taken=there)
        assert told in str(refusal(foreign))

    @pytest.mark.parametrize("rows", [slice(0, None, 2), [0, 2]])
    def test_cameras_that_take_turns_and_halves_of_frames_are_put_together(
        self, foreign: Path, rows: slice | list[int]
    ) -> None:
        def put(file: h5py.File, data: np.ndarray) -> None:
            layout = h5py.VirtualLayout(data.shape, data.dtype)
            for name, place in {"even": np.s_[rows], "left": np.s_[1::2, :, :9], "right": np.s_[1::2, :, 9:]}.items():
                with h5py.File(foreign.with_name(f"{name}.h5"), "w") as other:
                    other["d"] = data[place][0] if name == "left" else data[place]
                    layout[place] = h5py.VirtualSource(str(foreign.with_name(f"{name}.h5")), "d", other["d"].shape)
            file.create_virtual_dataset("in_phase", layout)

        data = replace(foreign, "in_phase", put)
        assert_shows(foreign, data)

    def test_more_sources_than_may_be_open_are_read(self, foreign: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(stored, "OPEN_SOURCES", 2)
        paths = [foreign.with_name(f"{number} 50%b 100%.h5") for number in range(4)]
        for path in paths:
            shutil.copy(foreign, path)
        join(paths, joined := foreign.with_name("joined.h5"))
        with Recording.open(joined) as recording, Recording.open(foreign) as one:
            for page in range(recording.pages):
                np.testing.assert_array_equal(recording.frames(page).in_phase, one.frames(page % PAGES).in_phase)
            assert recording.stored_page_bytes == pytest.approx(one.stored_page_bytes)
            paths[0].unlink()
            with refused(paths[0].name, kind=StorageError):  # it was there: no finding about the page
                recording.frames(0)

    def numbered(self, path: Path, there: list[int]) -> np.ndarray:
        def put(file: h5py.File, data: np.ndarray) -> None:
            for number in there:
                with h5py.File(path.with_name(f"part-{number}.h5"), "w") as other:
                    other["d"] = data[number]
            properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
            space = h5py.h5s.create_simple(data.shape, (UNLIMITED, *data.shape[1:]))
            space.select_hyperslab((0, 0, 0), (UNLIMITED, 1, 1), (1, 1, 1), (1, *data.shape[1:]))
            properties.set_virtual(space, b"part-%b.h5", b"d", h5py.h5s.create_simple(data.shape[1:]))
            h5py.h5d.create(file.id, b"in_phase", h5py.h5t.STD_U16LE, space, properties)

        return replace(path, "in_phase", put)

    def test_numbered_sources_are_read_and_a_gap_is_named(self, foreign: Path) -> None:
        data = self.numbered(foreign, [0, 1, 2])
        with Recording.open(foreign) as recording:
            assert recording.pages == PAGES
            np.testing.assert_array_equal(recording.frames(2).in_phase, data[2])
        foreign.with_name("part-1.h5").unlink()
        assert "part-1.h5" in refusal(foreign).subject

    def test_a_growing_source_that_is_missing_or_short_is_refused(self, foreign: Path) -> None:
        def put(file: h5py.File, data: np.ndarray) -> None:
            layout = h5py.VirtualLayout(data.shape, data.dtype, maxshape=(None, *data.shape[1:]))
            for number, place in enumerate((slice(0, UNLIMITED, 2), slice(1, UNLIMITED, 2))):
                path = foreign.with_name(f"{number}.h5")
                with h5py.File(path, "w") as other:
                    other.create_dataset("d", data=data[number::2], maxshape=(None, *data.shape[1:]))
                    layout[place] = h5py.VirtualSource(other["d"])[:UNLIMITED]
            file.create_virtual_dataset("in_phase", layout)

        data = replace(foreign, "in_phase", put)
        assert_shows(foreign, data)
        with h5py.File(foreign.with_name("1.h5"), "r+") as other:
            other["d"].resize(0, 0)
        refusal(foreign)
        foreign.with_name("1.h5").unlink()
        assert "1.h5" in str(refusal(foreign))


class TestExternalFiles:
    def test_they_are_read(self, foreign: Path) -> None:
        data = external(foreign)
        with Recording.open(foreign) as recording:
            np.testing.assert_array_equal(recording.frames(1).in_phase, data[1])
            assert recording.stored_page_bytes >= data[0].nbytes

    def test_behind_a_virtual_dataset_too(self, foreign: Path) -> None:
        virtual(foreign)
        external(foreign.with_name("source.h5"), "d")
        os.truncate(foreign.with_name("frames.raw"), 100)
        told = str(refusal(foreign))
        assert "source.h5" in told
        assert "frames.raw" in told


class TestChunksAndFilters:
    @pytest.mark.parametrize(
        "options", [{}, {"compression": "gzip"}, {"maxshape": (None, *FRAME)}, {"chunks": (1, 7, 5)}]
    )
    def test_pages_that_were_never_written_are_named(self, foreign: Path, options: dict[str, object]) -> None:
        def put(file: h5py.File, data: np.ndarray) -> None:
            made = file.create_dataset("quadrature", data.shape, data.dtype, **{"chunks": (1, *FRAME), **options})
            made[0] = data[0]
            if "chunks" in options:  # parts of the other pages
                made[1:, :, :15] = data[1:, :, :15]

        replace(foreign, "quadrature", put)
        error = refusal(foreign)
        assert "dataset 'quadrature'" in error.subject
        assert "1 to 2" in error.got

    def unknown_filter(self, path: Path, name: str, code: int) -> None:
        """Compress a dataset by LZF, and have the file call that by another number."""
        replace(
            path,
            name,
            lambda file, data: file.create_dataset(name, data=0 * data, chunks=data.shape, compression="lzf"),
        )
        told = (32000).to_bytes(2, "little") + (8).to_bytes(2, "little")  # number, length of the name
        content = path.read_bytes()
        assert content.count(told) == 1
        path.write_bytes(content.replace(told, code.to_bytes(2, "little") + told[2:]).replace(b"lzf\0", b"\0\0\0\0"))

    @pytest.mark.parametrize(("code", "word"), [(32001, "blosc"), (311, "unknown")])
    def test_a_filter_that_is_not_here_is_named(self, foreign: Path, code: int, word: str) -> None:
        self.unknown_filter(foreign, "symbols", code)
        error = refusal(foreign)
        assert f"{word} ({code})" in error.got
        assert "hdf5plugin" in error.expected

    def test_a_filter_of_hdf5plugin_is_taken_from_there(self, foreign: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.unknown_filter(foreign, "in_phase", 32001)
        loaded: list[str] = []
        monkeypatch.setattr(stored.importlib, "import_module", loaded.append)
        monkeypatch.setattr(stored, "decodes", lambda code: bool(loaded))
        Recording.open(foreign).close()
        assert loaded == ["hdf5plugin"]

    @pytest.mark.parametrize("kind", ["f4", "i2", "c8", "?", "S2", [("a", "u1"), ("b", "u1")], None])
    def test_what_are_no_counts_is_refused(self, foreign: Path, kind: object) -> None:
        def put(file: h5py.File, data: np.ndarray) -> None:
            if kind is None:  # a type that numpy knows not
                h5py.h5d.create(file.id, b"in_phase", h5py.h5t.STD_B16LE, h5py.h5s.create_simple(data.shape))
            else:
                file["in_phase"] = np.zeros(data.shape, kind)

        replace(foreign, "in_phase", put)
        assert "dataset 'in_phase'" in refusal(foreign).subject


class TestChunkMemory:
    def shared(self, path: Path, rows: int) -> None:
        """Have pages share their chunks, which hold some of the rows."""

        def put(file: h5py.File, data: np.ndarray) -> None:
            file.create_dataset("in_phase", data=data, chunks=(PAGES, rows, FRAME[1]), compression="gzip")

        replace(path, "in_phase", put)

    def test_chunks_that_pages_share_are_kept(self, foreign: Path) -> None:
        self.shared(foreign, rows=4)
        with h5py.File(foreign) as file:
            array = stored.ArrayFile(file, "recording").array("in_phase")
            assert array is not None
            slots, size, _ = array.dataset.id.get_access_plist().get_chunk_cache()
            assert size >= 4 * np.prod(array.dataset.chunks) * array.dtype.itemsize
            assert slots > 4

    def test_chunks_beyond_the_memory_are_told_of(self, foreign: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.shared(foreign, FRAME[0])
        monkeypatch.setattr(stored, "CACHE_BYTES", 1000)
        told = Told()
        with reporting(told), Recording.open(foreign) as recording:
            recording.frames(0)
        assert any("h5repack -l in_phase:CHUNK=1x14x20" in note for note in told.notes)


class TestUnfinishedFiles:
    def test_one_that_is_being_written(self, foreign: Path) -> None:
        program = f"import h5py\nwith h5py.File({str(foreign)!r}, 'r+') as f: f.flush(); input(print(flush=True))"
        with subprocess.Popen([sys.executable, "-c", program], stdin=-1, stdout=-1, text=True) as writer:
            assert writer.stdout is not None
            assert writer.stdin is not None
            writer.stdout.readline()
            assert "unfinished" in refusal(foreign).got
            writer.communicate("\n", timeout=60)

    @pytest.mark.parametrize("swmr", [False, True])
    def test_one_whose_writer_was_stopped(self, tmp_path: Path, swmr: bool) -> None:
        path = tmp_path / "stopped.h5"
        program = f"import h5py, os\nf = h5py.File({str(path)!r}, 'w', libver='latest'); f['d'] = 1\n"
        program += f"if {swmr}: f.swmr_mode = True\nf.flush(); os._exit(0)"
        subprocess.run([sys.executable, "-c", program], check=True, timeout=60)
        error = refusal(path)
        assert "unfinished" in error.got
        assert "h5clear" in error.expected

    def test_empty_and_truncated_ones(self, foreign: Path) -> None:
        content = foreign.read_bytes()
        for size in (0, len(content) // 2):
            foreign.write_bytes(content[:size])
            assert "unfinished" in refusal(foreign).got

    def test_one_that_has_not_got_its_name_yet(self, foreign: Path) -> None:
        foreign.rename(foreign.with_name("foreign.h5.partial"))
        assert "foreign.h5.partial" in refusal(foreign).got


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_file_system_without_locks_is_read(foreign: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    original = h5py.File.__init__

    def opened(file: h5py.File, name: object, *args: object, locking: object = None, **kwargs: object) -> None:
        if isinstance(name, str) and locking is None:
            raise OSError(number, f"Unable to open file (unable to lock file, errno = {number})")
        original(file, name, *args, locking=locking, **kwargs)

    monkeypatch.setattr(h5py.File, "__init__", opened)
    with Recording.open(foreign) as recording:
        assert recording.frames(0).in_phase.any()


class TestAttributes:
    def change(self, path: Path, **values: object) -> None:
        with h5py.File(path, "r+") as file:
            file.attrs.update(values)

    def test_null_is_absent(self, foreign: Path) -> None:
        null = h5py.Empty("f4")
        self.change(foreign, levels=null, black_level=null, profile=null, code=h5py.Empty("S1"))
        for name in ("symbols", "pilots"):
            replace(foreign, name, lambda file, _, name=name: file.__setitem__(name, null))
        with Recording.open(foreign) as recording:
            header = recording.header
            assert (header.levels, header.black_level, header.declared_levels) == (256, 0, None)
            assert (header.profile_text, header.code_text, header.page_shape) == (None, None, None)
            assert (recording.symbols(0), recording.pilots(), header.own_profile()) == (None, None, None)
        self.change(foreign, camera_bit_depth=null)
        assert refusal(foreign).subject.endswith("'camera_bit_depth'")

    @pytest.mark.parametrize("kind", ["i1", ">i2", "u4", "u8", "f2", "f8", ">f4"])
    def test_numbers_of_any_kind_are_read(self, foreign: Path, kind: str) -> None:
        self.change(foreign, levels=np.array([LEVELS], kind), camera_bit_depth=np.dtype(kind).type(12))
        with Recording.open(foreign) as recording:
            assert (recording.levels, recording.bit_depth) == (LEVELS, 12)

    @pytest.mark.parametrize("value", [True, 3.5, np.nan, np.inf, [16, 16], "16", h5py.Reference(), 2 + 0j, None])
    def test_what_is_no_whole_number_is_refused(self, foreign: Path, value: object) -> None:
        if value is None:  # a type that numpy knows not
            with h5py.File(foreign, "r+") as file:
                del file.attrs["levels"]
                h5py.h5a.create(file.id, b"levels", h5py.h5t.STD_B16LE, h5py.h5s.create(h5py.h5s.SCALAR))
        else:
            self.change(foreign, levels=value)
        assert refusal(foreign).subject.endswith("attribute 'levels'")

    def test_texts_of_any_kind_are_read(self, foreign: Path) -> None:
        self.change(foreign, format=np.bytes_(b"lightpage-recording".ljust(40, b"\0")), code=b"\xff caf\xe9")
        with Recording.open(foreign) as recording:
            assert recording.header.code_text is not None
            recording.header.code_text.encode()
        self.change(foreign, format=np.array(["lightpage-recording"], object))
        Recording.open(foreign).close()


def failing(monkeypatch: pytest.MonkeyPatch, error: Exception, times: int, name: str = "/in_phase") -> None:
    """Have the next reads of a dataset fail, and all that do without HDF5."""
    original, left = h5py.Dataset.__getitem__, [times]
    monkeypatch.setattr(os, "preadv", Mock(side_effect=OSError(errno.EIO, "Input/output error")))

    def read(dataset: h5py.Dataset, *args: object, **kwargs: object) -> object:
        if dataset.name == name and left[0]:
            left[0] -= 1
            raise error
        return original(dataset, *args, **kwargs)

    monkeypatch.setattr(h5py.Dataset, "__getitem__", read)


EIO_OF_HDF5 = OSError(
    "Can't synchronously read data (file read failed: errno = 5, error message = 'Input/output error')"
)


@pytest.mark.parametrize("options", [{}, {"chunks": (1, *FRAME)}, {"dtype": ">u2"}])
def test_pages_that_lie_in_the_file_as_they_are_are_read_without_hdf5(
    foreign: Path, monkeypatch: pytest.MonkeyPatch, options: dict[str, object]
) -> None:
    data = replace(foreign, "in_phase", lambda f, d: f.create_dataset("in_phase", data=d, **options))
    with Recording.open(foreign) as recording:
        monkeypatch.setattr(h5py.Dataset, "__getitem__", Mock(side_effect=AssertionError))
        for page in range(recording.pages):
            np.testing.assert_array_equal(recording.frames(page).in_phase, data[page])
        os.truncate(foreign, 1000)
        with refused("dataset 'in_phase' page 1", kind=StorageError):
            recording.frames(1)


class TestStorageThatFails:
    @pytest.mark.parametrize(
        "error", [EIO_OF_HDF5, OSError(errno.ESTALE, "Stale file handle"), KeyError(str(EIO_OF_HDF5))]
    )
    def test_a_momentary_failure_costs_nothing_and_one_that_lasts_is_a_storage_error(
        self, foreign: Path, monkeypatch: pytest.MonkeyPatch, paused: Callable[[], float], error: Exception
    ) -> None:
        with Recording.open(foreign) as recording:
            expected = recording.frames(1).in_phase
            failing(monkeypatch, error, 2)
            np.testing.assert_array_equal(recording.frames(1).in_phase, expected)
            assert paused() == pytest.approx(sum(hdf5.PAUSES_S))
            failing(monkeypatch, error, 3)
            with refused("dataset 'in_phase' page 1", kind=StorageError):
                recording.frames(1)
            assert recording.has_symbols
            np.testing.assert_array_equal(recording.frames(1).in_phase, expected)
        assert paused() == pytest.approx(2 * sum(hdf5.PAUSES_S))

    def test_another_file_of_the_same_name_is_not_read(
        self, foreign: Path, monkeypatch: pytest.MonkeyPatch, paused: Callable[[], float]
    ) -> None:
        with Recording.open(foreign) as recording:
            failing(monkeypatch, EIO_OF_HDF5, 1)
            foreign.unlink()
            foreign.write_bytes(b"another")
            with refused(got="another file", kind=RecordingError):
                recording.frames(1)

    def test_a_share_that_is_gone_for_a_moment_is_no_finding(
        self, foreign: Path, monkeypatch: pytest.MonkeyPatch, paused: Callable[[], float]
    ) -> None:
        away = foreign.with_name("away")
        with Recording.open(foreign) as recording:
            failing(monkeypatch, EIO_OF_HDF5, 1)
            foreign.rename(away)
            with pytest.raises(StorageError):
                recording.frames(1)
            away.rename(foreign)
            assert recording.frames(1).in_phase.any()
            assert recording.header.code_text is None

    def test_damaged_data_are_told_once_and_in_words(self, foreign: Path, paused: Callable[[], float]) -> None:
        replace(
            foreign, "in_phase", lambda f, d: f.create_dataset("in_phase", data=d, chunks=(1, *FRAME), fletcher32=True)
        )
        with h5py.File(foreign) as file:
            at = file["in_phase"].id.get_chunk_info(1).byte_offset
        content = bytearray(foreign.read_bytes())
        content[at + 9] ^= 255
        foreign.write_bytes(content)
        with Recording.open(foreign) as recording:
            recording.frames(0)
            with refused("dataset 'in_phase' page 1", kind=StorageError):
                recording.frames(1)
        assert paused() == 0

    def test_a_file_that_cannot_be_opened_for_a_moment(
        self, foreign: Path, monkeypatch: pytest.MonkeyPatch, paused: Callable[[], float]
    ) -> None:
        original, left = h5py.File.__init__, [2]

        def opened(file: h5py.File, *args: object, **kwargs: object) -> None:
            left[0] -= 1
            if left[0] >= 0:
                raise OSError(errno.EIO, "Unable to open file")
            original(file, *args, **kwargs)

        monkeypatch.setattr(h5py.File, "__init__", opened)
        Recording.open(foreign).close()
        assert paused() == pytest.approx(sum(hdf5.PAUSES_S))
        left[0] = 3
        refusal(foreign, StorageError)

    @pytest.mark.parametrize("number", [errno.EMFILE, errno.ENOMEM])
    def test_a_short_resource_is_called_that(
        self, foreign: Path, monkeypatch: pytest.MonkeyPatch, paused: Callable[[], float], number: int
    ) -> None:
        with Recording.open(foreign) as recording:
            failing(monkeypatch, OSError(f"Can't read data (errno = {number})"), 1)
            with pytest.raises(SurroundingsError):
                recording.frames(0)
        assert paused() == 0

    def test_a_source_that_fails_for_a_moment_is_not_filled_in(
        self, foreign: Path, monkeypatch: pytest.MonkeyPatch, paused: Callable[[], float]
    ) -> None:
        data = virtual(foreign)
        with Recording.open(foreign) as recording:
            failing(monkeypatch, EIO_OF_HDF5, 2, "/d")
            np.testing.assert_array_equal(recording.frames(1).in_phase, data[1])
            failing(monkeypatch, EIO_OF_HDF5, 3, "/d")
            with refused("source.h5", kind=StorageError):
                recording.frames(1)


def test_whatever_is_damaged_is_told_in_plain_words(foreign: Path, paused: Callable[[], float]) -> None:
    content, rng = foreign.read_bytes(), np.random.default_rng(0)
    told: list[str] = []
    for place in rng.integers(0, 12_000, 60):
        damaged = bytearray(content)
        damaged[place] ^= 255
        foreign.write_bytes(damaged)
        try:
            with Recording.open(foreign) as recording:
                for page in range(recording.pages):
                    recording.shown(page)
        except LightpageError as error:
            told.append(str(error))
    assert told
    assert not any("synchronously" in text for text in told)
    assert paused() == 0


def test_joined_pages_follow_one_another_and_references_are_the_first_ones(tmp_path: Path) -> None:
    paths = [tmp_path / "b.h5", tmp_path / "a.h5"]
    for number, path in enumerate(paths):
        device = toy.ToyDevice((100.0 + 10 * number, 80.0), seed=number)
        toy.write_toy_recording(path, device, 16, 2 + number, seed=number)
    join(paths, tmp_path / "joined.h5")
    expected = []
    for path in paths:
        with Recording.open(path) as recording:
            expected += [recording.shown(page) for page in range(recording.pages)]
    with Recording.open(tmp_path / "joined.h5") as joined:
        assert (joined.pages, joined.levels, joined.references().in_phase.mean()) == (5, 16, 100.0)
        for page, (pair, symbols) in enumerate(expected):
            np.testing.assert_array_equal(joined.symbols(page), symbols)
            np.testing.assert_array_equal(joined.frames(page).quadrature, pair.quadrature)
    toy.write_toy_recording(tmp_path / "a.h5", toy.ToyDevice(), 8, 2)
    with refused("a.h5: levels", 8, RecordingError):
        join(paths, tmp_path / "joined.h5")


@pytest.mark.parametrize("path", [".", "/", ""])
def test_a_path_without_a_name_is_no_recording(path: str) -> None:
    with pytest.raises(RecordingError, match="a folder"):
        Recording.open(Path(path))
