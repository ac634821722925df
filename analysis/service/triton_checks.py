"""Checks by an unmodified tritonclient, a health check and a reflection client; they run in their own environment.

    PYTHON analysis/service/triton_checks.py TARGET HEALTH FOLDER

`inference_protocol.py` makes the environment and the folder: `expected.npz` with a pair and what the service's own
client gets for it, `expected.json` with the figures, `example.py` with the example of the documentation. Each line of
the output is a check as JSON. Nothing of Lightpage is imported.

The checks do by the service's model what that project's own examples do by theirs: health and metadata, inference,
asynchronous inference, keep-alive, channel arguments, the asyncio client, explicit contents, objects used again. Its
examples with sequences, streams, strings, shared memory and model control ask for extensions; those have to be refused
clearly.
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
import queue
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import tritonclient.grpc as triton
import tritonclient.grpc.aio as triton_aio
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import ProtoReflectionDescriptorDatabase
from tritonclient.grpc import service_pb2, service_pb2_grpc
from tritonclient.utils import InferenceServerException

MODEL = "lightpage"
SERVICE = "inference.GRPCInferenceService"
ARRAYS = ("symbols", "confidence", "phase", "concentration")
CALL_S = 120.0
AT_ONCE = 6

_TYPES = {"uint8": "UINT8", "uint16": "UINT16", "bool": "BOOL"}


class Service:
    """The service, a pair for it, and what has to come back.

    Args:
        target: HOST:PORT of the service.
        health: HOST:PORT of its health checks.
        folder: folder of what is expected.
    """

    def __init__(self, target: str, health: str, folder: Path) -> None:
        self.target, self.health, self.folder = target, health, folder
        self.arrays = dict(np.load(folder / "expected.npz"))
        self.told: dict[str, Any] = json.loads((folder / "expected.json").read_text("utf-8"))
        self.client = triton.InferenceServerClient(target)

    def tensor(self, name: str, array: Any = None) -> Any:
        """An input with an array, by default that of its name."""
        array = self.arrays[name] if array is None else array
        return triton.InferInput(name, list(array.shape), _TYPES[str(array.dtype)]).set_data_from_numpy(array)

    def pair(self) -> list[Any]:
        """Return both frames as input tensors."""
        return [self.tensor("in_phase"), self.tensor("quadrature")]

    def infer(self, inputs: list[Any] | None = None, **options: Any) -> Any:
        """Decode the pair statelessly, unless other parameters are given."""
        options = {"parameters": {"stateless": True}, "client_timeout": CALL_S, **options}
        return self.client.infer(options.pop("model_name", MODEL), inputs or self.pair(), **options)

    def check_answer(self, result: Any, names: tuple[str, ...] = ARRAYS) -> None:
        """Compare an answer with that of the service's own client, bit by bit."""
        response = result.get_response()
        assert tuple(output.name for output in response.outputs) == names, response.outputs
        for name in names:
            found, expected = result.as_numpy(name), self.arrays[name]
            assert found.dtype == expected.dtype, name
            assert np.array_equal(found, expected), name
        assert (response.model_name, response.model_version) == (MODEL, self.told["model_version"])
        for name, expected in self.told["figures"].items():
            parameter = response.parameters[name]
            assert getattr(parameter, parameter.WhichOneof("parameter_choice")) == expected, name

    def explicit(self) -> Any:
        """The pair in typed contents, which this client makes by its stubs only."""
        request = service_pb2.ModelInferRequest(model_name=MODEL)
        request.parameters["stateless"].bool_param = True
        for name in ("in_phase", "quadrature"):
            frame = self.arrays[name]
            tensor = request.inputs.add(name=name, datatype=_TYPES[str(frame.dtype)], shape=frame.shape)
            tensor.contents.uint_contents.extend(frame.ravel().tolist())
        return request


def refused(call: Callable[[], Any], status: str, *words: str) -> None:
    """Check that a call is refused with a status, and that its sentence has some words."""
    try:
        call()
    except InferenceServerException as error:
        code, text = str(error.status()), str(error.message())
    except grpc.RpcError as error:
        code, text = str(error.code()), str(error.details())
    else:
        raise AssertionError(f"answered, wanted {status}")
    assert code == f"StatusCode.{status}", f"{code}: {text}"
    missing = [word for word in words if word not in text]
    assert not missing, f"no {missing[0]!r} in {text!r}"


