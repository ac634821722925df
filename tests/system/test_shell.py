"""The shell around the code: set-up, packaging, image and commands are what they say."""

from __future__ import annotations

import importlib
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
COMMANDS: dict[str, str] = {**PROJECT["scripts"], **PROJECT["entry-points"]["lightpage.commands"]}
EXTRAS: dict[str, list[str]] = PROJECT["optional-dependencies"]
LOCKS = ROOT / "packaging" / "locks"
# What a wheel is made of, and what the image build is given beside that.
PACKAGES = ("lightpage", "train", "export", "runtime", "analysis")
SOURCES = ("pyproject.toml", "LICENSE", "README.md", *PACKAGES)
PACKAGING = ("packaging",)


def run(command: Sequence[str | Path], *, cwd: Path = ROOT, timeout_s: float = 60) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=timeout_s,
        stdin=subprocess.DEVNULL,
    )


def normal(name: str) -> str:
    """A distribution's name as pip compares it."""
    return re.sub(r"[-_.]+", "-", re.split(r"[\s\[<>=!~;]", name, maxsplit=1)[0]).lower()


def pins() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    return {normal(name): version for name, _, version in (line.partition("==") for line in lines if line[:1] != "#")}


# ---- make and continuous integration ------------------------------------------------------------------------------


@pytest.mark.parametrize("target", ["setup", "demo", "test", "bench", "image", "sbom", "lock", "proto", "lint"])
def test_make_knows_what_to_do_for(target: str) -> None:
    planned = run(["make", "--dry-run", target])
    assert planned.returncode == 0, planned.stderr


def test_the_first_target_only_tells() -> None:
    assert run(["make", "--dry-run"]).stdout == run(["make", "--dry-run", "help"]).stdout


@pytest.mark.parametrize("script", [".ci/run", *(str(path.relative_to(ROOT)) for path in ROOT.glob("packaging/*.sh"))])
def test_scripts_are_executable_and_parse(script: str) -> None:
    assert os.access(ROOT / script, os.X_OK)
    parsed = run(["bash", "-n", script])
    assert parsed.returncode == 0, parsed.stderr


def test_continuous_integration_is_make_test() -> None:
    assert (ROOT / ".ci/run").read_text().splitlines()[-1] == "make test"


# ---- versions -----------------------------------------------------------------------------------------------------


def test_constraints_are_plain_pins_that_resolve_anywhere() -> None:
    for line in (ROOT / "constraints.txt").read_text().splitlines():
        assert line.startswith("#") or re.fullmatch(r"[\w.-]+==[\w.]+", line), line  # no URL, no path, no local tag


def test_every_direct_requirement_is_pinned() -> None:
    expected = [*PROJECT["dependencies"], *EXTRAS["train"], *EXTRAS["dev"]]
    assert {normal(requirement) for requirement in expected} <= pins().keys()


def test_torch_is_pinned_for_those_who_install_without_constraints_too() -> None:
    assert f"torch=={pins()['torch']}" in EXTRAS["train"]
    assert not any(normal(requirement) == "torch" for requirement in PROJECT["dependencies"])


# ---- commands -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", COMMANDS)
def test_the_command_is_there(name: str) -> None:
    module, _, attribute = COMMANDS[name].partition(":")
    assert callable(getattr(importlib.import_module(module), attribute))


# ---- image --------------------------------------------------------------------------------------------------------


def hadolint(*words: str | Path) -> subprocess.CompletedProcess[str]:
    return run([Path(sysconfig.get_path("scripts")) / "hadolint", "--config", ROOT / ".hadolint.yaml", *words])


def test_the_dockerfile_passes_hadolint() -> None:
    linted = hadolint(ROOT / "Dockerfile")
    assert linted.returncode == 0, linted.stdout


def test_hadolint_would_say_so_if_it_did_not(tmp_path: Path) -> None:
    spoiled = tmp_path / "Dockerfile"
    spoiled.write_text((ROOT / "Dockerfile").read_text().replace("--no-install-recommends ", ""))
    linted = hadolint(spoiled)
    assert linted.returncode != 0
    assert "DL3015" in linted.stdout


def stages() -> dict[str, str]:
    """The Dockerfile's named stages: name to text."""
    text = (ROOT / "Dockerfile").read_text()
    return {
        found["name"]: found["text"]
        for found in re.finditer(
            r"^FROM \S+ AS (?P<name>\S+)\n(?P<text>.*?)(?=^FROM |\Z)", text, re.MULTILINE | re.DOTALL
        )
    }


def test_the_image_is_not_root_quiet_and_checked() -> None:
    runtime = stages()["service"]
    assert "USER 10001:10001" in runtime
    assert "ORT_DISABLE_TELEMETRY=1" in runtime
    assert "PYTHONDONTWRITEBYTECODE=1" in runtime
    assert 'CMD ["python", "-m", "runtime.commands.healthcheck"]' in runtime
    assert 'ENTRYPOINT ["lightpage", "serve"]' in runtime
    text = (ROOT / "Dockerfile").read_text()
    for name in ("runtime", "camera", "deep", "gpu"):  # whatever is installed, it is run alike
        assert f"FROM service AS {name}" in text


def test_every_image_installs_its_own_lock() -> None:
    for name in ("runtime", "camera", "deep", "gpu"):
        installed = re.findall(r"packaging/install_locked.sh (\S+) (\S+)$", stages()[f"build-{name}"], re.MULTILINE)
        assert installed == [(f"packaging/locks/{name}.txt", "/opt/lightpage")]
        assert re.findall(r"--from=(\S+)", stages()[name]) == [f"build-{name}"]


