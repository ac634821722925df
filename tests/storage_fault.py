"""Storage that fails while a flag is up, for processes that a test starts: `storage_fault.c`, preloaded."""

from __future__ import annotations

import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

SOURCE = Path(__file__).with_suffix(".c")


@dataclass(frozen=True)
class StorageFault:
    """A fault that processes started with `environment` meet while `flag` exists."""

    flag: Path
    environment: dict[str, str]

    @classmethod
    def compiled(cls, folder: Path, name: str, error: int, least_bytes: int) -> StorageFault:
        """Compile it into `folder`; it hits files whose path holds `name`, their opening while `FAULT_OPEN` is set."""
        compiler = shutil.which("cc") or shutil.which("gcc")
        if compiler is None:
            pytest.skip("no C compiler")
        library, flag = folder / "fault.so", folder / "fault"
        subprocess.run([compiler, "-shared", "-fPIC", "-o", library, SOURCE, "-ldl"], check=True, timeout=60)
        told = {"LD_PRELOAD": library, "FAULT_FLAG": flag, "FAULT_NAME": name, "FAULT_ERRNO": error}
        told |= {"FAULT_LEAST": least_bytes, "FAULT_OPEN": 1}
        return cls(flag, {**os.environ, **{key: str(value) for key, value in told.items()}})
