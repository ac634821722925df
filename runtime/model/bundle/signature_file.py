"""Where the detached signature of a bundle lies, and how it is read."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from lightpage.errors import BundleError
from lightpage.failures import os_failure

SUFFIX = ".sig"
"""Behind the name of a bundle, the name of its signature."""

MOST_BYTES = 1 << 10
"""A signature is less than a hundred bytes."""


def signature_path(bundle: Path) -> Path:
    """Where the signature of a bundle lies."""
    return bundle.with_name(bundle.name + SUFFIX)


def read_signature(bundle: Path) -> bytes:
    """The signature beside a bundle; empty where there is none.

    Raises:
        BundleError: it is no plain file, or cannot be read.
    """
    path, expected = signature_path(bundle), "a plain file that can be read"
    try:
        # The kernel refuses a link, and nobody waits for whoever writes to a pipe.
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        with os.fdopen(descriptor, "rb") as file:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise BundleError(f"signature {path}", "no plain file", expected)
            return file.read(MOST_BYTES)
    except FileNotFoundError:
        return b""
    except OSError as error:
        raise os_failure(f"signature {path}", error, expected, BundleError) from None
