"""A file to pages and back by the commands, and every way in which that can go wrong."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner, Result

from lightpage.cli.main import lightpage, run
from lightpage.codec.checksum import crc32c
from lightpage.errors import InvalidInputError, LostDataError, RecordingError, StorageError
from lightpage.page.symbols import pilot_mask
from lightpage.recording.pages import Pages
from lightpage.recording.reader import Recording
from lightpage.runtime.commands.archives.code import code as code_command
from lightpage.runtime.commands.archives.encode import encode
from lightpage.runtime.commands.archives.recover import recover
from lightpage.runtime.model.bundle.bundle import Bundle
from tests.runtime import coded, toy

STORAGE = StorageError("page of the recording", "Input/output error", "data")


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    return coded.bundle(tmp_path / "toy.zip")


@pytest.fixture
def pages(bundle: Path, tmp_path: Path) -> np.ndarray:
    return coded.pages(bundle, tmp_path)


def recovered(bundle: Path, recording: Path, *more: str) -> tuple[Result, dict]:
    """Recover to read.bin beside the recording; the outcome, and the figures where there are any."""
    folder = recording.parent
    asked = ["--bundle", str(bundle), "--recording", str(recording), "--out", str(folder / "read.bin")]
    asked += ["--json", str(folder / "J.json"), "--no-tracking", *more]
    result = CliRunner().invoke(recover, asked, standalone_mode=False)
    figures = json.loads((folder / "J.json").read_text()) if (folder / "J.json").exists() else {}
    return result, figures


def test_a_file_comes_back_and_the_figures_say_what_it_cost(bundle: Path, pages: np.ndarray, tmp_path: Path) -> None:
    assert len(pages) == 9 + 3 * 2  # 9 data pages in groups of three, two parity pages each
    result, figures = recovered(bundle, coded.recording(tmp_path / "R.h5", pages), "--code-threads", "2")
    assert result.exception is None
    assert (tmp_path / "read.bin").read_bytes() == coded.CONTENT
    assert [figures[key] for key in ("pages", "pages_unread", "pages_lost", "user_bytes")] == [15, 0, 0, 1000]
    data = 384 - np.count_nonzero(pilot_mask(toy.PROFILE))
    assert figures["share_of_air"] == pytest.approx(figures["user_bytes_per_page"] / figures["air_bytes_per_page"])
    assert figures["air_bytes_per_page"] == pytest.approx(figures["air_bits_per_symbol"] * data / 8, rel=0.01)
    assert figures["q"] == pytest.approx(8 * figures["user_bytes_per_page"] / 384 / 5)
    assert 0 < figures["page_failure_rate_bound_95"] < 0.25
    assert figures["margin_bits_least"] > 0
    assert figures["seconds_per_page"] > figures["code_seconds_per_page"] > 0


def test_lost_pages_are_restored_and_named(
    bundle: Path, pages: np.ndarray, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    toy.frames_fail(monkeypatch, STORAGE, 5, 6)
    spoilt = {1: coded.dark, 2: coded.half_lost, 13: coded.half_lost}
    result, figures = recovered(bundle, coded.recording(tmp_path / "R.h5", pages, spoilt, known=False))
    assert result.exception is None
    assert (tmp_path / "read.bin").read_bytes() == coded.CONTENT
    assert (figures["pages_unread"], figures["restored"], figures["lost"]) == (5, [1, 2, 5, 6], [])
    assert figures["share_of_air"] is None  # its symbols are not known, and not needed
    for told in ("recorded pages 1, 13", "pages 1, 13 of", "recorded page 2"):
        assert told in caplog.text
    lost = {page["number"]: page["loss"] for page in figures["page_results"] if page["loss"]}
    assert (list(lost), lost[1], lost[5]) == ([1, 2, 5, 6, 13], "optics", "storage")


def test_too_many_lost_pages_are_named_and_leave_no_file(bundle: Path, pages: np.ndarray, tmp_path: Path) -> None:
    recording = coded.recording(tmp_path / "R.h5", pages, {1: coded.dark, 2: coded.half_lost, 3: coded.dark})
    result, figures = recovered(bundle, recording)
    assert isinstance(result.exception, LostDataError)
    assert "none needed" not in result.output
    for told in ("data pages 1-2", "recorded pages 1, 3", "recorded page 2"):
        assert told in str(result.exception)
    assert figures["lost"] == [1, 2]
    size = figures["user_bytes_per_page"]
    assert figures["lost_bytes"] == [[size, 3 * size]]
    assert not (tmp_path / "read.bin").exists()
    assert not list(tmp_path.glob("*.partial"))
    asked = f"recover --bundle {bundle} --recording {recording} --out {tmp_path / 'holes.bin'} --holes --no-tracking"
    assert run(lightpage, asked.split()) == 3
    read = (tmp_path / "holes.bin").read_bytes()
    assert read == coded.CONTENT[:size] + bytes(2 * size) + coded.CONTENT[3 * size :]


def test_two_volumes(bundle: Path, pages: np.ndarray, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    other = coded.pages(bundle, tmp_path / "other", b"other", "--volume", "3", "--data-pages", "1")
    recording = coded.recording(tmp_path / "R.h5", [*pages, *other])
    for more in ((), ("--volume", "4"), ("--volume", "9:1"), ("--volume", "x")):
        result, _ = recovered(bundle, recording, *more)
        assert isinstance(result.exception, InvalidInputError)
        assert not (tmp_path / "read.bin").exists()
    result, figures = recovered(bundle, recording, "--volume", f"3:{crc32c(b'other'):08x}")
    assert (tmp_path / "read.bin").read_bytes() == b"other"
    assert figures["other_volumes"] == {f"9:{crc32c(coded.CONTENT):08x}": len(pages)}


def test_a_recording_that_says_how_it_is_coded_needs_no_other_source(pages: np.ndarray, tmp_path: Path) -> None:
    plain = coded.bundle(tmp_path / "plain.zip", None)
    with h5py.File(tmp_path / "pages.h5") as file:
        told = file.attrs["code"]
    result, _ = recovered(plain, coded.recording(tmp_path / "R.h5", pages, code=told))
    assert (tmp_path / "read.bin").read_bytes() == coded.CONTENT
    result, _ = recovered(plain, coded.recording(tmp_path / "S.h5", pages))
    assert isinstance(result.exception, InvalidInputError)
    assert "--code" in result.exception.expected
    for wrong in ("[]", '{"levels": 31}', "{"):
        result, _ = recovered(plain, coded.recording(tmp_path / f"{len(wrong)}.h5", pages, code=wrong))
        assert isinstance(result.exception, RecordingError)


def test_code_is_chosen_by_known_pages_and_kept_in_a_bundle(tmp_path: Path) -> None:
    plain = coded.bundle(tmp_path / "plain.zip", None)
    toy.write_toy_recording(tmp_path / "R.h5", toy.ToyDevice(), 256, 6)
    asked = ["--bundle", str(plain), "--recording", str(tmp_path / "R.h5"), "--out", str(tmp_path / "C.toml")]
    asked += ["--out-bundle", str(tmp_path / "with.zip"), "--version", "toy-2", "--json", str(tmp_path / "J.json")]
    CliRunner().invoke(code_command, asked, standalone_mode=False, catch_exceptions=False)
    figures = json.loads((tmp_path / "J.json").read_text())
    best = max(figures["tried"], key=lambda each: each["user_bytes"])
    assert figures["code"] == best["code"]
    # sigma = 12 / 4 / 70 of a radian: 5.1 bits a symbol; six pages know little of how pages differ
    assert 0.4 < 8 * figures["user_bytes_per_page"] / 364 / 5.1 < 0.95
    pages = coded.pages(tmp_path / "with.zip", tmp_path)
    assert pages.max() < figures["code"]["levels"]


def test_a_bundle_with_a_new_code_reads_files_of_the_earlier_one(
    bundle: Path, pages: np.ndarray, tmp_path: Path
) -> None:
    other = tmp_path / "other.zip"
    later = coded.CODE.model_copy(update={"rate_per_mille": 550})
    toy.write_toy_bundle(other, code=later.to_toml(), earlier_codes=(coded.CODE.to_toml(),))
    recovered(other, coded.recording(tmp_path / "R.h5", pages))
    assert (tmp_path / "read.bin").read_bytes() == coded.CONTENT
    toy.write_toy_recording(tmp_path / "known.h5", toy.ToyDevice(), 256, 6)
    made = tmp_path / "made.zip"
    asked = f"--bundle {bundle} --recording {tmp_path / 'known.h5'} --out-bundle {made} --version toy-2"
    CliRunner().invoke(code_command, asked.split(), standalone_mode=False, catch_exceptions=False)
    assert Bundle.open(made).earlier_codes == (coded.CODE,)
    assert Bundle.open(made).code not in (None, coded.CODE)


def test_pages_that_are_read_are_known_and_choose_a_code_as_known_ones_do(
    bundle: Path, pages: np.ndarray, tmp_path: Path
) -> None:
    unknown = coded.recording(tmp_path / "R.h5", pages, {2: coded.half_lost, 5: coded.dark}, known=False)
    recovered(bundle, unknown, "--known-out", str(tmp_path / "K.h5"))
    with Recording.open(tmp_path / "K.h5") as known, Recording.open(unknown) as whole:
        assert (known.pages, known.levels) == (len(pages) - 2, coded.CODE.levels)
        for page, number in enumerate(n for n in range(len(pages)) if n not in (2, 5)):
            np.testing.assert_array_equal(known.symbols(page), pages[number])
            np.testing.assert_array_equal(known.frames(page).in_phase, whole.frames(number).in_phase)
    for name in ("R", "K"):
        asked = f"--bundle {bundle} --recording {tmp_path / name}.h5 --out {tmp_path / name}.toml"
        CliRunner().invoke(code_command, asked.split(), standalone_mode=False, catch_exceptions=False)
    assert (tmp_path / "R.toml").read_text() == (tmp_path / "K.toml").read_text()


@pytest.mark.parametrize(("options", "status"), [((), 75), (("--give-up",), 3)])
def test_a_file_that_storage_keeps_back_is_not_lost_unless_it_is_given_up(
    options: tuple[str, ...],
    status: int,
    bundle: Path,
    pages: np.ndarray,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    recording = coded.recording(tmp_path / "R.h5", pages)
    asked = f"recover --bundle {bundle} --recording {recording} --out {tmp_path / 'read.bin'} --no-tracking".split()
    with monkeypatch.context() as patched:
        toy.frames_fail(patched, STORAGE, 0, 1, 2)
        assert run(lightpage, [*asked, *options]) == status
        assert not (tmp_path / "read.bin").exists()
    assert run(lightpage, asked) == 0


def test_an_evaluation_ends_with_the_status_that_asks_for_another_try(
    toy_zip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    toy.write_toy_recording(tmp_path / "R.h5", toy.ToyDevice(), 16, 3)
    asked = f"evaluate --bundle {toy_zip} --recording {tmp_path / 'R.h5'} --json {tmp_path / 'E.json'}".split()
    for lacking in ({0, 1, 2}, {1}):
        with monkeypatch.context() as patched:
            toy.frames_fail(patched, STORAGE, *lacking)
            assert run(lightpage, asked) == 75
        figures = json.loads((tmp_path / "E.json").read_text())
        assert figures["pages"] == 3 - len(lacking)
        assert {page["page"]: page["cause"] for page in figures["refused_pages"]} == dict.fromkeys(lacking, "storage")
    assert run(lightpage, asked) == 0


def test_pages_are_not_overwritten_unless_that_is_asked_for(bundle: Path, pages: np.ndarray, tmp_path: Path) -> None:
    asked = f"encode {tmp_path / 'sent.bin'} --bundle {bundle} --out {tmp_path / 'pages.h5'}".split()
    before = (tmp_path / "pages.h5").read_bytes()
    assert run(lightpage, asked) == 2
    assert (tmp_path / "pages.h5").read_bytes() == before
    assert run(lightpage, [*asked, "--force"]) == 0
    assert (tmp_path / "pages.h5").read_bytes() != before


def test_a_file_may_come_on_stdin(bundle: Path, pages: np.ndarray, tmp_path: Path) -> None:
    asked = ["-", "--bundle", str(bundle), "--out", str(tmp_path / "piped.h5"), "--volume", "9"]
    asked += ["--data-pages", "3", "--parity-pages", "2"]
    assert CliRunner().invoke(encode, asked, input=coded.CONTENT, standalone_mode=False).exception is None
    with Pages.open(tmp_path / "piped.h5") as piped:
        assert (np.stack(list(piped)) == pages).all()
