"""What is cheap to check of the comparison with other servers: arithmetic, messages, callers, pinned packages."""

from __future__ import annotations

import json
import re
import socket
import struct
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from analysis.service.other_servers.calls import Answer, Call, arrays_of, bytes_caller, infer_request
from analysis.service.other_servers.environments import NAMES, requirements
from analysis.service.other_servers.figures import Comparison, Figure
from analysis.service.other_servers.graphs import Graph, committed
from analysis.service.other_servers.measuring import Way, compared
from analysis.service.other_servers.rivals import MLSERVER_HTTP_PORT, MLSERVER_PORT
from analysis.service.other_servers.servers import Marked
from analysis.service.other_servers.timing import CALLERS, WARM, in_turns, rate, timed
from lightpage.errors import LightpageError
from lightpage.recording.frame_pair import FramePair
from runtime.pb.inference import open_inference_pb2 as oip

ROOT = Path(__file__).resolve().parents[3]
P = np.arange(12, dtype=np.float32).reshape(2, 2, 3)


def test_the_spread_of_a_figure_is_from_its_10th_to_its_90th_percentile() -> None:
    figure = Figure.of([float(value) for value in range(101)])
    assert (figure.p10, figure.p50, figure.p90) == pytest.approx((10, 50, 90))
    assert figure.spread == pytest.approx(80)


def test_a_server_is_better_only_by_more_than_the_larger_spread() -> None:
    own = Figure(9, 10, 11)
    assert Comparison.of(own, Figure(14, 15, 16)) == Comparison(difference=5, spread=2)
    assert Comparison.of(own, Figure(14, 15, 16)).missed_by == -3
    assert Comparison.of(own, Figure(10, 15, 20)).missed_by == 5
    assert Comparison.of(own, Figure(4, 5, 6)).missed_by == 7
    assert Comparison.of(own, Figure(4, 5, 6), more_is_better=True).missed_by == -3


def test_calls_of_the_warm_up_do_not_count() -> None:
    numbers = {"a": iter(range(100)), "b": iter(range(100, 200))}
    calls = {name: partial(next, each) for name, each in numbers.items()}
    told = in_turns(calls, 3, "calls", np.random.default_rng(0))
    assert told == {"a": [WARM, WARM + 1, WARM + 2], "b": [100 + WARM, 101 + WARM, 102 + WARM]}


def test_every_round_calls_each_once_and_in_an_order_of_its_own() -> None:
    names, order = "abcdef", []
    in_turns({name: partial(order.append, name) for name in names}, 20, "calls", np.random.default_rng(0), warm=0)
    rounds = ["".join(order[start : start + 6]) for start in range(0, 120, 6)]
    assert [sorted(each) for each in rounds] == [list(names)] * 20
    assert len(set(rounds)) > 10


def test_all_callers_connect_and_call_before_the_clock_runs() -> None:
    happened: list[str] = []

    @contextmanager
    def connect() -> Iterator[Call]:
        def call() -> Answer:
            happened.append("call")
            return {}

        happened.append("connect")
        yield call

    assert rate(connect, 3) > 0
    assert happened.count("connect") == CALLERS
    assert happened.count("call") == CALLERS * (3 + 1)


def test_a_caller_that_fails_ends_all_and_is_told() -> None:
    numbers = iter(range(CALLERS))

    @contextmanager
    def connect() -> Iterator[Call]:
        if next(numbers) == CALLERS - 1:
            raise ConnectionError("nobody there")
        yield dict

    with pytest.raises(ConnectionError, match="nobody there"):
        rate(connect, 3)


@pytest.mark.parametrize("as_bytes", [False, True])
def test_a_request_has_both_frames_as_they_are(as_bytes: bool) -> None:
    pair = FramePair(*np.arange(12, dtype=np.uint8).reshape(2, 2, 3))
    request = infer_request("decoder", pair, ("p",), as_bytes)
    assert [tensor.name for tensor in request.inputs] == ["in_phase", "quadrature"]
    assert [tensor.name for tensor in request.outputs] == ["p"]
    for tensor, content, frame in zip(
        request.inputs, request.raw_input_contents, (pair.in_phase, pair.quadrature), strict=True
    ):
        if as_bytes:
            assert (tensor.datatype, list(tensor.shape)) == ("BYTES", [1])
            assert content == struct.pack("<I", 6) + frame.tobytes()
        else:
            assert (tensor.datatype, list(tensor.shape)) == ("UINT8", [2, 3])
            assert content == frame.tobytes()