def live_and_ready(service: Service) -> None:
    """Health as the protocol has it."""
    client = service.client
    assert client.is_server_live(headers={"test": "1"})
    assert client.is_server_ready()
    assert client.is_model_ready(MODEL)
    assert client.is_model_ready(MODEL, service.told["model_version"])
    assert not client.is_model_ready(MODEL, "no-such-version")
    assert not client.is_model_ready("no-such-model")


def metadata(service: Service) -> None:
    """Check the metadata of the server and of the model."""
    client, (rows, columns) = service.client, service.arrays["in_phase"].shape
    server = client.get_server_metadata()
    assert server.name == "lightpage"
    assert not server.extensions
    model = client.get_model_metadata(MODEL, headers={"test": "1"})
    assert service.told["model_version"] in model.versions
    kind = _TYPES[str(service.arrays["in_phase"].dtype)]
    shapes = [(one.name, one.datatype, tuple(one.shape)) for one in model.inputs]
    assert shapes == [("in_phase", kind, (rows, columns)), ("quadrature", kind, (rows, columns))], shapes
    outputs = {one.name: tuple(one.shape) for one in model.outputs}
    assert all(outputs[name] == service.arrays[name].shape for name in ARRAYS), outputs
    assert client.get_model_metadata(MODEL, as_json=True)["name"] == MODEL
    refused(lambda: client.get_model_metadata("wrong"), "NOT_FOUND", "model name", "'wrong'", MODEL)


def infer_raw(service: Service) -> None:
    """Arrays as this client sends them."""
    service.check_answer(service.infer())


def infer_typed(service: Service) -> None:
    """Elements one by one."""
    with grpc.insecure_channel(service.target) as channel:
        infer = service_pb2_grpc.GRPCInferenceServiceStub(channel).ModelInfer
        request = service.explicit()
        service.check_answer(triton.InferResult(infer(request, timeout=CALL_S)))
        request.raw_input_contents.extend([b"x", b"y"])
        refused(
            lambda: infer(request, timeout=CALL_S), "INVALID_ARGUMENT", "inputs.in_phase.contents", "one of the two"
        )


def infer_outputs(service: Service) -> None:
    """Outputs by name, in another order; a text of the caller's own."""
    names = ("phase", "symbols")
    result = service.infer(outputs=[triton.InferRequestedOutput(name) for name in names], request_id="order-7")
    service.check_answer(result, names)
    assert result.get_response().id == "order-7"


def infer_user_data(service: Service) -> None:
    """The page's bytes, or why there are none."""
    wanted = [triton.InferRequestedOutput("user_data")]
    if service.told["user_data_loss"] is None:
        refused(lambda: service.infer(outputs=wanted), "FAILED_PRECONDITION")
        return
    result = service.infer(outputs=wanted)
    loss = result.get_response().parameters["user_data.loss"].string_param
    assert loss == service.told["user_data_loss"], loss
    assert result.as_numpy("user_data").tobytes().hex() == service.told["user_data"]


def infer_compressed(service: Service) -> None:
    """gRPC's own compression."""
    for algorithm in ("gzip", "deflate"):
        service.check_answer(service.infer(compression_algorithm=algorithm))


def infer_again(service: Service) -> None:
    """Infer twice with the same objects."""
    inputs = service.pair()
    for _ in range(2):
        service.check_answer(service.infer(inputs))


def infer_asynchronously(service: Service) -> None:
    """Infer by callback, several at once on one connection."""
    done: queue.SimpleQueue[tuple[Any, Any]] = queue.SimpleQueue()
    for _ in range(AT_ONCE):
        service.client.async_infer(
            MODEL,
            service.pair(),
            lambda result, error: done.put((result, error)),
            parameters={"stateless": True},
            client_timeout=CALL_S,
        )
    for _ in range(AT_ONCE):
        result, error = done.get(timeout=CALL_S)
        assert error is None, error
        service.check_answer(result)


