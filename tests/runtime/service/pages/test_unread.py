"""Claims about pages of a range that came to nothing: which of them are worth another look."""

from lightpage.codec.page_bytes import FileFacts, Header, Loss, PageBytes
from lightpage.codec.volume import Volume
from lightpage.runtime.service.pages.reading import DataPage, Unread

VOLUME = Volume(id=7, file_bytes=60, page_bytes=10, data_pages=3, parity_pages=1)
"""Pages 0 to 3 and 4 to 7 are its groups; the fourth of each is of parity."""


def header(page: int) -> Header:
    return Header(1, VOLUME.id, page, VOLUME.file_bytes)


def read(index: int, page: int) -> DataPage:
    found = PageBytes(header(page), bytes(10), FileFacts(3, 1, 0), None, 0.0, 0, 0, 0, 0.0)
    return DataPage(index, found, model_version="m")


def test_a_lost_parity_page_is_not_missed_where_all_data_was_read() -> None:
    unread = Unread()
    groups = [unread.group_of(read(index, index)) for index in range(3)]
    unread.add(3, header(3), "m")
    assert groups[2] is not None
    assert list(unread.restored(groups[2])) == []
    assert unread.pages == {}
    assert unread.groups == {}


def test_a_group_that_lacks_too_much_stays_and_takes_what_is_read_again() -> None:
    unread = Unread()
    group = unread.group_of(read(2, 2))
    for index in (0, 1, 3):
        unread.add(index, header(index), "m")
    assert group is not None
    assert list(unread.restored(group)) == []
    assert sorted(unread.pages) == [0, 1, 3]
    again = unread.group_of(read(1, 1))
    assert again is not None
    assert sorted(again.pages) == [1, 2]


def test_a_page_that_was_read_says_which_ones_were_lost_before_it_and_a_lost_one_of_no_header_nothing() -> None:
    unread = Unread()
    for index in (0, 1, 2):
        unread.add(index, None, "m")
    unread.told(4, header(3))
    assert unread.pages == {0: None, 1: header(0), 2: header(1)}
    assert unread.group_of(DataPage(5, PageBytes(None, None, None, Loss.HEADER, 0.0, 0, 0, 0, 0.0))) is None
