"""Bundles of one device that answer differently: what a service serves can be told by its symbols."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from lightpage.runtime.model.bundle.bundle import Bundle, npz, write_bundle
from lightpage.runtime.model.bundle.manifest import GOLDEN, TABLE
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_drift import BundleTables
from lightpage.runtime.model.execution.twin import OnnxTwin


def write_variant(base: Bundle, version: str, shift_px: float, path: Path) -> Path:
    """The base bundle looking `shift_px` further right, as a zip of its own version; returns its path."""
    decoder = Decoder(base, 1)
    tables = BundleTables(decoder, OnnxTwin(base))
    shifted = tables.shifted(np.array([shift_px, 0.0]))
    table = {**base.table, **shifted}
    golden = base.golden.pair
    answer = decoder.with_table(shifted).infer(golden).p
    files = {
        **base.files,
        TABLE: npz(**table),
        GOLDEN: npz(in_phase=golden.in_phase, quadrature=golden.quadrature, p=answer),
    }
    return write_bundle(path, base.manifest.model_copy(update={"version": version}), files)


def answer_of(path: Path, levels: int) -> str:
    """SHA-256 of what a bundle makes of its device's golden pair, without following the image."""
    decoder = Decoder.load(path, 1)
    page = decoder.decode(Bundle.open(path).golden.pair, levels)
    return hashlib.sha256(page.symbols.tobytes()).hexdigest()
