"""Nothing is sent to anybody, and setuptools finds every folder of code."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.skips import NO_FILTERS

ROOT = Path(__file__).resolve().parents[2]
NO_INTERNET = """
import ctypes, os, platform, signal, socket, struct, sys
number = {"x86_64": 41, "aarch64": 198}[platform.machine()]  # of the system call socket(family, ...)
# A filter in the kernel: whoever asks for a socket of the internet's families ends this process.
load, equal, answer = 0x20, 0x15, 0x06
steps = [
    (load, 0, 0, 0), (equal, 0, 3, number),
    (load, 0, 0, 16), (equal, 2, 0, socket.AF_INET), (equal, 1, 0, socket.AF_INET6),
    (answer, 0, 0, 0x7FFF0000), (answer, 0, 0, 0x80000000),
]
program = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *step) for step in steps))
class Filter(ctypes.Structure):
    _fields_ = [("length", ctypes.c_ushort), ("steps", ctypes.c_void_p)]
filter = Filter(len(steps), ctypes.addressof(program))
libc = ctypes.CDLL(None)
if libc.prctl(38, 1, 0, 0, 0) or libc.prctl(22, 2, ctypes.byref(filter), 0, 0):
    sys.exit("no filters here")
child = os.fork()
if child == 0:
    socket.socket(socket.AF_INET)
    os._exit(0)
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGSYS
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.decoder import Decoder
decoder = Decoder(Bundle.open(sys.argv[1]))
decoder.decode(decoder.bundle.golden.pair, 16)
"""


def test_decoding_asks_for_no_connection_to_anybody(toy_zip: Path) -> None:
    command = [sys.executable, "-c", NO_INTERNET, str(toy_zip)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    if done.stderr.strip() == "no filters here":
        pytest.skip(NO_FILTERS)
    assert done.returncode == 0, done.stderr


def test_every_folder_of_code_is_a_package() -> None:
    """Setuptools leaves a folder without `__init__.py` out of the image, and here nobody would notice."""
    walked = list(os.walk(ROOT / "lightpage", followlinks=True))
    folders = [Path(folder) for folder, _, names in walked if any(name.endswith(".py") for name in names)]
    assert [str(folder.relative_to(ROOT)) for folder in folders if not (folder / "__init__.py").exists()] == []
