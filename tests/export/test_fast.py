"""A decoder that reads coarsely, of a camera whose pixels do not come in pairs: the file says what torch says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from export.graph import FRAME_INPUTS, DecoderGraph, table_tensors
from export.onnx_files import decoder_onnx
from export.parity import check_parity, torch_answer
from lightpage.calibration.samplers import FieldSampler
from lightpage.calibration.sampling_table import sampling_table
from lightpage.device.profile import Camera
from lightpage.device.state import Device
from lightpage.page.symbols import random_symbols
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import true_parameters
from lightpage.waves.grid import field_grid
from runtime.execution.session import open_session
from tests.export.untrained import untrained_decoder
from tests.lightpage.small import small_profile
from train.models.hyperparameters import Hyperparameters
from train.models.localizers.coherent import BILINEAR
from train.models.twin import RayTwin, TorchTwin

PROFILE = small_profile().model_copy(update={"camera": Camera(columns_px=685, rows_px=457, pitch_m=2.4e-6)})
QUICK = Hyperparameters(channels=8, blocks=1, field_rounds=0, binning=2, samples=3, interpolation=BILINEAR)
COARSE = replace(QUICK, field_step=3)


@pytest.mark.long  # exports three decoders for a camera that no device has
def test_it_agrees_with_torch_and_sees_nearly_what_the_standard_one_sees() -> None:
    device = Device()
    simulator = Simulator(PROFILE, device, seed=1)
    pair = simulator.page(random_symbols(PROFILE, 256, 1, np.random.default_rng(1))[0])
    parameters, usual = true_parameters(PROFILE, device), field_grid(PROFILE)
    places = np.stack(np.meshgrid(*(axis[10:-10] for axis in (usual.x_m, usual.y_m))), axis=-1)
    table = sampling_table(TorchTwin(RayTwin(PROFILE)), parameters, device.homodyne.turn_rad, PROFILE)
    fields = []
    for choices in (QUICK, COARSE, Hyperparameters(channels=8, blocks=1)):
        graph = DecoderGraph(PROFILE, untrained_decoder(PROFILE, parameters, choices), 1.0).eval()
        tensors = table_tensors(graph, table, simulator.references())
        session = open_session(decoder_onnx(graph, "uint8", PROFILE.frame_shape, tensors), "fast", 1)
        frames = dict(zip(FRAME_INPUTS, (pair.in_phase, pair.quadrature), strict=True))
        expected = torch_answer(graph, pair, {name: tensors[name] for name in graph.table_inputs})
        p, field = session.run(["p", "field"], frames)
        assert np.linalg.norm(p) > 0
        check_parity(expected["p"], p, "p")
        fields.append(FieldSampler(field[0] + 1j * field[1], choices.grid(PROFILE))(places))
    *fast, standard = fields
    for seen in fast:
        off = np.linalg.norm(seen - standard) / np.linalg.norm(standard)
        assert 0.01 < off < 0.35
