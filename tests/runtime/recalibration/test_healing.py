"""Pages of user data that a drifted device's model does not read, and no page that anybody knows."""

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import NoReturn
from unittest.mock import Mock, patch

import numpy as np
import pytest

from lightpage.cli.simulate import simulate
from lightpage.codec.code import Code
from lightpage.codec.page_bytes import Loss
from lightpage.codec.page_codec import PageCodec
from lightpage.device.state import Device
from lightpage.errors import CalibrationError, LostPageError, Reason, RecalibrationRefusedError, RecordingError
from lightpage.page.pilots import Pilots
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.layout import hash_frames
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings import page_reader
from lightpage.runtime.archives.recordings.page_reader import PageReader
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.commands.archives.encode import encode
from lightpage.runtime.commands.archives.recover import recover
from lightpage.runtime.device.acquisition.source import open_source
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.tracking import NoTracker
from lightpage.runtime.recalibration import healed_bundle
from lightpage.runtime.recalibration.healed_bundle import recalibrate_by_lost
from lightpage.runtime.recalibration.healing import LostPages, heal
from lightpage.runtime.recalibration.judgement import Verdict, judge, judged_pages
from lightpage.runtime.recalibration.known_pages import KnownPages
from lightpage.runtime.recalibration.recalibration import refitted_bundle
from lightpage.runtime.recalibration.refit import refit
from lightpage.runtime.service.caller import Call, Caller
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.jobs.kept_pages import KeptPages
from lightpage.runtime.service.jobs.recalibrator import Recalibrator
from lightpage.runtime.service.jobs.self_calibration import SelfCalibration
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.monitoring.monitor import Monitor
from lightpage.runtime.service.monitoring.observation import Observation
from lightpage.runtime.service.pages.page_calls import PageCalls
from lightpage.simulator.simulator import Simulator
from tests.lightpage.command import run
from tests.lightpage.small import UNEXPLAINED

CODE = Code(levels=8, coded_bits=2, rate_per_mille=500, corrections=2)
CONTENT = bytes(range(250)) * 3


