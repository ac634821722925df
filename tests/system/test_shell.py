"""The shell around the code: set-up, release, image and commands are what they say."""

import ast
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import pytest

from tests.release.scripts import script

ROOT = Path(__file__).resolve().parents[2]
SETTINGS: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT, DATA = SETTINGS["project"], SETTINGS["tool"]["setuptools"]["package-data"]
NAMED: list[dict[str, str]] = [PROJECT["scripts"], *PROJECT["entry-points"].values()]
LOCKS = ROOT / "release" / "locks"
# What a wheel is made of, and what the image build is given beside that.
PACKAGES = ("lightpage", "train", "export", "runtime", "report", "study", "demo", "virtual_device")
SOURCES = ("pyproject.toml", "setup.py", "LICENSE", "README.md", *PACKAGES)


def run(command: Sequence[str | Path], *, cwd: Path = ROOT, timeout_s: float = 60) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=timeout_s,
        stdin=subprocess.DEVNULL,
    )


def test_scripts_parse() -> None:
    assert run(["make", "--dry-run"]).stdout == run(["make", "--dry-run", "help"]).stdout
    for path in (ROOT / ".ci/run", *ROOT.glob("release/*.sh")):
        assert os.access(path, os.X_OK)
        assert run(["bash", "-n", path]).stderr == ""


def defined(module: str) -> set[str]:
    """Names that a module defines, read from its text: some take seconds to import."""
    names = set()
    for node in ast.parse(ROOT.joinpath(*module.split(".")).with_suffix(".py").read_text()).body:
        names |= {node.name} if isinstance(node, ast.FunctionDef | ast.ClassDef) else set()
        targets = [node.target] if isinstance(node, ast.AnnAssign) else getattr(node, "targets", [])
        names |= {target.id for target in targets if isinstance(target, ast.Name)}
    return names


def test_every_command_and_plug_in_is_there() -> None:
    for name, value in (item for names in NAMED for item in names.items()):
        module, _, attribute = value.partition(":")
        assert attribute in defined(module), name


def test_data_files_of_the_packages_travel_with_the_wheel() -> None:
    for folder, _, names in os.walk(ROOT / "lightpage", followlinks=True):
        for path in (Path(folder, name).relative_to(ROOT) for name in names):
            if path.suffix not in (".py", ".pyc", ".pyi", ".so", ".pyd"):  # what is compiled goes by itself
                within = [parent for parent in path.parents if ".".join(parent.parts) in DATA]
                patterns = [within[0] / pattern for pattern in DATA[".".join(within[0].parts)]] if within else []
                assert any(path.match(str(pattern)) for pattern in patterns), path


def stages() -> dict[str, str]:
    """The Dockerfile's named stages: name to text."""
    pattern = re.compile(r"^FROM \S+ AS (?P<name>\S+)\n(?P<text>.*?)(?=^FROM |\Z)", re.MULTILINE | re.DOTALL)
    return {found["name"]: found["text"] for found in pattern.finditer((ROOT / "Dockerfile").read_text())}


def test_the_image_is_not_root_quiet_and_checked() -> None:
    for line in (
        "USER 10001:10001",
        "ORT_DISABLE_TELEMETRY=1",
        'CMD ["python", "-m", "lightpage.runtime.commands.service.healthcheck"]',
    ):
        assert line in stages()["service"]
    for name in ("runtime", "camera", "deep", "gpu"):  # whatever is installed, it is run alike
        assert f"FROM service AS {name}" in (ROOT / "Dockerfile").read_text()
        assert re.findall(r"--from=(\S+)", stages()[name]) == [f"build-{name}"]


