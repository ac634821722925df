"""`lightpage simulate`: reproducible, interruptible, and careful with files that are there."""

from pathlib import Path

import click
import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from lightpage.cli.simulate import simulate
from lightpage.device.profile import load_profile
from lightpage.device.state import Device, load_device
from lightpage.errors import InvalidInputError
from lightpage.recording.reader import Recording
from lightpage.simulator import recording_job
from lightpage.simulator.simulator import LIGHT, SimulatedPage, Simulator
from tests.lightpage.small import small_profile

PAGES = 3


@pytest.fixture(scope="module")
def profile_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("profile") / "small.toml"
    path.write_text(small_profile().to_toml())
    return path


def run(profile: Path, out: Path, *more: str, pages: int = PAGES) -> None:
    arguments = ["--profile", str(profile), "--pages", str(pages), "--out", str(out), "--levels", "16", "--seed", "7"]
    result = CliRunner().invoke(simulate, [*arguments, *more], standalone_mode=False)
    if result.exception is not None:
        raise result.exception


def contents(path: Path) -> dict[str, np.ndarray]:
    found = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.update({name: item[()]}) if isinstance(item, h5py.Dataset) else None)
    return found


@pytest.fixture(scope="module")
def whole(profile_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "R.h5"
    run(profile_file, out)
    return out


def interrupt_after(pages: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C in the middle of the page after `pages`."""
    original, count = Simulator.simulate, iter(range(100))

    def interrupted(self: Simulator, symbols: np.ndarray) -> SimulatedPage:
        if next(count) == pages:
            raise KeyboardInterrupt
        return original(self, symbols)

    monkeypatch.setattr(recording_job.Simulator, "simulate", interrupted)


def test_a_recording_opens_with_its_profile_levels_and_symbols(whole: Path, profile_file: Path) -> None:
    profile = load_profile(profile_file)
    with Recording.open(whole) as recording:
        recording.header.check_against(profile)
        symbols = recording.symbols(0)
        assert (recording.pages, recording.levels, recording.header.profile_text) == (PAGES, 16, profile.to_toml())
    assert symbols is not None
    assert symbols.max() == 15


def test_the_truth_lies_beside_the_pages_and_can_be_left_out(whole: Path, profile_file: Path, tmp_path: Path) -> None:
    with h5py.File(whole) as file:
        (tmp_path / "device.toml").write_text(file["truth"].attrs["device"])
        assert set(file["truth"]) == {"exit_field", "piston", "shift_px"}
        pistons = file["truth/piston"][()]
    assert load_device(tmp_path / "device.toml") == Device()
    assert np.ptp(pistons) > 0
    run(profile_file, tmp_path / "bare.h5", "--no-truth", pages=1)
    with h5py.File(tmp_path / "bare.h5") as file:
        assert "truth" not in file


def test_an_interrupted_recording_goes_on_to_what_it_would_have_been(
    whole: Path, profile_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "R.h5"
    with monkeypatch.context() as patch:
        interrupt_after(2, patch)
        with pytest.raises(click.Abort):
            run(profile_file, out)
    assert not out.exists()
    with h5py.File(tmp_path / "R.h5.partial") as file:
        assert file.attrs["pages_complete"] == 2
    run(profile_file, out)
    expected, found = contents(whole), contents(out)
    assert set(found) == set(expected)
    for name, value in expected.items():
        np.testing.assert_array_equal(found[name], value, err_msg=name)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["R.h5"]


def test_pages_of_another_device_are_not_mixed_in(
    profile_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, other = tmp_path / "R.h5", ("--set", "geometry.pipe_angle_deg=0.5")
    with monkeypatch.context() as patch:
        interrupt_after(1, patch)
        with pytest.raises(click.Abort):
            run(profile_file, out)
    for more in (other, ("--no-truth",)):
        with pytest.raises(InvalidInputError, match="other settings"):
            run(profile_file, out, *more)
    with monkeypatch.context() as patch:
        patch.setattr(recording_job, "LIGHT", LIGHT + 1)
        with pytest.raises(InvalidInputError, match="other settings"):
            run(profile_file, out)
    out.write_bytes(b"precious")
    with pytest.raises(InvalidInputError, match="--force"):
        run(profile_file, out, *other, pages=1)
    assert out.read_bytes() == b"precious"
    run(profile_file, out, *other, "--force", pages=1)
    with h5py.File(out) as file:
        assert "pipe_angle_deg = 0.5" in file["truth"].attrs["device"]


def test_settings_and_a_device_file_make_the_device(profile_file: Path, tmp_path: Path) -> None:
    (tmp_path / "device.toml").write_text("[sensor]\nbit_depth = 12\n[drift]\npiston_rad = 0.4\n")
    device = ("--device", str(tmp_path / "device.toml"), "--set", "drift.piston_rad=0.0")
    run(profile_file, tmp_path / "R.h5", *device, pages=2)
    with Recording.open(tmp_path / "R.h5") as recording:
        assert recording.bit_depth == 12
    assert np.ptp(contents(tmp_path / "R.h5")["truth/piston"]) == 0