@pytest.fixture(scope="module")
def drifted(small_bundle: Path, small_device: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recording of a file's pages on the small device, its pipe turned by two fifths of a degree."""
    folder = tmp_path_factory.mktemp("drifted")
    (folder / "file").write_bytes(CONTENT)
    CODE.save(folder / "code.toml")
    named = ["--bundle", small_bundle, "--code", folder / "code.toml"]
    named += ["--volume", 2]  # else it is drawn, and in some draws a dozen pilots do not find an image that has moved
    run(encode, folder / "file", *named, "--parity-pages", 0, "--out", folder / "pages.h5")
    turned = ["--set", "geometry.pipe_angle_deg=-0.2", "--seed", 5]
    run(simulate, *small_device[:2], "--symbols", folder / "pages.h5", *turned, "--out", folder / "R.h5")
    return folder


def lost_pages(path: Path, count: int) -> LostPages:
    with Recording.open(path) as recording:
        return LostPages(tuple(map(recording.frames, range(count))), CODE, references=recording.references())


def test_a_file_that_no_page_gave_comes_back_by_itself(small_bundle: Path, drifted: Path) -> None:
    asked = ["--bundle", small_bundle, "--code", drifted / "code.toml", "--recording", drifted / "R.h5"]
    told = run(recover, *asked, "--out", drifted / "out", "--json", drifted / "recovery.json")
    assert (drifted / "out").read_bytes() == CONTENT
    figures = json.loads((drifted / "recovery.json").read_text())
    assert figures["pages_healed"] == figures["pages"] == 4
    assert {page["healed_rounds"] for page in figures["page_results"]} <= {1, 2, 3}
    assert "recorded pages 0-3, in " in told


def test_a_service_recalibrates_by_the_pages_that_it_keeps(small_bundle: Path, drifted: Path, tmp_path: Path) -> None:
    bundle = Bundle.open(small_bundle)
    manifest = bundle.manifest.model_copy(update={"code": CODE.to_toml()})
    decoder, kept = Decoder(replace(bundle, manifest=manifest), threads=1), KeptPages(most_bytes=1 << 30)
    assert kept.pages(decoder, (0.0, 0.0)) is None
    with Recording.open(drifted / "R.h5") as recording:
        pairs = [recording.frames(page) for page in range(recording.pages)]
        symbols = [recording.symbols(page) for page in range(recording.pages)]
    for pair in pairs:
        shown = Observation("page", 0, "small-1", 0.0, 0.1, Reason.PILOTS_DISAGREE, pair=pair)
        kept.observe(replace(shown, of_device=False))
        kept.observe(shown)
        kept.observe(shown)  # seen again, it is one page
        assert kept.enough_for_lost(decoder) == (pair is not pairs[0])  # the first could not be judged by
    lost = kept.pages(decoder, (0.0, 0.0))
    assert isinstance(lost, LostPages)
    assert len(lost.pairs) == len(pairs)
    out = tmp_path / "healed.zip"
    outcome = recalibrate_by_lost(decoder, lost, out, "small-1+r1", refit, lambda what, share: None)
    assert outcome.air_before < outcome.air_after - 0.5
    # a known page shows it to 0.01; where decisions gave more pages, theirs stays
    assert outcome.report.angle_deg == pytest.approx(-0.2, abs=0.03)
    healed = Decoder.load(out, threads=1)
    for pair in [*pairs, pairs[-2]]:
        page = healed.post_process(healed.infer(pair), CODE.levels, healed.written_pilots(CODE.levels))
        kept.observe(Observation("page", 0, "small-1+r1", 0.0, 0.1, pair=pair, page=page))
    known = kept.pages(healed, (0.0, 0.0))
    assert isinstance(known, KnownPages)
    np.testing.assert_array_equal(known.symbols[0], symbols[-2])
    known.check(healed)
    kinds = []
    assert not kept.enough_for_lost(healed)
    for pair in pairs[:2]:  # the device is knocked: what was read before shows another one
        kept.observe(Observation("page", 0, "small-1+r1", 0.0, 0.1, Reason.PILOTS_DISAGREE, pair=pair))
        assert kept.enough_for_lost(healed)
        kinds.append(type(kept.pages(healed, (0.0, 0.0))))
    assert kinds == [KnownPages, LostPages]


def test_a_range_of_pages_that_nobody_could_read_comes_back_with_the_model_healed(
    small_bundle: Path, drifted: Path
) -> None:
    bundle, kept, monitor = Bundle.open(small_bundle), KeptPages(most_bytes=1 << 30), Monitor()
    manifest = bundle.manifest.model_copy(update={"code": CODE.to_toml()})
    decoder = Decoder(replace(bundle, manifest=manifest), threads=1)
    with open_source(f"recording:{drifted / 'R.h5'}") as source, ThreadPoolExecutor(1) as pool:
        plane = DataPlane(Models(decoder), source, monitor=monitor, observers=[kept])
        with SelfCalibration(plane, monitor, Recalibrator(plane, refit), kept=kept):
            request = pb.ReadDataRequest(first_page=0, pages=4)
            replies = [*PageCalls(plane).ReadData(request, Call("ReadData", Caller(), pool))]
    lost, healed = replies[:4], replies[4:]
    assert not any(reply.user_data.data for reply in lost)
    assert [(reply.page, reply.model_version, reply.restored) for reply in healed] == [
        (page, "small-1+r1", False) for page in range(4)
    ]
    assert b"".join(reply.user_data.data for reply in healed)[: len(CONTENT)] == CONTENT


def test_frames_that_do_not_show_the_device_are_refused_before_anything_is_fitted(
    small_bundle: Path, drifted: Path
) -> None:
    decoder = Decoder.load(small_bundle, threads=1)
    with Recording.open(drifted / "R.h5") as recording:
        references, pair = recording.references(), recording.frames(0)
    rng, frames = np.random.default_rng(0), (pair.in_phase, pair.quadrature)
    shuffled = [FramePair(*(rng.permutation(f.ravel()).reshape(f.shape) for f in frames)) for _ in range(3)]
    upside_down = FramePair(*(np.ascontiguousarray(frame[::-1]) for frame in frames))
    with pytest.raises(RecalibrationRefusedError, match="pilots"):
        heal(decoder, LostPages((*shuffled, upside_down), CODE, references=references), untouched)
    dark = FramePair(*(np.zeros_like(frame) for frame in frames))
    with pytest.raises(RecalibrationRefusedError, match="light"):
        heal(decoder, LostPages((dark,), CODE, references=references), untouched)


@pytest.mark.parametrize("unreadable", [False, True], ids=["refused", "references unreadable"])
def test_pages_wait_for_others_and_for_twice_as_many_where_that_brought_none(
    unreadable: bool, small_bundle: Path, drifted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoder, decoded, tried = Decoder.load(small_bundle, threads=1), list[int](), list[int]()

    class Blind(NoTracker):
        def decode(self, *_: object) -> NoReturn:
            decoded.append(len(decoded))
            raise LostPageError("page", "nothing", "a page")

    def refused(*_: object) -> NoReturn:
        tried.append(len(decoded))
        raise (RecordingError if unreadable else RecalibrationRefusedError)("healing", "nothing", "pages")

    monkeypatch.setattr(page_reader, "heal", refused)
    with Recording.open(drifted / "R.h5") as recording:
        if unreadable:
            monkeypatch.setattr(recording, "references", refused)
        reader = PageReader(decoder, recording, Blind(decoder), CODE)
        pages = [*reader.read([*range(4)] * 6, lambda page, found: None)]
    assert tried == [6, 18, 24]
    assert [page.page for page in pages] == [*range(4)] * 6
    assert {page.loss for page in pages} == {Loss.OPTICS}


def test_a_healed_model_has_a_verdict_and_is_not_written_where_it_is_wrong(small_bundle: Path, drifted: Path) -> None:
    decoder = Decoder.load(small_bundle, threads=1)
    lost = lost_pages(drifted / "R.h5", 4)
    healed = heal(decoder, lost, fit=Mock(side_effect=CalibrationError("re-fit", "nothing", "a geometry")))
    found, report = healed.decoder.bundle.calibration, healed.result.report
    assert report.goodness == found.goodness is not None
    assert report.image is not None
    assert healed.known.fitted == found.calibrated_pages[-len(healed.known.fitted) :]
    wrong = found.model_copy(update={"goodness": UNEXPLAINED}).to_toml()
    manifest = decoder.bundle.manifest.model_copy(update={"calibration": wrong})
    spoilt = replace(healed, decoder=decoder.of_bundle(replace(decoder.bundle, manifest=manifest)))
    all_fitted = replace(healed.known, fitted=tuple(map(hash_frames, healed.known.pairs)))
    unjudged = decoder.bundle.calibration.model_copy(update={"goodness": None}).to_toml()
    earlier = manifest.model_copy(update={"calibration": unjudged})
    other = decoder.of_bundle(replace(decoder.bundle, manifest=earlier))
    all_healed = replace(healed, known=all_fitted)
    for subject, one, start in (("re-fit", spoilt, None), ("re-fit", spoilt, other), ("healing", all_healed, None)):
        with patch.object(healed_bundle, "heal", return_value=one), pytest.raises(RecalibrationRefusedError) as refused:
            recalibrate_by_lost(decoder, lost, drifted / "out", "small-1+r1", refit, untouched, start=start)
        assert refused.value.subject.startswith(subject)


def test_where_only_the_image_has_moved_a_last_fit_that_fails_takes_no_page_away(
    small_bundle: Path, small_device: list[str], drifted: Path
) -> None:
    moved = ["--set", "in_phase_camera.shift_y_px=-2", "--set", "quadrature_camera.shift_y_px=3"]
    run(simulate, *small_device[:2], "--symbols", drifted / "pages.h5", *moved, "--seed", 6, "--out", drifted / "M.h5")
    fails = Mock(side_effect=CalibrationError("re-fit", "nothing", "a geometry"))
    healed = heal(Decoder.load(small_bundle, threads=1), lost_pages(drifted / "M.h5", 4), fit=fails)
    assert (healed.rounds, len(healed.known.pairs)) == (0, 4)
    assert healed.result.report.goodness == healed.decoder.bundle.calibration.goodness is not None


def test_a_bundle_without_a_calibration_is_not_healed(small_bundle: Path, drifted: Path) -> None:
    bundle = Bundle.open(small_bundle)
    manifest = bundle.manifest.model_copy(update={"calibration": ""})
    with pytest.raises(RecalibrationRefusedError):
        heal(Decoder(replace(bundle, manifest=manifest), threads=1), lost_pages(drifted / "R.h5", 1), untouched)


def test_a_healing_ends_where_pages_claim_enough_and_no_checksum_holds(small_bundle: Path, drifted: Path) -> None:
    decode = PageCodec.decode
    in_vain = patch.object(PageCodec, "decode", lambda *given: replace(decode(*given), loss=Loss.BODY, margin_bits=0.0))
    with in_vain, pytest.raises(RecalibrationRefusedError, match="round 1"):
        heal(Decoder.load(small_bundle, threads=1), lost_pages(drifted / "R.h5", 4))


def test_a_models_own_decisions_speak_for_it_and_pages_that_come_right_for_the_better_one(small_bundle: Path) -> None:
    decoder, rng = Decoder.load(small_bundle, threads=1), np.random.default_rng(1)
    bundle, mask = decoder.bundle, decoder.bundle.pilot_mask
    turned = Device().with_settings(["geometry.pipe_angle_deg=-0.57", "drift.shift_px=0"])
    simulator = Simulator(bundle.profile, turned, 256, seed=7)
    written = rng.integers(256, size=(2, *bundle.profile.page_shape)).astype(np.uint8)
    pairs = tuple(simulator.page(page) for page in written)
    right = KnownPages(pairs, tuple(written), 256, simulator.references())
    fitted = refitted_bundle(bundle, refit(bundle, right.part(slice(1)), lambda what, share: None, decoder))
    pages = [
        decoder.decode(pair, 256, Pilots.of_symbols(mask, page, 256)) for pair, page in zip(pairs, written, strict=True)
    ]
    decided = tuple(np.where(mask, page, found.symbols) for page, found in zip(written, pages, strict=True))

    def judged(pages: KnownPages) -> Verdict:
        before, after = (
            judged_pages(NoTracker(decoder.of_bundle(one)), one, pages, lambda share: None) for one in (bundle, fitted)
        )
        return judge(before, after, 256)

    verdict = judged(right.part(slice(1, 2)))
    assert verdict.after > verdict.limit
    with pytest.raises(RecalibrationRefusedError):
        judged(KnownPages(pairs[1:], decided[1:], 256, right.references))


def untouched(what: str, share: float) -> None:
    raise AssertionError(what)
