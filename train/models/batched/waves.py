"""The wave model of a device for many pages: two lenses and the pipe, one way."""

from __future__ import annotations

from torch import Tensor, nn

from lightpage.train.models.batched.lens import BatchedLens
from lightpage.train.models.batched.pipe import BatchedPipe
from lightpage.train.models.batched.products import Tables
from lightpage.train.models.waves import Waves


class BatchedWaves(nn.Module):
    """Modulator to the sparse samples of the common grid, or back, as `lightpage.train.models.waves.Waves` does.

    A GPU is many times as fast by its few large products as by the small ones of `Waves`; a CPU takes longer.

    Args:
        waves: the model, for its sampling.
        to_page: whether light goes back.
    """

    def __init__(self, waves: Waves, *, to_page: bool) -> None:
        super().__init__()
        self.model, self.to_page = waves, to_page
        first, last = (waves.delaunch, waves.launch) if to_page else (waves.launch, waves.delaunch)
        self.first = BatchedLens(first, to_plane=False)
        self.pipe = BatchedPipe(waves.geometry, waves.cells, waves.fidelity.pipe, backwards=to_page)
        self.last = BatchedLens(last, to_plane=True)

    def tables(self, parameters: Tensor, blur: Tensor | float = 0.0) -> Tables:
        """Constants of a device, float64, by its parameters [P] and the modulator's blur: see `Waves.matrices`."""
        blur = blur.double() if isinstance(blur, Tensor) else blur
        sparse = self.model.sparse_x_m, self.model.sparse_y_m
        launch, camera = self.model.lenses(parameters.double(), blur, sparse)
        first, last = (camera, launch) if self.to_page else (launch, camera)
        tables, into, out = self.pipe.tables(launch.geometry)
        parts = {"first": self.first.tables(first, into), "pipe": tables, "last": self.last.tables(last, out)}
        return {f"{part}.{name}": value for part, made in parts.items() for name, value in made.items()}

    def forward(self, field: Tensor, tables: Tables) -> Tensor:
        """A field on one plane [B, 2, ny, nx] to that on the other."""
        first, pipe, last = (of_part(tables, part) for part in ("first", "pipe", "last"))
        return self.last.to_plane(self.pipe(self.first.to_modes(field, first), pipe), last)


def of_part(tables: Tables, part: str) -> Tables:
    """The constants of one part, by their names within it."""
    return {name.removeprefix(f"{part}."): value for name, value in tables.items() if name.startswith(f"{part}.")}
