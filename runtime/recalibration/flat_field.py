"""Flat field of an estimator by all known pages of its device, beside the few of its calibration.

Part of what the fitted waves miss may be the same on every page. The more pages there are, the better it is known.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.calibrated_device import CalibratedDevice
from lightpage.calibration.known_pages import known_pages
from lightpage.calibration.likelihood.interfaces import ProgressCallback
from lightpage.calibration.likelihood.table import FLAT_FIELD
from lightpage.calibration.sampling_table import SamplingTable
from lightpage.errors import InvalidInputError
from lightpage.recording.layout import narrow
from lightpage.recording.reader import Recording
from lightpage.runtime.model.execution.estimator_graph import NOISE, EstimatorGraph
from lightpage.runtime.recalibration.noise import UNIT_NOISE, KnownPhases, PhaseErrors, best_flat_field, differ, placed

MOST_PAGES = 16
"""Pages, at most, from which a flat field is made."""
_FIRST = 4
"""Pages after which a flat field that does not help is no longer looked for."""
_KEPT = (4, 10)
"""Pages, at least and at most, that stay unseen, so that they tell what is read and choose a code. Between these, half
of the pages do."""
_LEAST_READ = 0.5
"""Least mean resultant of a page's errors; with less, the page is not read."""


class FlatFieldPages(NamedTuple):
    """Tensors of the table by a flat field of further pages, and the hashes of these pages (`hash_frames`)."""

    table: SamplingTable
    hashes: tuple[str, ...]


def flat_field_of(
    graph: EstimatorGraph,
    recording: Recording,
    device: CalibratedDevice,
    used: list[int],
    mask: NDArray[np.bool_],
    progress: ProgressCallback = lambda share: None,
) -> FlatFieldPages:
    """Make a flat field of a recording's further known pages, if such pages are read better with it.

    Every page is judged with the flat field of the others.

    Args:
        graph: graph of the device with its noise and the flat field of its calibration.
        recording: recording of the device, with symbols.
        device: calibrated device.
        used: numbers of the calibration's pages. They have part in the flat field, and do not judge.
        mask: positions of the pilots, bool [ny, nx].
        progress: called with the finished share of the work.

    Returns:
        `FLAT_FIELD` [ny, nx] and `NOISE`, with the hashes of the further pages; nothing where the graph takes no flat
        field or none helps.

    Raises:
        RecordingError: unreadable data.
    """
    others = [page for page in range(recording.pages) if page not in used] if recording.has_symbols else []
    unseen = min(max(len(others) // 2, _KEPT[0]), _KEPT[1])
    others = others[: min(MOST_PAGES - len(used), len(others) - unseen)] if len(others) > unseen else []
    if FLAT_FIELD not in graph.ports or not others:
        return FlatFieldPages({}, ())
    earlier = np.asarray(graph.value(FLAT_FIELD), np.float64)
    by_page: list[PhaseErrors] = []
    hashes: list[str] = []
    own = 0
    pages = [*used, *others]
    for page, errors in errors_of_pages(graph, recording, device, pages, mask):
        progress(pages.index(page) / len(pages))
        by_page.append(errors)
        if page in used:
            own += 1
            continue
        hashes.append(recording.page_hash(page))
        if len(hashes) == _FIRST and not _table(by_page, own, ~mask, earlier, graph):
            return FlatFieldPages({}, ())
    table = _table(by_page, own, ~mask, earlier, graph) if hashes else {}
    return FlatFieldPages(table, tuple(hashes) if table else ())


def errors_of_pages(
    graph: EstimatorGraph,
    recording: Recording,
    device: CalibratedDevice,
    pages: Sequence[int],
    mask: NDArray[np.bool_],
) -> Iterator[tuple[int, PhaseErrors]]:
    """Yield the numbers of known pages, and their errors without a flat field, [1, ny, nx] each.

    Pages without light, pages that are not read, and pages with the symbols of an earlier one are left out. See
    `flat_field_of`.
    """
    earlier: list[NDArray[np.float64]] = []
    noise = graph.value(NOISE).copy()
    noise[-1] = UNIT_NOISE
    plain = graph.with_table({FLAT_FIELD: np.zeros(mask.shape, np.float32), NOISE: noise})
    for number in pages:
        try:
            (page,) = known_pages(recording, device.profile, [number])
        except InvalidInputError:
            continue
        known = KnownPhases.of(page, device)
        if not all(differ(known.phases, phases) for phases in earlier):
            continue
        earlier.append(known.phases)
        known = known._replace(pair=narrow(known.pair, recording.bit_depth))
        feeds = placed(plain, known.feeds(mask))
        state = plain.first_estimate(feeds)
        for step in range(1, plain.most_steps + 1):
            state = plain.step(state, feeds, step)
        errors = PhaseErrors.of([state["p"]], [known], mask)
        if abs(np.mean(np.exp(1j * errors.phases))) >= _LEAST_READ:
            yield number, errors


def _table(
    by_page: list[PhaseErrors], own: int, data: NDArray[np.bool_], earlier: NDArray[np.float64], graph: EstimatorGraph
) -> SamplingTable:
    """Return the tensors of the best flat field; none where that of the calibration is as good.

    Args:
        by_page: errors of pages, [1, ny, nx] each; the calibration's come first.
        own: number of the calibration's pages.
        data: symbols that are no pilots, [ny, nx].
        earlier: flat field of the calibration, radians [ny, nx].
        graph: graph of the device.
    """
    errors = PhaseErrors.together(by_page)
    best = best_flat_field(errors, data, earlier, judges=slice(own, None))
    if np.array_equal(best.phases, earlier) or not best.phases.any():
        return {}
    noise = graph.value(NOISE).copy()
    noise[-1] = errors.noise(best.by_others, data)
    return {FLAT_FIELD: best.phases.astype(np.float32), NOISE: noise}
