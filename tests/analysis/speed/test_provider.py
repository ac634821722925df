"""What a provider makes of a bundle: figures against the CPU's answers, callers at once, a failure of one of them."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from analysis.speed.provider import Kernel, Made, Shown, lines, made_by, main, pages_of, rate
from lightpage.errors import FrameError, RecordingError
from lightpage.recording.frame_pair import FramePair
from runtime.bundle.bundle import Bundle
from runtime.decoding.decoder import Decoder
from runtime.execution.providers import ON_CPU
from tests.runtime import toy


def test_answers_are_compared_with_those_of_the_cpu(tmp_path: Path) -> None:
    toy.write_toy_recording(tmp_path / "r.h5", toy.ToyDevice(), 256, 2)
    bundle = Bundle.open(toy.write_toy_bundle(tmp_path / "toy.zip"))
    decoder = Decoder(bundle)
    shown, levels = pages_of(tmp_path / "r.h5", 5, bundle.pilot_mask)
    usual = [decoder.decode(page.pair, levels, pilots=page.pilots) for page in shown]
    assert len(usual) == 2
    made = made_by(ON_CPU, bundle, "float32", shown, levels, usual, (1, 3), 0.05)
    assert made.deviation == made.symbols_changed == 0
    assert made.air > 4
    assert set(made.nodes) == {"CPUExecutionProvider"}
    assert set(made.pages_per_s) == {1, 3}
    assert min(made.pages_per_s.values()) > 0
    assert made.frame_bytes == 2 * shown[0].pair.in_phase.nbytes
    assert (made.device_bytes, made.busy_s, made.kernel_count, made.kernels) == (None, None, None, ())
    swapped = made_by(ON_CPU, bundle, "float32", shown, levels, usual[::-1], (), 0.05)
    assert swapped.deviation > 1
    assert swapped.symbols_changed > 0.9


def test_the_command_prints_and_keeps_the_figures(tmp_path: Path) -> None:
    toy.write_toy_recording(tmp_path / "r.h5", toy.ToyDevice(), 256, 1)
    bundle, figures = toy.write_toy_bundle(tmp_path / "toy.zip"), tmp_path / "F.json"
    asked = ["--bundle", str(bundle), "--recording", str(tmp_path / "r.h5"), "--precision", "float32"]
    done = CliRunner().invoke(main, [*asked, "--seconds", "0.05", "--json", str(figures)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert "toy, float32, cpu" in done.output
    assert "4 at once" in done.output
    assert json.loads(figures.read_text())["made"][0]["precision"] == "float32"


def test_a_failure_of_one_caller_is_told(tmp_path: Path) -> None:
    toy.write_toy_recording(tmp_path / "r.h5", toy.ToyDevice(), 256, 1)
    decoder = Decoder.load(toy.write_toy_bundle(tmp_path / "toy.zip"))
    shown, _ = pages_of(tmp_path / "r.h5", 1, decoder.bundle.pilot_mask)
    black = FramePair(np.zeros_like(shown[0].pair.in_phase), np.zeros_like(shown[0].pair.in_phase))
    with pytest.raises(FrameError):
        rate(decoder.decode, [shown[0], Shown(black, shown[0].symbols, shown[0].pilots)], 2, 0.05)


def test_pages_without_symbols_are_refused(tmp_path: Path) -> None:
    toy.write_toy_recording(tmp_path / "r.h5", toy.ToyDevice(), 256, 1)
    with h5py.File(str(tmp_path / "r.h5"), "a") as file:
        del file["symbols"]
    with pytest.raises(RecordingError, match="no dataset 'symbols'"):
        pages_of(tmp_path / "r.h5", 1, np.ones((1, 1), bool))


def test_what_a_gpu_did_is_told_kernel_by_kernel() -> None:
    kernels = (Kernel("conv", 3, 0.004), Kernel("copy", 2, 0.001))
    figures = Made(
        "b", "float32", "cuda", 1.0, {"CUDAExecutionProvider": 9}, 5.0, 1e-4, 0.0, 0.02, 0.03, {2: 80.0}, {2: 50.0},
        40_000_000, 47_463, 3_000_000_000, 0.005, kernels, 5,
    )  # fmt: skip
    told = "\n".join(lines(figures))
    assert "2 at once: 80.0 graphs/s; 50.0 pages/s, 2.00 GB/s of frames, 2.37 MB/s of user bytes" in told
    assert "3.00 GB of the GPU's memory; computes for 5.0 ms a page, in 5 kernels and copies" in told
    assert "4.00 ms in     3 of conv" in told
