"""Recovers the field of a frame pair by a graph of a bundle."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from lightpage.calibration.sampling_table import APART, SamplingTable
from lightpage.errors import BundleError
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.manifest import DECODER, FIELD
from lightpage.runtime.model.execution.page_graph import PageGraph
from lightpage.runtime.model.execution.session import open_session, running
from lightpage.waves.grid import field_grid

FIELD_OUTPUTS = ("field", "unexplained")
"""Outputs of the field graph, or of a decoder that shows them, [2, Gy, Gx] each: the recovered field, and what is left
of the homodyne equations."""


class BundleFieldSolver:
    """A bundle's `lightpage.calibration.interfaces.FieldSolver`.

    Runs the field's own graph, which does no more than is asked for; where the bundle has none, all of the decoder.

    Args:
        bundle: an opened bundle.
        graph: graph of its decoder.
        threads: threads of one run; by default the cores that this process may use.

    Raises:
        BundleError: no graph shows the field.
    """

    def __init__(self, bundle: Bundle, graph: PageGraph, threads: int | None = None) -> None:
        self._graph, self._profile = graph, bundle.profile
        self._alone = FIELD in bundle.files
        name = FIELD if self._alone else DECODER
        self._subject = f"{bundle.subject}: {name}"
        self._session = open_session(bundle.files[name], self._subject, threads)
        if missing := set(FIELD_OUTPUTS) - {node.name for node in self._session.get_outputs()}:
            raise BundleError(f"{self._subject}: outputs", f"no {', '.join(sorted(missing))}", "a graph with its field")

    def __call__(
        self,
        pair: FramePair,
        references: FramePair,
        registration: NDArray[np.float32],
        homodyne: NDArray[np.float32],
        apart: Mapping[str, NDArray[np.float32]],
    ) -> tuple[NDArray[np.complex64], NDArray[np.float32]]:
        """Field and what is left of the equations, see `FieldSolver`; whatever the page's residual is.

        Raises:
            BundleError: the field is not on the common grid.
            InvalidInputError: a tensor that does not fit.
        """
        table: SamplingTable = {
            "reference_in_phase": references.in_phase,
            "reference_quadrature": references.quadrature,
            "registration": registration,
            "homodyne": homodyne,
        }
        for name in APART:
            if name in self._graph.ports:
                table[name] = apart[name] if name in apart else _together(name, self._graph.value(name))
        self._graph.check(table)
        feeds = {"in_phase": pair.in_phase, "quadrature": pair.quadrature, **table}
        if not self._alone:
            feeds = {**self._graph.table, **feeds}
        with running(self._subject):
            (real, imaginary), left = self._session.run(FIELD_OUTPUTS, feeds)
        if real.shape != (wanted := field_grid(self._profile).shape):
            expected = f"{wanted}, or a {FIELD} beside it"
            raise BundleError(f"{self._subject}: output field", f"shape {real.shape}", expected)
        return np.asarray(real + 1j * imaginary, np.complex64), left


def _together(name: str, apart: NDArray[np.float32]) -> NDArray[np.float32]:
    """Value of a table's entry of `APART` for cameras that see the same plane, in the shape of another one."""
    same = np.zeros_like(apart)
    if name != APART[-1]:
        same[..., 0, apart.shape[-1] // 2] = 1
    return same
