"""What computes pages: names, options, refusals, tensors that stay where it computes; the share of cores and memory."""

import ctypes
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import onnxruntime
import pytest

from lightpage.errors import InvalidInputError, ProviderError, SurroundingsError
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.execution.cpus import available_cpus
from lightpage.runtime.model.execution.memory import share_freed_memory
from lightpage.runtime.model.execution.providers import ON_CPU, Provider
from lightpage.runtime.model.execution.session import BoundSession, Session, open_session
from tests.runtime import toy


@pytest.mark.parametrize(
    ("text", "expected"), [("cpu", ON_CPU), ("cuda", Provider("cuda")), ("cuda:1", Provider("cuda", 1))]
)
def test_a_text_names_a_provider_and_its_device(text: str, expected: Provider) -> None:
    assert Provider.parse(text) == expected
    assert Provider.parse(str(expected)) == expected


@pytest.mark.parametrize("text", ["gpu", "cpu:1", "cuda:", "CUDA", "cuda:1000"])
def test_a_text_that_names_none_is_refused(text: str) -> None:
    with pytest.raises(InvalidInputError, match=r"^provider: got"):
        Provider.parse(text)


def test_tensorrt_leaves_what_it_lacks_to_cuda_and_keeps_its_engines(tmp_path: Path) -> None:
    chain = Provider.parse("tensorrt:1", tmp_path).chain("0a1b")
    names = ["TensorrtExecutionProvider", "CUDAExecutionProvider", "CPUExecutionProvider"]
    assert [name for name, _ in chain] == names
    assert [options.get("device_id") for _, options in chain] == [1, 1, None]
    assert chain[0][1]["trt_engine_cache_path"] == str(tmp_path)
    assert chain[0][1]["trt_engine_cache_prefix"] == "lightpage-0a1b"  # else another model's engine would be taken
    assert "trt_engine_cache_enable" not in Provider.parse("tensorrt").chain("0a1b")[0][1]
    assert Provider.parse("cuda").chain("0a1b")[0][1]["use_tf32"] == 0  # single precision is not rounded
    with pytest.raises(InvalidInputError, match=r"^engine cache"):
        Provider.parse("cuda", tmp_path)


def test_a_provider_that_this_onnxruntime_was_not_built_with_is_refused(toy_zip: Path) -> None:
    with pytest.raises(ProviderError, match=r"^provider cuda"):
        Decoder.load(toy_zip, provider=Provider("cuda"))


def test_a_gpu_that_cannot_be_used_is_not_replaced_in_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    usable = [*onnxruntime.get_available_providers(), "CUDAExecutionProvider"]
    monkeypatch.setattr("onnxruntime.get_available_providers", lambda: usable)
    with pytest.raises(ProviderError, match=r"^provider cuda:3"):
        open_session(toy.decoder_onnx(), "toy", 1, provider=Provider("cuda", 3))


def test_constants_stay_bound_and_a_feed_stands_in_for_one() -> None:
    session = open_session(toy.decoder_onnx(), "toy", 1)
    rng = np.random.default_rng(3)
    feeds = {name: rng.integers(20, 200, toy.SHAPE, dtype=np.uint8) for name in ("in_phase", "quadrature")}
    expected = session.run(["p", "phase"], feeds)
    others = {"in_phase": feeds["in_phase"][::-1], "quadrature": feeds["quadrature"]}
    bound = BoundSession(session, ON_CPU, {"quadrature": feeds["quadrature"], "in_phase": others["in_phase"]}, "toy")
    for _ in range(2):
        got = bound.run(["p", "phase"], {"in_phase": feeds["in_phase"]})
        for one, other in zip(got, expected, strict=True):
            np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(bound.run(["p"], {})[0], session.run(["p"], others)[0])


def test_what_a_gpu_says_is_told_and_a_graph_s_own_failure_is_not_the_gpus() -> None:
    session = open_session(toy.decoder_onnx(), "toy", 1)
    in_vain = {"in_phase": np.zeros((3, 3), np.uint8)}
    with pytest.raises(ProviderError, match=r"^provider cuda:1"):
        BoundSession(session, Provider("cuda", 1), in_vain, "toy").run(["p"], {})
    with pytest.raises(RuntimeError):
        BoundSession(session, ON_CPU, in_vain, "toy").run(["p"], {})


def test_models_behind_the_first_are_computed_where_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Provider] = []
    own = open_session

    def noted(model: bytes, subject: str, threads: int | None, **options: Any) -> Session:
        asked.append(options.pop("provider", ON_CPU))
        return own(model, subject, threads, **options)

    monkeypatch.setattr("lightpage.runtime.model.execution.table_graph.open_session", noted)
    on_second = Provider("cpu", 1)  # no GPU is here: the number alone tells it from the default
    decoder = Decoder.load(toy.write_toy_bundle(tmp_path / "b.zip"), 1, on_second)
    other = toy.write_toy_bundle(tmp_path / "c.zip", version="toy-2")
    gain = {"homodyne": np.array([2.0, 1.0], np.float32)}
    bundle = Bundle.open(other)
    for one in (decoder, decoder.of_another(bundle), decoder.with_table(gain), decoder.of_bundle(bundle)):
        assert one.graph.provider == on_second
        assert one.threads == 1
    assert asked.count(on_second) == 2


def test_a_resource_that_is_short_is_no_fault_of_the_bundle(monkeypatch: pytest.MonkeyPatch) -> None:
    short = Mock(side_effect=RuntimeError("[ONNXRuntimeError] : 6 : RUNTIME_EXCEPTION : std::bad_alloc"))
    bound = BoundSession(open_session(toy.decoder_onnx(), "toy", 1), ON_CPU, {}, "toy")
    monkeypatch.setattr("onnxruntime.InferenceSession.run_with_iobinding", short)
    with pytest.raises(SurroundingsError, match=r"^toy: .*memory"):
        bound.run(["p"], {name: np.zeros(toy.SHAPE, np.uint8) for name in ("in_phase", "quadrature")})
    monkeypatch.setattr("onnxruntime.InferenceSession", short)
    with pytest.raises(SurroundingsError, match=r"^toy: .*memory"):
        open_session(toy.decoder_onnx(), "toy", 1)


@pytest.mark.parametrize(
    ("files", "membership", "cores"),
    [
        ({"cpu.max": "150000 100000\n"}, "0::/\n", 2),
        ({"cpu.max": "max 100000\n"}, "0::/\n", 64),
        ({"a/cpu.max": "400000 100000", "a/b/cpu.max": "800000 100000"}, "0::/a/b\n", 4),
        (
            {"cpu,cpuacct/j/cpu.cfs_quota_us": "50000", "cpu,cpuacct/j/cpu.cfs_period_us": "100000"},
            "4:cpu,cpuacct:/j",
            1,
        ),
        ({"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, "1:cpu:/\n", 64),
        ({}, "", 64),
    ],
)
def test_quota_of_the_control_group_holds(
    files: dict[str, str], membership: str, cores: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(64)))
    (root := tmp_path / "cgroup").mkdir()
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    (tmp_path / "self").write_text(membership)
    assert available_cpus(root, tmp_path / "self") == cores


def test_threads_take_memory_from_two_places_where_the_c_library_can_be_told(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[tuple[int, int]] = []
    libc = SimpleNamespace(mallopt=lambda *option: not told.append(option))
    monkeypatch.setattr(ctypes, "CDLL", lambda name: libc)
    assert share_freed_memory()
    assert told == [(-8, 2)]  # M_ARENA_MAX of glibc
    monkeypatch.setattr(ctypes, "CDLL", lambda name: object())
    assert not share_freed_memory()
