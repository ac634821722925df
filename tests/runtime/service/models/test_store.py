"""The store: what it remembers, whom it keeps out, what it sweeps, what it says when it is not well or hangs."""

from __future__ import annotations

import errno
import itertools
import json
import os
import shutil
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from lightpage.errors import BundleError, StoreError
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.models.registry import ModelRegistry
from lightpage.runtime.service.models.store import (
    CURRENT,
    DAMAGED,
    KEPT_BUNDLES,
    LOCK,
    PROBE_S,
    ModelStore,
    Origin,
)
from lightpage.runtime.service.models.store_health import LONGEST_S, StoreHealth
from tests.clock import HandClock
from tests.runtime import toy
from tests.waiting import eventually


@pytest.fixture
def store(decoder: Decoder, tmp_path: Path) -> ModelStore:
    """It is tried whenever somebody asks."""
    return ModelStore(tmp_path / "store", decoder.bundle, clock=itertools.count(0.0, PROBE_S).__next__)


def a_plane(decoder: Decoder, store: ModelStore, **options: object) -> DataPlane:
    """A service as it is after a restart."""
    clock = itertools.count(0.0, PROBE_S).__next__
    again = ModelStore(store.folder, decoder.bundle, **{"clock": clock, **options})  # type: ignore[arg-type]
    plane = DataPlane(ModelRegistry(decoder), store=again)
    plane.models.resume()
    return plane


def put(store: ModelStore, *versions: str) -> None:
    for version in versions:
        toy.write_toy_bundle(store.path_of(version), version=version)


@pytest.fixture
def worn(decoder: Decoder, store: ModelStore) -> DataPlane:
    """A service with a history: base, r1, r2, r3."""
    put(store, "toy-1+r1", "toy-1+r2", "toy-1+r3")
    plane = a_plane(decoder, store)
    plane.models.activate("toy-1+r1")
    plane.models.activate("toy-1+r2")
    plane.models.activate("toy-1+r3")
    return plane


def trouble(plane: DataPlane) -> str:
    """What is wrong with the store, empty where nothing is."""
    found = plane.models.trouble()
    return "" if found is None else found.text


def figure(plane: DataPlane, name: str, **labels: str) -> float | None:
    return plane.metrics.registry.get_sample_value(name, labels)


def test_the_history_survives_a_restart(worn: DataPlane, decoder: Decoder, store: ModelStore) -> None:
    worn.models.rollback()
    after = a_plane(decoder, store)
    assert after.registry.history == worn.registry.history
    assert after.registry.current.version == "toy-1+r2"
    assert after.models.roll_forward()[0].version == "toy-1+r3"
    again = a_plane(decoder, store)
    assert [again.models.rollback()[0].version for _ in range(3)] == ["toy-1+r2", "toy-1+r1", "toy-1"]
    assert a_plane(decoder, store).models.roll_forward()[0].version == "toy-1+r1"


def test_pins_and_origins_survive_a_restart_and_another_base(
    worn: DataPlane, decoder: Decoder, store: ModelStore, tmp_path: Path
) -> None:
    assert worn.models.pin("toy-1+r1", True).pinned
    assert worn.store is not None
    worn.store.change(origins={"toy-1+r2": Origin.UPLOADED})
    other = Bundle.open(toy.write_toy_bundle(tmp_path / "other.zip", version="other"))
    for base, places in ((decoder.bundle, 4), (other, 1)):
        note = ModelStore(store.folder, base).read()
        assert (note.origins, note.pinned) == ({"toy-1+r2": Origin.UPLOADED}, {"toy-1+r1"})
        assert len(note.history) == places


def test_a_second_service_is_kept_out_and_what_a_killed_one_left_is_swept(decoder: Decoder, store: ModelStore) -> None:
    put(store, "toy-1+r1")
    (store.folder / ".toy-1+r2.zip-abc").mkdir()
    (store.folder / ".toy-1+r2.zip-abc" / "bundle.zip").write_bytes(b"half")
    for name in (".upload-x", ".probe-x", f".{CURRENT}-x", ".nfs1", "notes.txt"):
        (store.folder / name).write_bytes(b"half")
    (store.folder / ".upload-link").symlink_to(store.path_of("toy-1+r1"))
    again = ModelStore(store.folder, decoder.bundle)
    with store.locked():
        left = sorted(path.name for path in store.folder.iterdir())
        with pytest.raises(StoreError, match="model store"), again.locked():
            raise AssertionError("two at once")
    assert left == sorted([".nfs1", LOCK, "notes.txt", "toy-1+r1.zip"])
    with again.locked():
        pass


