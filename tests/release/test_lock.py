"""The locks name all that an image installs: versions of constraints.txt, a SHA-256 of each file, a known licence."""

import re
import tomllib
from collections.abc import Iterable, Mapping
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement

from tests.release.scripts import ROOT, script

inventory, licences, lock = script("inventory"), script("licences"), script("lock")
LOCKS: Path = lock.LOCKS
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
OF_CUDA = ("nvidia-", "cuda-", "triton")
"""Beginnings of names of packages that PyTorch's build for GPUs brings. A developer may have it; no lock does."""
BEYOND_CONSTRAINTS = ("nvidia-",)
"""Packages of the image `gpu` alone. constraints.txt leaves them open: torch for GPUs needs other versions."""
OF_THE_DASHBOARD = {
    *("aiohttp-cors", "colorful", "google-api-core", "google-auth", "opencensus", "opencensus-context", "proto-plus"),
    *("opentelemetry-exporter-prometheus", "py-spy", "pyasn1", "pyasn1-modules", "smart-open", "wrapt"),
}
"""Packages of the image `ray` alone: those of Ray's dashboard, by which KubeRay hands over jobs."""


def constrained() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    return {lock.normal(name): version for name, _, version in (line.partition("==") for line in lines if "==" in line)}


def asked(target: str) -> list[Requirement]:
    """Return the requirements that pyproject.toml states for a target."""
    extras: Mapping[str, list[str]] = PROJECT["optional-dependencies"]
    lists = [PROJECT["dependencies"], *(extras[extra] for extra in lock.TARGETS[target].extras)]
    return [Requirement(line) for requirements in lists for line in requirements]


def closure(requirements: Iterable[Requirement], machine: str) -> set[str]:
    """Names of these requirements and all that they need on a processor, by the metadata of what is installed here."""
    found: set[str] = set()
    open_ones = [(requirement, frozenset(requirement.extras)) for requirement in requirements]
    seen: set[tuple[str, frozenset[str]]] = set()
    while open_ones:
        requirement, extras = open_ones.pop()
        name = lock.normal(requirement.name)
        if (name, extras) in seen:
            continue
        seen.add((name, extras))
        found.add(name)
        for line in () if name in OF_THE_DASHBOARD else distribution(name).requires or ():
            inner = Requirement(line)
            environments = [{"platform_machine": machine, "extra": extra} for extra in (*extras, "")]
            wanted = inner.marker is None or any(inner.marker.evaluate(each) for each in environments)
            if wanted and not (name == "torch" and inner.name.startswith(OF_CUDA)):
                open_ones.append((inner, frozenset(inner.extras)))
    return found


def disagreements(
    locked: Mapping[str, Any], pins: Mapping[str, str], needed: set[str], beyond: tuple[str, ...] = ()
) -> list[str]:
    """List a lock's faults: packages that are missing or too many, and versions that constraints.txt does not have."""
    lines = [f"{name} is not locked" for name in needed - locked.keys()]
    for name, package in locked.items():
        if beyond and name.startswith(beyond):
            continue
        if name not in needed:
            lines.append(f"{name} is needed by nothing")
        if (version := package.version.partition("+")[0]) != pins.get(name):
            lines.append(f"{name} is {version}, and {pins.get(name)} in constraints.txt")
    return sorted(lines)


@pytest.mark.parametrize("target", ["runtime", "camera", "deep"])
def test_a_lock_is_what_the_image_needs_and_no_more(target: str) -> None:
    locked = lock.read_lock(LOCKS / f"{target}.txt")
    for machine in lock.TARGETS[target].machines:
        assert disagreements(locked, constrained(), closure(asked(target), machine)) == []


def test_the_lock_for_gpus_is_what_pyproject_asks_for_and_the_libraries_of_cuda() -> None:
    locked = lock.read_lock(LOCKS / "gpu.txt")
    # onnxruntime-gpu is installed in that image alone. Beside the libraries of CUDA it needs what onnxruntime needs.
    needed = closure(asked("runtime"), "x86_64") - {"onnxruntime"} | {"onnxruntime-gpu"}
    assert disagreements(locked, constrained(), needed, BEYOND_CONSTRAINTS) == []
    assert all(locked[requirement.name].version in requirement.specifier for requirement in asked("gpu"))
    assert {"nvidia-cublas", "nvidia-cudnn-cu13"} <= locked.keys()


def test_the_lock_for_ray_is_what_a_worker_needs_and_rays_dashboard() -> None:
    locked = lock.read_lock(LOCKS / "ray.txt")
    needed = closure([*asked("ray"), Requirement("six")], "x86_64") | OF_THE_DASHBOARD  # opencensus needs six
    assert disagreements(locked, constrained(), needed) == []
    assert all(locked[requirement.name].version in requirement.specifier for requirement in asked("ray"))


def test_the_sizes_of_all_installations_of_the_readme_can_be_printed() -> None:
    assert {"./clients/python", ".[cpu]", *(f".[cpu,{name}]" for name in ("import", "report", "train"))} == set(
        script("install_sizes").stated()
    )


def test_every_stage_that_installs_does_it_by_its_lock() -> None:
    text = (ROOT / "Dockerfile").read_text()
    assert sorted(re.findall(r"release/locks/(\w+)\.txt", text)) == sorted(path.stem for path in LOCKS.glob("*.txt"))
    installs = re.findall(r"pip (?:install|wheel|download) .*", text + (ROOT / "release/install_locked.sh").read_text())
    for line in installs:
        assert "--require-hashes" in line or "--no-index" in line, line


@pytest.mark.parametrize("target", ["runtime", "camera", "deep", "ray"])
def test_every_locked_package_has_a_licence_that_is_allowed(target: str) -> None:
    locked = lock.read_lock(LOCKS / f"{target}.txt")
    here = locked.keys() - OF_THE_DASHBOARD  # of the others, licences.toml must say it
    found = {
        name: licences.spdx(name, inventory.licence_of(distribution(name)) if name in here else "") for name in locked
    }
    assert {name: licence for name, licence in found.items() if licence is None or licences.refused(licence)} == {}


def spoiled(folder: Path, old: str, new: str) -> Path:
    """The lock of `runtime`, changed at its first match."""
    text = (LOCKS / "runtime.txt").read_text()
    changed = re.sub(old, new, text, count=1, flags=re.MULTILINE)
    assert changed != text
    path = folder / "lock.txt"
    path.write_text(changed)
    return path


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (r"^(click==\S+) \\\n(    --hash=\S+( \\)?\n)+", r"\1\n", "click==8.5.1"),
        (r"^(click==\S+ \\\n    --hash=sha256:)", r"\1x", "click==8.5.1"),
        (r"^click==", r"--index-url https://example.com/simple\nclick==", "--index-url"),
        (r"^click==", "click>=", "click>="),
    ],
)
def test_a_line_that_is_no_pin_with_hashes_is_refused(tmp_path: Path, old: str, new: str, said: str) -> None:
    with pytest.raises(lock.LockError, match=re.escape(said)):
        lock.read_lock(spoiled(tmp_path, old, new))
