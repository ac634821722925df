"""What computes pages: names, options, refusals, and tensors that stay where it computes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime
import pytest

from lightpage.cli.main import lightpage, run
from lightpage.errors import InvalidInputError
from runtime.decoding.decoder import Decoder
from runtime.errors import ProviderError
from runtime.execution.providers import ON_CPU, Provider
from runtime.execution.session import BoundSession, open_session
from tests.runtime import toy


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("cpu", ON_CPU),
        ("cuda", Provider("cuda")),
        ("cuda:1", Provider("cuda", 1)),
        ("tensorrt:0", Provider("tensorrt")),
    ],
)
def test_a_text_names_a_provider_and_its_device(text: str, expected: Provider) -> None:
    assert Provider.parse(text) == expected
    assert Provider.parse(str(expected)) == expected


@pytest.mark.parametrize("text", ["", "gpu", "cpu:1", "cuda:", "cuda:-1", "CUDA", "cuda:1 ", "cuda:1000"])
def test_a_text_that_names_none_is_refused(text: str) -> None:
    with pytest.raises(InvalidInputError, match=r"provider: got '.*', wanted cpu, cuda or tensorrt, with :N"):
        Provider.parse(text)


def test_tensorrt_leaves_what_it_lacks_to_cuda_and_keeps_its_engines(tmp_path: Path) -> None:
    chain = Provider.parse("tensorrt:1", tmp_path).chain()
    names = ["TensorrtExecutionProvider", "CUDAExecutionProvider", "CPUExecutionProvider"]
    assert [name for name, _ in chain] == names
    assert [options.get("device_id") for _, options in chain] == [1, 1, None]
    assert chain[0][1]["trt_engine_cache_path"] == str(tmp_path)
    assert "trt_engine_cache_enable" not in Provider.parse("tensorrt").chain()[0][1]


def test_a_gpu_does_not_round_single_precision() -> None:
    assert Provider.parse("cuda").chain()[0][1]["use_tf32"] == 0


@pytest.mark.parametrize("name", ["cuda", "tensorrt"])
def test_a_provider_that_this_onnxruntime_was_not_built_with_is_refused(tmp_path: Path, name: str) -> None:
    path = toy.write_toy_bundle(tmp_path / "b.zip")
    with pytest.raises(
        ProviderError, match=rf"provider {name}: got an onnxruntime with .*CPU.*, wanted onnxruntime-gpu"
    ):
        Decoder.load(path, provider=Provider(name))


def test_a_gpu_that_cannot_be_used_is_not_replaced_in_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    usable = [*onnxruntime.get_available_providers(), "CUDAExecutionProvider"]
    monkeypatch.setattr("onnxruntime.get_available_providers", lambda: usable)
    with pytest.raises(ProviderError, match=r"provider cuda:3: got CPUExecutionProvider in its place, wanted a GPU"):
        open_session(toy.decoder_onnx(), "toy", 1, provider=Provider("cuda", 3))


def test_constants_stay_bound_and_a_feed_stands_in_for_one() -> None:
    session = open_session(toy.decoder_onnx(), "toy", 1)
    rng = np.random.default_rng(3)
    feeds = {name: rng.integers(20, 200, toy.SHAPE, dtype=np.uint8) for name in ("in_phase", "quadrature")}
    expected = session.run(["p", "phase"], feeds)
    others = {"in_phase": feeds["in_phase"][::-1], "quadrature": feeds["quadrature"]}
    bound = BoundSession(session, ON_CPU, {"quadrature": feeds["quadrature"], "in_phase": others["in_phase"]})
    for _ in range(2):
        got = bound.run(["p", "phase"], {"in_phase": feeds["in_phase"]})
        for one, other in zip(got, expected, strict=True):
            np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(bound.run(["p"], {})[0], session.run(["p"], others)[0])


def test_a_command_refuses_a_provider_before_it_opens_a_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(lightpage, ["evaluate", "--provider", "gpu", "--recording", str(tmp_path / "none.h5")]) == 2
    assert "provider: got 'gpu', wanted cpu, cuda or tensorrt" in capsys.readouterr().err
