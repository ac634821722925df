"""Whoever only calls the service loads nothing that only the service needs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
HEAVY = {"onnxruntime", "scipy", "matplotlib", "h5py", "pydantic", "torch", "PIL", "reedsolo", "click", "google_crc32c"}


def test_the_client_loads_nothing_heavy() -> None:
    script = """
import sys
import runtime.client.client
print(*sorted({name.partition(".")[0] for name in sys.modules}))
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    loaded = set(done.stdout.split())
    assert {"grpc", "numpy", "runtime"} <= loaded
    assert loaded & HEAVY == set()
