"""Goes through the checklist of a release, and prints what holds.

    python release/check_release.py [STEP ...]

Each step is a command that ends with 0; its output goes to build/release/STEP.log. A step that this machine cannot do,
for want of a builder of images, counts as failed.
"""

from __future__ import annotations

import re
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "build" / "release"
BIN = Path(sys.executable).parent
_LONGEST_S = {"wheel": 1800.0, "client": 900.0, "site": 900.0}
"""Longest time of a command, by step; `_OTHERS_S` of the others."""
_OTHERS_S = 4 * 3600.0


def versions() -> list[str]:
    """Return how CITATION.cff and the newest heading of CHANGELOG.md differ from pyproject.toml, and their dates."""
    wanted = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]
    found = {
        "CITATION.cff": _found(r"^version: (.+)$", "CITATION.cff"),
        "CHANGELOG.md": _found(r"^## \[(.+?)\]", "CHANGELOG.md"),
    }
    wrong = [f"{name}: got {version}, wanted {wanted}" for name, version in found.items() if version != wanted]
    released = _found(r"^## \[.+?\] - (.+)$", "CHANGELOG.md")
    if (cited := _found(r"^date-released: (.+)$", "CITATION.cff")) != released:
        wrong.append(f"CITATION.cff: got date-released {cited}, wanted that of CHANGELOG.md, {released}")
    return wrong


def _found(pattern: str, name: str) -> str:
    match = re.search(pattern, (ROOT / name).read_text("utf-8"), re.MULTILINE)
    return "none" if match is None else match[1]


def _wheel(folder: Path, extra: str, *programs: list[str]) -> list[list[str]]:
    """Return the commands that build a wheel, install it into an empty environment, and run Python programs there."""
    place = OUT / folder.name
    python = place / "environment" / "bin" / "python"
    constraints = ["--constraint", str(ROOT / "constraints.txt")]
    pip = [str(python), "-m", "pip", "install", "--quiet", *constraints]
    return [
        [sys.executable, "-m", "venv", "--clear", str(place / "environment")],
        [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(place), str(folder)],
        ["sh", "-c", '"$@" "$(ls -t "$0"/*.whl | head -n 1)"' + f'"{extra}"', str(place), *pip],
        *([str(python), "-P", *program] for program in programs),
    ]


def _small_file() -> list[list[str]]:
    """Return the programs that put a small file on pages, simulate the device's frames and read the file back."""
    pages, shown, read = (str(OUT / ROOT.name / name) for name in ("pages.h5", "shown.h5", "LICENSE"))
    licence = str(ROOT / "LICENSE")
    command = ["-m", "lightpage"]
    return [
        [*command, "encode", licence, "--bundle", "bench", "--force", "--out", pages],
        [*command, "simulate", "--symbols", pages, "--seed", "2", "--force", "--out", shown],
        [*command, "recover", "--recording", shown, "--out", read],
        ["-c", "import filecmp, sys; sys.exit(not filecmp.cmp(*sys.argv[1:], shallow=False))", licence, read],
    ]


STEPS: Mapping[str, Callable[[], list[list[str]]]] = {
    "wheel": lambda: _wheel(ROOT, "[cpu]", *_small_file()),
    "client": lambda: _wheel(
        ROOT / "clients" / "python", "", ["-c", "from lightpage_client import LightpageClient; print(LightpageClient)"]
    ),
    "site": lambda: [["make", "site"]],
    "notebooks": lambda: [[str(BIN / "pytest"), "-n", "0", "-q", "tests/system/test_notebooks.py"]],
    "image": lambda: [["make", "image", "sbom", "check-image", "LIGHTPAGE_BUILDER=buildah"]],
    "planted": lambda: [["make", "planted"]],
}
"""Commands of each step but the first, `versions`."""


def done(name: str) -> str:
    """Do a step; returns what is wrong, empty where nothing is."""
    if name == "versions":
        return "; ".join(versions())
    log = OUT / f"{name}.log"
    with log.open("w") as file:
        for words in STEPS[name]():
            file.write(f"$ {' '.join(words)}\n")
            file.flush()
            try:
                longest = _LONGEST_S.get(name, _OTHERS_S)
                status = subprocess.run(words, cwd=ROOT, stdout=file, stderr=file, timeout=longest, check=False)
            except (OSError, subprocess.TimeoutExpired) as error:
                return str(error)
            if status.returncode != 0:
                return f"status {status.returncode}, see {log.relative_to(ROOT)}"
    return ""


def main(names: list[str]) -> int:
    """Go through the named steps, all by default; returns the exit status."""
    known = ["versions", *STEPS]
    if wrong := [name for name in names if name not in known]:
        print(f"check_release: got {', '.join(wrong)}, wanted some of {', '.join(known)}", file=sys.stderr)
        return 2
    OUT.mkdir(parents=True, exist_ok=True)
    failed = False
    for name in names or known:
        begun = time.monotonic()
        trouble = done(name)
        failed |= bool(trouble)
        print(f"{name:<10} {trouble or 'holds'} ({time.monotonic() - begun:.0f} s)", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
