"""Files that are whole, options that name files to write, temporary folders, and what errors of files say."""

import errno
import fcntl
import os
import stat
import sys
import tempfile
from pathlib import Path
from unittest.mock import Mock

import click
import pytest

from lightpage.cli.paths import OutputFile
from lightpage.errors import InvalidInputError, NoRoomError, StorageError, SurroundingsError
from lightpage.files import lock, move_to_new_name, new_file, read_text, replace_file, replace_text
from lightpage.temporary import settle_matplotlib, short_folder, temporary_folder


@click.command()
@click.option("--json", "path", type=OutputFile())
def write(path: Path) -> None:
    """A command with nothing but a result."""
    replace_text(path, "text")


@pytest.mark.parametrize("name", ["", "missing/F"])
def test_a_path_that_cannot_be_written_is_known_before_the_work(tmp_path: Path, name: str) -> None:
    with pytest.raises(InvalidInputError, match=r"^--json"):
        write.main(["--json", str(tmp_path / name)], standalone_mode=False)


def test_a_path_that_can_be_written_leaves_nothing_beside_the_result(tmp_path: Path) -> None:
    (tmp_path / "F").write_text("earlier")
    write.main(["--json", str(tmp_path / "F")], standalone_mode=False)
    assert [path.name for path in tmp_path.iterdir()] == ["F"]
    assert (tmp_path / "F").read_text() == "text"


def test_content_and_name_are_on_the_disk_before_a_file_is_said_to_be_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    rename = os.replace

    def synced(descriptor: int) -> None:
        state = os.fstat(descriptor)
        folder = stat.S_ISDIR(state.st_mode)
        assert os.path.samestat(state, tmp_path.stat()) if folder else state.st_size == 4
        done.append("folder" if folder else "content")

    def renamed(old: str, new: Path) -> None:
        rename(old, new)
        done.append("name")

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", renamed)
    replace_text(tmp_path / "F", "text")
    assert done == ["content", "name", "folder"]
    assert (tmp_path / "F").stat().st_mode & 0o777 == 0o644


def test_a_write_that_fails_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full = Mock(side_effect=OSError(28, "No space left on device"))
    (tmp_path / "F").write_text("earlier")
    with pytest.raises(NoRoomError, match="F: got"):
        replace_file(tmp_path / "F", full)
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(NoRoomError, match="F: got"):
        replace_text(tmp_path / "F", "text")
    assert [path.name for path in tmp_path.iterdir()] == ["F"]
    assert (tmp_path / "F").read_text() == "earlier"


@pytest.mark.parametrize("links", [True, False])
def test_a_file_that_is_there_keeps_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, links: bool) -> None:
    if not links:
        monkeypatch.setattr(os, "link", Mock(side_effect=PermissionError(1, "Operation not permitted")))
    made, final = tmp_path / "made", tmp_path / "final"
    made.write_text("first")
    move_to_new_name(made, final)
    assert not made.exists()
    made.write_text("second")
    with pytest.raises(FileExistsError):
        move_to_new_name(made, final)
    assert (made.read_text(), final.read_text()) == ("second", "first")


def test_files_have_the_modes_that_the_umask_leaves(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        replace_text(tmp_path / "F", "text")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "F").stat().st_mode) == 0o640