def infer_on_many_connections(service: Service) -> None:
    """A connection each, with arguments of its own, and a keep-alive."""

    def one(_: int) -> None:
        options = [("grpc.use_local_subchannel_pool", 1), ("grpc.max_send_message_length", (1 << 31) - 1)]
        keepalive = triton.KeepAliveOptions(keepalive_time_ms=2**31 - 1, keepalive_timeout_ms=20_000)
        for more in ({"channel_args": options}, {"keepalive_options": keepalive}):
            with triton.InferenceServerClient(service.target, **more) as client:
                parameters = {"stateless": True}
                service.check_answer(client.infer(MODEL, service.pair(), parameters=parameters, client_timeout=CALL_S))

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(one, range(2)))


def infer_by_asyncio(service: Service) -> None:
    """The asynchronous client, all calls of the protocol."""

    async def all_calls() -> None:
        async with triton_aio.InferenceServerClient(service.target) as client:
            assert await client.is_server_live()
            assert await client.is_server_ready()
            assert await client.is_model_ready(MODEL)
            assert (await client.get_server_metadata(as_json=True))["name"] == "lightpage"
            assert (await client.get_model_metadata(MODEL)).name == MODEL
            parameters = {"stateless": True}
            result = await client.infer(MODEL, service.pair(), parameters=parameters, client_timeout=CALL_S)
            service.check_answer(result)

    asyncio.run(all_calls())


def wrong_requests(service: Service) -> None:
    """Wrong names, versions, shapes, types, parameters and outputs."""
    in_phase, quadrature = (service.arrays[name] for name in ("in_phase", "quadrature"))
    other = np.zeros(in_phase.shape, np.uint16 if in_phase.dtype == np.uint8 else np.uint8)
    pair, tensor = service.pair(), service.tensor
    output = triton.InferRequestedOutput
    bad = "INVALID_ARGUMENT"
    refused(lambda: service.infer(model_name="wrong"), "NOT_FOUND", "model name", "'wrong'")
    refused(lambda: service.infer(model_version="wrong"), "NOT_FOUND", "model version", "'wrong'")
    refused(lambda: service.infer(pair[:1]), bad, "inputs.quadrature", "nothing")
    refused(lambda: service.infer([tensor("image", in_phase), pair[1]]), bad, "inputs", "'image'", "in_phase")
    refused(lambda: service.infer([pair[0], *pair]), bad, "inputs.in_phase", "twice")
    refused(lambda: service.infer([tensor("in_phase", in_phase[1:]), pair[1]]), bad, "inputs.in_phase", "UINT")
    refused(lambda: service.infer([pair[0], tensor("quadrature", quadrature[None])]), bad, "inputs.quadrature", "[1, ")
    refused(lambda: service.infer([tensor("in_phase", other), pair[1]]), bad, "inputs.in_phase", "wanted")
    refused(lambda: service.infer(outputs=[output("logits")]), bad, "outputs", "'logits'", "symbols")
    refused(lambda: service.infer(outputs=[output("symbols", class_count=3)]), bad, "classification")
    refused(lambda: service.infer(parameters={"level": 16}), bad, "parameters", "'level'", "levels")
    refused(lambda: service.infer(parameters={"levels": "16"}), bad, "parameters.levels", "int64_param")
    refused(lambda: service.infer(parameters={"levels": 1000}), bad, "levels", "1000")
    refused(lambda: service.infer(priority=1), bad, "parameters", "'priority'")
    refused(lambda: service.infer(sequence_id=7), bad, "parameters", "sequence")
    black = np.zeros_like(in_phase)
    refused(lambda: service.infer([tensor("in_phase", black), pair[1]]), bad, "in-phase frame")


def lost_page(service: Service) -> None:
    """Pilots that contradict the page: no symbols are given out."""
    mask = service.arrays["pilot_mask"] != 0
    symbols = np.random.default_rng(8).integers(16, size=mask.shape).astype(np.uint8)
    inputs = [*service.pair(), service.tensor("pilot_mask", mask), service.tensor("pilot_symbols", symbols)]
    parameters = {"stateless": True, "levels": 16, "pilot_levels": 16}
    refused(lambda: service.infer(inputs, parameters=parameters), "DATA_LOSS", "pilots")


