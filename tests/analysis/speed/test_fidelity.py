"""Forms of a decoder side by side: what each reads, how far its p is off, and a time where it says something."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from analysis.speed.fidelity import FORMS, HALF, measured, name_of
from lightpage.recording.reader import Recording
from runtime.decoding.decoder import Decoder
from tests.runtime import toy


def test_rates_deviations_and_times_of_each_form(tmp_path: Path) -> None:
    toy.write_toy_recording(tmp_path / "r.h5", toy.ToyDevice(), 256, 3)
    usual, doubtful = toy.decoder_onnx(), toy.decoder_onnx(kappa=100.0)
    decoder = Decoder.load(toy.write_toy_bundle(tmp_path / "toy.zip"))
    with Recording.open(tmp_path / "r.h5") as recording:
        models = {"usual": usual, "doubtful": doubtful}
        forms = {form.name: form for form in measured(decoder, models, doubtful, recording, 2, "usual")}
    assert list(forms) == ["usual", "doubtful", HALF]
    assert forms["usual"].air > forms["doubtful"].air == forms[HALF].air > 4
    assert forms["usual"].deviation == 0
    assert forms["doubtful"].deviation == forms[HALF].deviation == pytest.approx(0.75, abs=1e-3)
    assert forms["usual"].seconds > 0
    assert np.isnan(forms[HALF].seconds)


def test_forms_go_by_their_errors() -> None:
    names = [name_of(form) for form in FORMS]
    assert "0.01, 0.015; 0.06, 0.05" in names
    assert len(set(names)) == len(FORMS)
