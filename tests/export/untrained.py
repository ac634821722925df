"""A decoder that says something before it was trained."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from lightpage.device.profile import Profile
from train.models.decoder import SymbolDecoder
from train.models.hyperparameters import Hyperparameters


def untrained_decoder(profile: Profile, parameters: NDArray[np.float64], choices: Hyperparameters) -> SymbolDecoder:
    """A coherent decoder with random weights, those of its head too, which would else begin with zeros."""
    torch.manual_seed(0)
    decoder = SymbolDecoder(profile, parameters, "coherent", choices)
    for value in decoder.network.head.parameters():
        torch.nn.init.normal_(value, std=0.05)
    return decoder
