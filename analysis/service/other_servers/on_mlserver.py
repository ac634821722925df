"""MLServer's side: a runtime of its own for the graph, which mlserver-model.json names. Runs in MLServer's environment.

Over gRPC, MLServer makes a list of numbers of every tensor, but for one of type BYTES. So a frame comes as one element
of BYTES, and p goes as one. A frame that comes as numbers is taken too. Over HTTP, a handler of the model's own takes
bytes.
"""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import numpy as np
from mlserver import MLModel, ModelSettings
from mlserver.codecs import NumpyCodec
from mlserver.handlers.custom import CustomHandler, register_custom_handler
from mlserver.types import InferenceRequest, InferenceResponse, RequestInput, ResponseOutput
from mlserver.utils import get_model_uri
from numpy.typing import NDArray
from starlette.requests import Request
from starlette.responses import Response

from analysis.service.other_servers.onnx_run import OUTPUT, OnnxRun


class GraphRuntime(MLModel):  # type: ignore[misc]  # of another environment
    """Runs the graph of its folder."""

    def __init__(self, settings: ModelSettings) -> None:
        super().__init__(settings)

        async def raw(request: Request) -> Response:
            """p of both frames, one behind the other in the body."""
            frames = np.frombuffer(await request.body(), self._dtype).reshape(2, *self._shape)
            return Response((await asyncio.to_thread(self._run, *frames)).tobytes())

        register_custom_handler(CustomHandler(rest_path=f"/{self.name}"), raw)
        self.raw = raw  # MLServer looks for such attributes before it loads

    async def load(self) -> bool:
        """Open it."""
        own = self.settings.parameters.extra
        self._run = OnnxRun(Path(await get_model_uri(self.settings)), own["threads"])
        self._shape, self._dtype = tuple(own["frame_shape"]), np.dtype(own["frame_dtype"])
        return True

    async def predict(self, payload: InferenceRequest) -> InferenceResponse:
        """p of the frames that came."""
        frames = {tensor.name: self._frame(tensor) for tensor in payload.inputs}
        p = await asyncio.to_thread(self._run, frames["in_phase"], frames["quadrature"])
        output = ResponseOutput(name=OUTPUT, datatype="BYTES", shape=[1], data=[p.tobytes()])
        return InferenceResponse(model_name=self.name, outputs=[output])

    def _frame(self, tensor: RequestInput) -> NDArray[Any]:
        if tensor.datatype != "BYTES":
            frame: NDArray[Any] = NumpyCodec.decode_input(tensor)
            return frame
        return np.frombuffer(tensor.data.root[0], self._dtype).reshape(self._shape)
