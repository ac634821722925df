"""The strictest test: recordings made by a simulator that shares nothing with ours, through the commands."""

import io
import json
import os
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from analysis.foreign_device import BENCH, HALF, Design, ForeignDevice
from lightpage.cli import main
from lightpage.device.profile import load_profile
from tests.lightpage.small import small_profile

JUMPS = {0: (-6.0, 8.0), 2: (9.0, -5.0)}
"""Camera pixels: while nobody read, and between two pages."""
KEPT_SHARE = 0.88
"""Share of the AIR of other pages, read in order: 98% at full size, 93% at half, but for what leaves the cameras."""
SEED = "LIGHTPAGE_FOREIGN_SEED"
"""Environment variable with the seed of the device; without it, the long test draws another one each time."""


def lightpage(*arguments: object, status: int = 0) -> str:
    """Run a command line, and return what it writes to standard error."""
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()) as told:
        assert main.run(main.lightpage, [str(argument) for argument in arguments]) == status, told.getvalue()[-4000:]
    return told.getvalue()


def figures_of(folder: Path, *arguments: object) -> dict[str, Any]:
    """Run a command that writes figures, and return them."""
    lightpage(*arguments, "--json", folder / "figures.json")
    return dict(json.loads((folder / "figures.json").read_text()))


@pytest.mark.timeout(20 * 60)
@pytest.mark.parametrize(
    ("design", "pages", "choices", "synthetic", "size"),
    [
        (HALF, 6, "--preset standard --channels 16 --blocks 1 --steps 100", 0, 600),
        # minutes: the whole bench device, another one each time
        pytest.param(BENCH, 16, "--preset accurate --steps 300", 48, 1500, marks=pytest.mark.long),
    ],
    ids=["half", "whole"],
)
def test_a_device_that_nobody_here_made_is_calibrated_trained_exported_and_decoded(
    tmp_path: Path, design: Design, pages: int, choices: str, synthetic: int, size: int, request: pytest.FixtureRequest
) -> None:
    if design is HALF:
        profile, drawn = small_profile(), 1
        page = profile.page.model_copy(update={"pilot_fraction": 0.05})  # as many as a page of the bench device has
        profile = profile.model_copy(update={"page": page})
        request.getfixturevalue("ready_twin")
    else:
        profile, drawn = load_profile("bench"), np.random.SeedSequence().generate_state(1)[0]
    seed = int(os.environ.get(SEED) or drawn)
    print(f"foreign device, seed {seed}")
    device, recording, toml = ForeignDevice.draw(seed, design), tmp_path / "R.h5", tmp_path / "profile.toml"
    toml.write_text(profile.to_toml())
    device.write(recording, pages=pages, levels=256, seed=seed)
    with h5py.File(recording) as file:
        assert "profile" not in file.attrs

    calibration, run, bundle = tmp_path / "calibration.toml", tmp_path / "run", tmp_path / "bundle.zip"
    known = ["--profile", toml, "--recording", recording]
    found = figures_of(tmp_path, "calibrate", *known, "--out", calibration, "--pages", 1)
    assert abs(found["angle_deg"] - device.parameters.pipe_angle_deg) <= 0.03
    assert found["coherence_after"] > 10 * found["coherence_before"]
    trained = ["--calibration", calibration, *choices.split(), "--synthetic-pages", synthetic]
    lightpage("train", *known, *trained, "--out", run)
    lightpage("export", run, "--out", bundle)
    evaluation = figures_of(tmp_path, "evaluate", "--bundle", bundle, "--recording", recording)
    print(f"AIR {evaluation['air_bits_per_symbol']:.2f}")
    # so few steps on few pages are a start, not a decoder; unrelated light gives none
    assert evaluation["air_bits_per_symbol"] > 2.5

    device.write(tmp_path / "jumped.h5", pages=3, levels=256, seed=seed + 1, jumps_px=JUMPS)  # walks, and just started
    figures = figures_of(tmp_path, "evaluate", "--bundle", bundle, "--recording", tmp_path / "jumped.h5")
    print(f"AIR of pages whose image has jumped {np.round(figures['air_per_page'], 2)}")
    assert len(figures["air_per_page"]) == 3
    assert min(figures["air_per_page"]) > KEPT_SHARE * evaluation["air_bits_per_symbol"]

    # no page of another device is read, whatever its cameras show
    other = ForeignDevice.draw(seed + 1, device.design).with_parameters(bit_depth=device.parameters.bit_depth)
    other.write(tmp_path / "other.h5", pages=1, levels=256, seed=seed)
    told = lightpage("evaluate", "--bundle", bundle, "--recording", tmp_path / "other.h5", status=2)
    assert "1 of 1" in told

    carry_a_file(device, bundle, seed, np.random.default_rng(seed).bytes(size), tmp_path)


def carry_a_file(device: ForeignDevice, bundle: Path, seed: int, sent: bytes, folder: Path) -> None:
    """Send a file through the device and read it bit by bit, from frames and pilots alone."""
    known, code, written, shown = (folder / name for name in ("known.h5", "code.toml", "pages.h5", "shown.h5"))
    device.write(known, pages=4, levels=256, seed=seed + 2)
    lightpage("code", "--bundle", bundle, "--recording", known, "--out", code)
    (folder / "sent").write_bytes(sent)
    coded = ["--bundle", bundle, "--code", code]
    lightpage("encode", folder / "sent", *coded, "--data-pages", 2, "--parity-pages", 1, "--out", written)
    with h5py.File(written) as file:
        symbols, levels = file["symbols"][()], int(file.attrs["levels"])
    device.write(shown, len(symbols), levels, seed + 3, with_symbols=False, symbols=symbols)
    told = figures_of(folder, "recover", *coded, "--recording", shown, "--out", folder / "read")
    print(f"{told['user_bytes_per_page']} user bytes a page, margin at least {told['margin_bits_least']:.2f} bits")
    assert (folder / "read").read_bytes() == sent
