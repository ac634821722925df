"""A service with a toy device, all its parts in reach."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import grpc
import numpy as np

from lightpage.recording.frame_pair import FramePair
from runtime.client.client import LightpageClient
from runtime.pb.lightpage.v1 import lightpage_pb2_grpc as pb_grpc
from runtime.rpc.server import LightpageServer
from runtime.service.dataplane import DataPlane
from runtime.service.recalibrator import Recalibrator
from tests.runtime import toy


@dataclass
class Running:
    """A service with all its parts in reach."""

    plane: DataPlane
    recalibrator: Recalibrator
    server: LightpageServer
    source: toy.ToySource
    client: LightpageClient

    @property
    def device(self) -> toy.ToyDevice:
        return self.source.device

    def count(self, name: str, **labels: str) -> float:
        """What the service's metrics say."""
        return self.plane.metrics.registry.get_sample_value(name, labels) or 0.0

    def stub(self, channel: grpc.Channel) -> pb_grpc.LightpageStub:
        return pb_grpc.LightpageStub(channel)


Start = Callable[..., Running]


def wait_until(condition: Callable[[], bool], seconds: float = 10.0) -> bool:
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        if condition():
            return True
        time.sleep(0.01)
    return condition()


def a_page(levels: int = 16, seed: int = 3) -> tuple[np.ndarray, FramePair]:
    symbols = toy.symbols_of(levels, seed)[0]
    return symbols, toy.ToyDevice(seed=seed).page(symbols, levels, 0.7)