def test_a_damaged_bundle_is_said_and_the_newest_before_it_that_is_there_serves(
    worn: DataPlane, decoder: Decoder, store: ModelStore
) -> None:
    store.path_of("toy-1+r3").write_bytes(b"damaged")
    store.path_of("toy-1+r1").unlink()
    plane = a_plane(decoder, store)
    assert plane.models.current.version == "toy-1+r2"
    assert "toy-1+r3.zip" in trouble(plane)
    assert figure(plane, "lightpage_store_ok") == 0
    assert figure(plane, "lightpage_store_trouble", reason="bundle") == 1
    assert figure(plane, "lightpage_model_info", version="toy-1+r2") == 1
    plane.models.pin("toy-1", True)  # says nothing of what is to be in service
    assert "toy-1+r3.zip" in trouble(a_plane(decoder, store))
    assert plane.models.rollback()[0].version == "toy-1"
    assert trouble(plane) == trouble(a_plane(decoder, store)) == ""
    store.path_of("toy-1+r2").unlink()
    assert "toy-1+r2.zip" in trouble(a_plane(decoder, store))


def test_nothing_is_deleted_while_it_is_not_settled_what_is_to_be_in_service(
    worn: DataPlane, decoder: Decoder, store: ModelStore
) -> None:
    (store.folder / CURRENT).unlink()
    plane = a_plane(decoder, store, kept=0)
    assert plane.store is not None
    plane.models.prune(plane.store)
    assert plane.store.versions() == ["toy-1+r1", "toy-1+r2", "toy-1+r3"]
    plane.models.activate("toy-1+r2")
    plane.models.prune(plane.store)
    assert plane.store.versions() == ["toy-1+r2"]


@pytest.mark.usefixtures("worn")
@pytest.mark.parametrize("content", [None, "junk"])
def test_a_note_that_is_damaged_or_gone_is_said(content: str | None, decoder: Decoder, store: ModelStore) -> None:
    note = store.folder / CURRENT
    note.unlink()
    if content is not None:
        note.write_text(content)
    plane = a_plane(decoder, store)
    assert plane.models.current.version == "toy-1"
    assert CURRENT in trouble(plane)
    assert figure(plane, "lightpage_store_trouble", reason="note") == 1
    assert note.exists() == (content is not None)  # the next start says it again
    plane.models.activate("toy-1+r2")
    kept = store.folder / DAMAGED
    assert (kept.read_text() if kept.exists() else None) == content
    assert trouble(plane) == ""
    assert a_plane(decoder, store).registry.current.version == "toy-1+r2"


@pytest.mark.usefixtures("worn")
@pytest.mark.parametrize(
    "change",
    [
        {"cursor": 7},
        {"cursor": -1},
        {"cursor": "x"},
        {"history": [None, 3]},
        {"history": ["../x"], "cursor": 0},
        {"base": 3, "pinned": 3},
    ],
)
def test_a_note_that_contradicts_itself_is_damaged(change: dict[str, object], store: ModelStore) -> None:
    note = store.folder / CURRENT
    note.write_text(json.dumps(json.loads(note.read_text()) | change))
    with pytest.raises(BundleError, match=CURRENT):
        store.read()


def test_pinned_loaded_and_foreign_bundles_are_never_pruned_and_pruned_ones_leave_the_history(
    decoder: Decoder, store: ModelStore
) -> None:
    names = [f"toy-1+r{number}" for number in range(1, KEPT_BUNDLES + 8)]
    put(store, *names[:6])
    for name in ("bench", *names[6:]):
        store.path_of(name).write_bytes(b"")
    for age, name in enumerate(["bench", *names]):
        os.utime(store.path_of(name), (age, age))
    plane = a_plane(decoder, store)
    plane.models.activate(names[0])
    for name in names[1:6]:
        plane.models.activate(name)
    plane.models.pin(names[1], True)
    assert plane.store is not None
    plane.models.prune(plane.store)
    assert [model.version for model in plane.models.loaded] == names[2:6]
    assert set(plane.store.versions()) == {"bench", *names[1:6], *names[-KEPT_BUNDLES:]}
    assert [place.version for place in plane.models.history.places] == ["toy-1", *names[1:6]]
    assert ModelStore(store.folder, decoder.bundle).read().history == (None, *(f"{name}.zip" for name in names[1:6]))


def _read_only(*_: object, **__: object) -> None:
    raise OSError(errno.EROFS, "Read-only file system")


