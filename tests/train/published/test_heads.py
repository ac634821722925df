"""Posteriors over classes as von Mises densities, and that they are learned."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch.nn import functional

from tests.train.published.test_training import module
from train.published.decoder import p_of_classes
from train.published.training import NOT_ASKED, PublishedChoices, nearest_class

LEVELS = 64


@pytest.mark.parametrize("kappa", [0.3, 3.0, 30.0])
def test_a_von_mises_posterior_over_classes_comes_back(kappa: float) -> None:
    angles = torch.arange(LEVELS) * (2 * math.pi / LEVELS)
    direction = 1.3
    logits = (kappa * torch.cos(angles - direction))[None, :, None, None]
    px, py = p_of_classes(logits)[0, :, 0, 0].tolist()
    assert math.atan2(py, px) == pytest.approx(direction, abs=1e-3)
    assert math.hypot(px, py) == pytest.approx(kappa, rel=0.06)


def test_no_knowledge_is_no_p_and_a_sure_one_is_finite() -> None:
    none = p_of_classes(torch.zeros(1, LEVELS, 1, 1))
    assert float(none.abs().max()) < 1e-5
    sure = torch.zeros(1, LEVELS, 1, 1)
    sure[0, 5] = 1000.0
    p = p_of_classes(sure)[0, :, 0, 0]
    assert torch.isfinite(p).all()
    assert float(p.norm()) > 1e4


def test_the_nearest_class_goes_round() -> None:
    phases = torch.tensor([0.0, 2 * math.pi - 0.01, math.pi, -math.pi / 2])
    assert nearest_class(phases, 4).tolist() == [0, 0, 2, 3]
    assert nearest_class(torch.tensor([math.nan]), 4).tolist() == [NOT_ASKED]


def test_classes_are_judged_by_what_they_say_of_the_data_with_the_piston_known() -> None:
    made = module("none", PublishedChoices(channels=(4, 8), classes=4))
    rng = np.random.default_rng(0)
    symbols = torch.from_numpy(rng.integers(4, size=(2, 28, 44)))
    scores = 3.0 * functional.one_hot(symbols, 4).movedim(-1, 1).float()
    scores[:, :, torch.from_numpy(made.pilot_mask)] = 0
    made.network.scores = lambda frames, shift: scores  # type: ignore[method-assign]
    piston = torch.tensor([math.pi / 2, -math.pi])
    phases = symbols * (math.pi / 2) - piston[:, None, None]
    state = torch.stack([torch.zeros(2), torch.zeros(2), piston], dim=1)
    right = 3 - math.log(math.exp(3) + 3)
    assert made.rate((torch.zeros(2, 2, 8, 8), state, phases)) == pytest.approx(2 + right / math.log(2), rel=1e-5)


def test_classes_are_learned_by_cross_entropy() -> None:
    torch.manual_seed(0)
    choices = PublishedChoices(channels=(4, 8), classes=4)
    training = module("none", choices)
    training.log = lambda *_, **__: None  # type: ignore[assignment,method-assign]
    frames = 100 + 20 * torch.randn(1, 2, 456, 684)
    phases = torch.from_numpy(np.random.default_rng(0).integers(4, size=(1, 28, 44)) * math.pi / 2).float()
    batch = (frames, torch.zeros(1, 3), phases)
    assert training(*batch[:2]).shape == (1, 2, 28, 44)
    optimizer = torch.optim.Adam(training.parameters(), 1e-2)
    losses = []
    for _ in range(25):
        optimizer.zero_grad()
        loss = training.training_step(batch, 0)
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[0] == pytest.approx(math.log(4), abs=0.1)  # it begins by guessing
    assert losses[-1] < losses[0] - 0.01
