"""Ray Serve's side: one replica that has the graphs, behind gRPC and HTTP. Runs in Ray's environment.

    python -m analysis.service.other_servers.on_ray FOLDER THREADS GRPC_PORT HTTP_PORT TEMPORARY

It serves until its stdin is closed.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import ray
from ray import serve
from ray.serve.config import HTTPOptions, gRPCOptions

from analysis.service.other_servers.onnx_run import FRAMES, OUTPUT, open_all

_STUBS = "lightpage.runtime.client.pb.inference.open_inference_pb2_grpc.add_GRPCInferenceServiceServicer_to_server"
_ONGOING = 64
"""Requests that the replica has taken at once: more than there are callers."""
_STORE_BYTES = 1 << 30
"""Size of Ray's memory for objects: room for a dozen pairs of 42 MB."""


class Graphs:
    """The deployment: its methods are those of the protocol, and run in threads.

    Args:
        folder: folder of the models.
        threads: threads of one run.
    """

    def __init__(self, folder: Path, threads: int) -> None:
        self._runs = open_all(folder, threads)
        self._frames = {path.parent.name: np.load(path, mmap_mode="r") for path in folder.glob(f"*/{FRAMES}")}

    def ModelInfer(self, request: Any) -> Any:
        """p of the frames that came, over gRPC."""
        from lightpage.runtime.client.pb.inference import open_inference_pb2 as oip

        frames = {
            tensor.name: np.frombuffer(content, tensor.datatype.lower()).reshape(tuple(tensor.shape))
            for tensor, content in zip(request.inputs, request.raw_input_contents, strict=True)
        }
        p = self._runs[request.model_name](frames["in_phase"], frames["quadrature"])
        response = oip.ModelInferResponse(model_name=request.model_name, id=request.id)
        response.outputs.add(name=OUTPUT, datatype="FP32", shape=p.shape)
        response.raw_output_contents.append(p.tobytes())
        return response

    async def __call__(self, request: Any) -> Any:
        """p of both frames, one behind the other in the body, over HTTP."""
        import asyncio

        from starlette.responses import Response

        name = request.url.path.strip("/")
        like = self._frames[name]
        in_phase, quadrature = np.frombuffer(await request.body(), like.dtype).reshape(like.shape)
        p = await asyncio.to_thread(self._runs[name], in_phase, quadrature)
        return Response(p.tobytes())


def main(folder: str, threads: str, grpc_port: str, http_port: str, temporary: str) -> None:
    """Start Ray and Serve, and end both with stdin."""
    ray.init(
        address="local",
        include_dashboard=False,
        object_store_memory=_STORE_BYTES,
        log_to_driver=False,
        _node_ip_address="127.0.0.1",
        _temp_dir=temporary,
    )
    serve.start(
        http_options=HTTPOptions(host="127.0.0.1", port=int(http_port)),
        grpc_options=gRPCOptions(port=int(grpc_port), grpc_servicer_functions=[_STUBS]),
    )
    deployment = serve.deployment(num_replicas=1, max_ongoing_requests=_ONGOING)(Graphs)
    serve.run(deployment.bind(Path(folder), int(threads)))
    sys.stdin.read()
    ray.shutdown()  # Serve with it


if __name__ == "__main__":
    main(*sys.argv[1:])
