"""A bundle whose answer does not depend on the frames: what a call with it takes is the service's own time.

``python -m analysis.service.constant_bundle --profile paper --out constant.zip`` writes one, and frames to send.
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from lightpage.cli.paths import NewPath
from lightpage.device.profile import Profile, load_profile
from lightpage.page.levels import MAX_LEVELS
from lightpage.page.symbols import random_symbols, symbol_phases
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.bundle.bundle import npz, write_bundle
from lightpage.runtime.model.bundle.manifest import DECODER, GOLDEN, TWIN, Manifest

_KAPPA = 400.0
"""Claimed of every symbol."""


def constant_bundle(path: Path, profile: Profile, seed: int = 0) -> FramePair:
    """Write a bundle for 8-bit cameras, and return a pair of frames that it takes.

    Args:
        path: a new zip.
        profile: profile of the device.
        seed: seed of the page that it always answers, and of the frames.
    """
    rng = np.random.default_rng(seed)
    theta = symbol_phases(random_symbols(profile, MAX_LEVELS, 1, rng)[0], MAX_LEVELS)
    p = (_KAPPA * np.stack([np.cos(theta), np.sin(theta)])).astype(np.float32)
    pair = FramePair(*rng.integers(20, 200, (2, *profile.frame_shape), np.uint8))
    manifest = Manifest(
        name="constant",
        version="constant-1",
        created="2026-01-01T00:00:00Z",
        profile=profile.to_toml(),
        calibration="angle_deg = 0.0\n",
        camera_bit_depth=8,
        frame_dtype="uint8",
        table_inputs=(),
    )
    golden = npz(in_phase=pair.in_phase, quadrature=pair.quadrature, p=p)
    write_bundle(path, manifest, {DECODER: _graph(profile.frame_shape, p), TWIN: _no_twin(), GOLDEN: golden})
    return pair


def _graph(shape: tuple[int, int], p: np.ndarray) -> bytes:
    """p, whatever the frames are: nothing times their first pixels is added to it."""
    f, nodes = TensorProto.FLOAT, []
    for name in ("in_phase", "quadrature"):
        nodes += [
            helper.make_node("Slice", [name, "zero", "one"], [f"{name}_row"]),
            helper.make_node("Cast", [f"{name}_row"], [f"{name}_f"], to=f),
            helper.make_node("ReduceMean", [f"{name}_f"], [f"{name}_m"], keepdims=0),
        ]
    nodes += [
        helper.make_node("Sub", ["in_phase_m", "in_phase_m"], ["nothing_1"]),
        helper.make_node("Sub", ["quadrature_m", "quadrature_m"], ["nothing_2"]),
        helper.make_node("Add", ["nothing_1", "nothing_2"], ["nothing"]),
        helper.make_node("Add", ["answer", "nothing"], ["p"]),
        helper.make_node("Add", ["answer_phase", "nothing"], ["phase"]),
        helper.make_node("Add", ["answer_kappa", "nothing"], ["concentration"]),
    ]
    constants = {
        "zero": np.array([0], np.int64),
        "one": np.array([1], np.int64),
        "answer": p,
        "answer_phase": np.arctan2(p[1], p[0]).astype(np.float32),
        "answer_kappa": np.full(p.shape[1:], _KAPPA, np.float32),
    }
    frames = [helper.make_tensor_value_info(name, TensorProto.UINT8, shape) for name in ("in_phase", "quadrature")]
    outputs = [
        helper.make_tensor_value_info(name, f, size)
        for name, size in (("p", p.shape), ("phase", p.shape[1:]), ("concentration", p.shape[1:]))
    ]
    initial = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    return _model(helper.make_graph(nodes, "constant", frames, outputs, initial))


def _no_twin() -> bytes:
    """A bundle has a model of its device; this one's is never asked."""
    double = TensorProto.DOUBLE
    graph = helper.make_graph(
        [helper.make_node("Identity", ["points"], ["places"])],
        "twin",
        [helper.make_tensor_value_info("points", double, ["n", 2])],
        [helper.make_tensor_value_info("places", double, ["n", 2])],
    )
    return _model(graph)


def _model(graph: onnx.GraphProto) -> bytes:
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())


@click.command()
@click.option("--profile", "profile_name", default="paper", show_default=True, help="Name or file of the device.")
@click.option("--out", type=NewPath(), required=True, help="Bundle to write, a .zip.")
@click.option("--frames", type=NewPath(), help="File for a pair of frames, .npz.")
def main(profile_name: str, out: Path, frames: Path | None) -> None:
    """Write the bundle."""
    pair = constant_bundle(out, load_profile(profile_name))
    if frames is not None:
        np.savez(frames, in_phase=pair.in_phase, quadrature=pair.quadrature)


if __name__ == "__main__":
    main()
