"""The decoder for many pages in a bundle: it reads as that for one page does, and a GPU has nothing slow to do."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from lightpage.calibration.sampling_table import sampling_table, shifted
from lightpage.codec.code import Code
from lightpage.codec.page_bytes import FileFacts, Header
from lightpage.codec.page_codec import PageCodec
from lightpage.device.state import Device
from lightpage.errors import BundleError, UnconfirmedPageError
from lightpage.export.batched import batched_onnx, traced
from lightpage.export.graph import DecoderGraph, table_tensors
from lightpage.export.half import deviation
from lightpage.export.operators.batches import BatchFile
from lightpage.export.operators.check import fallbacks
from lightpage.metrics.measures import measure
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import random_symbols
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from lightpage.runtime.archives.recordings.evaluation import evaluate
from lightpage.runtime.model.bundle.bundle import npz
from lightpage.runtime.model.bundle.manifest import BATCH, CONSTANTS, GOLDEN
from lightpage.runtime.model.decoding.batch_graph import BatchGraph, Constants, with_proven_batches
from lightpage.runtime.model.decoding.batches import Batches, Batching
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_drift import SHIFT
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.model.decoding.page import Inference
from lightpage.runtime.model.execution.page_graph import REGISTRATION
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import true_parameters
from lightpage.train.models.decoder import SymbolDecoder
from lightpage.train.models.network import SymbolUNet
from lightpage.train.models.presets import ACCURATE, FAST, PRESETS, STANDARD
from lightpage.train.models.twin import RayTwin, TorchTwin
from tests.lightpage.small import small_profile

PROFILE = small_profile()
PAGES = 3


@pytest.fixture(scope="module")
def decoder(small_bundle: Path) -> Decoder:
    return Decoder.load(small_bundle)


@pytest.fixture(scope="module")
def batches(decoder: Decoder) -> BatchGraph:
    return BatchGraph(decoder.bundle, decoder.graph, PAGES)


@pytest.fixture(scope="module")
def shown(small_device: list[str]) -> list[tuple[FramePair, np.ndarray]]:
    """Pages and their symbols."""
    with Recording.open(small_device[3]) as recording:
        pages = [(recording.frames(page), recording.symbols(page)) for page in range(PAGES)]
    return [(pair, symbols) for pair, symbols in pages if symbols is not None]


def read(batches: BatchGraph, constants: Constants, pairs: list[FramePair], shifts: np.ndarray) -> list[Inference]:
    """Pages of one run whose images lie elsewhere by `shifts`, (x, y) of both cameras, [B, 2] pixels."""
    buffer = batches.buffer()
    for place, (pair, shift) in enumerate(zip(pairs, shifts, strict=True)):
        buffer.put(place, pair, np.stack([shift, shift]).astype(np.float32))
    return batches.run(constants, buffer, slice(0, len(pairs)))


def test_pages_of_a_batch_are_read_as_each_alone_where_each_image_lies(
    decoder: Decoder, batches: BatchGraph, shown: list[tuple[FramePair, np.ndarray]]
) -> None:
    mask, registration = decoder.bundle.pilot_mask, decoder.graph.value(REGISTRATION)
    moved = [(0, 0), (0, 1), (-1, 0)]
    shifts = np.array([[0, 0], [0.1, -0.2], [0.04, 0.3]]) + moved
    rolled = [
        FramePair(*(np.roll(frame, (y, x), (0, 1)) for frame in (pair.in_phase, pair.quadrature)))
        for (pair, _), (x, y) in zip(shown, moved, strict=True)
    ]
    together = read(batches, batches.constants_of_bundle, rolled, shifts)
    for pair, (_, symbols), shift, found in zip(rolled, shown, shifts, together, strict=True):
        place = shifted(registration, shift)
        expected, found = decoder.infer(pair, {REGISTRATION: place}), decoder.view.seen(found, place)
        assert deviation(expected.p, found.p) < (0.15 if shift.any() else 0.03)
        assert found.residual == pytest.approx(expected.residual, rel=0.08)
        known = Pilots.of_symbols(mask, symbols, 256)
        rates = [
            measure(
                decoder.post_process(each, 256, known).phase[~mask],
                each.concentration[~mask],  # as claimed, whatever the few pilots of a small page confirm
                symbols[~mask],
                256,
            ).air_bits_per_symbol
            for each in (expected, found)
        ]
        assert rates[1] > rates[0] - 0.005


def test_constants_serve_shifts_within_reach_and_nothing_else(decoder: Decoder, batches: BatchGraph) -> None:
    constants, registration = batches.constants_of_bundle, decoder.graph.value(REGISTRATION)
    np.testing.assert_allclose(constants.shift_of(shifted(registration, [2, -1])), [[2, -1]] * 2, atol=1e-4)
    larger = registration.copy()
    larger[0, 0, 1] += 1
    assert constants.shift_of(larger) is None
    assert constants.shift_of(shifted(registration, [0.02 * PROFILE.frame_shape[1], 0])) is None


def test_fewer_pages_are_read_as_all(batches: BatchGraph, shown: list[tuple[FramePair, np.ndarray]]) -> None:
    pairs, constants = [pair for pair, _ in shown], batches.constants_of_bundle
    (alone,), together = (read(batches, constants, some, np.zeros((len(some), 2))) for some in (pairs[1:2], pairs))
    np.testing.assert_allclose(alone.p, together[1].p, rtol=1e-3, atol=1e-3 * float(np.abs(alone.p).max()))


def test_user_bytes_are_read_of_a_batch(decoder: Decoder, batches: BatchGraph) -> None:
    rng, mask = np.random.default_rng(2), decoder.bundle.pilot_mask
    codec = PageCodec(Code(levels=16, coded_bits=2, rate_per_mille=400, corrections=4, needed_information=0.6), mask)
    headers = [Header(codec.code.id, 1, page, 1) for page in range(2)]
    sent = rng.integers(256, size=(2, codec.user_bytes), dtype=np.uint8)
    symbols = codec.encode(headers, sent, FileFacts(1, 1, 0), rng.integers(16, size=mask.sum(), dtype=np.uint8))
    simulator = Simulator(PROFILE, Device(), 16, seed=2)
    found = read(batches, batches.constants_of_bundle, [simulator.page(page) for page in symbols], np.zeros((2, 2)))
    for page, inference, known in zip(sent, found, symbols, strict=True):
        decoded = decoder.post_process(inference, 16, Pilots.of_symbols(mask, known, 16))
        assert codec.decode(decoded.phase, decoded.concentration).data == page.tobytes()


def test_other_numbers_in_the_table_reach_both_forms(decoder: Decoder, batches: BatchGraph) -> None:
    drifted = Device().with_settings([f"geometry.pipe_angle_deg={Device().geometry.pipe_angle_deg + 0.15}"])
    pair = Simulator(PROFILE, drifted, seed=9).page(random_symbols(PROFILE, 256, 1, np.random.default_rng(9))[0])
    parameters = true_parameters(PROFILE, drifted)
    table = sampling_table(TorchTwin(RayTwin(PROFILE)), parameters, drifted.homodyne.turn_rad, PROFILE)
    refitted = decoder.with_table(decoder.taken(table))
    both = batches.constants(refitted.graph), batches.constants_of_bundle
    found, before = (read(batches, constants, [pair], np.zeros((1, 2)))[0] for constants in both)
    expected = refitted.infer(pair)
    assert deviation(expected.p, found.p) < 0.04 < deviation(expected.p, before.p)


def test_a_bundle_without_the_graph_is_refused(decoder: Decoder) -> None:
    files = {name: data for name, data in decoder.bundle.files.items() if name not in (BATCH, CONSTANTS)}
    with pytest.raises(BundleError):
        BatchGraph(replace(decoder.bundle, files=files), decoder.graph, PAGES)


def test_where_memory_is_short_batches_are_smaller_at_once(decoder: Decoder, monkeypatch: pytest.MonkeyPatch) -> None:
    def with_room_for_two(*asked: Any) -> list[Inference]:
        if asked[-1].stop > 2:
            raise MemoryError
        return run(*asked)

    run = BatchGraph.run
    monkeypatch.setattr(BatchGraph, "run", with_room_for_two)
    assert BatchGraph(decoder.bundle, decoder.graph, PAGES).pages == 2


def test_a_graph_that_says_something_else_to_the_golden_page_is_left_out(decoder: Decoder) -> None:
    golden = decoder.bundle.golden
    files = decoder.bundle.files | {GOLDEN: npz(**vars(golden.pair), p=1.1 * golden.p)}
    left = with_proven_batches(replace(decoder.bundle, files=files), decoder.graph)
    assert files.keys() - left.files.keys() == {BATCH, CONSTANTS}


def typical(phases: np.ndarray) -> float:
    """Median size of phases, radians."""
    return float(np.median(np.abs(np.angle(np.exp(1j * phases)))))


def test_a_stream_is_read_in_batches_as_page_by_page(
    decoder: Decoder, batches: BatchGraph, small_device: list[str]
) -> None:
    """The image walks, jumps before the fifth page, and the third one is not of this device."""
    mask, lost, jump = decoder.bundle.pilot_mask, 2, 4
    with Recording.open(small_device[3]) as recording:
        pages = [(recording.frames(page), np.asarray(recording.symbols(page))) for page in range(7)]
    known = [Pilots.of_symbols(mask, symbols, 256) for _, symbols in pages]
    known[lost] = Pilots(mask, known[lost].phases[::-1])
    pairs = [
        FramePair(*(np.roll(frame, page >= jump, 1) for frame in (pair.in_phase, pair.quadrature)))
        for page, (pair, _) in enumerate(pages)
    ]
    tracker, batching = tracker_for(decoder), Batching(PAGES)
    gathering = Decoder(decoder.bundle, None, decoder.graph, batches=Batches(batches, decoder.graph, batching))
    trackers, rates, phases, errors = (tracker, tracker.refitted(gathering)), [], [], []
    with ThreadPoolExecutor(1) as alone, ThreadPoolExecutor(14) as pool:  # two sessions of the second one
        asked = [
            [
                threads.submit(each.decode, pair, 256, pilots, each.turn())
                for pair, pilots in zip(pairs, known, strict=True)
            ]
            for each, threads in ((trackers[0], alone), (trackers[1], pool), (trackers[1].anew(), pool))
        ]
    for read in asked:
        assert [page for page, one in enumerate(read) if isinstance(one.exception(), UnconfirmedPageError)] == [lost]
        right = [(one.result(), symbols) for one, (_, symbols) in zip(read, pages, strict=True) if not one.exception()]
        read_well = [(page.phase[~mask], page.concentration[~mask], symbols[~mask]) for page, symbols in right]
        rates.append(np.array([measure(*page, 256).air_bits_per_symbol for page in read_well]))
        phases.append(np.stack([phase for phase, _, _ in read_well]))
        errors.append(np.stack([phase - 2 * np.pi * symbols / 256 for phase, _, symbols in read_well]))
    assert max(batching.pages.runs) > 1
    # the small network's errors depend on the processor that trained it, and so does what a page gains by its place
    assert all(typical(each - phases[0]) < typical(errors[0]) / 10 for each in phases[1:])
    # a dozen pilots may trust one page less, by chance either way
    assert all(np.median(np.abs(each - rates[0])) < 0.05 for each in rates[1:])
    with Recording.open(small_device[3]) as recording:
        decoders = zip((decoder, gathering), trackers, strict=True)
        both = [evaluate(one, recording, each.anew()).to_json() for one, each in decoders]
    names = "pages", "pages_left_out", "symbol_error_rate", "air_bits_per_symbol"
    assert [both[1][name] for name in names] == pytest.approx([both[0][name] for name in names], abs=0.005)
    apart_px = np.subtract(trackers[1].image_px, trackers[0].image_px)
    deviations_px = np.sqrt(np.diag(trackers[0].state.covariance)[SHIFT])
    assert np.all(np.abs(apart_px) < deviations_px / 4), apart_px


def graph_for_batches(preset: str) -> BatchFile:
    """Return the batch graph of an untrained decoder of a preset."""
    torch.manual_seed(0)
    device, chosen = Device(), PRESETS[preset]
    parameters = true_parameters(PROFILE, device)
    decoder = SymbolDecoder(PROFILE, parameters, chosen.localizer, chosen.choices)
    for part in decoder.modules():
        for value in part.head.parameters() if isinstance(part, SymbolUNet) else ():
            nn.init.normal_(value, std=0.01)
    graph = DecoderGraph(PROFILE, decoder, 1.0).eval()
    table = sampling_table(TorchTwin(RayTwin(PROFILE)), parameters, device.homodyne.turn_rad, PROFILE)
    defaults = table_tensors(graph, table, Simulator(PROFILE, device, seed=1).references())
    made = batched_onnx(graph, "uint8", defaults, torch.float16)
    assert made is not None
    return BatchFile(made[1], 8)


@pytest.mark.parametrize(
    ("preset", "kernels", "megabytes"), [(STANDARD, 700, 200), (FAST, 180, 33), (ACCURATE, 1000, 260)]
)
def test_a_gpu_has_nothing_slow_to_do(preset: str, kernels: int, megabytes: float) -> None:
    file = graph_for_batches(preset)
    assert file.left_constants() == []
    assert file.reduced_planes() == []
    assert file.rounded_places() == []
    assert file.wide_planes(PROFILE.page_shape) == []
    assert fallbacks(file.model.SerializeToString(), "cuda") == []
    cost = file.cost()
    assert cost.kernels < kernels
    assert cost.bytes_a_page < 1e6 * megabytes
    assert cost.flops_a_page > 1e7  # all shapes are known, or it would count none


class Slow(nn.Module):
    """A constant on the left, and a sum over planes."""

    def forward(self, in_phase: torch.Tensor, constant: torch.Tensor) -> torch.Tensor:
        return (constant @ in_phase).sum(-1)


def test_what_is_slow_is_found() -> None:
    inputs = torch.zeros(1, 40, 40), torch.zeros(40, 40)
    model = traced(Slow(), inputs, ("in_phase", "constant"), ("p",), ("in_phase", "p"))
    file = BatchFile(model.SerializeToString(), 4)
    assert len(file.left_constants()) == 1
    assert len(file.reduced_planes()) == 1
    assert "in_phase" in file.wide_planes((1, 1))
