"""Process of a training on several nodes, which are shown the same pages between them in each step, unturned."""

import sys
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Subset, TensorDataset

from lightpage.train.data.pages import Page
from lightpage.train.fitting.fit import fit
from lightpage.train.fitting.modules import SymbolTraining
from lightpage.train.models.hyperparameters import Hyperparameters
from lightpage.train.models.network import SymbolUNet
from lightpage.train.processes import Processes, is_first_process

STEPS = 8
_PAGES, _SHAPE, _CHANNELS = 4, (12, 16), 8


class Unturned(SymbolTraining):
    """Draws nothing, so that only the pages of a step say what it does."""

    def training_step(self, batch: Page, index: int) -> Tensor:
        """Loss of the pages as they are."""
        *shown, phases = batch
        return self.loss(self(*shown), phases)


def train(out: Path, nodes: int) -> float:
    """Train, and return the validation AIR."""
    random = torch.Generator().manual_seed(3)
    light = torch.randn(_PAGES, _CHANNELS, *_SHAPE, generator=random)
    positions = torch.rand(_PAGES, 4, *_SHAPE, generator=random)
    phases = 6 * torch.rand(_PAGES, *_SHAPE, generator=random)
    pages = TensorDataset(light, positions, phases)
    torch.manual_seed(1)
    choices = Hyperparameters(channels=8, blocks=1, steps=STEPS, precision="32-true")
    mask = np.zeros(_SHAPE, bool)
    mask[::4, ::4] = True
    module = Unturned(SymbolUNet(_CHANNELS, choices.channels, choices.blocks, 0), choices, mask, 16)
    half = _PAGES // 2
    share = range(_PAGES) if nodes == 1 else range(half) if is_first_process() else range(half, _PAGES)
    fitted = fit(
        out,
        module,
        DataLoader(Subset(pages, share), batch_size=len(share)),
        Subset(pages, range(half)),
        steps=STEPS,
        precision=choices.precision,
        processes=Processes(1, nodes).checked(),
    )
    return fitted.validation_air


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(train(Path(sys.argv[1]), int(sys.argv[2])))
