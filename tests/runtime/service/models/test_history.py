"""The history of models: back, forward, elsewhere, and only a few of them loaded."""

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest

from lightpage.errors import BundleError, CalibrationError, ModelExistsError, StoreError
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.caller import NOBODY
from lightpage.runtime.service.models.history import HISTORY
from lightpage.runtime.service.models.loader import Loader
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.models.store import Store
from tests.runtime import toy

Make = Callable[..., Models]


@pytest.fixture
def make(decoder: Decoder, tmp_path: Path) -> Make:
    """Makes models with a store, in which these were in service one after another."""

    def begin(*versions: str, kept: int = 4) -> Models:
        models = Models(decoder, Store(tmp_path, decoder.bundle), kept=kept)
        for version in versions:
            toy.write_toy_bundle(tmp_path / f"{version}.zip", version=version)
            models.activate(version)
        return models

    return begin


def loaded(models: Models) -> list[str]:
    return [model.version for model in models.loaded]


def order(models: Models) -> list[str]:
    return [*models.now.state.history.versions]


def test_a_model_that_was_rolled_back_stays_until_a_new_one_drops_what_lies_ahead(make: Make, tmp_path: Path) -> None:
    models = make("toy-2", "toy-3")
    later = models.current
    assert [model.version for model in models.rollback()] == ["toy-2", "toy-3"]
    assert (models.current.version, loaded(models)) == ("toy-2", ["toy-1", "toy-2", "toy-3"])
    assert models.roll_forward() == (later, models.loaded[1])
    with pytest.raises(BundleError, match="later"):
        models.roll_forward()
    models.rollback()
    toy.write_toy_bundle(tmp_path / "toy-4.zip", version="toy-4")
    models.activate("toy-4")
    assert order(models) == loaded(models) == ["toy-1", "toy-2", "toy-4"]
    assert models.rollback()[0].version == "toy-2"


def test_models_beyond_those_kept_are_loaded_again_where_they_can_be(make: Make, tmp_path: Path) -> None:
    models = make("toy-2", "toy-3", "toy-4", kept=2)
    assert loaded(models) == ["toy-3", "toy-4"]
    models.rollback()
    good = (tmp_path / "toy-2.zip").read_bytes()
    (tmp_path / "toy-2.zip").write_bytes(b"damaged")
    with pytest.raises(BundleError, match="bundle"):
        models.rollback()
    (tmp_path / "toy-2.zip").unlink()
    toy.write_toy_bundle(tmp_path / "toy-2.zip", version="toy-9")
    with pytest.raises(BundleError, match="got toy-9"):
        models.rollback()
    assert models.current.version == "toy-3"
    (tmp_path / "toy-2.zip").write_bytes(good)
    assert [models.rollback()[0].version for _ in range(2)] == ["toy-2", "toy-1"]
    assert loaded(models) == ["toy-1", "toy-2"]
    assert models.current.decoder.threads == 1


def test_a_model_anywhere_can_be_put_in_service_and_the_one_before_stays(make: Make) -> None:
    models = make("toy-2", "toy-5")
    assert [model.version for model in models.activate("toy-1")] == ["toy-1", "toy-5"]
    assert order(models) == ["toy-1", "toy-2", "toy-5", "toy-1"]
    assert models.activate("toy-1") == (models.current, models.current)
    assert models.rollback()[0].version == "toy-5"
    with pytest.raises(ModelExistsError, match="toy-2"):
        models.adopt(models.loaded[1].decoder)


def test_a_change_that_breaks_in_the_middle_or_after_the_end_changes_nothing(
    make: Make, decoder: Decoder, tmp_path: Path
) -> None:
    models = make("toy-2")
    models.rollback()
    before = models.now
    new = Decoder.load(toy.write_toy_bundle(tmp_path / "toy-3.zip", version="toy-3"), 1)
    with pytest.raises(StoreError):
        models.adopt(new, None, NOBODY, lambda database: database.execute("INSERT INTO jobs VALUES (1, 'no message')"))
    assert models.now == before
    models.store.close()
    with pytest.raises(StoreError, match="closed"):
        models.roll_forward()
    assert Store(tmp_path, decoder.bundle).contents.state == before.state


def test_a_change_is_made_though_somebody_who_is_told_of_it_fails(make: Make, caplog: pytest.LogCaptureFixture) -> None:
    models = make("toy-2")
    models.in_service = lambda model: 1 // 0  # type: ignore[assignment,return-value]
    assert models.rollback()[0] is models.current
    assert (models.current.version, "not everybody knows" in caplog.text) == ("toy-1", True)


def test_readers_wait_for_no_change_and_changes_for_each_other(make: Make) -> None:
    models = make("toy-2")
    changes = [threading.Thread(target=models.activate, args=[version]) for version in ("toy-1", "toy-2", "toy-1")]
    with models.store.changing:
        for change in changes:
            change.start()
        read = threading.Thread(target=lambda: (models.current, models.entries(), models.loaded))
        read.start()
        read.join(20)
        assert not read.is_alive()
        assert models.current.version == "toy-2"
    for change in changes:
        change.join(20)
    assert models.current.version in ("toy-1", "toy-2")
    assert order(models)[-1] == models.current.version


def test_the_history_is_bounded(make: Make) -> None:
    models = make("toy-2")
    history = models.now.state.history
    for number in range(2 * HISTORY):
        history = history.followed_by(f"toy-{number}")
    assert (len(history.versions), history.current) == (HISTORY, f"toy-{2 * HISTORY - 1}")


def test_other_devices_and_bundles_that_cannot_be_tracked_are_refused(decoder: Decoder, tmp_path: Path) -> None:
    manifest = decoder.bundle.manifest.model_copy(update={"camera_bit_depth": 10})
    deep = Decoder(replace(decoder.bundle, manifest=manifest), 1, decoder.graph)
    same = Decoder.load(toy.write_toy_bundle(tmp_path / "toy-2.zip", version="toy-2"), 1)
    tracker = Mock(side_effect=CalibrationError("calibration", "no table", "a calibration document"))
    with pytest.raises(BundleError, match="calibration"):
        Loader(tracker).tracked(same, decoder)
    with pytest.raises(BundleError, match="got 10 bits"):
        Loader().tracked(deep, decoder)
    Loader().tracked(same, decoder)
