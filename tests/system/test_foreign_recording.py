"""The strictest test: recordings made by a simulator that shares nothing with ours, through the command line."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from analysis.foreign_device import ForeignDevice

MINUTES = 20
"""Machines differ by a factor of three, and other tests run beside these."""
TRAININGS = {
    "short": (9, ["--preset", "standard", "--channels", "32", "--blocks", "1", "--steps", "200"], 0),
    "long": (16, ["--preset", "accurate", "--steps", "300"], 48),
}
"""Pages, choices and synthetic pages: enough to read a page, and all that a decoder is made of."""
JUMPS = {0: (-6.0, 8.0), 2: (9.0, -5.0)}
"""Camera pixels: while nobody read, and between two pages."""
KEPT_SHARE = 0.95
"""Of the AIR of other pages, read in order: 98%, but for how pages differ and for what leaves the cameras."""
SEED = "LIGHTPAGE_FOREIGN_SEED"
"""Environment variable that repeats the device of an earlier test; another is drawn each time without it."""


def lightpage(*arguments: str, status: int = 0) -> str:
    """Run the command as a user would, in a process of its own; returns what it writes to standard error."""
    command = [sys.executable, "-m", "lightpage.cli.main", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60 * MINUTES, check=False)
    assert done.returncode == status, f"{' '.join(arguments)}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
    return done.stderr


def read_after_jumps(device: ForeignDevice, bundle: Path, still: float, seed: int, folder: Path) -> None:
    """Pages of a device that walks and jumps, read by a decoder that was just started; `still` is the AIR without."""
    path, figures = folder / "jumped.h5", folder / "jumped.json"
    device.write(path, pages=3, levels=256, seed=seed + 1, jumps_px=JUMPS)
    lightpage("evaluate", "--bundle", str(bundle), "--recording", str(path), "--json", str(figures))
    rates = json.loads(figures.read_text())["air_per_page"]
    print(f"AIR of pages whose image has jumped {np.round(rates, 2)}, without {still:.2f}")
    assert len(rates) == 3
    assert min(rates) > KEPT_SHARE * still, f"seed {seed}"


def refuse_another_device(bundle: Path, seed: int, folder: Path) -> None:
    """No page of another device is given out, whatever its cameras show."""
    path = folder / "other.h5"
    depth = ForeignDevice.draw(seed).parameters.bit_depth
    ForeignDevice.draw(seed + 1).with_parameters(bit_depth=depth).write(path, pages=1, levels=256, seed=seed)
    told = lightpage("evaluate", "--bundle", str(bundle), "--recording", str(path), status=2)
    assert "1 of 1 pages that were refused" in told, told


def carry_a_file(device: ForeignDevice, bundle: Path, seed: int, folder: Path) -> None:
    """A file goes through the device and comes back bit by bit, read from frames and pilots alone."""
    known, code, written = folder / "known.h5", folder / "code.toml", folder / "pages.h5"
    sent, read, figures = folder / "sent.bin", folder / "read.bin", folder / "recovered.json"
    device.write(known, pages=4, levels=256, seed=seed + 2)
    lightpage("code", "--bundle", str(bundle), "--recording", str(known), "--out", str(code))
    sent.write_bytes(np.random.default_rng(seed).bytes(1500))
    lightpage("encode", str(sent), "--bundle", str(bundle), "--code", str(code), "--data-pages", "2",
              "--parity-pages", "1", "--out", str(written))  # fmt: skip
    with h5py.File(written) as file:
        symbols, levels = file["symbols"][()], int(file.attrs["levels"])
    shown = folder / "shown.h5"
    device.write(shown, len(symbols), levels, seed + 3, with_symbols=False, symbols=symbols)
    lightpage("recover", "--bundle", str(bundle), "--code", str(code), "--recording", str(shown), "--out", str(read),
              "--json", str(figures))  # fmt: skip
    told = json.loads(figures.read_text())
    print(f"{told['user_bytes_per_page']} user bytes a page, margin at least {told['margin_bits_least']:.2f} bits")
    assert read.read_bytes() == sent.read_bytes(), f"seed {seed}"


@pytest.mark.timeout(60 * MINUTES)
@pytest.mark.parametrize("training", ["short", pytest.param("long", marks=pytest.mark.long)])
def test_a_device_that_nobody_here_made_is_calibrated_trained_exported_and_decoded(
    tmp_path: Path, training: str
) -> None:
    pages, choices, synthetic = TRAININGS[training]
    seed = int(os.environ.get(SEED) or np.random.SeedSequence().generate_state(1)[0])
    print(f"foreign device, seed {seed}")
    recording = tmp_path / "foreign.h5"
    device = ForeignDevice.draw(seed)
    device.write(recording, pages=pages, levels=256, seed=seed)
    with h5py.File(recording) as file:
        assert "profile" not in file.attrs

    calibration, run, bundle = tmp_path / "calibration.toml", tmp_path / "run", tmp_path / "bundle.zip"
    found, figures = tmp_path / "calibration.json", tmp_path / "evaluation.json"
    lightpage("calibrate", "--profile", "bench", "--recording", str(recording), "--out", str(calibration),
              "--pages", "2", "--json", str(found))  # fmt: skip
    angle = json.loads(found.read_text())["angle_deg"]
    assert abs(angle - device.parameters.pipe_angle_deg) <= 0.03, f"seed {seed}"

    lightpage("train", "--profile", "bench", "--recording", str(recording), "--calibration", str(calibration),
              *choices, "--synthetic-pages", str(synthetic),
              "--out", str(run))  # fmt: skip
    lightpage("export", str(run), "--out", str(bundle))
    lightpage("evaluate", "--bundle", str(bundle), "--recording", str(recording), "--json", str(figures))
    evaluation = json.loads(figures.read_text())
    print(
        f"angle {angle:.4f}, true {device.parameters.pipe_angle_deg:.4f}; AIR {evaluation['air_bits_per_symbol']:.2f}"
    )
    assert evaluation["pages"] >= 1
    # so few steps on eight pages are a start, not a decoder; unrelated light gives none
    assert evaluation["air_bits_per_symbol"] > 2.5, f"seed {seed}: {evaluation}"

    read_after_jumps(device, bundle, evaluation["air_bits_per_symbol"], seed, tmp_path)
    refuse_another_device(bundle, seed, tmp_path)
    carry_a_file(device, bundle, seed, tmp_path)
