"""Training: it learns, takes up its last checkpoint, and counts no pilot as data."""

import ctypes
import math
import shutil
from dataclasses import replace
from pathlib import Path

import lightning as L
import numpy as np
import pytest
import torch
from scipy import stats
from torch.utils.data import TensorDataset

from lightpage.errors import InvalidInputError
from lightpage.metrics.information import achievable_rate
from lightpage.train.fitting.concentration_scale import best_kappa_scale, decode_pages, most_likely_factor
from lightpage.train.fitting.fit import fit_network
from lightpage.train.fitting.fitted import CHECKPOINTS, FITTED, FITTED_WEIGHTS, Fitted
from lightpage.train.fitting.loss import training_rate, von_mises_nll
from lightpage.train.fitting.memory import keep_freed_memory
from lightpage.train.fitting.validation import held_out_air
from lightpage.train.models.hyperparameters import Hyperparameters

PAGE = (8, 12)
LEVELS = 256
MASK = np.zeros(PAGE, dtype=bool)
MASK[::4, ::4] = True
CHOICES = Hyperparameters(channels=16, blocks=1, steps=120, batch=2, precision="32-true", learning_rate=5e-3)


def test_pages_that_a_run_is_shown_count_patches_for_their_share() -> None:
    choices = Hyperparameters(steps=100, batch=4, patch=96)
    assert choices.drawn((56, 87)) == 400
    assert choices.drawn((192, 64)) == 200
    assert choices.drawn((192, 384)) == 50


def pages(count: int, seed: int, noise: float | np.ndarray = 0.2) -> TensorDataset:
    """Light that shows its symbol, in noise."""
    rng = np.random.default_rng(seed)
    phases = rng.uniform(0, 2 * np.pi, (count, *PAGE))
    light = np.stack([np.cos(phases), np.sin(phases)], axis=1)[:, :, None, None]
    light = light + noise * rng.standard_normal(light.shape)
    light = torch.from_numpy(light.astype(np.float16)).flatten(1, 3)
    return TensorDataset(light, torch.zeros(count, 2, *PAGE), torch.from_numpy(phases.astype(np.float32)))


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Fitted]:
    """A training that has ended, and its folder."""
    run = tmp_path_factory.mktemp("fit") / "run"
    return run, fit_network(run, CHOICES, MASK, LEVELS, pages(12, 0), pages(3, 1))


def test_it_learns_and_is_not_trained_twice(trained: tuple[Path, Fitted], tmp_path: Path) -> None:
    training, validation = pages(12, 0), pages(3, 1)
    run, first = Path(shutil.copytree(trained[0], tmp_path / "run")), trained[1]
    assert first.validation_air > 1.0
    kept = fit_network(run, CHOICES, MASK, LEVELS, training, validation)
    assert (kept.validation_air, kept.seconds, kept.curves) == (first.validation_air, first.seconds, first.curves)
    assert kept.curves["val_air"][-1][1] == pytest.approx(first.validation_air, abs=0.1)
    torch.testing.assert_close(kept.module.network.state_dict(), first.module.network.state_dict())
    (run / FITTED).unlink()  # interrupted after its last step, and moved
    run = run.rename(tmp_path / "moved")
    again = fit_network(run, CHOICES, MASK, LEVELS, training, validation)
    assert again.validation_air == pytest.approx(first.validation_air, abs=1e-6)
    for one, other in zip(first.module.parameters(), again.module.parameters(), strict=True):
        torch.testing.assert_close(one, other)
    # the time of the earlier stretch, up to its last checkpoint, and not that of looking at it again
    assert 0.5 * first.seconds < again.seconds <= first.seconds
    checkpoint = torch.load(run / "checkpoints" / "last.ckpt", map_location="cpu", weights_only=False)
    assert checkpoint["global_step"] == CHOICES.steps
    shutil.rmtree(run / CHECKPOINTS)
    without = fit_network(run, CHOICES, MASK, LEVELS, training, validation)
    assert without.validation_air == again.validation_air
    assert not (run / CHECKPOINTS).exists()


