"""A file on pages: how they are numbered, that the file comes back whole or not at all, and what is missing."""

from collections.abc import Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from lightpage.codec.header import MOST_BYTES
from lightpage.codec.page_bytes import PageBytes
from lightpage.codec.volume import Volume, encode_volume
from lightpage.codec.volume_file import MOST_VOLUMES, VolumeFile, VolumeFiles, ranges
from lightpage.errors import LostDataError, SurroundingsError
from tests.lightpage.codec.light import codec_of, noisy
from tests.lightpage.full_disk import full_disk
from tests.lightpage.refused import refused

VOLUMES = [
    Volume(7, file_bytes, 10, *group)
    for file_bytes in (0, 1, 10, 11, 249, 250, 251)
    for group in ((1, 0), (1, 2), (5, 3), (10, 2), (200, 55))
]


def listing(volume: Volume) -> list[tuple[int, str, int]]:
    """All pages that are written, by the specification: number, kind, data page of the file or place of the parity."""
    data = max(1, -(-volume.file_bytes // volume.page_bytes))
    k, m = volume.data_pages, volume.parity_pages
    pages = [(page // k * (k + m) + page % k, "data", page) for page in range(data)]
    for group in range(-(-data // k)):
        pages += [(group * (k + m) + k + i, "parity", i) for i in range(m)]
    return sorted(pages)


class TestNumbers:
    @pytest.mark.parametrize("volume", VOLUMES)
    def test_pages_are_numbered_as_listed(self, volume: Volume) -> None:
        pages = listing(volume)
        numbers = [number for number, _, _ in pages]
        assert volume.pages == len(pages)
        assert volume.file_pages == sum(kind == "data" for _, kind, _ in pages)
        assert [n for group in range(volume.groups) for n in volume.numbers_in(group)] == numbers
        assert volume.group_pages == volume.data_pages + volume.parity_pages
        for group in range(volume.groups):
            first = group * volume.group_pages
            mine = [page for page in pages if first <= page[0] < first + volume.group_pages]
            assert volume.data_in(group) == sum(kind == "data" for _, kind, _ in mine)
        beyond = volume.groups * volume.group_pages
        assert [number for number in range(beyond + 300) if volume.holds(number)] == numbers
        assert [volume.following(number) for number in numbers] == [*numbers[1:], None]

    @pytest.mark.parametrize(
        ("change", "subject", "got"),
        [
            ({"id": -1}, "volume id", -1),
            ({"data_pages": 0}, "group of pages", "0 data and 3 parity"),
            # 2^24 pages in groups of 8 hold 5 x 2^21 data pages
            ({"file_bytes": 10 * 5 * (1 << 21) + 1}, "file", (1 << 24) + 8),
        ],
    )
    def test_what_cannot_be_numbered_is_refused(self, change: dict[str, int], subject: str, got: object) -> None:
        with refused(subject, got):
            replace(Volume(7, 99, 10, 5, 3), **change)

    def test_the_largest_volume_is_allowed(self) -> None:
        volume = Volume((1 << 32) - 1, 10 * 5 * (1 << 21), 10, 5, 3)
        assert volume.pages == 1 << 24
        assert volume.holds((1 << 24) - 1)
        assert not volume.holds(1 << 24)
        assert Volume(0, MOST_BYTES, 1 << 20, 200, 55).groups == -(-(1 << 20) // 200)


CODEC = codec_of(16, 2, 700, 0)
SIZE = CODEC.user_bytes
PILOTS = np.zeros(np.count_nonzero(CODEC.pilots), np.uint8)


class Written(NamedTuple):
    """A file, how it lies on pages, and what is read from each."""

    file: bytes
    volume: Volume
    pages: dict[int, PageBytes]


def write(file: bytes, volume: Volume) -> Written:
    """Put a file on pages and read them in perfect light."""
    symbols = np.concatenate(list(encode_volume(CODEC, volume, BytesIO(file), PILOTS)))
    found = [CODEC.decode(*noisy(page, 16, np.inf, np.random.default_rng(0))) for page in symbols]
    numbers = [number for number, _, _ in listing(volume)]
    assert [page.header.page for page in found if page.header] == numbers
    return Written(file, volume, dict(zip(numbers, found, strict=True)))


@pytest.fixture(scope="module")
def written() -> Written:
    """23 data pages, the last not full, in groups of 5 + 3: the last group lacks two data pages."""
    file = np.random.default_rng(1).bytes(22 * SIZE + 5)
    return write(file, whole(0xCAFE, file))


def whole(number: int, file: bytes, data_pages: int = 5, parity_pages: int = 3) -> Volume:
    return Volume.of_file(BytesIO(file), number, SIZE, data_pages, parity_pages)


def chosen(files: VolumeFiles) -> VolumeFile:
    """The only volume."""
    found = files.chosen()
    assert found is not None
    return found


def collect(path: Path, pages: Iterator[PageBytes] | list[PageBytes]) -> tuple[bytes, VolumeFile]:
    """The file that comes of pages."""
    with VolumeFiles(path) as files:
        for page in pages:
            assert files.add(page)
        file = chosen(files)
        file.restore()
        file.complete()
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]
    return path.read_bytes(), file


def test_a_file_that_shrank_or_grew_is_noticed(written: Written) -> None:
    for size in (-1, -5, -6, -SIZE - 5):
        with refused("file", len(written.file) + size):
            list(encode_volume(CODEC, written.volume, BytesIO(written.file[:size]), PILOTS))
    with refused("file", "more bytes"):
        list(encode_volume(CODEC, written.volume, BytesIO(written.file + b"\0"), PILOTS))


class TestFile:
    def test_pages_in_any_order_and_repeated_give_the_file(self, written: Written, tmp_path: Path) -> None:
        pages = list(written.pages.values())
        order = np.random.default_rng(0).permutation(len(pages))
        got, volume_file = collect(tmp_path / "file", [*(pages[i] for i in order), *pages[::2], *pages[::-1]])
        assert got == written.file
        assert volume_file.volume == written.volume
        assert volume_file.missing() == []
        assert volume_file.repeated == len(pages[::2]) + len(pages)

    @pytest.mark.parametrize("seed", range(2))
    def test_three_lost_pages_of_every_group_come_back(self, written: Written, tmp_path: Path, seed: int) -> None:
        rng, volume = np.random.default_rng(seed), written.volume
        lost = {int(n) for g in range(volume.groups) for n in rng.choice(volume.numbers_in(g), 3, replace=False)}
        data = sorted(n for n, kind, _ in listing(volume) if kind == "data" and n in lost)
        assert data
        path = tmp_path / "file"
        with VolumeFiles(path) as files:
            for number, page in reversed(written.pages.items()):
                if number not in lost:
                    files.add(page)
            assert chosen(files).missing() == sorted(lost)
            done = chosen(files).restore()
            assert (done.restored, done.lost) == (tuple(data), ())
            chosen(files).complete()
        assert path.read_bytes() == written.file

    def test_data_that_are_lost_are_named_and_zero(self, written: Written, tmp_path: Path) -> None:
        # three data pages and one parity page of the second group, the last data page and the parity of the last one
        path, lost = tmp_path / "file", {8, 9, 11, 14, 34, 37, 38, 39}
        with VolumeFiles(path) as files:
            for number, page in written.pages.items():
                if number not in lost | {0}:
                    files.add(page)
            done = chosen(files).restore()
            assert (done.restored, done.lost) == ((0,), (8, 9, 11, 34))
            chosen(files).complete(done.lost)
        expected = bytearray(written.file)
        for page in (5, 6, 8):
            expected[page * SIZE : (page + 1) * SIZE] = bytes(SIZE)
        expected[22 * SIZE :] = bytes(5)
        assert path.read_bytes() == bytes(expected)

    @pytest.mark.parametrize("size", [0, 1, SIZE, SIZE + 1, 5 * SIZE])
    @pytest.mark.parametrize("group", [(5, 3), (1, 0), (3, 1)])
    def test_files_of_any_length(self, tmp_path: Path, size: int, group: tuple[int, int]) -> None:
        file = np.random.default_rng(size).bytes(size)
        case = write(file, whole(1, file, *group))
        assert collect(tmp_path / "whole", list(case.pages.values()))[0] == file
        (tmp_path / "whole").unlink()
        if group[1]:
            kept = [page for number, page in case.pages.items() if number]  # without the first page
            assert collect(tmp_path / "restored", kept)[0] == file

    def test_one_of_several_volumes_is_chosen(self, written: Written, tmp_path: Path) -> None:
        path, others = tmp_path / "file", [write(b"other", whole(9, b"other")), write(b"third", whole(9, b"third"))]
        with VolumeFiles(path) as files:
            for case in (others[0], written, others[1]):
                assert {files.add(page) for page in case.pages.values()} == {case.volume}
            assert files.counts() == {case.volume: len(case.pages) for case in (others[0], written, others[1])}
            for asked in ((), (9,), (8,), (written.volume.id, 1)):
                with refused("volume", f"{written.volume.id}:"):
                    files.chosen(*asked)
            assert files.chosen(9, others[1].volume.checksum).volume == others[1].volume
            files.chosen(written.volume.id).complete()
        assert path.read_bytes() == written.file
        assert [entry.name for entry in tmp_path.iterdir()] == ["file"]

    def test_the_files_checksum_tells_pages_of_two_files_apart(self, written: Written, tmp_path: Path) -> None:
        """Two files have the same number, size, groups and, by accident, checksum."""
        other = write(written.file[::-1], whole(written.volume.id, written.file[::-1]))
        with VolumeFiles(tmp_path / "file") as files:
            for number, page in written.pages.items():
                files.add(page if number % 2 else replace(other.pages[number], file=page.file))
            assert chosen(files).restore().lost == ()
            with refused(kind=LostDataError):
                chosen(files).complete()
        assert list(tmp_path.iterdir()) == []

    def test_two_processes_do_not_share_a_partial_file(self, written: Written, tmp_path: Path) -> None:
        path = tmp_path / "file"
        with VolumeFiles(path) as files, VolumeFiles(path) as second:
            files.add(written.pages[0])
            with refused(".partial"):
                second.add(written.pages[1])
            chosen(files).complete([1])
        assert path.exists()

    def test_two_pages_of_a_number_with_different_bytes_are_refused(self, written: Written, tmp_path: Path) -> None:
        page = written.pages[6]
        other = replace(page, data=written.pages[5].data)
        with VolumeFiles(tmp_path / "file") as files:
            files.add(page)
            with refused("volume 51966: page 6"):
                files.add(other)
            assert chosen(files).repeated == 0

    def test_pages_that_disagree_about_the_file_are_of_other_volumes(self, written: Written, tmp_path: Path) -> None:
        page = written.pages[1]
        changes = [
            replace(page, file=replace(page.file, data_pages=6)),
            replace(page, file=replace(page.file, parity_pages=2)),
            replace(page, file=replace(page.file, checksum=1)),
            replace(page, header=replace(page.header, volume_bytes=len(written.file) - 1)),
        ]
        with VolumeFiles(tmp_path / "file") as files:
            volumes = {files.add(each) for each in (written.pages[0], *changes)}
        assert len(volumes) == 5
        assert None not in volumes

    @pytest.mark.parametrize("number", [4 * 8 + 3, 4 * 8 + 4, 5 * 8, (1 << 24) - 1])
    def test_a_number_beyond_the_files_end_is_of_no_volume(self, written: Written, tmp_path: Path, number: int) -> None:
        page = written.pages[0]
        with VolumeFiles(tmp_path / "file") as files:
            assert files.add(replace(page, header=replace(page.header, page=number))) is None
            assert files.add(replace(page, file=replace(page.file, data_pages=0))) is None
            assert files.add(replace(page, data=None)) is None
            assert files.counts() == {}

    def test_more_volumes_than_are_collected_are_counted(self, written: Written, tmp_path: Path) -> None:
        page = written.pages[0]
        with VolumeFiles(tmp_path / "file") as files:
            for checksum in range(MOST_VOLUMES + 3):
                files.add(replace(page, file=replace(page.file, checksum=checksum)))
            assert (len(files.counts()), files.dropped) == (MOST_VOLUMES, 3)

    def test_a_file_that_is_not_completed_is_not_there(self, written: Written, tmp_path: Path) -> None:
        path = tmp_path / "file"
        path.write_bytes(b"earlier")
        with VolumeFiles(path) as files:
            files.add(written.pages[0])
        with pytest.raises(KeyboardInterrupt), VolumeFiles(path) as files:  # noqa: PT012
            files.add(written.pages[0])
            raise KeyboardInterrupt
        assert [entry.name for entry in tmp_path.iterdir()] == ["file"]
        assert path.read_bytes() == b"earlier"


class TestFullDisk:
    ENOUGH = 1 << 20

    @pytest.mark.parametrize(("room", "to_restore"), [(0, ENOUGH), (2 * SIZE + 10, ENOUGH), (ENOUGH, 5 * SIZE)])
    def test_pages_that_find_no_room_leave_nothing(
        self, written: Written, tmp_path: Path, room: int, to_restore: int
    ) -> None:
        pages = [page for number, page in written.pages.items() if number not in (8, 9)]
        with refused(".partial", kind=SurroundingsError), VolumeFiles(tmp_path / "file") as files:
            with full_disk(room):
                for page in pages:
                    files.add(page)
            with full_disk(to_restore):
                chosen(files).restore()
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("numbers", "text"), [((), ""), ((4,), "4"), ((1, 2), "1-2"), ((7, 3, 1, 2), "1-3, 7"), ((0, 2, 4, 5), "0, 2, 4-5")]
)
def test_numbers_for_people(numbers: tuple[int, ...], text: str) -> None:
    assert ranges(numbers) == text
