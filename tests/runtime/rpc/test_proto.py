"""The committed stubs are those that the contract generates."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]


def stubs(folder: Path) -> dict[str, str]:
    paths = [path for path in folder.rglob("*.py*") if path.suffix in (".py", ".pyi")]
    return {str(path.relative_to(folder)): path.read_text("utf-8") for path in paths}


def test_the_committed_stubs_are_what_the_contract_generates(tmp_path: Path) -> None:
    generate = [sys.executable, ROOT / "proto" / "generate.py", tmp_path]
    subprocess.run(generate, check=True, capture_output=True, timeout=60)
    assert stubs(tmp_path) == stubs(ROOT / "runtime" / "pb"), "run python proto/generate.py"
