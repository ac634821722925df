"""Python as its users meet it: what completion shows, what things say of themselves, the README's examples."""

import re
import shutil
import subprocess
import sys
import tomllib
import venv
from pathlib import Path
from rlcompleter import Completer

import numpy as np
import pytest

import lightpage
from lightpage.calibration.document import load_calibration
from lightpage.runtime.model.decoding.decoder import Decoder
from tests.runtime import toy
from tests.runtime.service.stage import Running

ROOT = Path(__file__).resolve().parents[2]
LONGEST_REPR = 240


def test_completion_shows_the_public_names_alone() -> None:
    completer, shown = Completer({"lightpage": lightpage}), set[str]()
    while (name := completer.complete("lightpage.", len(shown))) is not None:
        shown.add(name)
    assert {name.removeprefix("lightpage.").rstrip("()") for name in shown} == {*lightpage.__all__} - {"__version__"}
    assert dir(lightpage) == lightpage.__all__ == sorted(lightpage.__all__)
    assert lightpage.__version__ == tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]


def test_what_users_hold_says_in_a_line_what_it_is_and_can_be_drawn(
    decoder: Decoder, service: Running, small_device: list[str], tmp_path: Path
) -> None:
    toy.write_toy_recording(tmp_path / "R.h5", toy.ToyDevice(), 16, 2)
    with lightpage.Recording.open(tmp_path / "R.h5") as recording:
        pair, page, remote = recording.frames(0), decoder.decode(recording.frames(0), 16), service.client.pages.read()
        assert len(recording) == len(list(recording)) == 2
        assert (next(iter(recording)).in_phase == pair.in_phase).all()
        held = (recording, pair, page, remote, decoder, decoder.bundle, service.client, service.client.describe())
        more = (decoder.pilots(16), load_calibration(small_device[-1]), decoder.bundle.golden, decoder.bundle.profile)
        for thing in (*held, *more):
            told = repr(thing)
            assert type(thing).__name__ in told
            assert len(told) <= LONGEST_REPR
            assert "array(" not in told
            assert "\n" not in told
        for thing, panels in ((recording, 4), (pair, 2), (page, 2), (remote, 2)):
            assert len([axes for axes in lightpage.plot(thing).axes if axes.images]) == panels
        with pytest.raises(lightpage.LightpageError):
            lightpage.plot("R.h5")  # type: ignore[arg-type]


def test_the_readmes_script_reads_a_recording_and_follows_its_image(
    toy_zip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scripts = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    (script,) = (each for each in scripts if "decode_recording" in each)
    symbols = toy.write_toy_recording(tmp_path / "mine.h5", toy.ToyDevice(noise=4.0), 16, 3)
    shutil.copy(toy_zip, tmp_path / "mine.zip")
    monkeypatch.chdir(tmp_path)
    found: dict[str, object] = {}
    exec(script, found)
    page = found["page"]
    assert isinstance(page, lightpage.DecodedPage)
    assert np.mean(page.symbols != symbols[2]) < 0.01
    assert (tmp_path / "frames.png").stat().st_size > 1000


def test_its_types_are_found_in_an_installed_wheel(tmp_path: Path) -> None:
    """Checkers take them from a package beside others if `py.typed` says that it may."""
    environment = tmp_path / "environment"
    venv.create(environment)
    (packages,) = environment.glob("lib/*/site-packages")
    shutil.copytree(ROOT / "lightpage", packages / "lightpage", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "own.py").write_text(
        'import lightpage\nwith lightpage.Recording.open("R.h5") as recording:\n    number: str = recording.pages\n'
    )
    command = [sys.executable, "-m", "mypy", "--config-file=", "--python-executable", environment / "bin" / "python"]
    done = subprocess.run([*command, "own.py"], cwd=tmp_path, capture_output=True, text=True, timeout=500)
    assert re.match(r"own\.py:3: error: .*\[assignment\]\n", done.stdout), done.stdout
