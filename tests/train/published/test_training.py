"""The published decoders: their network, what classes say, learning rates, clipping, and the command."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn import functional

from lightpage.device.profile import load_profile
from lightpage.errors import InvalidInputError
from lightpage.page.symbols import pilot_mask
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from lightpage.train.data.features import PageState
from lightpage.train.data.pages import Page
from lightpage.train.published.decoder import p_of_classes
from lightpage.train.published.trainer import published_choices, published_decoder, train_published
from lightpage.train.published.training import (
    NOT_ASKED,
    PROFILE,
    DataPages,
    FramePages,
    PublishedChoices,
    PublishedTraining,
    nearest_class,
)
from lightpage.train.published.unet import PublishedUNet, samples_for
from lightpage.train.runs import load_run
from tests.conftest import SMALL_PAGES
from tests.lightpage.small import THICK, small_profile

STEP_RATES = (1e-3, 2e-4, 1e-4)
LEVELS = 64


def module(localizer: str, choices: PublishedChoices) -> PublishedTraining:
    profile = small_profile()
    references = FramePair(*np.full((2, *profile.frame_shape), 100, dtype=np.uint8))
    decoder = published_decoder(localizer, choices, profile, references, quadrature_phase=1.5)
    return PublishedTraining(decoder, choices, pilot_mask(profile), 256)


def test_rates_rise_over_two_percent_of_the_steps_and_only_the_decoder_s_falls() -> None:
    choices = PublishedChoices(channels=(4, 8), steps=100)
    made = module("ray", choices).configure_optimizers()
    optimizer, schedule = made["optimizer"], made["lr_scheduler"]["scheduler"]
    rates = []
    for _ in range(choices.steps):
        rates.append([group["lr"] for group in optimizer.param_groups])
        optimizer.step()
        schedule.step()
    assert rates[0] == pytest.approx([rate / 2 for rate in STEP_RATES])
    assert rates[1] == rates[79] == pytest.approx(STEP_RATES)
    assert rates[80] == pytest.approx([5e-4, *STEP_RATES[1:]])
    assert rates[90] == pytest.approx([2.5e-4, *STEP_RATES[1:]])
    late = module("ray", PublishedChoices(channels=(4, 8), steps=100, held_share=0.5, start=PROFILE))
    factors = late.configure_optimizers()["lr_scheduler"]["scheduler"].lr_lambdas
    assert [[factor(step) for factor in factors] for step in (49, 51)] == [[1, 0, 0], [1, 1, 1]]
    across = small_profile().page_width_m / small_profile().image_pixel_m / small_profile().camera.columns_px
    assert late.network.localizer.registration.matrix[1, 0].tolist() == pytest.approx([across, 0.0])


def test_every_parameter_has_one_rate() -> None:
    made = module("ray", PublishedChoices(channels=(4, 8)))
    groups = made.configure_optimizers()["optimizer"].param_groups
    sizes = [sum(parameter.numel() for parameter in group["params"]) for group in groups]
    assert sizes[1:] == [2 * 4 + 2 * 2, 1]
    assert sum(sizes) == sum(parameter.numel() for parameter in made.parameters())


def test_the_gradient_of_the_network_alone_is_clipped() -> None:
    made = module("mode", PublishedChoices(channels=(4, 8)))
    for parameter in made.parameters():
        parameter.grad = torch.ones_like(parameter)
    made.configure_gradient_clipping()
    gradients = [p.grad for p in made.network.unet.parameters() if p.grad is not None]
    assert float(torch.cat([g.ravel() for g in gradients]).norm()) == pytest.approx(1, rel=1e-4)
    for parameter in made.network.localizer.parameters():
        assert parameter.grad is not None
        assert torch.equal(parameter.grad, torch.ones_like(parameter))


def test_the_authors_choices() -> None:
    paper = small_profile()
    assert published_choices("mode", paper, 450) == PublishedChoices()
    for size_px, epochs, decay in ((2, 50, 0.5), (8, 30, 1.0), (16, 15, 1.0)):
        page = paper.page.model_copy(update={"symbol_size_px": size_px})
        chosen = published_choices("ray", paper.model_copy(update={"page": page}), 450)
        assert (chosen.steps, chosen.decay) == (epochs * 225, decay)
    assert published_choices("ray", load_profile("paper"), 450).lenses == "AC508-080-A"  # its lenses are real
    thick = paper.model_copy(update={"lens_path": THICK})
    assert published_choices("ray", thick, 450).lenses == "paraxial"  # of no known lens
    assert published_choices("mode", load_profile("paper"), 450) == PublishedChoices()  # which traces none


def test_the_network_gets_two_images_and_the_places_they_stand_for() -> None:
    made = module("ray", PublishedChoices(channels=(4, 8)))
    given: list[torch.Tensor] = []
    made.network.unet.register_forward_pre_hook(lambda _, inputs: given.append(inputs[0]))
    frames = 100 + 10 * torch.rand(1, 2, *small_profile().frame_shape)
    made(frames, torch.zeros(1, 3))
    images, across, down = given[0][0, :2], given[0][0, 2], given[0][0, 3]
    rows, columns = across.shape
    assert torch.allclose(across, ((torch.arange(columns) + 0.5) / columns * 2 - 1).expand(rows, columns))
    assert torch.allclose(down, ((torch.arange(rows) + 0.5) / rows * 2 - 1)[:, None].expand(rows, columns))
    assert all(image.std() > 0.1 for image in images)


@pytest.mark.parametrize("classes", [0, 4])
def test_pilots_are_not_learnt_from(classes: int) -> None:
    made = module("none", PublishedChoices(channels=(4, 8), classes=classes))
    made.log = lambda *_, **__: None  # type: ignore[method-assign]
    profile, pilots = small_profile(), pilot_mask(small_profile())
    frames = 100 + 10 * torch.rand(1, 2, *profile.frame_shape)
    phases = 2 * np.pi * torch.rand(*profile.page_shape)
    others = torch.where(torch.from_numpy(pilots), phases + 1, phases)
    pages: list[Page] = [(frames[0], torch.zeros(3), shown) for shown in (phases, others)]
    asked = DataPages(pages, pilots)  # type: ignore[arg-type]  # a list is all that it takes
    first, second = (made.training_step(tuple(part[None] for part in asked[index]), 0) for index in range(2))
    assert torch.isfinite(first)
    assert first == second
    assert len(asked) == 2


def test_training_hides_the_pilots(small_device: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    monkeypatch.setattr("lightpage.train.published.trainer.fit", lambda *given, **_: seen.append(given[2]))
    profile = small_profile()
    with Recording.open(small_device[3]) as recording:
        pages = FramePages(recording, [2], [PageState((0.0, 0.0), 0.0)])
        pilots, choices = pilot_mask(profile), PublishedChoices(channels=(4, 8))
        train_published(tmp_path, "none", choices, profile, 1.5, pilots, pages, pages)
        (batch,) = seen[0]
    np.testing.assert_array_equal(torch.isnan(batch[-1][0]).numpy(), pilots)


def test_a_run_says_what_it_did(ray_run: Path) -> None:
    described = load_run(ray_run)
    assert described.pages == (6, 1, 1)
    assert described.hyperparameters == PublishedChoices(channels=(4, 8), steps=12)
    assert "localizer.angle" in torch.load(ray_run / "decoder.pt", weights_only=True)
    states = json.loads((ray_run / "states.json").read_text())["states"]
    assert len(states) == SMALL_PAGES - 1


def test_table_1_of_samples_and_no_others() -> None:
    assert [samples_for(size) for size in (2, 4, 8, 16)] == [4, 4, 8, 16]
    with pytest.raises(InvalidInputError, match="4, 8, 16"):
        PublishedUNet(5)


@pytest.mark.parametrize("kappa", [0.3, 3.0, 30.0])
def test_a_von_mises_posterior_over_classes_comes_back(kappa: float) -> None:
    angles, direction = torch.arange(LEVELS) * (2 * math.pi / LEVELS), 1.3
    logits = (kappa * torch.cos(angles - direction))[None, :, None, None]
    px, py = p_of_classes(logits)[0, :, 0, 0].tolist()
    assert math.atan2(py, px) == pytest.approx(direction, abs=1e-3)
    assert math.hypot(px, py) == pytest.approx(kappa, rel=0.06)


def test_no_knowledge_is_no_p_and_a_sure_one_is_finite() -> None:
    assert float(p_of_classes(torch.zeros(1, LEVELS, 1, 1)).abs().max()) < 1e-5
    sure = torch.zeros(1, LEVELS, 1, 1)
    sure[0, 5] = 1000.0
    p = p_of_classes(sure)[0, :, 0, 0]
    assert torch.isfinite(p).all()
    assert float(p.norm()) > 1e4


def test_the_nearest_class_goes_round() -> None:
    phases = torch.tensor([0.0, 2 * math.pi - 0.01, math.pi, -math.pi / 2, math.nan])
    assert nearest_class(phases, 4).tolist() == [0, 0, 2, 3, NOT_ASKED]


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
    training = module("none", PublishedChoices(channels=(4, 8), classes=4))
    training.log = lambda *_, **__: None  # type: ignore[assignment,method-assign]
    phases = torch.from_numpy(np.random.default_rng(0).integers(4, size=(1, 28, 44)) * math.pi / 2).float()
    loss = training.training_step((100 + 20 * torch.randn(1, 2, 456, 684), torch.zeros(1, 3), phases), 0)
    assert float(loss.detach()) == pytest.approx(math.log(4), abs=0.1)  # it begins by guessing
