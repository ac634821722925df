"""A Prometheus of one's own on this machine, for a while."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import tempfile
import time
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path
from typing import Any, Self

from lightpage.errors import InvalidInputError

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
_READY_S = 60.0
_ANSWER_S = 30.0
_END_S = 20.0


class RunningPrometheus:
    """Debian's `prometheus` with the configuration of this repository, on a free port; use it in a `with` statement.

    Args:
        target: HOST:PORT to scrape, in place of the configuration's.
        interval_s: between two scrapes.

    Raises:
        InvalidInputError: there is no program `prometheus`.
    """

    def __init__(self, target: str, interval_s: int = 1) -> None:
        program = shutil.which("prometheus")
        if program is None:
            raise InvalidInputError("program prometheus", "none", "one: apt-get install prometheus")
        self._program, self._folder = program, tempfile.TemporaryDirectory(prefix="lightpage-")
        folder = Path(self._folder.name)
        text = (DEPLOY / "prometheus" / "prometheus.yml").read_text("utf-8")
        text = text.replace("lightpage:9100", target).replace("interval: 5s", f"interval: {interval_s}s")
        (folder / "prometheus.yml").write_text(text.replace("interval: 15s", f"interval: {interval_s}s"), "utf-8")
        shutil.copy(DEPLOY / "prometheus" / "rules.yml", folder)
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._address = f"127.0.0.1:{free.getsockname()[1]}"

    def __enter__(self) -> Self:
        folder = self._folder.name
        self._log = open(Path(folder) / "log", "w")  # closed with it
        self._process = subprocess.Popen(
            [
                self._program,
                f"--config.file={folder}/prometheus.yml",
                f"--storage.tsdb.path={folder}/data",
                f"--web.listen-address={self._address}",
            ],
            stdout=self._log,
            stderr=subprocess.STDOUT,
        )
        until = time.monotonic() + _READY_S
        while time.monotonic() < until and self._process.poll() is None:
            try:
                with urllib.request.urlopen(f"http://{self._address}/-/ready", timeout=_ANSWER_S):
                    return self
            except (urllib.error.URLError, OSError):
                time.sleep(0.2)
        self.__exit__()
        raise RuntimeError("prometheus did not become ready")

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._log.close()
        self._folder.cleanup()

    def over(self, expression: str, start: float, end: float, step_s: float) -> list[dict[str, Any]]:
        """Series of an expression, as the HTTP API gives them: `metric` and `values`, pairs of time and text.

        Raises:
            ValueError: the expression cannot be evaluated.
        """
        asked = {"query": expression, "start": start, "end": end, "step": step_s}
        url = f"http://{self._address}/api/v1/query_range?{urllib.parse.urlencode(asked)}"
        try:
            with urllib.request.urlopen(url, timeout=_ANSWER_S) as reply:
                found: list[dict[str, Any]] = json.load(reply)["data"]["result"]
        except urllib.error.HTTPError as error:
            raise ValueError(f"{expression}: {error.read().decode()}") from None
        return found
