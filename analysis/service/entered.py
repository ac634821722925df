"""Notes which functions of the project are entered, in this process (`tracing`) or in programs it starts (`Traced`).

What runs while a module is imported does not count, nor do the bodies of classes, nor comprehensions, which are a part
of the function around them. A generator or a coroutine counts once, when it begins.
"""

from __future__ import annotations

import atexit
import json
import mmap
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import astuple, dataclass, replace
from inspect import CO_OPTIMIZED
from opcode import opmap
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

ROOT = Path(__file__).resolve().parents[2]

_FOLDER = "LIGHTPAGE_ENTERED"
"""Variable that names the folder of a program that is traced."""
_SWITCH = "switch"
_OTHER = (".", f"analysis{os.sep}", f"tests{os.sep}")
"""Beginnings of paths in the repository that serve nothing, those of an environment's packages among them."""
_START = bytes([opmap["RESUME"], 0])
"""Instruction at which a function begins; a generator or a coroutine goes on at a RESUME of another number. Source:
module `dis`."""
_PARTS = frozenset(["<listcomp>", "<setcomp>", "<dictcomp>", "<genexpr>"])


@dataclass(frozen=True)
class Entry:
    """A function that was entered.

    Attributes:
        moment: time of the first entry, `time.monotonic` seconds, which all processes of a machine share.
        file: path in the repository.
        function: qualified name, without functions inside it.
        calls: how often it was entered, lambdas and functions inside it counted with it.
        caller: path of the file of the project that entered it first; empty where a library or a thread did.
    """

    moment: float
    file: str
    function: str
    calls: int
    caller: str


class Recorder:
    """Notes the functions of the project that are entered while the byte that it watches is set.

    Args:
        switch: byte, which another process may set.
    """

    def __init__(self, switch: mmap.mmap | bytearray) -> None:
        self._switch, self._root = switch, f"{ROOT}{os.sep}"
        self._here = threading.local()
        self._entered: list[tuple[float, CodeType, CodeType | None]] = []

    def install(self) -> None:
        """Watch this thread, and all that are started from now on."""
        threading.setprofile(self._event)
        sys.setprofile(self._event)

    def entries(self) -> list[Entry]:
        """The functions that were entered, in order of the first time."""
        found: dict[tuple[str, str], Entry] = {}
        for moment, code, caller in self._entered:
            key = self._file(code), code.co_qualname.partition(".<locals>.")[0]
            if key in found:
                found[key] = replace(found[key], calls=found[key].calls + 1)
            else:
                found[key] = Entry(moment, *key, 1, "" if caller is None else self._file(caller))
        return sorted(found.values(), key=lambda entry: entry.moment)

    def _event(self, frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event not in ("call", "return"):
            return
        if code.co_name == "<module>":
            if frame.f_globals.get("__name__") != "__main__":
                self._here.imports = max(0, self._imports + (1 if event == "call" else -1))
        elif (
            event == "call"
            and self._switch[0]
            and code.co_code[frame.f_lasti : frame.f_lasti + 2] == _START
            and code.co_flags & CO_OPTIMIZED  # or it is the body of a class
            and code.co_name not in _PARTS
            and self._is_own(code)
            and not self._imports
        ):
            back = frame.f_back
            while back is not None and not self._is_own(back.f_code):
                back = back.f_back
            self._entered.append((time.monotonic(), code, None if back is None else back.f_code))

    def _is_own(self, code: CodeType) -> bool:
        """True for code of the project that serves."""
        if not code.co_filename.startswith(self._root):
            return False
        file = self._file(code)
        return not file.startswith(_OTHER) and "_pb2" not in file

    def _file(self, code: CodeType) -> str:
        return code.co_filename.removeprefix(self._root)

    @property
    def _imports(self) -> int:
        """Modules that this thread is importing, one within the other."""
        return getattr(self._here, "imports", 0)


class Traced:
    """Programs that note what they enter while `entered` says so.

    Args:
        folder: empty, for what they note.

    Attributes:
        environment: variables that make a program, and those that it starts, such ones.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        (folder / _SWITCH).write_bytes(b"\0")
        (folder / "sitecustomize.py").write_text(f"from {__name__} import follow\n\nfollow()\n")
        paths = [str(folder), str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
        self.environment = {_FOLDER: str(folder), "PYTHONPATH": os.pathsep.join(paths)}

    @contextmanager
    def entered(self) -> Iterator[None]:
        """Have the programs note what they enter in the `with` statement."""
        with (self._folder / _SWITCH).open("r+b") as file, mmap.mmap(file.fileno(), 1) as switch:
            switch[0] = 1
            try:
                yield
            finally:
                switch[0] = 0

    def entries(self) -> list[Entry]:
        """The functions that all of them entered, in order of the first time, once they have ended."""
        noted = [Entry(*one) for file in self._folder.glob("*.json") for one in json.loads(file.read_text())]
        return sorted(noted, key=lambda entry: entry.moment)


@contextmanager
def tracing() -> Iterator[Recorder]:
    """Yields a recorder of the functions that this process enters in the `with` statement."""
    switch = bytearray([1])
    recorder = Recorder(switch)
    recorder.install()
    try:
        yield recorder
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
        switch[0] = 0  # of threads that go on


def follow() -> None:
    """Make this process one of `Traced`, if its environment says so."""
    if (name := os.environ.get(_FOLDER)) is None:
        return
    folder = Path(name)
    with (folder / _SWITCH).open("r+b") as file:
        recorder = Recorder(mmap.mmap(file.fileno(), 1, access=mmap.ACCESS_READ))

    def write() -> None:
        noted = [astuple(entry) for entry in recorder.entries()]
        (folder / f"{os.getpid()}.json").write_text(json.dumps(noted))

    atexit.register(write)
    recorder.install()
