"""The foreign device writes a recording in which its pages can be seen."""

from __future__ import annotations

import re
from pathlib import Path

import h5py
import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from analysis import foreign_device as fd
from analysis.foreign_device import ForeignDevice

CENTRE_PX = (3.0, -4.0)


def test_the_middle_of_the_page_is_upright_and_in_phase_on_the_frames(tmp_path: Path) -> None:
    """There light meets no wall, and frames less references, averaged over pixels, are the symbols' phases."""
    device = ForeignDevice().with_parameters(pipe_angle_deg=-0.6, pipe_roll_deg=0.1, page_centre_px=CENTRE_PX)
    path = tmp_path / "upright.h5"
    symbols = device.write(path, 1, 16, seed=4)
    with h5py.File(str(path)) as file:
        assert (file.attrs["camera_bit_depth"], file.attrs["levels"]) == (8, 16)
        assert np.array_equal(file["symbols"], symbols)
        parts = []
        for name in ("in_phase", "quadrature"):
            frame, reference = file[name][0].astype(float), file[f"reference_{name}"][()].astype(float)
            parts.append(gaussian_filter((frame - reference) / (2 * np.sqrt(np.maximum(reference, 1))), 2))
    (rows, columns), pitch = fd.PAGE_SHAPE, fd.SYMBOL_PX * fd.SLM_PITCH
    x = ((np.arange(columns) - (columns - 1) / 2) * pitch + CENTRE_PX[0] * fd.SLM_PITCH)[None, 36:51]
    y = ((np.arange(rows) - (rows - 1) / 2) * pitch + CENTRE_PX[1] * fd.SLM_PITCH)[22:34, None]
    centre = [(count - 1) / 2 for count in fd.FRAME_SHAPE]
    where = np.stack(np.broadcast_arrays(y / fd.CAMERA_PITCH + centre[0], x / fd.CAMERA_PITCH + centre[1]))
    seen = map_coordinates(parts[0], where, order=1) + 1j * map_coordinates(parts[1], where, order=1)
    glass, k2 = fd.GLASS_INDEX * fd.WAVENUMBER, (fd.WAVENUMBER / device.focal_length) ** 2 * (x**2 + y**2)
    seen = seen * np.exp(-1j * (np.sqrt(glass**2 - k2) - glass) * device.pipe_length)
    written = np.exp(2j * np.pi * symbols[0, 22:34, 36:51] / 16)
    overlap = np.vdot(written, seen) / (np.linalg.norm(written) * np.linalg.norm(seen))
    assert abs(overlap) > 0.8


def test_nothing_of_the_project_is_imported() -> None:
    assert not re.search(
        r"^\s*(from|import) (lightpage|train|export|runtime)", Path(fd.__file__).read_text(), re.MULTILINE
    )