def test_further_processes_take_what_the_first_one_has_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each would judge the pages by itself, and on another machine find another last digit."""
    choices, fitting = replace(CHOICES, steps=10), L.Trainer.fit
    first = fit_network(tmp_path / "first", choices, MASK, LEVELS, pages(2, 0), pages(1, 1))

    def then_the_first_ends(*args: object, **kwargs: object) -> None:
        fitting(*args, **kwargs)  # type: ignore[arg-type]
        replace(first, validation_air=1.25).save(tmp_path / "other")

    monkeypatch.setattr(L.Trainer, "fit", then_the_first_ends)
    monkeypatch.setattr("lightpage.train.fitting.fit.is_first_process", lambda: False)
    other = fit_network(tmp_path / "other", choices, MASK, LEVELS, pages(2, 0), pages(1, 1))
    assert (other.validation_air, other.curves) == (1.25, first.curves)
    torch.testing.assert_close(other.module.network.state_dict(), first.module.network.state_dict())


@pytest.mark.parametrize("damaged", [FITTED, FITTED_WEIGHTS])
def test_what_a_finished_training_kept_is_named_when_it_is_damaged(damaged: str, tmp_path: Path) -> None:
    choices = replace(CHOICES, steps=10)
    fit_network(tmp_path, choices, MASK, LEVELS, pages(2, 0), pages(1, 1))
    with pytest.raises(InvalidInputError, match=FITTED_WEIGHTS):  # of another size
        fit_network(tmp_path, replace(choices, channels=8), MASK, LEVELS, pages(2, 0), pages(1, 1))
    (tmp_path / damaged).write_bytes(b"")
    with pytest.raises(InvalidInputError, match=damaged):
        fit_network(tmp_path, choices, MASK, LEVELS, pages(2, 0), pages(1, 1))


def test_few_steps_teach_large_confidences_and_small_ones(tmp_path: Path) -> None:
    noise = np.where(np.arange(PAGE[1]) < PAGE[1] // 2, 0.03, 0.6)
    training, validation = pages(12, 0, noise), pages(8, 1, noise)
    module = fit_network(tmp_path, CHOICES, MASK, LEVELS, training, validation).module
    p, phases = decode_pages(module, validation)
    mu, kappa = np.arctan2(p[:, 1], p[:, 0]), np.hypot(p[:, 0], p[:, 1])
    clear, noisy = np.split(kappa, 2, axis=2)
    assert np.median(clear) > 20 * np.median(noisy)
    level = (np.rint(phases * (LEVELS / (2 * np.pi))) % LEVELS).astype(np.uint8)
    assert achievable_rate(mu, kappa, level, LEVELS)[..., : PAGE[1] // 2].mean() > 3.6


def test_a_claim_that_is_too_bold_is_scaled_down(trained: tuple[Path, Fitted]) -> None:
    validation = pages(3, 1)
    module = fit_network(trained[0], CHOICES, MASK, LEVELS, pages(12, 0), validation).module
    calibrated = best_kappa_scale(module, validation, MASK)
    with torch.no_grad():
        assert module.network.head.bias is not None
        for value in (module.network.head.weight, module.network.head.bias):
            value[:2] *= 3
    assert best_kappa_scale(module, validation, MASK) == pytest.approx(calibrated / 3, rel=0.02)


def test_a_factor_at_the_end_of_the_search_is_said_to_be_there(caplog: pytest.LogCaptureFixture) -> None:
    assert most_likely_factor(lambda factor: (math.log(factor) - 1) ** 2) == pytest.approx(math.e, rel=1e-4)
    assert caplog.text == ""
    most_likely_factor(lambda factor: -factor)
    assert "factor 20" in caplog.text


def test_air_does_not_see_the_piston_and_leaves_pilots_out() -> None:
    rng = np.random.default_rng(0)
    truth = rng.uniform(0, 2 * np.pi, (1, *PAGE)).astype(np.float32)
    p = 30 * np.stack([np.cos(truth + 1.0), np.sin(truth + 1.0)], axis=1).astype(np.float32)
    exact = held_out_air(p, truth, MASK, LEVELS)
    wrong_data, wrong_pilots = truth.copy(), p.copy()
    wrong_data[0][~MASK] = rng.uniform(0, 2 * np.pi, int((~MASK).sum()))
    wrong_pilots[0, :, MASK] *= 0.5
    assert exact > 3.5
    assert held_out_air(wrong_pilots, truth, MASK, LEVELS) == pytest.approx(exact, abs=0.02)
    assert held_out_air(p, wrong_data, MASK, LEVELS) < 0


def test_freed_memory_is_left_to_another_c_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ctypes, "CDLL", lambda name: object())
    assert not keep_freed_memory()


def test_the_loss_is_the_density_that_scipy_has() -> None:
    kappa, mu, theta = np.array([0.1, 2.0, 40.0]), np.array([0.3, -2.0, 3.0]), np.array([1.0, 2.5, -3.1])
    p = torch.from_numpy(np.stack([kappa * np.cos(mu), kappa * np.sin(mu)])[None])
    expected = -stats.vonmises.logpdf(theta, kappa, loc=mu)
    got = von_mises_nll(p, torch.from_numpy(theta)[None])[0].numpy()
    np.testing.assert_allclose(got, expected, atol=2e-5)


def test_the_loss_is_finite_with_its_gradient_at_no_and_at_huge_confidence() -> None:
    p = torch.tensor([[[0.0, 1e4], [0.0, 0.0]]], requires_grad=True)
    loss = von_mises_nll(p, torch.zeros(1, 2)).sum()
    loss.backward()
    assert torch.isfinite(loss)
    assert p.grad is not None
    assert torch.isfinite(p.grad).all()


@pytest.mark.parametrize(("levels", "concentration"), [(2, 100), (100, 4000), (256, 8000)])
def test_the_rate_in_training_is_that_of_the_symbols_whatever_the_piston(levels: int, concentration: float) -> None:
    rng = np.random.default_rng(levels)
    symbols, kappa = rng.integers(levels, size=4000), rng.gamma(2.0, concentration / 2, 4000)
    mu = symbols * 2 * np.pi / levels + rng.vonmises(0, kappa)
    expected = achievable_rate(mu, kappa, symbols, levels).mean()
    for piston in (0.0, 2.1):
        p = torch.from_numpy(kappa * np.stack([np.cos(mu + piston), np.sin(mu + piston)]))
        phases = torch.from_numpy(symbols * 2 * np.pi / levels + piston)
        assert training_rate(p, phases, levels) == pytest.approx(expected, abs=2e-3)
    assert expected < np.log2(levels)
