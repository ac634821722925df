"""The servers, each with a mark in its environment, by which all processes that it has started are found."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from types import TracebackType
from typing import Self

import grpc

import analysis
from analysis.service.other_servers.calls import Call
from analysis.service.other_servers.graphs import Graph
from lightpage.errors import LightpageError

MARK = "LIGHTPAGE_BENCH_SERVER"
"""Variable of the environment that all processes of one server share."""
_QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "OTEL_SDK_DISABLED": "true",
    "ORT_DISABLE_TELEMETRY": "1",
    "DO_NOT_TRACK": "1",
}
"""Nothing is reported to anybody."""
_ROOT = Path(analysis.__file__).parents[1]
_START_S = 180.0
_STOP_S = 15.0
_KILL_S = 5.0
_LOOK_S = 0.2
_LAST_LINES = 2000
_TICKS = os.sysconf("SC_CLK_TCK")


class Marked:
    """Processes that share a mark.

    Attributes:
        mark: value of `MARK` in their environments.
    """

    def __init__(self) -> None:
        self.mark = uuid.uuid4().hex

    def ids(self) -> list[int]:
        """Return the numbers of the marked processes that run now."""
        wanted, found = f"{MARK}={self.mark}".encode(), []
        for folder in Path("/proc").iterdir():
            if folder.name.isdigit():
                with suppress(OSError):  # it has ended, or is another user's
                    if wanted in (folder / "environ").read_bytes().split(b"\0"):
                        found.append(int(folder.name))
        return found

    def cpu_s(self) -> float:
        """CPU seconds of those that run now."""
        total = 0
        for each in self.ids():
            with suppress(OSError):
                fields = Path(f"/proc/{each}/stat").read_text().rpartition(")")[2].split()
                total += int(fields[11]) + int(fields[12])
        return total / _TICKS

    def resident_bytes(self) -> int:
        """Memory of all; what they share counts for each."""
        total = 0
        for each in self.ids():
            with suppress(OSError):
                total += int(Path(f"/proc/{each}/statm").read_text().split()[1])
        return total * resource.getpagesize()

    def end(self) -> None:
        """End those that still run."""
        for number in (signal.SIGTERM, signal.SIGKILL):
            end = time.monotonic() + _KILL_S
            for each in self.ids():
                with suppress(ProcessLookupError):
                    os.kill(each, number)
            while self.ids() and time.monotonic() < end:
                time.sleep(_LOOK_S)


class OtherServer:
    """A server in an environment of its own; use it in a `with` statement.

    Args:
        name: name of the server.
        command: command that starts it.
        folder: folder that it works in, and writes NAME.log to.
        caller: connects a caller to it.
        environment: variables beside those of this process.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        folder: Path,
        caller: Callable[[Graph], AbstractContextManager[Call]],
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self.name, self.caller, self.marked = name, caller, Marked()
        self._command, self._folder, self._log = list(command), folder, folder / f"{name}.log"
        self._environment = {**os.environ, **_QUIET, **(environment or {})}
        # Stubs pickle their messages as of a package `inference`.
        python_path = os.pathsep.join((str(_ROOT), str(_ROOT / "runtime" / "pb")))
        self._environment |= {"PYTHONPATH": python_path, MARK: self.marked.mark}
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> Self:
        """Start it; `wait` says when it serves."""
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                self._command,
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                cwd=self._folder,
                env=self._environment,
            )
        return self

    def wait(self, graph: Graph) -> None:
        """Wait until the server answers a call.

        Raises:
            LightpageError: it has ended, or never answers.
        """
        assert self._process is not None  # it was started
        end, got = time.monotonic() + _START_S, "no answer"
        while time.monotonic() < end:
            if (status := self._process.poll()) is not None:
                got = f"exit status {status}"
                break
            try:
                with self.caller(graph) as call:
                    call()
                return
            except grpc.RpcError as error:
                got = f"{error.code().name}: {error.details()}"
            except OSError as error:
                got = str(error)
            time.sleep(_LOOK_S)
        tail = self._log.read_text("utf-8", "replace")[-_LAST_LINES:]
        raise LightpageError(f"{self.name}", f"{got}\n{tail}", "an answer")

    def stop(self) -> None:
        """End it, and all that it has started."""
        if self._process is None:
            return
        assert self._process.stdin is not None  # asked for
        self._process.stdin.close()
        self._process.terminate()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_STOP_S)
        self.marked.end()
        self._process.wait(_KILL_S)

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()
