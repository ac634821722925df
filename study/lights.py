"""Light of simulated devices that several cases of a study share, made where they compute, and held there."""

from __future__ import annotations

from dataclasses import dataclass, field

from lightpage.device.profile import Profile
from lightpage.device.state import Device
from lightpage.progress import Progress
from lightpage.simulator.light_bound import mean_information, sampled_concentrations
from lightpage.simulator.simulator import Simulator
from lightpage.train.data.torch_engine import TorchEngine
from lightpage.train.published.held_pages import MadePages

LEVELS = 256


@dataclass(frozen=True)
class DataSet:
    """A simulated device, on whose pages several decoders are trained.

    Attributes:
        profile, device: nominal and true.
        levels: M of its pages.
    """

    profile: Profile
    device: Device
    levels: int = LEVELS


@dataclass
class Lights:
    """Pages of the latest data set: those of one fill most of a GPU's memory at full size.

    Attributes:
        compute: where they are made and held, `cpu`, `cuda` or `cuda:N`.
    """

    compute: str = "cpu"
    _latest: tuple[tuple[object, ...], MadePages] | None = field(default=None, repr=False)

    def of(self, data_set: DataSet, count: int, seed: int, progress: Progress) -> MadePages:
        """So many pages of a data set, made if they are not held.

        Raises:
            InvalidInputError: no such device to compute on.
        """
        key = (data_set, count, seed)
        if self._latest is None or self._latest[0] != key:
            self._latest = None  # before the next ones take its place
            simulator = Simulator(
                data_set.profile, data_set.device, data_set.levels, seed, engine=TorchEngine(self.compute)
            )
            self._latest = key, MadePages.of(simulator, count, progress)
        return self._latest[1]

    def release(self) -> None:
        """Give the memory of the pages back."""
        self._latest = None

    def bound(self, data_set: DataSet, pages: int, symbols: int, seed: int, progress: Progress) -> tuple[float, float]:
        """Return the bound of a data set's light, over so many symbols of so many pages, and its standard error, bits.

        Raises:
            InvalidInputError: no such device to compute on.
        """
        found, engine = list[float](), TorchEngine(self.compute)
        for page in range(pages):
            for concentration in sampled_concentrations(
                data_set.profile, data_set.device, data_set.levels, symbols, (seed, page), engine
            ):
                found.append(concentration)
                progress("bound", len(found) / (pages * symbols))
        return mean_information(found, data_set.levels, seed)
