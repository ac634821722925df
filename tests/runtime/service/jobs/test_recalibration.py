"""Recalibration over the endpoint: what it brings, what it refuses, and that nothing is lost or changed meanwhile."""

import json
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import grpc
import h5py
import numpy as np
import pytest

from lightpage.errors import (
    BundleError,
    InvalidInputError,
    LightpageError,
    LimitError,
    OtherModelError,
    RecalibrationRefusedError,
    RecordingError,
    SourceError,
)
from lightpage.metrics.measures import measure
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.device.acquisition.source import Shot, open_source
from lightpage.runtime.recalibration.recalibration import RefitResult
from lightpage.runtime.service.models.models import KEPT_MODELS
from tests.runtime import toy
from tests.runtime.recalibration.toy_worker import DRIFTED
from tests.runtime.service.stage import Running, Start, refused
from tests.runtime.slow_fit import SlowFit
from tests.waiting import eventually


def recorded(path: Path, pages: int, **changes: Callable[[Any], Any]) -> np.ndarray:
    """Write a recording of the drifted device, some of its datasets changed; returns its symbols."""
    symbols = toy.write_toy_recording(path, toy.ToyDevice(DRIFTED), 16, pages)
    with h5py.File(path, "r+") as file:
        for name, change in changes.items():
            data = file[name][()]
            del file[name]
            if (changed := change(data)) is not None:
                file[name] = changed
    return symbols


def air_of(service: Running, pages: int = 3) -> float:
    read = [
        service.client.pages.read(want_phase=True, want_concentration=True, want_written=True) for _ in range(pages)
    ]
    data = ~np.stack([page.pilot_mask for page in read])
    stacked = [np.stack([getattr(page, name) for page in read])[data] for name in ("phase", "concentration", "written")]
    return measure(*stacked, 16).air_bits_per_symbol


def test_it_recovers_what_drift_cost_and_rollback_undoes_it(start: Start) -> None:
    service = start()
    before = air_of(service)
    service.device.offsets = DRIFTED
    assert air_of(service) < before - 0.8
    steps: list[tuple[str, float]] = []
    result = service.client.jobs.recalibrate(count=2, progress=lambda name, share: steps.append((name, share)))
    assert (result.model_version, result.previous_version) == ("toy-1+r1", "toy-1")
    assert (result.pages_used, result.pages_held_back) == (2, 1)
    assert (result.angle_deg, result.coherence_before, result.coherence_after) == (0.5, 0.4, 0.9)
    assert result.air_after > result.air_before
    shares = [share for _, share in steps]
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0, 1)
    assert ("fit", pytest.approx(2 / 25 + 23 / 25 * 11 / 23)) in steps  # half of the fit, two pages read
    assert air_of(service) > 0.98 * before
    assert [(m.version, m.current) for m in service.client.models.list()] == [("toy-1", False), ("toy-1+r1", True)]
    assert service.client.describe().calibration_toml == "angle_deg = 0.5\n"
    assert service.client.models.roll_back() == ("toy-1", "toy-1+r1")
    assert air_of(service) < before - 0.8
    with pytest.raises(BundleError):
        service.client.models.roll_back()


def test_without_a_store_it_goes_on_after_a_rollback_and_keeps_only_the_models_held(start: Start) -> None:
    service = start()
    assert service.client.jobs.recalibrate(count=2).model_version == "toy-1+r1"
    assert service.client.models.roll_back() == ("toy-1", "toy-1+r1")
    versions = [service.client.jobs.recalibrate(count=2).model_version for _ in range(KEPT_MODELS + 1)]
    assert versions == [f"toy-1+r{number}" for number in range(2, KEPT_MODELS + 3)]
    kept = [model.decoder.bundle.path for model in service.plane.models.loaded]
    assert sorted(kept[0].parent.iterdir()) == sorted(kept)
    service.end()
    assert not kept[0].parent.exists()


# ---- refused ------------------------------------------------------------------------------------------------------


def test_a_re_fit_is_not_judged_by_the_page_that_it_was_fitted_on(start: Start, tmp_path: Path) -> None:
    recorded(path := tmp_path / "source.h5", 2)
    client = start(source=open_source(f"recording:{path}")).client
    # Of two pages the third one is the first.
    for twice, subject in (({"pages": [1, 1]}, "known page 1"), ({"count": 3}, "known page 2")):
        with pytest.raises(InvalidInputError) as error:
            client.jobs.recalibrate(**twice)
        assert error.value.subject == subject
    assert client.jobs.recalibrate(pages=[1, 0]).pages_used == 2


def test_pages_without_symbols_are_the_fault_of_who_named_them(start: Start, tmp_path: Path) -> None:
    service = start()
    service.reading(lambda shot: Shot(shot.pair, shot.page_index))
    recorded(tmp_path / "plain.h5", 2, symbols=lambda _: None)
    for asked, code, subject in (
        ({"source": pb.SourcePages(count=2)}, grpc.StatusCode.FAILED_PRECONDITION, "pages of toy:device"),
        ({"recording": "plain.h5"}, grpc.StatusCode.INVALID_ARGUMENT, "recording plain.h5"),
    ):
        answer = refused(lambda asked=asked: service.stub.Recalibrate(pb.RecalibrateRequest(**asked), timeout=20))
        assert (answer.code, answer.subject) == (code, subject)