def extensions(service: Service) -> None:
    """Calls and inputs beyond the protocol."""
    client = service.client
    for call in (
        lambda: client.get_model_config(MODEL),
        client.get_model_repository_index,
        lambda: client.get_inference_statistics(MODEL),
        client.get_system_shared_memory_status,
        lambda: client.load_model(MODEL),
        lambda: client.get_trace_settings(),
    ):
        refused(call, "UNIMPLEMENTED", SERVICE, "ModelInfer")
    shared = service.pair()
    shared[0].set_shared_memory("region", service.arrays["in_phase"].nbytes)
    refused(lambda: service.infer(shared), "INVALID_ARGUMENT", "inputs.in_phase.parameters", "shared_memory_region")


def health_protocol(service: Service) -> None:
    """Ask for health as grpc_health_probe and Kubernetes do, at both ports."""
    for target in (service.target, service.health):
        with grpc.insecure_channel(target) as channel:
            check = health_pb2_grpc.HealthStub(channel).Check
            for name in ("", SERVICE):
                answer = check(health_pb2.HealthCheckRequest(service=name), timeout=CALL_S)
                assert answer.status == health_pb2.HealthCheckResponse.SERVING, (target, name)
            unknown = health_pb2.HealthCheckRequest(service="no.such.Service")
            refused(lambda check=check, unknown=unknown: check(unknown, timeout=CALL_S), "NOT_FOUND")  # type: ignore[misc]


def reflection(service: Service) -> None:
    """A stranger who has no file of the protocol: descriptors, then metadata, then an inference by what they say."""
    with grpc.insecure_channel(service.target) as channel:
        database = ProtoReflectionDescriptorDatabase(channel)
        assert SERVICE in database.get_services()
        methods = DescriptorPool(database).FindServiceByName(SERVICE).methods_by_name

        def call(method: str, **fields: Any) -> Any:
            kinds = methods[method].input_type, methods[method].output_type
            asked, told = (GetMessageClass(kind) for kind in kinds)
            path = f"/{SERVICE}/{method}"
            return channel.unary_unary(path, asked.SerializeToString, told.FromString)(asked(**fields), timeout=CALL_S)

        assert call("ServerLive").live
        model = call("ModelMetadata", name=MODEL)
        tensors = [{"name": one.name, "datatype": one.datatype, "shape": list(one.shape)} for one in model.inputs]
        contents = [service.arrays[one.name].tobytes() for one in model.inputs]
        stateless = {"stateless": {"bool_param": True}}
        response = call(
            "ModelInfer", model_name=model.name, inputs=tensors, raw_input_contents=contents, parameters=stateless
        )
        found = {one.name: raw for one, raw in zip(response.outputs, response.raw_output_contents, strict=True)}
        assert found == {name: service.arrays[name].tobytes() for name in ARRAYS}
        assert dict(model.properties)["bit_depth"] == str(service.told["bit_depth"])


def example_of_the_docs(service: Service) -> None:
    """Run the example of the documentation as a reader would paste it."""
    text = (service.folder / "example.py").read_text("utf-8")
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(text, "example.py", "exec", dont_inherit=True), {})
    assert printed.getvalue().startswith(("StatusCode.DATA_LOSS", "StatusCode.INVALID_ARGUMENT")), printed.getvalue()


CHECKS = (
    live_and_ready,
    metadata,
    infer_raw,
    infer_typed,
    infer_outputs,
    infer_user_data,
    infer_compressed,
    infer_again,
    infer_asynchronously,
    infer_on_many_connections,
    infer_by_asyncio,
    wrong_requests,
    lost_page,
    extensions,
    health_protocol,
    reflection,
    example_of_the_docs,
)


def main(target: str, health: str, folder: str) -> None:
    """Print each check as a line of JSON."""
    service = Service(target, health, Path(folder))
    for check in CHECKS:
        begun, trouble = time.monotonic(), ""
        try:
            check(service)
        except Exception as error:
            trouble = f"{type(error).__name__}: {error}"[:500]
        line = {"check": check.__name__, "trouble": trouble, "seconds": round(time.monotonic() - begun, 3)}
        print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
