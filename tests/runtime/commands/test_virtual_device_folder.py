"""A folder that a simulated device cannot work in is told in a line, before anything is started."""

from __future__ import annotations

from pathlib import Path

import pytest

from lightpage.cli import main as cli_main
from lightpage.cli.main import EXIT_ERROR, lightpage
from runtime.commands import virtual_device as module


@pytest.mark.parametrize("place", ["file", "read-only"])
def test_a_folder_that_cannot_be_made_or_written_is_named(
    tmp_path: Path, place: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(module, "go_on_inside", lambda name: pytest.fail("started"))
    (tmp_path / "file").touch()
    folder = tmp_path / "file" / "device" if place == "file" else Path("/proc/self")  # read-only for root too
    assert cli_main.run(lightpage, ["virtual-device", "--out", str(folder), "--", "true"]) == EXIT_ERROR
    assert f"error: --out {folder}:" in capsys.readouterr().err
