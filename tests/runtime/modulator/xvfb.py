"""X servers without a monitor, and what they have on their screens."""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

ROWS, COLUMNS = 800, 1280
ENDED_S = 60


class XServer:
    """An Xvfb that runs: `display` is its name, e.g. ``:3``."""

    def __init__(self, folder: Path, *options: str) -> None:
        if shutil.which("Xvfb") is None:
            pytest.skip("no Xvfb (apt-get install xvfb)")
        folder.mkdir(exist_ok=True)
        self._folder = folder
        ours, its = os.pipe()
        with os.fdopen(ours) as reader:
            command = ["Xvfb", "-displayfd", str(its), "-nolisten", "tcp", "-fbdir", str(folder), *options]
            self._process = subprocess.Popen(command, pass_fds=[its], stderr=subprocess.DEVNULL)
            os.close(its)
            self.display = ":" + reader.readline().strip()  # an Xvfb that ends closes its end
        assert self.display != ":"

    def picture(self, screen: int = 0) -> NDArray[np.uint8]:
        """What is on its screen, by the server itself: red, green and blue [row, column, 3]."""
        content = (self._folder / f"Xvfb_screen{screen}").read_bytes()
        head = struct.unpack(">25I", content[:100])
        columns, rows, row_bytes, colours = head[4], head[5], head[12], head[19]
        start = head[0] + colours * 12
        pixels = np.frombuffer(content, np.uint8, rows * row_bytes, start).reshape(rows, row_bytes // 4, 4)
        return pixels[:, :columns, 2::-1]

    def greys(self, screen: int = 0) -> NDArray[np.uint8]:
        """The same of a screen that is grey all over: [row, column]."""
        picture = self.picture(screen)
        assert (picture == picture[..., :1]).all()
        return picture[..., 0]

    def end(self) -> None:
        self._process.kill()
        self._process.wait(ENDED_S)


@contextmanager
def x_server(folder: Path, *options: str) -> Iterator[XServer]:
    """An X server with one screen of ROWS x COLUMNS, or with other options."""
    server = XServer(folder, *(options or ("-screen", "0", f"{COLUMNS}x{ROWS}x24")))
    try:
        yield server
    finally:
        server.end()