def test_an_answer_is_read_as_tensors_and_as_bytes() -> None:
    response = oip.ModelInferResponse()
    response.outputs.add(name="p", datatype="FP32", shape=P.shape)
    response.outputs.add(name="same", datatype="BYTES", shape=[1])
    response.raw_output_contents.extend([P.tobytes(), struct.pack("<I", P.nbytes) + P.tobytes()])
    found = arrays_of(response)
    np.testing.assert_array_equal(found["p"], P)
    np.testing.assert_array_equal(found["same"], P.ravel())


def test_what_the_service_tells_of_its_own_work_leaves_the_run_out() -> None:
    response = oip.ModelInferResponse()
    for name, value in (("timings.decode_s", 0.5), ("timings.inference_s", 0.375)):
        response.parameters[name].double_param = value
    assert timed(lambda: arrays_of(response)).work_s == 0.125
    assert timed(dict).work_s == 0


def test_every_way_is_compared_and_the_best_one_of_a_server_is_marked() -> None:
    def connect() -> AbstractContextManager[Call]:
        raise AssertionError

    ways = {name: Way(name.partition(",")[0], Marked(), connect) for name in ("Lightpage, a", "Other, a", "Other, b")}
    figures = {name: Figure(value, value, value) for name, value in zip(ways, (4.0, 5.0, 7.0), strict=True)}
    found = compared(figures, ways)
    assert [(name, one["Lightpage, a"]["best"]) for name, one in found.items()] == [
        ("Other, a", True),
        ("Other, b", False),
    ]
    found = compared(figures, ways, more_is_better=True)
    assert found["Other, b"]["Lightpage, a"] == {"difference": -3, "spread": 0, "missed_by": 3, "best": True}


def test_a_connection_that_the_server_has_ended_is_opened_anew() -> None:
    graph = Graph("g", FramePair(*np.zeros((2, 2, 3), np.uint8)), Path("none"), (2, 3))
    answer = b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n" % P.nbytes + P.tobytes()
    with socket.create_server(("127.0.0.1", 0)) as listening, ThreadPoolExecutor(1) as pool:
        listening.settimeout(10)

        def serve_once() -> bytes:
            with listening.accept()[0] as connection, connection.makefile("rb") as asked:
                connection.settimeout(10)
                size = next(int(line.split()[1]) for line in asked if line.lower().startswith(b"content-length"))
                while asked.readline().strip():
                    pass
                body = asked.read(size)
                connection.sendall(answer)
            return body

        with bytes_caller(listening.getsockname()[1], "/g", graph) as call:
            for _ in range(2):
                served = pool.submit(serve_once)
                np.testing.assert_array_equal(call()["p"], P)
                assert served.result(10) == bytes(12)


@pytest.mark.parametrize(
    ("datatype", "contents"),
    [
        ("FP32", []),
        ("FP32", [P.tobytes()[:-4]]),
        ("BYTES", [struct.pack("<I", P.nbytes + 1) + P.tobytes()]),
        ("BYTES", [b""]),
    ],
)
def test_an_answer_that_contradicts_itself_is_refused(datatype: str, contents: list[bytes]) -> None:
    response = oip.ModelInferResponse()
    response.outputs.add(name="p", datatype=datatype, shape=P.shape)
    response.raw_output_contents.extend(contents)
    with pytest.raises(LightpageError):
        arrays_of(response)


def test_all_environments_are_pinned_and_have_the_onnx_runtime_of_the_service() -> None:
    own = dict(re.findall(r"^([\w.-]+)==(\S+)$", (ROOT / "constraints.txt").read_text("utf-8"), re.M))
    for name in NAMES:
        lines = requirements(name).split()
        pinned = dict(re.fullmatch(r"([\w.-]+)==([\w.]+)", line).groups() for line in lines)  # type: ignore[union-attr]
        assert name in pinned
        assert {key: pinned[key] for key in ("onnxruntime", "grpcio", "numpy")} == {
            key: own[key] for key in ("onnxruntime", "grpcio", "numpy")
        }


def test_mlserver_listens_where_it_is_called() -> None:
    settings = json.loads(committed("mlserver-settings.json"))
    assert (settings["host"], settings["grpc_port"], settings["http_port"]) == (
        "127.0.0.1",
        MLSERVER_PORT,
        MLSERVER_HTTP_PORT,
    )
