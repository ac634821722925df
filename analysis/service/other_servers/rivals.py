"""Starts and callers of the other servers: the configuration that counts, and others that were tried."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from analysis.service.other_servers.calls import Call, bytes_caller, inference_caller
from analysis.service.other_servers.graphs import Graph
from analysis.service.other_servers.onnx_run import OUTPUT
from analysis.service.other_servers.servers import OtherServer

MLSERVER, KSERVE, RAY = "MLServer", "KServe", "Ray Serve"
MLSERVER_PORT, MLSERVER_HTTP_PORT = 18081, 18080
"""Ports are in a network that nothing else is in. These are in mlserver-settings.json too."""
KSERVE_PORT, KSERVE_HTTP_PORT = 18181, 18180
RAY_PORT, RAY_HTTP_PORT = 18281, 18280
"""Ports of Ray's proxy."""
RAY_DIRECT_PORT, RAY_DIRECT_HTTP_PORT = 18301, 18311
"""Ports of the replica."""
_MESSAGE_BYTES = 128 << 20

Caller = Callable[[Graph], AbstractContextManager[Call]]


def grpc_caller(port: int, as_bytes: bool = False) -> Caller:
    """Callers of a server by the Open Inference Protocol over gRPC."""

    def caller(graph: Graph) -> AbstractContextManager[Call]:
        return inference_caller(f"127.0.0.1:{port}", graph.name, graph.pair, (OUTPUT,), as_bytes)

    return caller


def http_caller(port: int, path: str = "/{}") -> Caller:
    """Callers of a server over HTTP, with frames as they are; the path has the model's name."""

    def caller(graph: Graph) -> AbstractContextManager[Call]:
        return bytes_caller(port, path.format(graph.name), graph)

    return caller


GRPC: dict[str, Caller] = {
    MLSERVER: grpc_caller(MLSERVER_PORT, as_bytes=True),
    KSERVE: grpc_caller(KSERVE_PORT),
    RAY: grpc_caller(RAY_DIRECT_PORT),
}
HTTP: dict[str, Caller] = {
    MLSERVER: http_caller(MLSERVER_HTTP_PORT),
    KSERVE: http_caller(KSERVE_HTTP_PORT, "/v1/models/{}:predict"),
    RAY: http_caller(RAY_DIRECT_HTTP_PORT),
}
MLSERVER_NUMBERS = grpc_caller(MLSERVER_PORT)
"""Frames as tensors of UINT8, as the other servers take them."""
RAY_PROXY_GRPC, RAY_PROXY_HTTP = grpc_caller(RAY_PORT), http_caller(RAY_HTTP_PORT)


def mlserver(python: Path, models: Path, folder: Path) -> OtherServer:
    """MLServer: no workers, since each of them is sent a copy; no logs of calls, no metrics."""
    command = [str(python.with_name("mlserver")), "start", str(models)]
    return OtherServer(MLSERVER, command, folder, GRPC[MLSERVER])


def kserve(python: Path, models: Path, folder: Path, threads: int) -> OtherServer:
    """KServe: no logs of calls."""
    options = {
        "http_port": KSERVE_HTTP_PORT,
        "grpc_port": KSERVE_PORT,
        "grpc_max_receive_message_length": _MESSAGE_BYTES,
        "grpc_max_send_message_length": _MESSAGE_BYTES,
        "enable_latency_logging": "false",
        "configure_logging": "false",
    }
    given = [text for name, value in options.items() for text in (f"--{name}", str(value))]
    command = [str(python), "-m", "analysis.service.other_servers.on_kserve", str(models), str(threads), *given]
    return OtherServer(KSERVE, command, folder, GRPC[KSERVE])


@contextmanager
def ray_serve(python: Path, models: Path, folder: Path, threads: int, direct: bool = True) -> Iterator[OtherServer]:
    """Ray Serve.

    Args:
        python: Python of its environment.
        models: folder of the graphs.
        folder: folder that it works in.
        threads: threads of one run.
        direct: whether the replica itself listens for callers, in place of a proxy before it.
    """
    temporary = tempfile.mkdtemp(prefix="lightpage-ray-")  # its sockets' paths must be short
    settings = {
        "HOME": temporary,  # where it would leave a token
        "RAY_SERVE_LOG_TO_STDERR": "0",
        "RAY_SERVE_REQUEST_PATH_LOG_BUFFER_SIZE": "1000",
        "RAY_SERVE_CONTROL_LOOP_INTERVAL_S": "1",  # ten times as often by default, which takes cores from the others
    }
    if direct:
        settings |= {
            "RAY_SERVE_ENABLE_DIRECT_INGRESS": "1",
            "RAY_SERVE_DIRECT_INGRESS_MIN_GRPC_PORT": str(RAY_DIRECT_PORT),
            "RAY_SERVE_DIRECT_INGRESS_MAX_GRPC_PORT": str(RAY_DIRECT_PORT + 1),
            "RAY_SERVE_DIRECT_INGRESS_MIN_HTTP_PORT": str(RAY_DIRECT_HTTP_PORT),
            "RAY_SERVE_DIRECT_INGRESS_MAX_HTTP_PORT": str(RAY_DIRECT_HTTP_PORT + 1),
            "RAY_SERVE_DIRECT_INGRESS_MIN_DRAINING_PERIOD_S": "0",
        }
    module = "analysis.service.other_servers.on_ray"
    own = [str(models), str(threads), str(RAY_PORT), str(RAY_HTTP_PORT), temporary]
    caller = GRPC[RAY] if direct else RAY_PROXY_GRPC
    try:
        with OtherServer(RAY, [str(python), "-m", module, *own], folder, caller, settings) as server:
            yield server
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
