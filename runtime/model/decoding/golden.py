"""The golden page of a bundle, by which a decoder shows that it computes what the bundle's maker did."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from lightpage.errors import BundleError, ProviderError, SurroundingsError
from lightpage.failures import short_resource
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.manifest import FLOAT16, FLOAT32, GOLDEN, Precision

GOLDEN_TOLERANCE = {FLOAT32: 1e-3, FLOAT16: 1e-2}
"""Largest error of p on the golden page, relative to its norm, by precision: room for another processor's rounding, not
for another net."""


def check_golden(bundle: Bundle, answer: Callable[[FramePair], NDArray[np.float32]], precision: Precision) -> None:
    """Check what a graph of a bundle says to the golden page.

    Raises:
        BundleError: something else than the bundle says, or nothing.
    """
    golden, subject = bundle.golden, f"{bundle.subject}: {GOLDEN}"
    try:
        p = answer(golden.pair)
    except (BundleError, ProviderError, SurroundingsError):
        raise
    except Exception as error:  # onnxruntime's errors share no base class
        raise short_resource(subject, error) or BundleError(subject, error, "a golden page that decodes") from None
    if golden.p.shape != p.shape:
        raise BundleError(f"{subject}: p", f"shape {golden.p.shape}", f"shape {p.shape}")
    error_norm = float(np.linalg.norm(p - golden.p) / max(float(np.linalg.norm(golden.p)), 1e-30))
    if not error_norm <= (tolerance := GOLDEN_TOLERANCE[precision]):
        raise BundleError(subject, f"an answer off by {error_norm:.3g} of its norm", f"p within {tolerance:g}")