def test_only_the_deep_image_has_torch_and_none_has_both_runtimes() -> None:
    named = {
        path.stem: set(re.findall(r"^([\w.-]+)==", path.read_text(), re.MULTILINE)) for path in LOCKS.glob("*.txt")
    }
    assert [name for name, some in named.items() if "torch" in some] == ["deep"]
    runtimes = {name: sorted(some & {"onnxruntime", "onnxruntime-gpu"}) for name, some in named.items()}
    assert runtimes.pop("build") == []
    assert runtimes.pop("gpu") == ["onnxruntime-gpu"]
    assert set(map(tuple, runtimes.values())) == {("onnxruntime",)}


def test_the_image_is_built_of_what_the_wheel_is_built_of() -> None:
    copied = re.findall(r"^COPY (?!--)(.*) \S+$", stages()["build"], re.MULTILINE)
    assert sorted(" ".join(copied).split()) == sorted((*SOURCES, *PACKAGING))
    let_through = [line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")]
    assert sorted(let_through) == sorted((*SOURCES, *PACKAGING))


# ---- what the image build is lent ---------------------------------------------------------------------------------


def lend(listing: str, out: Path) -> tuple[str, list[str]]:
    """Run the helper of build_image.sh: the pip.conf that it writes and the folders that it prints."""
    done = subprocess.run(
        [sys.executable, ROOT / "packaging/lend_pip_settings.py", out],
        input=listing,
        capture_output=True,
        text=True,
        check=True,
    )
    return (out / "pip.conf").read_text(), done.stdout.split()


def test_a_machine_without_settings_lends_none(tmp_path: Path) -> None:
    assert lend("", tmp_path) == ("[global]\n", [])
    assert not (tmp_path / "ca_bundle").exists()


def test_local_folders_and_certificates_are_lent_under_neutral_names(tmp_path: Path) -> None:
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
    assert str(tmp_path) not in settings


def test_the_environment_beats_the_file_whatever_the_order(tmp_path: Path) -> None:
    listing = [
        ":env:.index-url='https://two.example/simple'",
        "WARNING: chatter",
        "global.index-url='https://one.example/simple'",
    ]
    for order in (listing, listing[::-1]):
        assert lend("\n".join(order), tmp_path)[0] == "[global]\nindex-url = https://two.example/simple\n"


# ---- an environment without torch ---------------------------------------------------------------------------------


NEED_AN_EXTRA = {"runtime.modulator.present": "xcffib", "runtime.modulator.x_window": "xcffib"}
"""Modules that the process of a modulator's window alone loads, and what they lack without the extra `screen`."""


@pytest.fixture(scope="module")
def torchless(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scripts folder of a fresh environment with lightpage in it as the runtime image has it: no torch."""
    folder = tmp_path_factory.mktemp("torchless")
    source = folder / "source"
    source.mkdir()
    for name in SOURCES:  # a copy: a build leaves its traces beside pyproject.toml
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, source)
    made = run([sys.executable, "-m", "venv", folder / "environment"])
    assert made.returncode == 0, made.stderr
    scripts = folder / "environment" / "bin"
    locked = ["--require-hashes", "--only-binary", ":all:", "--requirement", LOCKS / "runtime.txt"]
    for words in (locked, ["--no-deps", "."]):
        installed = run([scripts / "pip", "install", *words], cwd=source, timeout_s=500)
        assert installed.returncode == 0, installed.stderr
    return scripts


def ask(scripts: Path, code: str) -> str:
    """What the environment's python prints, away from the source tree."""
    said = run([scripts / "python", "-I", "-c", code], cwd=scripts)
    assert said.returncode == 0, said.stderr
    return said.stdout.strip()


def test_the_runtime_needs_no_torch(torchless: Path) -> None:
    assert ask(torchless, "from importlib.util import find_spec; print(find_spec('torch'))") == "None"
    imports_everything = """
import importlib, pkgutil, sys
lacking = {}
for package in ("lightpage", "runtime"):
    for module in pkgutil.walk_packages(importlib.import_module(package).__path__, package + "."):
        try:
            importlib.import_module(module.name)
        except ModuleNotFoundError as error:
            lacking[module.name] = error.name
print(lacking)
print("lightpage.cli.main" in sys.modules, "runtime.commands.healthcheck" in sys.modules)
"""
    assert ask(torchless, imports_everything) == f"{NEED_AN_EXTRA}\nTrue True"


def test_the_command_runs_without_torch(torchless: Path) -> None:
    helped = run([torchless / "lightpage", "--help"], cwd=torchless)
    assert helped.returncode == 0, helped.stderr
    for name in ("serve", "decode", "evaluate", "recalibrate"):
        assert re.search(rf"^  {name} ", helped.stdout, re.MULTILINE), helped.stdout


def test_profiles_and_type_markers_travel_with_the_wheel(torchless: Path) -> None:
    lists_files = """
from importlib.resources import files
print(sorted(file.name for file in files("lightpage.device").joinpath("profiles").iterdir()))
print(all(files(package).joinpath("py.typed").is_file() for package in ("lightpage", "train", "export", "runtime")))
"""
    assert ask(torchless, lists_files) == "['bench.toml', 'paper.toml']\nTrue"


def test_the_shipped_bundle_decodes_without_torch(torchless: Path) -> None:
    decodes = """
import sys
import numpy as np
from runtime.decoding.decoder import Decoder
from runtime.bundle.shipped import bundle_path
decoder = Decoder.load(bundle_path("bench"), threads=1)
page = decoder.decode(decoder.bundle.golden.pair, 16)
print(page.symbols.shape, bool(np.median(page.confidence) > 0.5), "torch" in sys.modules)
"""
    assert ask(torchless, decodes) == "(56, 87) True False"
