"""The history of models: back, forward, elsewhere, and only a few of them loaded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from lightpage.errors import BundleError, CalibrationError, ModelExistsError, OtherModelError
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.tracking import NoTracker
from lightpage.runtime.service.models.registry import HISTORY, History, Model, ModelRegistry, Place
from tests.runtime import toy


def a_place(folder: Path, version: str) -> Place:
    return Place(version, toy.write_toy_bundle(folder / f"{version}.zip", version=version))


def a_registry(decoder: Decoder, folder: Path, *versions: str, kept: int = 4) -> ModelRegistry:
    registry = ModelRegistry(decoder, kept=kept)
    for version in versions:
        registry.swap(Decoder.load(a_place(folder, version).path, threads=1))
    return registry


def loaded(registry: ModelRegistry) -> list[str]:
    return [model.version for model in registry.models]


def order(registry: ModelRegistry) -> list[str]:
    return [place.version for place in registry.history.places]


def refuse(model: Model, history: History) -> None:
    raise BundleError("note", "disk full", "room")


def test_a_model_that_was_rolled_back_stays_until_a_new_one_drops_what_lies_ahead(
    decoder: Decoder, tmp_path: Path
) -> None:
    registry = a_registry(decoder, tmp_path, "toy-2", "toy-3")
    later = registry.current
    assert [model.version for model in registry.step(-1)] == ["toy-2", "toy-3"]
    assert (registry.current.version, loaded(registry)) == ("toy-2", ["toy-1", "toy-2", "toy-3"])
    assert registry.step(1) == (later, registry.models[1])
    with pytest.raises(BundleError, match="later"):
        registry.step(1)
    registry.step(-1)
    registry.swap(Decoder.load(a_place(tmp_path, "toy-4").path, threads=1))
    assert order(registry) == loaded(registry) == ["toy-1", "toy-2", "toy-4"]
    assert registry.step(-1)[0].version == "toy-2"


def test_models_beyond_those_kept_are_loaded_again_where_they_can_be(decoder: Decoder, tmp_path: Path) -> None:
    registry = a_registry(decoder, tmp_path, "toy-2", "toy-3", "toy-4", kept=2)
    assert loaded(registry) == ["toy-3", "toy-4"]
    registry.step(-1)
    good = (tmp_path / "toy-2.zip").read_bytes()
    (tmp_path / "toy-2.zip").write_bytes(b"damaged")
    with pytest.raises(BundleError, match="bundle"):
        registry.step(-1)
    (tmp_path / "toy-2.zip").unlink()
    toy.write_toy_bundle(tmp_path / "toy-2.zip", version="toy-9")
    with pytest.raises(BundleError, match="got toy-9"):
        registry.step(-1)
    assert registry.current.version == "toy-3"
    (tmp_path / "toy-2.zip").write_bytes(good)
    assert [registry.step(-1)[0].version for _ in range(2)] == ["toy-2", "toy-1"]
    assert loaded(registry) == ["toy-1", "toy-2"]
    assert registry.current.decoder.threads == 1


def test_a_step_is_made_only_from_the_version_that_is_expected(decoder: Decoder, tmp_path: Path) -> None:
    registry = a_registry(decoder, tmp_path, "toy-2")
    for change in (
        lambda: registry.step(-1, "toy-1"),
        lambda: registry.step(1, "toy-1"),
        lambda: registry.go_to(registry.base, "toy-1"),
    ):
        with pytest.raises(OtherModelError, match="got toy-2"):
            change()
    assert registry.step(-1, "toy-2")[0].version == "toy-1"


def test_a_model_anywhere_can_be_put_in_service_and_the_one_before_stays(decoder: Decoder, tmp_path: Path) -> None:
    registry = a_registry(decoder, tmp_path, "toy-2")
    place = a_place(tmp_path, "toy-5")
    assert [model.version for model in registry.go_to(place)] == ["toy-5", "toy-2"]
    assert [model.version for model in registry.go_to(registry.base)] == ["toy-1", "toy-5"]
    assert order(registry) == ["toy-1", "toy-2", "toy-5", "toy-1"]
    assert registry.go_to(registry.base) == (registry.current, registry.current)
    assert registry.step(-1)[0].version == "toy-5"
    with pytest.raises(ModelExistsError, match="toy-2"):
        registry.swap(registry.models[1].decoder)


def test_what_cannot_be_noted_changes_nothing(decoder: Decoder, tmp_path: Path) -> None:
    registry = a_registry(decoder, tmp_path, "toy-2")
    registry.step(-1)
    before = (registry.history, registry.models)
    place = a_place(tmp_path, "toy-3")
    for change in (
        lambda: registry.step(1, "", refuse),
        lambda: registry.go_to(place, "", refuse),
        lambda: registry.swap(Decoder.load(place.path, 1), None, refuse),
    ):
        with pytest.raises(BundleError, match="note"):
            change()
        assert (registry.history, registry.models) == before


def test_the_history_is_bounded(decoder: Decoder, tmp_path: Path) -> None:
    registry = a_registry(decoder, tmp_path, "toy-2")
    other = registry.history.current
    for _ in range(HISTORY):
        registry.go_to(registry.base)
        registry.go_to(other)
    assert (len(registry.history.places), registry.current.version) == (HISTORY, "toy-2")


def test_deleted_bundles_leave_the_history_but_loaded_ones_stay(decoder: Decoder, tmp_path: Path) -> None:
    registry = a_registry(decoder, tmp_path, "toy-2", "toy-3", "toy-4", kept=2)
    noted: list[History] = []
    registry.forget([tmp_path / "toy-2.zip", tmp_path / "toy-3.zip"], noted.append)
    assert order(registry) == ["toy-1", "toy-3", "toy-4"]
    assert noted == [registry.history]
    assert registry.current.version == "toy-4"
    registry.forget([], noted.append)
    assert len(noted) == 1


def test_other_devices_and_bundles_that_cannot_be_tracked_are_refused(decoder: Decoder, tmp_path: Path) -> None:
    manifest = decoder.bundle.manifest.model_copy(update={"camera_bit_depth": 10})
    deep = Decoder(replace(decoder.bundle, manifest=manifest), 1, decoder.graph)
    same = Decoder.load(a_place(tmp_path, "toy-2").path, 1)

    def tracker(made: Decoder) -> NoTracker:
        if made is not decoder:
            raise CalibrationError("calibration", "no table", "a calibration document")
        return NoTracker(made)

    with pytest.raises(BundleError, match="calibration"):
        ModelRegistry(decoder, tracker).tracked(same)
    with pytest.raises(BundleError, match="got 10 bits"):
        ModelRegistry(decoder).tracked(deep)
    ModelRegistry(decoder).tracked(same)