def test_the_image_is_built_of_what_the_wheel_is_built_of() -> None:
    copied = re.findall(r"^COPY (?!--)(.*) \S+$", stages()["build"], re.MULTILINE)
    assert sorted(" ".join(copied).split()) == sorted((*SOURCES, "release"))
    let_through = [line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")]
    assert sorted(let_through) == sorted((*SOURCES, "release"))


def lend(listing: str, out: Path) -> tuple[str, list[str]]:
    """Run the helper of build_image.sh: the pip.conf that it writes and the folders that it prints."""
    helper, told = script("lend_pip_settings"), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(told):
        patch.setattr(sys, "argv", ["lend_pip_settings.py", str(out)])
        patch.setattr(sys, "stdin", io.StringIO(listing))
        helper.main()
    return (out / "pip.conf").read_text(), told.getvalue().split()


def test_settings_of_pip_are_lent_to_the_build_of_an_image(tmp_path: Path) -> None:
    out, index, wheels, cert = (tmp_path / name for name in ("out", "index", "wheels", "my.pem"))
    for folder in (out, index / "simple", wheels):
        folder.mkdir(parents=True)
    cert.write_text("certificates\n")
    settings, folders = lend(
        f"global.extra-index-url='file://{index}/simple'\n:env:.find-links='{wheels}'\nglobal.cert='{cert}'\n", out
    )
    assert folders == [str(index), str(wheels)]
    assert settings.splitlines() == [
        "[global]",
        "extra-index-url = file:///run/packages/0/simple",
        "find-links = /run/packages/1",
        "cert = /run/secrets/ca_bundle",
    ]
    assert (out / "ca_bundle").read_text() == "certificates\n"
    listing = [f"{where}.index-url='https://{host}.example/simple'" for where, host in ((":env:", 1), ("global", 2))]
    for order in ([*listing, "WARNING: chatter"], listing[::-1]):
        assert lend("\n".join(order), tmp_path)[0] == "[global]\nindex-url = https://1.example/simple\n"


NEED_AN_EXTRA = {"lightpage.runtime.device.modulator.screen.x_window": "xcffib"}
"""Modules that the process of a modulator's window alone loads, and what they lack without the extra `screen`."""

WITH_TORCH = ("lightpage.train", "lightpage.export", "lightpage.study", "lightpage.report")

IN_THE_IMAGE = f"""
import builtins, importlib, json, os, pkgutil, sys
os.environ["ORT_DISABLE_TELEMETRY"], load, telemetry = "0", builtins.__import__, set()
def watch(name, *rest, **named):
    if name.partition(".")[0] == "onnxruntime" and "onnxruntime" not in sys.modules:
        telemetry.add(os.environ["ORT_DISABLE_TELEMETRY"])
    return load(name, *rest, **named)
builtins.__import__ = watch
import lightpage
lacking = {{}}
rooms = [room for room in pkgutil.iter_modules(lightpage.__path__, "lightpage.") if room.name not in {WITH_TORCH}]
for room in rooms:
    within = importlib.import_module(room.name).__path__ if room.ispkg else []
    for module in pkgutil.walk_packages(within, room.name + "."):
        try:
            importlib.import_module(module.name)
        except ModuleNotFoundError as error:
            lacking[module.name] = error.name
assert lacking == {NEED_AN_EXTRA}, lacking
assert {{"lightpage.cli.main", "lightpage.runtime.commands.service.healthcheck"}} <= sys.modules.keys()
import numpy as np
from importlib.resources import files
from click.testing import CliRunner
from lightpage.cli.main import lightpage
from lightpage.device.profile import load_profile
from lightpage.runtime.model.bundle.shipped import bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder
decoder = Decoder.load(bundle_path("bench"), threads=1)
page = decoder.decode(decoder.bundle.golden.pair, 16)
print(json.dumps({{
    "decoded": [page.symbols.shape, bool(np.median(page.confidence) > 0.5)],
    "help": CliRunner().invoke(lightpage, ["--help"]).output,
    "profiles": [load_profile(name).name for name in ("bench", "paper")],
    "telemetry": [*telemetry],
    "strangers": [name for name in sys.modules if name.startswith({("torch", "tests", *WITH_TORCH)})],
    "typed": files("lightpage").joinpath("py.typed").is_file(),
}}))
"""
"""Script that must run with the runtime image's packages, in one process, since importing everything takes seconds."""


def does_its_work(said: str) -> None:
    told = json.loads(said)
    assert told["decoded"] == [[56, 87], True]
    assert told["profiles"] == ["bench", "paper"]
    assert (told["telemetry"], told["strangers"], told["typed"]) == (["1"], [], True)
    assert re.search(r"^  serve ", told["help"], re.MULTILINE), told["help"]


def test_the_runtime_needs_nothing_but_what_its_image_has() -> None:
    locked = set(re.findall(r"^([\w.-]+)==", (LOCKS / "runtime.txt").read_text(), re.MULTILINE))
    hides = f"""
import sys
from importlib.metadata import packages_distributions
known = {{normal.lower().replace("_", "-") for normal in {sorted(locked)}}} | {{"lightpage"}}
hidden = {{
    name for name, owners in packages_distributions().items()
    if not known & {{owner.lower().replace("_", "-").replace(".", "-") for owner in owners}}
}}
class Hides:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in hidden:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name.partition(".")[0])
sys.meta_path.insert(0, Hides())
"""
    said = run([sys.executable, "-c", hides + IN_THE_IMAGE], timeout_s=120)
    assert said.returncode == 0, said.stderr
    does_its_work(said.stdout)


@pytest.mark.long  # pip installs forty locked packages for half a minute; the test above hides all others
def test_it_installs_from_its_lock_and_does_its_work(tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.mkdir()
    for name in SOURCES:  # a copy: a build leaves its traces beside pyproject.toml
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, source)
    made = run([sys.executable, "-m", "venv", tmp_path / "environment"], timeout_s=120)
    assert made.returncode == 0, made.stderr
    scripts = tmp_path / "environment" / "bin"
    locked = ["--require-hashes", "--only-binary", ":all:", "--requirement", LOCKS / "runtime.txt"]
    for words in (locked, ["--no-deps", "."]):
        installed = run([scripts / "pip", "install", *words], cwd=source, timeout_s=500)
        assert installed.returncode == 0, installed.stderr
    said = run([scripts / "python", "-I", "-c", IN_THE_IMAGE], cwd=scripts, timeout_s=120)
    assert said.returncode == 0, said.stderr
    does_its_work(said.stdout)
