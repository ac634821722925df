"""KServe's side: its model server with the graphs as models. Runs in KServe's environment.

    python -m analysis.service.other_servers.on_kserve FOLDER THREADS --grpc_port PORT --http_port PORT ...

Over HTTP it takes bytes by version 1 of KServe's protocol, which hands on what is not JSON. Version 2 over HTTP would
make a list of numbers of them.
"""

from __future__ import annotations

import argparse
import asyncio
from pathlib import Path
from typing import Any

import numpy as np
from kserve import InferOutput, InferRequest, InferResponse, Model, ModelServer, model_server

from analysis.service.other_servers.onnx_run import FRAMES, OUTPUT, OnnxRun, open_all


class GraphModel(Model):  # type: ignore[misc]  # of another environment
    """Runs a graph.

    Args:
        name: name of the model.
        run: the graph.
        like: frames that it takes.
    """

    def __init__(self, name: str, run: OnnxRun, like: np.ndarray) -> None:
        super().__init__(name)
        self._run, self._like, self.ready = run, like, True

    async def predict(self, payload: InferRequest | bytes, headers: Any = None) -> InferResponse | bytes:
        """p of the frames that came: tensors over gRPC, both frames one behind the other over HTTP."""
        if isinstance(payload, bytes):
            pair = np.frombuffer(payload, self._like.dtype).reshape(self._like.shape)
            return (await asyncio.to_thread(self._run, *pair)).tobytes()
        frames = {tensor.name: tensor.as_numpy() for tensor in payload.inputs}
        p = await asyncio.to_thread(self._run, frames["in_phase"], frames["quadrature"])
        output = InferOutput(OUTPUT, list(p.shape), "FP32")
        output.set_data_from_numpy(p)
        return InferResponse(payload.id, self.name, [output])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(parents=[model_server.parser])
    parser.add_argument("folder", type=Path)
    parser.add_argument("threads", type=int)
    given, _ = parser.parse_known_args()
    runs = open_all(given.folder, given.threads)
    frames = {name: np.load(given.folder / name / FRAMES, mmap_mode="r") for name in runs}
    ModelServer().start([GraphModel(name, run, frames[name]) for name, run in runs.items()])