def test_recordings_on_the_server(start: Start, tmp_path: Path) -> None:
    service = start()

    def fails(kind: type[LightpageError], name: str, count: int = 0) -> LightpageError:
        with pytest.raises(kind) as error:
            service.client.jobs.recalibrate(recording=name, count=count)
        return error.value

    recorded(tmp_path / "known.h5", 4, in_phase=lambda data: data * (np.arange(4) != 1)[:, None, None].astype(np.uint8))
    assert service.client.jobs.recalibrate(recording="known.h5").pages_used == 3  # but for the dark one
    (tmp_path / "link.h5").symlink_to(tmp_path / "known.h5")
    for name in ("absent.h5", "../known.h5", str(tmp_path / "known.h5"), "", "x" * 300, "link.h5"):
        assert fails(InvalidInputError, name).subject == "recording to recalibrate with"

    def wrong_behind_three(symbols: np.ndarray) -> np.ndarray:
        return np.concatenate([symbols[:3], 15 - symbols[3:]])

    recorded(tmp_path / "long.h5", 18, symbols=wrong_behind_three)
    assert [fails(LimitError, "long.h5", count).got for count in (0, 17)] == ["18", "17"]
    result = service.client.jobs.recalibrate(recording="long.h5", count=3)
    assert (result.pages_used, result.pages_held_back) == (3, 2)
    assert "4 pages" in fails(RecordingError, "known.h5", 5).got

    frames = ("in_phase", "quadrature", "reference_in_phase", "reference_quadrature")
    recorded(tmp_path / "narrow.h5", 2, **dict.fromkeys(frames, lambda data: data[..., :90]))
    assert "64 x 90" in fails(RecordingError, "narrow.h5").got
    (tmp_path / "damaged.h5").write_bytes((tmp_path / "known.h5").read_bytes()[:-2000])
    assert fails(SourceError, "damaged.h5").subject.startswith("recording damaged.h5")


# ---- beside other things ------------------------------------------------------------------------------------------


def test_the_service_ends_beside_one_that_does_not_stop_and_it_changes_nothing_any_more(start: Start) -> None:
    entered, go = threading.Event(), threading.Event()

    def deaf(*arguments: object) -> RefitResult:
        entered.set()
        go.wait(60)
        return toy.fit_references(*arguments)  # type: ignore[arg-type]

    service = start(fit=deaf)
    call = service.stub.Recalibrate(pb.RecalibrateRequest(source=pb.SourcePages(count=2)), timeout=60)
    assert next(call).progress.step
    assert entered.wait(60)
    service.server.stop(0.1)
    assert service.count("lightpage_recalibrations_total", result="dropped") == 0  # it is still at work
    go.set()
    eventually(lambda: service.count("lightpage_recalibrations_total", result="dropped") == 1)
    assert [model.version for model in service.plane.models.loaded] == ["toy-1"]


def test_who_asked_for_a_change_is_written_down(start: Start, tmp_path: Path) -> None:
    file = tmp_path / "audit.jsonl"
    start(audit=file).client.jobs.recalibrate(count=2)
    assert json.loads(file.read_text("utf-8"))["who"].startswith("ipv4:127.0.0.1:")


def test_a_caller_who_leaves_ends_it(start: Start) -> None:
    fit = SlowFit()
    service = start(fit=fit)
    call = service.stub.Recalibrate(pb.RecalibrateRequest(source=pb.SourcePages(count=2)), timeout=60)
    assert next(call).progress.step
    assert fit.entered.wait(60)
    call.cancel()
    assert fit.ended.wait(60)
    eventually(lambda: service.count("lightpage_recalibrations_total", result="dropped") == 1)
    assert service.version == "toy-1"
    eventually(lambda: service.client.jobs.list()[0].state.name != "RUNNING")  # its end is noted after it is counted
    fit.go.set()
    assert service.client.jobs.recalibrate(count=2).model_version == "toy-1+r1"


def test_a_model_that_changes_meanwhile_makes_its_result_out_of_date(start: Start) -> None:
    fit = SlowFit()
    service = start(fit=fit)
    fit.go.set()
    service.client.jobs.recalibrate(count=2)
    fit.go.clear()
    fit.entered.clear()
    with ThreadPoolExecutor(1) as pool:
        again = pool.submit(service.client.jobs.recalibrate, count=2)
        assert fit.entered.wait(60)
        assert service.client.models.roll_back()[0] == "toy-1"
        fit.go.set()
        with pytest.raises(RecalibrationRefusedError):
            again.result(60)
    assert service.version == "toy-1"

    def changing(shot: Shot) -> Shot:
        if service.version != "toy-1":
            service.client.models.roll_back()
        return shot

    assert service.client.jobs.recalibrate(count=2).model_version == "toy-1+r2"
    service.reading(changing)
    with pytest.raises(OtherModelError):
        service.client.jobs.recalibrate(count=2, expected_version="toy-1+r2")
    assert service.version == "toy-1"
