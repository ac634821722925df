"""Every decoder as an untrained graph: time does not depend on weights."""

from __future__ import annotations

from collections.abc import Callable, Collection

import click
import numpy as np

from lightpage.calibration.parameters import nominal
from lightpage.calibration.sampling_table import sampling_table
from lightpage.device.profile import Profile
from lightpage.export.graph import DecoderGraph, Graph, PublishedGraph, published_tensors, table_tensors
from lightpage.recording.frame_pair import FramePair
from lightpage.train.models.decoder import SymbolDecoder
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.models.presets import FAST, PRESETS
from lightpage.train.models.twin import RayTwin, TorchTwin
from lightpage.train.published.trainer import published_decoder
from lightpage.train.published.training import PublishedChoices

Tensors = dict[str, np.ndarray]
FIRST_LOOK = Hyperparameters()
OWN = {
    "coherent": ("coherent", FIRST_LOOK),
    "refined": ("coherent", Hyperparameters(refinements=1)),
    FAST: ("coherent", PRESETS[FAST].choices),
    "wave": ("wave", FIRST_LOOK),
}
"""Decoders at symbol pitch: localizer and choices by name."""
WIDTHS = {"ray 16/32": (16, 32), "ray 32/64": (32, 64), "ray 64/128": (64, 128)}
"""The published decoder with its ray grid, by the channels of its U-Net."""


def reference(profile: Profile) -> FramePair:
    """Reference-only frames of an even beam."""
    frame = np.full(profile.frame_shape, 100, dtype=np.uint8)
    return FramePair(frame, frame)


def at_symbol_pitch(profile: Profile, localizer: str, choices: Hyperparameters) -> tuple[Graph, Tensors]:
    """A decoder of ours, at an angle of -0.6 degree: a square pipe would need no splitting steps."""
    parameters = nominal()
    parameters[0] = np.deg2rad(-0.6)
    table = sampling_table(TorchTwin(RayTwin(profile)), parameters, np.pi / 2, profile)
    decoder = SymbolDecoder(profile, parameters, localizer, choices)
    graph = DecoderGraph(profile, decoder, 1.0)
    return graph, table_tensors(graph, table, reference(profile))


def published(profile: Profile, localizer: str, channels: tuple[int, int]) -> tuple[Graph, Tensors]:
    """A published decoder."""
    choices = PublishedChoices(channels=channels)
    decoder = published_decoder(localizer, choices, profile, reference(profile), np.pi / 2)
    return PublishedGraph(decoder, 1.0), published_tensors(decoder)


def makers(profile: Profile) -> dict[str, Callable[[], tuple[Graph, Tensors]]]:
    """Every decoder by name; the others are compared with the first."""
    rays = {name: lambda width=width: published(profile, "ray", width) for name, width in WIDTHS.items()}
    own = {name: lambda chosen=chosen: at_symbol_pitch(profile, *chosen) for name, chosen in OWN.items()}
    return {
        **own,
        **rays,
        "mode 32/64": lambda: published(profile, "mode", (32, 64)),
    }


def makers_of(profile: Profile, names: Collection[str]) -> dict[str, Callable[[], tuple[Graph, Tensors]]]:
    """The `makers`, among which somebody asks for some.

    Raises:
        click.BadParameter: a name that is none.
    """
    known = makers(profile)
    for name in names:
        if name not in known:
            raise click.BadParameter(f"{name!r}: wanted one of {', '.join(known)}", param_hint="--decoder")
    return known
