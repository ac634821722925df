"""The processes of one training: Lightning's own strategies, and what each process may know before they have met."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import torch

from lightpage.clock import SYSTEM, Clock
from lightpage.errors import InvalidInputError, LightpageError
from lightpage.progress import State
from lightpage.systems import cores

if TYPE_CHECKING:
    from lightning.fabric.plugins.environments.cluster_environment import ClusterEnvironment

T = TypeVar("T")

AUTO, DDP = "auto", "ddp"
STRATEGIES = (AUTO, DDP)

_MOST_ON_A_NODE = 1024
_MEETING = ("MASTER_ADDR", "MASTER_PORT", "NODE_RANK")
_PATIENCE_S, _LOOK_S = 1800.0, 0.2
"""Longest wait of a process for the next piece of another's work, and time between two looks."""


@dataclass(frozen=True)
class Processes:
    """The processes of one training, a GPU each where there are any.

    Attributes:
        devices: number of devices of each node; "auto" for all GPUs, or one process without one.
        nodes: machines.
        strategy: name out of `STRATEGIES`.
        compute: device of the only process, `cpu`, `cuda` or `cuda:N`; chosen by `devices` if left out.
    """

    devices: int | str = AUTO
    nodes: int = 1
    strategy: str = AUTO
    compute: str = ""

    @property
    def accelerator(self) -> str:
        """Lightning's name of the kind of device."""
        kind = self.compute.partition(":")[0]
        return {"": AUTO, "cuda": "gpu"}.get(kind, kind)

    @property
    def chosen_devices(self) -> int | str | list[int]:
        """Number of devices, or those that are chosen, as Lightning takes them."""
        _, _, number = self.compute.partition(":")
        return [int(number or 0)] if self.accelerator == "gpu" else self.devices

    @property
    def device(self) -> torch.device:
        """Device on which the first process prepares pages."""
        if self.accelerator == AUTO:
            return torch.device("cuda" if torch.cuda.is_available() else "cpu")
        return torch.device(self.compute)

    def checked(self) -> Processes:
        """Check the processes, and return them as `torchrun` says if that has started this process.

        Raises:
            InvalidInputError: more devices than there are, nodes that cannot meet, or others than `torchrun` started.
        """
        if _by_torchrun():
            return self._as_started()
        if self.devices != AUTO:
            self._check_devices(int(self.devices))
        given = {name: value for name in _MEETING if (value := os.environ.get(name, ""))}
        if self.nodes > 1 and len(given) < len(_MEETING):
            got = f"no {', '.join(name for name in _MEETING if name not in given)}"
            expected = "in the environment: MASTER_ADDR and MASTER_PORT of the first node, and NODE_RANK of this one"
            raise InvalidInputError(f"--nodes {self.nodes}", got, expected)
        for name, most in (("MASTER_PORT", 65535), ("NODE_RANK", self.nodes - 1)):
            value = given.get(name, "0")
            if not (value.isdecimal() and int(value) <= most):
                raise InvalidInputError(f"--nodes {self.nodes}: {name}", value, f"0 to {most}")
        return self

    def environment(self) -> ClusterEnvironment:
        """Return the environment by which the processes find each other."""
        from lightning.fabric.plugins.environments.lightning import LightningEnvironment
        from lightning.fabric.plugins.environments.torchelastic import TorchElasticEnvironment

        return TorchElasticEnvironment() if _by_torchrun() else LightningEnvironment()

    def _as_started(self) -> Processes:
        there, all_of_them = int(os.environ["LOCAL_WORLD_SIZE"]), int(os.environ["WORLD_SIZE"])
        nodes = all_of_them // there
        for flag, asked, started in (("--devices", self.devices, there), ("--nodes", self.nodes, nodes)):
            if asked not in (AUTO, 1, started):
                raise InvalidInputError(flag, asked, f"{started}, as torchrun has started, or nothing")
        self._check_devices(there)
        return Processes(there, nodes, self.strategy)

    @staticmethod
    def _check_devices(devices: int) -> None:
        if torch.cuda.is_available():
            there, what = torch.cuda.device_count(), "GPUs"
        else:
            there, what = cores(), "cores, without a GPU"
        if devices > there:
            raise InvalidInputError("--devices", devices, f"at most {there}: this machine's {what}")


AS_IT_IS = Processes()
"""All GPUs of this machine, or one process."""

ONE = Processes(1)


def process_number() -> int:
    """Return this process's number, which is unique; it is 0 for the first process of the first node."""
    if _by_torchrun():
        return int(os.environ["RANK"])
    return _MOST_ON_A_NODE * int(os.environ.get("NODE_RANK") or 0) + int(os.environ.get("LOCAL_RANK") or 0)


def is_first_process() -> bool:
    """Return whether this is the process that writes, and shows progress."""
    return process_number() == 0


def wait_for_first(done: Callable[[], int], count: int, what: str, clock: Clock = SYSTEM) -> None:
    """Wait for work of the first process, so long as any of it is done.

    Args:
        done: how much is there.
        count: amount of work that is waited for.
        what: name of the work, for the error.
        clock: clock to wait by.

    Raises:
        LightpageError: no more has come for half an hour.
    """
    seen, since = -1, clock.now()
    while (now := done()) < count:
        if now != seen:
            seen, since = now, clock.now()
        if clock.now() - since > _PATIENCE_S:
            expected = "the first process at work in the same folder: --out on storage that every node sees"
            raise LightpageError(what, f"{now} of {count}, and no more for {_PATIENCE_S:.0f} s", expected)
        clock.sleep(_LOOK_S)


class Silence:
    """Shows nothing: what the first process shows is enough; see `lightpage.progress.Reporter`."""

    def track(
        self, items: Iterable[T], what: str, unit: str, total: int | None, done: int, state: State
    ) -> Iterable[T]:
        """See `Reporter`."""
        return items

    def note(self, what: str) -> None:
        """See `Reporter`."""


def _by_torchrun() -> bool:
    return "TORCHELASTIC_RUN_ID" in os.environ
