"""The library's door: what is missing is named, and its errors become exceptions."""

from __future__ import annotations

from pathlib import Path

import pytest

from runtime.cameras.aravis_library import ENVIRONMENT, PACKAGE, AravisError, aravis
from runtime.errors import SourceError


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(ENVIRONMENT, str(tmp_path / "none.so"))
    with pytest.raises(SourceError, match=r"none\.so.*libaravis-0\.8\.so\.0.*libaravis-0\.8-0"):
        aravis()


def test_another_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(ENVIRONMENT, "libc.so.6")
    with pytest.raises(SourceError, match=f"arv_.*{PACKAGE}"):
        aravis()


@pytest.mark.own_network
def test_an_error_of_the_library_is_an_exception() -> None:
    with pytest.raises(AravisError, match="not found") as raised:
        aravis()("arv_camera_new", b"no-such-camera")
    assert (raised.value.domain, raised.value.code) == ("arv-device-error-quark", 6)