@pytest.mark.parametrize("number", [errno.EINVAL, errno.EPERM])
def test_what_a_file_system_lacks_is_gone_without(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    lacking = Mock(side_effect=OSError(number, os.strerror(number)))
    for name in ("fsync", "link", "chmod", "fchmod"):
        monkeypatch.setattr(os, name, lacking)
    monkeypatch.setattr(fcntl, "flock", lacking)
    monkeypatch.setattr("lightpage.files.WITHOUT_LOCKS", set())
    replace_text(tmp_path / "F", "text")
    move_to_new_name(tmp_path / "F", tmp_path / "G")
    assert (tmp_path / "G").read_text() == "text"
    descriptor, _ = new_file(tmp_path, "H")
    assert not lock(descriptor, "file H")
    os.close(descriptor)
    assert "file H" in caplog.text


@pytest.mark.parametrize(
    ("number", "kind"), [(errno.EIO, StorageError), (errno.EDQUOT, NoRoomError), (errno.EROFS, InvalidInputError)]
)
def test_what_is_needed_is_named(
    number: int, kind: type[Exception], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fsync", Mock(side_effect=OSError(number, os.strerror(number))))
    with pytest.raises(kind, match="F"):
        replace_text(tmp_path / "F", "text")
    assert list(tmp_path.iterdir()) == []


def test_the_longest_name_can_be_written(tmp_path: Path) -> None:
    replace_text(tmp_path / ("ä" * 127), "text")
    assert [path.name for path in tmp_path.iterdir()] == ["ä" * 127]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-32"])
def test_text_is_read_in_the_encodings_that_editors_write(encoding: str, tmp_path: Path) -> None:
    for end in ("\n", "\r\n", "\r"):
        (tmp_path / "F").write_bytes(f'name = "ä"{end}'.encode(encoding))
        assert read_text(tmp_path / "F", "file F", "text") == 'name = "ä"\n'


@pytest.mark.parametrize(
    ("content", "told"),
    [(b"one\nb\xe4d", "byte 0xe4 in line 2, column 2"), ("no mark".encode("utf-16-le") + b"\xff\xff", "UTF-16")],
)
def test_another_encoding_is_named(content: bytes, told: str, tmp_path: Path) -> None:
    (tmp_path / "F").write_bytes(content)
    with pytest.raises(InvalidInputError, match=told):
        read_text(tmp_path / "F", "file F", "text")


def test_what_is_no_file_is_written_to_and_not_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    replace_text(pipe, "text")
    assert os.read(reader, 10) == b"text"
    os.close(reader)
    assert stat.S_ISFIFO(pipe.stat().st_mode)


def test_an_error_names_the_thing_what_came_and_what_was_wanted() -> None:
    assert str(InvalidInputError("--pages", 0, "at least 1")) == "--pages: got 0, wanted at least 1"
    assert InvalidInputError("file F", OSError("odd file"), "a whole one").got == "odd file"
    error = InvalidInputError("file F", FileNotFoundError(errno.ENOENT, "No such file", "F"), "a file")
    assert error.got == "no such file"


def test_no_folder_for_temporary_files_is_named_with_the_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    nowhere = Mock(side_effect=FileNotFoundError(2, "No usable temporary directory found in ['/nowhere']"))
    monkeypatch.setattr(tempfile, "mkdtemp", nowhere)
    with pytest.raises(SurroundingsError, match=r"^scratch: .*TMPDIR"):
        temporary_folder("scratch")


def test_a_long_tmpdir_is_not_taken_for_sockets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (long := tmp_path / ("x" * 100)).mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(long))
    with short_folder("sockets", "s-", 60) as folder:
        assert len(os.fsencode(folder)) <= 60
        assert os.path.isdir(folder)
    with pytest.raises(SurroundingsError, match=r"^sockets: .*xxx.*TMPDIR"):
        short_folder("sockets", "s-", 10)


@pytest.mark.parametrize("own", [True, False])
def test_matplotlib_gets_a_folder_where_it_has_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own: bool) -> None:
    (tmp_path / "file").touch()
    home = tmp_path if own else tmp_path / "file" / "home"
    for name in ("MPLCONFIGDIR", "XDG_CONFIG_HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.delitem(sys.modules, "matplotlib", raising=False)
    settle_matplotlib()
    assert (os.environ.get("MPLCONFIGDIR") is None) == own
    if not own:
        assert os.access(os.environ["MPLCONFIGDIR"], os.W_OK)
        monkeypatch.delenv("MPLCONFIGDIR")
