"""Training of the published decoders: learning rates, clipping, and the command."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from lightpage.device.profile import load_profile
from lightpage.page.symbols import pilot_mask
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from tests.conftest import SMALL_PAGES
from tests.lightpage.small import THICK, small_profile
from train.commands.train import train
from train.data.features import PageState
from train.data.pages import Page
from train.published.trainer import published_choices, published_decoder, train_published
from train.published.training import DataPages, FramePages, PublishedChoices, PublishedTraining
from train.runs import load_run

STEP_RATES = (1e-3, 2e-4, 1e-4)


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
    assert rates[1] == pytest.approx(STEP_RATES)
    assert rates[79] == pytest.approx(STEP_RATES)
    assert rates[80] == pytest.approx([5e-4, *STEP_RATES[1:]])
    assert rates[90] == pytest.approx([2.5e-4, *STEP_RATES[1:]])


def test_every_parameter_has_one_rate() -> None:
    made = module("ray", PublishedChoices(channels=(4, 8)))
    groups = made.configure_optimizers()["optimizer"].param_groups
    sizes = [sum(parameter.numel() for parameter in group["params"]) for group in groups]
    assert sizes[1:] == [2 * 4 + 2 * 2, 1]
    assert sum(sizes) == sum(parameter.numel() for parameter in made.parameters())
    assert len(module("mode", PublishedChoices(channels=(4, 8))).configure_optimizers()["optimizer"].param_groups) == 2


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


@pytest.mark.parametrize("localizer", ["none", "mode", "ray"])
def test_the_network_gets_two_images_and_the_places_they_stand_for(localizer: str) -> None:
    made = module(localizer, PublishedChoices(channels=(4, 8)))
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
    profile = small_profile()
    frames = 100 + 10 * torch.rand(1, 2, *profile.frame_shape)
    phases = 2 * np.pi * torch.rand(*profile.page_shape)
    pilots = pilot_mask(profile)
    others = torch.where(torch.from_numpy(pilots), phases + 1, phases)
    pages: list[Page] = [(frames[0], torch.zeros(3), shown) for shown in (phases, others)]
    asked = DataPages(pages, pilots)  # type: ignore[arg-type]  # a list is all that it takes
    first, second = (made.training_step(tuple(part[None] for part in asked[index]), 0) for index in range(2))
    assert torch.isfinite(first)
    assert first == second
    assert len(asked) == 2


def test_training_hides_the_pilots(small_device: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    monkeypatch.setattr("train.published.trainer.fit", lambda *given, **_: seen.append(given[2]))
    profile = small_profile()
    with Recording.open(small_device[3]) as recording:
        pages = FramePages(recording, [2], [PageState((0.0, 0.0), 0.0)])
        pilots, choices = pilot_mask(profile), PublishedChoices(channels=(4, 8))
        train_published(tmp_path, "none", choices, profile, 1.5, pilots, pages, pages)
        (batch,) = seen[0]
    np.testing.assert_array_equal(torch.isnan(batch[-1][0]).numpy(), pilots)


def test_pages_come_with_frames_state_and_phases(small_device: list[str]) -> None:
    with Recording.open(small_device[3]) as recording:
        frames, state, phases = FramePages(recording, [2], [PageState((0.5, -0.25), 1.0)])[0]
        assert torch.equal(frames[1], torch.from_numpy(recording.frames(2).quadrature.astype(np.float32)))
        assert state.tolist() == [0.5, -0.25, 1.0]
        assert phases.shape == recording.page_shape


@pytest.mark.parametrize("localizer", ["mode", "ray"])
def test_the_command_trains_and_says_what_it_did(
    localizer: str, small_device: list[str], tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    folder = tmp_path / "run" if localizer == "mode" else request.getfixturevalue("ray_run")
    words = [*small_device, "--localizer", localizer, "--channels", "4", "--steps", "12", "--out", str(folder)]
    CliRunner().invoke(train, words, standalone_mode=False, catch_exceptions=False)
    described = load_run(folder)
    assert described.pages == (6, 1, 1)
    assert described.hyperparameters == PublishedChoices(channels=(4, 8), steps=12)
    weights = torch.load(folder / "decoder.pt", weights_only=True)
    assert ("localizer.angle" in weights) == (localizer == "ray")
    states = json.loads((folder / "states.json").read_text())["states"]
    assert len(states) == SMALL_PAGES - 1
