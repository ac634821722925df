"""A file on pages: how they are numbered, that the file comes back whole or not at all, and what is missing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from lightpage.codec.header import MOST_BYTES
from lightpage.codec.page_codec import PageBytes
from lightpage.codec.volume import Volume, encode_volume, restore_group
from lightpage.codec.volume_file import VolumeFile, ranges
from lightpage.errors import InvalidInputError
from tests.lightpage.codec.light import codec_of, noisy
from tests.lightpage.full_disk import full_disk

VOLUMES = [
    Volume(7, file_bytes, 10, *group)
    for file_bytes in (0, 1, 9, 10, 11, 99, 100, 101, 249, 250, 251)
    for group in ((1, 0), (1, 2), (5, 3), (4, 0), (10, 2), (25, 1), (200, 55))
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

    @pytest.mark.parametrize("volume", VOLUMES)
    def test_each_page_is_followed_by_the_next_that_is_written(self, volume: Volume) -> None:
        numbers = [number for number, _, _ in listing(volume)]
        assert [volume.following(number) for number in numbers] == [*numbers[1:], None]

    def test_it_says_what_a_file_of_pages_keeps(self) -> None:
        assert Volume(7, 99, 10, 5, 3).to_json() == {
            "volume": 7,
            "file_bytes": 99,
            "page_bytes": 10,
            "data_pages": 5,
            "parity_pages": 3,
        }

    @pytest.mark.parametrize(
        ("change", "complaint"),
        [
            ({"id": -1}, "volume id: got -1"),
            ({"id": 1 << 32}, "volume id: got 4294967296"),
            ({"file_bytes": -1}, "file: got -1 bytes"),
            ({"file_bytes": MOST_BYTES + 1}, f"file: got {MOST_BYTES + 1} bytes"),
            ({"data_pages": 0}, "group of pages: got 0 data and 3 parity pages"),
            ({"parity_pages": -1}, "group of pages: got 5 data and -1 parity pages"),
            ({"data_pages": 253}, "group of pages: got 253 data and 3 parity pages"),
            # 2^24 pages in groups of 8 hold 5 x 2^21 data pages
            ({"file_bytes": 10 * 5 * (1 << 21) + 1}, f"file: got {(1 << 24) + 8} pages"),
        ],
    )
    def test_what_cannot_be_numbered_is_refused(self, change: dict[str, int], complaint: str) -> None:
        with pytest.raises(InvalidInputError, match=complaint):
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
    return write(file, Volume(0xCAFE, len(file), SIZE, 5, 3))


def collect(path: Path, pages: Iterator[PageBytes] | list[PageBytes]) -> tuple[bytes, VolumeFile]:
    """The file that comes of pages."""
    with VolumeFile(path, SIZE) as volume_file:
        for page in pages:
            assert volume_file.add(page)
        volume_file.restore()
        volume_file.complete()
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]
    return path.read_bytes(), volume_file


class TestEncoding:
    def test_pages_hold_the_file_and_its_parity(self, written: Written) -> None:
        k, m = written.volume.data_pages, written.volume.parity_pages
        for number, kind, place in listing(written.volume):
            page = written.pages[number]
            assert page.header is not None
            assert (page.header.volume, page.header.volume_bytes) == (0xCAFE, len(written.file))
            assert page.header.code_id == CODEC.code.id
            assert (page.data_pages, page.parity_pages) == (k, m)
            if kind == "data":
                assert page.data == written.file[place * SIZE :][:SIZE].ljust(SIZE, b"\0")

    def test_each_group_is_restored_from_any_of_its_pages(self, written: Written) -> None:
        volume, rng = written.volume, np.random.default_rng(2)
        for group in range(volume.groups):
            numbers = volume.numbers_in(group)
            data = [written.pages[number].data for number in numbers[: volume.data_in(group)]]
            for _ in range(20):
                lost = rng.choice(numbers, 3, replace=False)
                left = {n: written.pages[n].data or b"" for n in numbers if n not in lost}
                assert restore_group(volume, group, left) == data
                if set(numbers[: len(data)]) - set(left):
                    left.pop(next(iter(left)))
                    assert restore_group(volume, group, left) is None

    def test_a_file_is_read_from_where_it_stands(self, written: Written) -> None:
        file = BytesIO(b"before" + written.file)
        file.seek(6)
        first = next(encode_volume(CODEC, written.volume, file, PILOTS))
        again = next(encode_volume(CODEC, written.volume, BytesIO(written.file), PILOTS))
        assert np.array_equal(first, again)

    @pytest.mark.parametrize("missing", [1, 5, 6, SIZE + 5, 22 * SIZE + 5])
    def test_a_file_that_shrank_is_noticed(self, written: Written, missing: int) -> None:
        size = len(written.file)
        with pytest.raises(InvalidInputError, match=rf"file: got {size - missing} bytes, wanted {size}, as it had"):
            list(encode_volume(CODEC, written.volume, BytesIO(written.file[:-missing]), PILOTS))

    @pytest.mark.parametrize("more", [1, SIZE, 1000])
    def test_a_file_that_grew_is_noticed(self, written: Written, more: int) -> None:
        with pytest.raises(InvalidInputError, match=rf"file: got more bytes, wanted {len(written.file)}, as it had"):
            list(encode_volume(CODEC, written.volume, BytesIO(written.file + bytes(more)), PILOTS))


class TestFile:
    def test_pages_in_any_order_give_the_file(self, written: Written, tmp_path: Path) -> None:
        pages = list(written.pages.values())
        for seed in range(3):
            order = np.random.default_rng(seed).permutation(len(pages))
            got, volume_file = collect(tmp_path / "file", [pages[i] for i in order])
            assert got == written.file
            assert volume_file.volume == written.volume
            assert volume_file.missing() == []

    def test_repeated_pages_are_counted(self, written: Written, tmp_path: Path) -> None:
        pages = list(written.pages.values())
        got, volume_file = collect(tmp_path / "file", pages + pages[::2] + pages[::-1])
        assert got == written.file
        assert volume_file.repeated == len(pages[::2]) + len(pages)

    @pytest.mark.parametrize("seed", range(5))
    def test_three_lost_pages_of_every_group_come_back(self, written: Written, tmp_path: Path, seed: int) -> None:
        rng, volume = np.random.default_rng(seed), written.volume
        lost = {int(n) for g in range(volume.groups) for n in rng.choice(volume.numbers_in(g), 3, replace=False)}
        data = sorted(n for n, kind, _ in listing(volume) if kind == "data" and n in lost)
        assert data
        path = tmp_path / "file"
        with VolumeFile(path, SIZE) as volume_file:
            for number, page in reversed(written.pages.items()):
                if number not in lost:
                    volume_file.add(page)
            assert volume_file.missing() == sorted(lost)
            done = volume_file.restore()
            assert (done.restored, done.lost) == (tuple(data), ())
            volume_file.complete()
        assert path.read_bytes() == written.file

    def test_data_that_are_lost_are_named_and_zero(self, written: Written, tmp_path: Path) -> None:
        path, lost = tmp_path / "file", {8, 9, 11, 14}  # three data pages and one parity page of the second group
        with VolumeFile(path, SIZE) as volume_file:
            for number, page in written.pages.items():
                if number not in lost | {0}:
                    volume_file.add(page)
            done = volume_file.restore()
            assert (done.restored, done.lost) == ((0,), (8, 9, 11))
            volume_file.complete()
        expected = bytearray(written.file)
        for page in (5, 6, 8):
            expected[page * SIZE : (page + 1) * SIZE] = bytes(SIZE)
        assert path.read_bytes() == bytes(expected)

    def test_lost_pages_at_the_end_leave_the_length_right(self, written: Written, tmp_path: Path) -> None:
        path = tmp_path / "file"
        with VolumeFile(path, SIZE) as volume_file:
            volume_file.add(written.pages[0])
            assert volume_file.restore().lost == tuple(
                n for n, kind, _ in listing(written.volume) if kind == "data" and n
            )
            volume_file.complete()
        assert path.read_bytes() == written.file[:SIZE].ljust(len(written.file), b"\0")

    @pytest.mark.parametrize("size", [0, 1, SIZE - 1, SIZE, SIZE + 1, 5 * SIZE, 5 * SIZE + 1])
    @pytest.mark.parametrize("group", [(5, 3), (1, 0), (3, 1)])
    def test_files_of_any_length(self, tmp_path: Path, size: int, group: tuple[int, int]) -> None:
        file = np.random.default_rng(size).bytes(size)
        case = write(file, Volume(1, size, SIZE, *group))
        assert collect(tmp_path / "whole", list(case.pages.values()))[0] == file
        (tmp_path / "whole").unlink()
        if group[1]:
            kept = [page for number, page in case.pages.items() if number]  # without the first page
            assert collect(tmp_path / "restored", kept)[0] == file

    def test_pages_of_another_volume_are_counted_and_left_out(self, written: Written, tmp_path: Path) -> None:
        other = write(b"other", Volume(9, 5, SIZE, 5, 3))
        for volume_id, first, file in ((None, written, written.file), (9, written, b"other"), (None, other, b"other")):
            path = tmp_path / "file"
            second = other if first is written else written
            with VolumeFile(path, SIZE, volume_id) as volume_file:
                taken = [volume_file.add(page) for case in (first, second) for page in case.pages.values()]
                kept, foreign = (written, other) if file == written.file else (other, written)
                assert taken.count(True) == len(kept.pages)
                assert volume_file.foreign == {foreign.volume.id: len(foreign.pages)}
                volume_file.restore()
                volume_file.complete()
            assert path.read_bytes() == file

    def test_two_pages_of_a_number_with_different_bytes_are_refused(self, written: Written, tmp_path: Path) -> None:
        page = written.pages[6]
        other = replace(page, data=written.pages[5].data)
        with VolumeFile(tmp_path / "file", SIZE) as volume_file:
            volume_file.add(page)
            with pytest.raises(InvalidInputError, match=r"volume 51966: page 6: got two pages of this number"):
                volume_file.add(other)
            assert volume_file.repeated == 0

    @pytest.mark.parametrize("change", [{"data_pages": 6}, {"parity_pages": 2}])
    def test_pages_that_disagree_about_their_groups_are_refused(
        self, written: Written, tmp_path: Path, change: dict[str, int]
    ) -> None:
        with VolumeFile(tmp_path / "file", SIZE) as volume_file:
            volume_file.add(written.pages[0])
            with pytest.raises(
                InvalidInputError, match=r"volume 51966: page 1: got .* \+ \d pages, wanted .*5 \+ 3 pag"
            ):
                volume_file.add(replace(written.pages[1], **change))

    def test_pages_that_disagree_about_the_files_size_are_refused(self, written: Written, tmp_path: Path) -> None:
        page = written.pages[1]
        assert page.header is not None
        with VolumeFile(tmp_path / "file", SIZE) as volume_file:
            volume_file.add(written.pages[0])
            with pytest.raises(
                InvalidInputError, match=rf"page 1: got 5 bytes in .*wanted {len(written.file)} bytes in"
            ):
                volume_file.add(replace(page, header=replace(page.header, volume_bytes=5)))

    @pytest.mark.parametrize("number", [4 * 8 + 3, 4 * 8 + 4, 5 * 8, (1 << 24) - 1])
    def test_a_number_beyond_the_files_end_is_refused(self, written: Written, tmp_path: Path, number: int) -> None:
        page = written.pages[0]
        assert page.header is not None
        with VolumeFile(tmp_path / "file", SIZE) as volume_file:
            volume_file.add(page)
            with pytest.raises(InvalidInputError, match=f"page {number}: got a number beyond the file's end"):
                volume_file.add(replace(page, header=replace(page.header, page=number)))

    def test_no_page_makes_no_file(self, tmp_path: Path) -> None:
        with VolumeFile(tmp_path / "file", SIZE) as volume_file:
            assert volume_file.missing() == []
            assert volume_file.restore().lost == ()
            with pytest.raises(InvalidInputError, match=r"file .*file: got no page, wanted at least one"):
                volume_file.complete()
        assert list(tmp_path.iterdir()) == []

    def test_a_file_that_is_not_completed_is_not_there(self, written: Written, tmp_path: Path) -> None:
        path = tmp_path / "file"
        path.write_bytes(b"earlier")
        with VolumeFile(path, SIZE) as volume_file:
            volume_file.add(written.pages[0])
        with pytest.raises(KeyboardInterrupt), VolumeFile(path, SIZE) as volume_file:  # noqa: PT012
            volume_file.add(written.pages[0])
            raise KeyboardInterrupt
        assert [entry.name for entry in tmp_path.iterdir()] == ["file"]
        assert path.read_bytes() == b"earlier"

    def test_a_folder_that_is_not_there_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(
            InvalidInputError, match=r"file .*file\.partial: got No such file.*wanted a file that can be w"
        ):
            VolumeFile(tmp_path / "no" / "file", SIZE)


def make_file(path: Path, pages: list[PageBytes], room_for_pages: int, room_to_restore: int) -> None:
    """Make the file of pages on a disk that is full beyond so many bytes."""
    with VolumeFile(path, SIZE) as volume_file:
        with full_disk(room_for_pages):
            for page in pages:
                volume_file.add(page)
        with full_disk(room_to_restore):
            volume_file.restore()


class TestFullDisk:
    ENOUGH = 1 << 20

    @pytest.mark.parametrize("room", [0, SIZE, 2 * SIZE + 10])
    def test_pages_that_find_no_room_leave_nothing(self, written: Written, tmp_path: Path, room: int) -> None:
        with pytest.raises(InvalidInputError, match=r"file .*file\.partial: got .*wanted room for it on the disk"):
            make_file(tmp_path / "file", list(written.pages.values()), room, self.ENOUGH)
        assert list(tmp_path.iterdir()) == []

    def test_restored_pages_that_find_no_room_leave_nothing(self, written: Written, tmp_path: Path) -> None:
        pages = [page for number, page in written.pages.items() if number not in (8, 9)]
        with pytest.raises(InvalidInputError, match=r"file .*file\.partial: got .*wanted room for it on the disk"):
            make_file(tmp_path / "file", pages, self.ENOUGH, 5 * SIZE)
        assert list(tmp_path.iterdir()) == []

    def test_a_file_that_cannot_be_completed_leaves_the_earlier_one(self, written: Written, tmp_path: Path) -> None:
        path = tmp_path / "file"
        path.mkdir()  # no file can have this name
        with VolumeFile(path, SIZE) as volume_file:
            volume_file.add(written.pages[0])
            with pytest.raises(InvalidInputError, match=r"file .*file: got .*wanted a file that can be completed"):
                volume_file.complete()
        assert [entry.name for entry in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    ("numbers", "text"),
    [((), ""), ((4,), "4"), ((1, 2), "1-2"), ((7, 3, 1, 2), "1-3, 7"), ((0, 2, 4, 5), "0, 2, 4-5")],
)
def test_numbers_for_people(numbers: tuple[int, ...], text: str) -> None:
    assert ranges(numbers) == text
