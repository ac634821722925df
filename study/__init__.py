"""Studies of the device and its decoders: each asks one question, and answers it in a table and a picture."""

from __future__ import annotations

from lightpage.study.studies import (
    angle,
    cross_section,
    drift,
    folding,
    heads,
    imaging_condition,
    lens_path,
    paper,
    pipe_length,
    rays,
    receptive_field,
    scaling,
    symbol_size,
    tolerances,
)
from lightpage.study.study import Study

STUDIES: dict[str, Study] = {
    "paper": paper.STUDY,
    "folding": folding.STUDY,
    "rays": rays.STUDY,
    "cross-section": cross_section.STUDY,
    "imaging-condition": imaging_condition.STUDY,
    "lens-path": lens_path.STUDY,
    "receptive-field": receptive_field.STUDY,
    "drift": drift.STUDY,
    "scaling": scaling.STUDY,
    "symbol-size": symbol_size.STUDY,
    "pipe-length": pipe_length.STUDY,
    "angle": angle.STUDY,
    "heads": heads.STUDY,
    "tolerances": tolerances.STUDY,
}
"""Studies by the names of the command line."""
