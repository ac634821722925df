"""Writes release/locks: what each image installs, every version exact and every file by its SHA-256.

    python release/lock.py [TARGET ...]

Versions are those of constraints.txt; uv asks the package index for the rest. A target is resolved for every platform
that it is built for. One lock serves them all, so the answers must be alike. No address gets into a lock. The image
`deep` takes PyTorch's build for processors, which the index lacks: UV_FIND_LINKS names the folder or page that has it.
"""

from __future__ import annotations

import re
import subprocess
import sys
import sysconfig
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LOCKS = ROOT / "release" / "locks"
PYTHON, GLIBC = "3.11", "2_36"
"""Versions of Debian bookworm, which the images are made from."""
BUILT_FROM_SOURCE = ("xcffib",)
"""Packages without a wheel. They are pure Python, and the tools of the lock `build` make their wheels."""
HEAD = "# Made by `make lock` for {target}: {platforms}. Do not edit.\n"


@dataclass(frozen=True)
class Target:
    """Target of an image: what it installs, and for which processors it is built.

    Args:
        extras: extras of pyproject.toml.
        machines: the processors that it is built for.
        refused: why it is not built for the others.
    """

    extras: tuple[str, ...]
    machines: tuple[str, ...] = ("x86_64", "aarch64")
    refused: str = ""


TARGETS: Mapping[str, Target] = {
    "runtime": Target(("cpu", "traces")),
    "camera": Target(("cpu", "camera", "screen", "traces"), ("x86_64",), "genicam has no wheel for it"),
    "deep": Target(("cpu", "train", "traces"), ("x86_64",), "the lock holds PyTorch's CPU build for x86_64 alone"),
    "gpu": Target(("gpu", "traces")),
    "ray": Target(("cpu", "kuberay", "traces")),
}
"""The stages of the Dockerfile."""
BUILD = "build"
"""The lock of the tools that make wheels. None of them gets into an image by it."""


class LockError(Exception):
    """A lock cannot be made."""


@dataclass(frozen=True)
class Locked:
    """Entry of a lock for a package: its version, and the SHA-256 of each of its files."""

    version: str
    hashes: frozenset[str]


def normal(name: str) -> str:
    """A distribution's name as pip compares it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def read_lock(path: Path) -> dict[str, Locked]:
    """The packages of a lock by normal name.

    Raises:
        LockError: a line is neither a pin nor a SHA-256: an address, an option, or a package without a version.
    """
    found: dict[str, Locked] = {}
    text = re.sub(r"^#.*\n", "", path.read_text(), flags=re.MULTILINE).replace("\\\n", " ")
    for line in text.splitlines():
        pin, *hashes = line.split()
        if not re.fullmatch(r"[\w.-]+==[\w.+]+", pin) or not hashes:
            raise LockError(f"{path.name}: got '{line[:80].strip()}', wanted NAME==VERSION --hash=sha256:DIGEST ...")
        if bad := [each for each in hashes if not re.fullmatch(r"--hash=sha256:[0-9a-f]{64}", each)]:
            raise LockError(f"{path.name}: {pin}: got '{bad[0][:80]}', wanted --hash=sha256:DIGEST")
        name, version = pin.split("==")
        found[normal(name)] = Locked(version, frozenset(each.removeprefix("--hash=sha256:") for each in hashes))
    return found


def compiled(target: str, machine: str) -> str:
    """The lock's lines for one processor.

    Raises:
        LockError: no such set of wheels is to be had.
    """
    uv = Path(sysconfig.get_path("scripts")) / "uv"
    words = ["--generate-hashes", "--no-header", "--no-annotate", "--no-config", "--only-binary", ":all:"]
    words += [word for name in BUILT_FROM_SOURCE for word in ("--no-binary", name)]
    words += ["--python-version", PYTHON, "--python-platform", f"{machine}-manylinux_{GLIBC}"]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    if target == BUILD:
        source, given = "-", "\n".join(project["build-system"]["requires"])
    else:
        source, given = "pyproject.toml", ""
        words += [word for extra in TARGETS[target].extras for word in ("--extra", extra)]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "lock.txt"
        if (before := LOCKS / f"{target}.txt").exists():  # what need not change stays
            out.write_text("".join(f"{name}=={package.version}\n" for name, package in read_lock(before).items()))
        done = subprocess.run(
            [uv, "pip", "compile", source, *words, "--constraint", "constraints.txt", "--output-file", out],
            cwd=ROOT,
            input=given,
            capture_output=True,
            text=True,
            timeout=600,
        )
        if done.returncode != 0:
            raise LockError(f"{target} for {machine}: {done.stderr.strip()}")
        return out.read_text()


def lock(target: str) -> str:
    """The text of a target's lock.

    Raises:
        LockError: it cannot be resolved, differs between processors, or takes a torch that is not for processors.
    """
    machines = ("x86_64", "aarch64") if target == BUILD else TARGETS[target].machines
    found = {machine: compiled(target, machine) for machine in machines}
    text = found[machines[0]]
    if any(other != text for other in found.values()):
        raise LockError(f"{target}: {' and '.join(machines)} need different packages, and one lock is for both")
    if target == "deep" and "\ntorch==" in text and "+cpu" not in text:
        raise LockError("deep: got a torch that needs CUDA; name a folder with torch's +cpu build in UV_FIND_LINKS")
    return HEAD.format(target=target, platforms=", ".join(machines)) + text


def main(targets: Sequence[str]) -> None:
    """Write the locks that are named, or all."""
    for target in targets or (BUILD, *TARGETS):
        if target not in (BUILD, *TARGETS):
            sys.exit(f"lock: target '{target}' is none of {', '.join((BUILD, *TARGETS))}")
        try:
            text = lock(target)
        except LockError as error:
            sys.exit(f"lock: {error}")
        LOCKS.mkdir(exist_ok=True)
        (LOCKS / f"{target}.txt").write_text(text)
        print(f"{target}: {text.count('==')} packages, {text.count('--hash=')} files")


if __name__ == "__main__":
    main(sys.argv[1:])
