"""Graphs that all servers run, frames that they take, and the bundles that both come from."""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.service.constant_bundle import constant_bundle
from analysis.service.other_servers.onnx_run import FRAMES, GRAPH
from lightpage.device.profile import load_profile
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.manifest import DECODER
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path

DECODER_NAME = "decoder"
CONSTANT = {"constant-small": "bench", "constant-large": "paper"}
"""Profiles of the devices whose frames go to a graph that answers a constant, by its name."""


@dataclass(frozen=True)
class Graph:
    """A graph that every server carries.

    Attributes:
        name: name of the model.
        pair: frames that it takes.
        bundle: bundle that holds it, a zip.
        page_shape: shape of the answer.
    """

    name: str
    pair: FramePair
    bundle: Path
    page_shape: tuple[int, int]

    @property
    def frames(self) -> NDArray[Any]:
        """Frames of the pair, [2, rows, columns]."""
        return np.stack([self.pair.in_phase, self.pair.quadrature])

    @property
    def pair_bytes(self) -> int:
        """Bytes of both frames."""
        return int(self.pair.in_phase.nbytes + self.pair.quadrature.nbytes)


def write_graphs(folder: Path, threads: int) -> list[Graph]:
    """Write the graphs for the other servers: FOLDER/NAME has the graph, frames, and MLServer's description.

    Args:
        folder: an empty one.
        threads: threads of one run.
    """
    graphs = []
    for name, profile_name in CONSTANT.items():
        profile, path = load_profile(profile_name), folder / f"{name}.zip"
        graphs.append(Graph(name, constant_bundle(path, profile), path, profile.page_shape))
    shipped = Bundle.open(bundle_path(DEFAULT))
    graphs.append(Graph(DECODER_NAME, shipped.golden.pair, shipped.path, shipped.profile.page_shape))
    for graph in graphs:
        home = folder / graph.name
        home.mkdir()
        (home / GRAPH).write_bytes(Bundle.open(graph.bundle).files[DECODER])
        np.save(home / FRAMES, graph.frames)
        settings = json.loads(committed("mlserver-model.json"))
        frame = graph.pair.in_phase
        own = {"threads": threads, "frame_shape": frame.shape, "frame_dtype": str(frame.dtype)}
        settings["parameters"]["extra"] = own
        (home / "model-settings.json").write_text(json.dumps({"name": graph.name, **settings}, indent=2), "utf-8")
    (folder / "settings.json").write_text(committed("mlserver-settings.json"), "utf-8")
    return graphs


def committed(name: str) -> str:
    """A configuration beside this file."""
    return resources.files(__package__).joinpath(name).read_text("utf-8")
