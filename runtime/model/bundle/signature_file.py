"""The detached signature of a bundle: its path and its reader."""

import os
import stat
from pathlib import Path

from lightpage.errors import BundleError
from lightpage.failures import os_failure

SUFFIX = ".sig"
"""Behind the name of a bundle, the name of its signature."""

MOST_BYTES = 1 << 10
"""A signature is less than a hundred bytes."""

_HOW = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
"""Windows has neither."""


def signature_path(bundle: Path) -> Path:
    """Return where the signature of a bundle lies."""
    return bundle.with_name(bundle.name + SUFFIX)


def read_signature(bundle: Path) -> bytes:
    """The signature beside a bundle; empty where there is none.

    Raises:
        BundleError: it is no plain file, or cannot be read.
    """
    path = signature_path(bundle)
    try:
        return read_plain_file(path, MOST_BYTES, f"signature {path}")
    except FileNotFoundError:
        return b""
    except OSError as error:
        raise os_failure(f"signature {path}", error, "a plain file that can be read", BundleError) from None


def read_plain_file(path: Path | str, most_bytes: int, subject: str) -> bytes:
    """The first bytes of a file; a link is refused, and nobody waits for whoever writes to a pipe.

    Raises:
        BundleError: it is no plain file.
        OSError: it cannot be read, or is a link.
    """
    if not _HOW and os.path.islink(path):
        raise BundleError(subject, "a link", "a plain file")
    descriptor = os.open(path, os.O_RDONLY | _HOW | getattr(os, "O_BINARY", 0))
    with os.fdopen(descriptor, "rb") as file:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise BundleError(subject, "no plain file", "a plain file")
        return file.read(most_bytes)
