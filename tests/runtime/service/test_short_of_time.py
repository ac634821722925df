"""Pages of callers who take fewer Gauss-Newton steps where their time is short."""

from itertools import count

import numpy as np
import pytest

from lightpage.errors import OverloadedError
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.client.answers import RemotePage
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path
from lightpage.runtime.model.execution.estimator_graph import EARLY_STEPS, EstimatorGraph
from lightpage.runtime.model.execution.step_times import StepTimes
from tests.runtime.service.frames.test_inference import request_of, stub_of
from tests.runtime.service.stage import Running, Start

STEP_S = 10.0
"""Time that each step seems to take, far more than it does."""
DEADLINE_S = 30.0


@pytest.fixture
def slow(start: Start) -> Running:
    """A service of three steps, each of which seems to take `STEP_S`, as the first estimate does."""
    service = start(bundle_path(DEFAULT), source=None)
    graph = service.plane.models.current.decoder.graph
    assert graph.steps == 3
    ticks = count()
    graph.times = StepTimes(EARLY_STEPS, lambda: STEP_S * next(ticks))
    for number in range(3):
        with graph.times.measured(number):
            pass
    service.plane.decodes.took(4 * STEP_S)
    return service


def decoded(service: Running, least_steps: int) -> tuple[FramePair, RemotePage]:
    """The golden page as the service decodes it by a call that ends after `DEADLINE_S`."""
    pair = service.plane.models.current.decoder.bundle.golden.pair
    with LightpageClient(service.server.target, timeout_s=DEADLINE_S) as client:
        return pair, client.frames.decode(pair, 256, stateless=True, want_phase=True, least_steps=least_steps)


def rms(differences: np.ndarray) -> float:
    """Root mean square of phase differences whose mean is taken off, radians."""
    turned = differences - np.angle(np.mean(np.exp(1j * differences)))
    return float(np.sqrt(np.mean(np.angle(np.exp(1j * turned)) ** 2)))


def test_a_caller_who_takes_fewer_steps_is_answered_in_time(slow: Running) -> None:
    pair, page = decoded(slow, least_steps=1)
    assert (page.timings.steps, page.timings.skipped_steps) == (1, 2)
    graph = slow.plane.models.current.decoder.graph
    assert isinstance(graph, EstimatorGraph)
    feeds = {"in_phase": pair.in_phase, "quadrature": pair.quadrature}
    one, whole = (graph.run(["phase"], feeds, steps)[0] for steps in (1, 3))
    assert page.phase is not None
    assert rms(page.phase - one) < 0.5 * rms(page.phase - whole)  # piston and smooth errors are taken off the page's
    assert slow.count("lightpage_steps_total", outcome="taken") == 1
    assert slow.count("lightpage_steps_total", outcome="skipped") == 2
    # what all steps would have taken is what others are expected to need
    assert slow.plane.decodes.needed_s > 2 * STEP_S


@pytest.mark.parametrize("least_steps", [0, 2])
def test_a_caller_who_wants_more_steps_is_refused_at_once(slow: Running, least_steps: int) -> None:
    with pytest.raises(OverloadedError, match="deadline"):
        decoded(slow, least_steps)


def test_with_enough_time_all_steps_are_taken(start: Start) -> None:
    service = start(bundle_path(DEFAULT), source=None)
    _, page = decoded(service, least_steps=1)
    assert (page.timings.steps, page.timings.skipped_steps) == (3, 0)


def test_the_service_describes_the_times_of_its_steps(slow: Running) -> None:
    assert slow.client.describe().steps_s == (2 * STEP_S, 3 * STEP_S, 4 * STEP_S)
    assert slow.count("lightpage_steps_seconds", steps="2") == 3 * STEP_S


def test_a_network_has_no_steps(service: Running) -> None:
    assert service.client.describe().steps_s == ()


def test_the_inference_protocol_takes_the_option(slow: Running) -> None:
    pair = slow.plane.models.current.decoder.bundle.golden.pair
    request = request_of(pair, levels=256, stateless=True, least_steps=1)
    response = stub_of(slow).ModelInfer(request, timeout=DEADLINE_S)
    assert response.parameters["timings.steps"].int64_param == 1
    assert response.parameters["timings.skipped_steps"].int64_param == 2
