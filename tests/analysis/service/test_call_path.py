"""Functions that a call enters in a running service are split into its path and those that only record it."""

import json
from fnmatch import filter as matching
from inspect import getfile
from pathlib import Path

from click.testing import CliRunner

from analysis.service.call_path import APART, main
from analysis.service.entered import ROOT
from lightpage.runtime.model.decoding import decoder
from lightpage.runtime.service.frames import frame_calls
from lightpage.runtime.service.monitoring import metrics
from lightpage.runtime.service.server import call_log


def test_a_decode_enters_its_handler_then_the_decoder_and_never_the_client(toy_zip: Path, tmp_path: Path) -> None:
    asked = ["decode", "--bundle", str(toy_zip), "--json", str(tmp_path / "F.json")]
    CliRunner().invoke(main, asked, catch_exceptions=False, standalone_mode=False)
    files = {file["file"]: file for file in json.loads((tmp_path / "F.json").read_text())["files"]}
    handler, decoding, *apart = (
        files[str(Path(getfile(module)).relative_to(ROOT))] for module in (frame_calls, decoder, call_log, metrics)
    )
    assert handler["number"] < decoding["number"]
    assert "FrameCalls.DecodeFrames" in handler["functions"]
    assert [bool(file["apart"]) for file in (handler, decoding, *apart)] == [False, False, True, True]
    assert not matching(files, "*/client/client.py")


def test_each_pattern_of_what_only_records_is_that_of_a_file() -> None:
    served = [str(path) for path in ROOT.glob("[!.]*/**/*.py") if path.relative_to(ROOT).parts[0] != "tests"]
    assert [pattern for pattern in APART if not matching(served, pattern)] == []