def test_a_full_disk_is_noticed_and_said_until_there_is_room(
    decoder: Decoder, store: ModelStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    plane = a_plane(decoder, store)
    size = sum(map(len, decoder.bundle.files.values()))
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=2 * size - 1))
        with pytest.raises(StoreError, match="model store"):
            plane.models.check_store()
        assert str(2 * size) in trouble(plane)
        assert figure(plane, "lightpage_store_trouble", reason="full") == 1
        patch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=2 * size))
        assert trouble(plane) == ""
        with pytest.raises(StoreError, match="model store"):
            plane.models.check_store(2 * size + 1)
    assert figure(plane, "lightpage_store_ok") == 1
    assert sorted(path.name for path in store.folder.iterdir()) == [CURRENT]


def test_a_store_that_cannot_be_written_is_noticed_and_nothing_changes(
    worn: DataPlane, monkeypatch: pytest.MonkeyPatch
) -> None:
    models = worn.models
    with monkeypatch.context() as patch:
        for module in ("lightpage.runtime.service.models.store", "lightpage.files"):
            patch.setattr(f"{module}.new_file", _read_only)
        for change in (models.rollback, lambda: models.pin("toy-1", True), lambda: models.activate("toy-1")):
            with pytest.raises(StoreError, match="model store"):
                change()
        assert "Read-only" in trouble(worn)
        assert figure(worn, "lightpage_store_trouble", reason="read_only") == 1
    assert worn.registry.current.version == "toy-1+r3"
    assert not models.entry(worn.registry.models[0]).pinned
    assert trouble(worn) == ""
    assert worn.models.rollback()[0].version == "toy-1+r2"


def test_a_folder_that_is_gone_or_another_is_noticed(decoder: Decoder, store: ModelStore, tmp_path: Path) -> None:
    plane = DataPlane(ModelRegistry(decoder), store=store)
    with store.locked():
        plane.models.resume()
        assert trouble(plane) == ""
        away = store.folder.rename(tmp_path / "away")
        assert figure(plane, "lightpage_store_trouble", reason="gone") == 1
        store.folder.mkdir()  # as under a disk that is not mounted
        (store.folder / LOCK).touch()
        assert "another folder" in trouble(plane)
        with pytest.raises(StoreError, match="another folder"):
            store.change()
        shutil.rmtree(store.folder)
        away.rename(store.folder)
        assert trouble(plane) == ""


def test_the_store_is_tried_now_and_then_and_not_whenever_somebody_asks(
    decoder: Decoder, store: ModelStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = HandClock()
    plane = a_plane(decoder, store, clock=clock.now)
    assert trouble(plane) == ""
    monkeypatch.setattr("lightpage.runtime.service.models.store.new_file", _read_only)
    clock.advance(PROBE_S - 0.1)
    assert trouble(plane) == ""
    clock.advance(0.1)
    assert "Read-only" in trouble(plane)


def test_a_service_without_a_store_has_no_trouble_and_shows_none(decoder: Decoder) -> None:
    plane = DataPlane(ModelRegistry(decoder))
    plane.models.resume()
    plane.models.check_store()
    assert trouble(plane) == ""
    assert figure(plane, "lightpage_store_ok") is None


WAIT_S = 2.0


def test_a_look_at_the_store_that_hangs_is_waited_for_by_nobody_and_shared_by_all() -> None:
    clock, answers, trouble, looks = HandClock(), threading.Event(), "", list[int]()

    def look() -> str:
        looks.append(1)
        answers.wait()
        return trouble

    health = StoreHealth(look, clock=clock)
    assert [health.is_well() for _ in range(8)] == [True] * 8  # nothing is known yet
    clock.advance(LONGEST_S)
    assert health.is_well()
    assert not health.hangs
    clock.advance(0.1)
    assert health.hangs
    assert not health.is_well(WAIT_S)  # no wait: nobody moves the clock
    assert len(looks) == 1
    assert [each.daemon for each in threading.enumerate() if each.name == "lightpage-store-look"] == [True]
    answers.set()
    eventually(lambda: not health.hangs)
    for trouble in ("full", ""):
        assert health.is_well(WAIT_S) == (not trouble)
    assert len(looks) == 3


def test_a_look_that_breaks_is_followed_by_another(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threading, "excepthook", lambda told: None)
    troubles = iter([1, 0, 1])
    health = StoreHealth(lambda: 1 // next(troubles), clock=HandClock())
    assert [health.is_well(WAIT_S) for _ in range(3)] == [False, False, False]
