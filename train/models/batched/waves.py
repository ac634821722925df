"""The wave model of a device for many pages: two lenses and the pipe, one way."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lightpage.calibration.parameters import NAMES
from lightpage.calibration.waves.wave_model import fitted_camera_phase, fitted_geometry, fitted_launch_phase
from lightpage.train.models.batched import functions
from lightpage.train.models.batched.lens import BatchedLens, Facet
from lightpage.train.models.batched.pipe import BatchedPipe
from lightpage.train.models.batched.products import Tables
from lightpage.train.models.waves import Waves
from lightpage.waves.lens import entrance_window


class BatchedWaves(nn.Module):
    """Modulator to the sparse samples of the common grid, or back, as `lightpage.train.models.waves.Waves` does.

    Args:
        waves: the model, for its sampling.
        to_page: whether light goes back.
    """

    def __init__(self, waves: Waves, *, to_page: bool) -> None:
        super().__init__()
        self.model, self.to_page = waves, to_page
        geometry = waves.geometry
        page, sparse = waves.planes
        launch = geometry, geometry.lens_path, page, waves.cells, waves.launch
        camera = geometry, geometry.camera_path, sparse, waves.cells, waves.delaunch
        first, last = (camera, launch) if to_page else (launch, camera)
        self.first = BatchedLens(*first, to_plane=False)
        self.pipe = BatchedPipe(geometry, waves.cells, waves.fidelity.pipe, backwards=to_page)
        self.last = BatchedLens(*last, to_plane=True)

    def tables(self, parameters: Tensor) -> Tables:
        """Constants of a device with parameters [P], float64."""
        model = self.model
        value = dict(zip(NAMES, parameters.double().unbind(), strict=True))
        geometry = fitted_geometry(model.profile, value)
        page_x, page_y = model.x_m.double(), model.y_m.double()
        sparse_x, sparse_y = model.sparse_x_m.double(), model.sparse_y_m.double()
        x, y = page_x + value["page_centre_x_m"], page_y + value["page_centre_y_m"]
        at_launch = fitted_launch_phase(model.profile, value, geometry, page_x[None, :], page_y[:, None])
        at_launch = at_launch + geometry.lens_path.of_field(x[None, :], y[:, None])
        at_camera = fitted_camera_phase(model.profile, value, geometry, sparse_x[None, :], sparse_y[:, None])
        at_camera = at_camera - geometry.camera_path.of_field(sparse_x[None, :], sparse_y[:, None])

        def window(across: Tensor, up: Tensor) -> Tensor:
            return torch.as_tensor(entrance_window(geometry, across, up, model.envelope_m, xp=functions))

        tables, into, out = self.pipe.tables(geometry)
        launch = geometry, geometry.lens_path, (x[0], y[0]), Facet(window, at_launch)
        camera = geometry, geometry.camera_path, (sparse_x[0], sparse_y[0]), Facet(None, -at_camera)
        first, last = (camera, launch) if self.to_page else (launch, camera)
        parts = {"first": self.first.tables(*first, into), "pipe": tables, "last": self.last.tables(*last, out)}
        return {f"{part}.{name}": value for part, made in parts.items() for name, value in made.items()}

    def forward(self, field: Tensor, tables: Tables) -> Tensor:
        """A field on one plane [B, 2, ny, nx] to that on the other."""
        first, pipe, last = (of_part(tables, part) for part in ("first", "pipe", "last"))
        return self.last.to_plane(self.pipe(self.first.to_modes(field, first), pipe), last)


def of_part(tables: Tables, part: str) -> Tables:
    """The constants of one part, by their names within it."""
    return {name.removeprefix(f"{part}."): value for name, value in tables.items() if name.startswith(f"{part}.")}
