"""Temporary folders where a system has few places for them."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import pytest

from lightpage.errors import SurroundingsError
from lightpage.temporary import settle_matplotlib, short_folder, temporary_folder


def test_no_folder_for_temporary_files_is_named_with_the_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere(*_: object) -> None:
        raise FileNotFoundError(2, "No usable temporary directory found in ['/nowhere']")

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
