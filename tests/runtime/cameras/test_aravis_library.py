"""The library's door names what is missing."""

from __future__ import annotations

from pathlib import Path

import pytest

from runtime.cameras.aravis_library import ENVIRONMENT, PACKAGE, aravis
from runtime.errors import SourceError


@pytest.mark.parametrize(("path", "named"), [("none.so", "none.so"), ("libc.so.6", "arv_")])
def test_a_library_that_is_missing_or_another_one_is_named(
    path: str, named: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv(ENVIRONMENT, str(tmp_path / path) if path == "none.so" else path)
    with pytest.raises(SourceError, match=PACKAGE) as raised:
        aravis()
    assert named in raised.value.got
