"""A folder of bundles: what is whole and good goes to the store, all else stays and is said."""

from __future__ import annotations

import errno
import logging
from pathlib import Path

import pytest

from runtime.decoding.decoder import Decoder
from runtime.service.dataplane import DataPlane
from runtime.service.incoming import Incoming
from runtime.service.registry import ModelRegistry
from runtime.service.store import ModelStore
from tests.clock import HandClock
from tests.runtime import toy
from tests.waiting import eventually


@pytest.fixture
def plane(decoder: Decoder, tmp_path: Path) -> DataPlane:
    made = DataPlane(ModelRegistry(decoder), store=ModelStore(tmp_path / "store", decoder.bundle))
    made.models.resume()
    return made


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (made := tmp_path / "incoming").mkdir()
    return made


def versions(plane: DataPlane) -> list[str]:
    return [entry.manifest.version for entry in plane.models.entries(stored=True)]


def test_a_bundle_is_moved_to_the_store_once_it_is_whole(plane: DataPlane, folder: Path) -> None:
    incoming, path = Incoming(plane, folder), folder / "new.zip"
    whole = toy.write_toy_bundle(folder / "new.part", version="toy-2")
    data = toy.write_toy_bundle(folder.parent / "toy-2.zip", version="toy-2").read_bytes()
    path.write_bytes(data[:100])
    incoming.look()
    path.write_bytes(data)
    incoming.look()  # it has changed
    assert versions(plane) == ["toy-1"]
    incoming.look()
    assert versions(plane) == ["toy-2", "toy-1"]
    assert [file.name for file in folder.iterdir()] == [whole.name]
    assert plane.registry.current.version == "toy-1"


def test_what_is_refused_is_said_once_and_stays(
    plane: DataPlane, folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    incoming, path = Incoming(plane, folder), folder / "bad.zip"
    path.write_bytes(b"no zip")
    (folder / "link.zip").symlink_to(toy.write_toy_bundle(folder.parent / "elsewhere.zip", version="toy-3"))
    for _ in range(4):
        incoming.look()
    assert sum("bad.zip" in record.getMessage() for record in caplog.records) == 1
    assert path.exists()
    path.unlink()
    toy.write_toy_bundle(path, version="toy-2")
    for _ in range(2):
        incoming.look()
    assert versions(plane) == ["toy-2", "toy-1"]


def test_what_the_store_cannot_take_is_tried_again(
    plane: DataPlane, folder: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    incoming = Incoming(plane, folder)
    toy.write_toy_bundle(folder / "new.zip", version="toy-2")
    incoming.look()

    def read_only(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    with monkeypatch.context() as patch:
        patch.setattr("runtime.service.store.new_file", read_only)
        incoming.look()
        incoming.look()
    assert sum("new.zip" in record.getMessage() for record in caplog.records) == 1
    incoming.look()
    assert versions(plane) == ["toy-2", "toy-1"]


def test_the_folder_is_looked_at_while_the_service_runs(
    plane: DataPlane, folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    clock = HandClock()
    toy.write_toy_bundle(folder / "new.zip", version="toy-2")
    with Incoming(plane, folder, 5.0, clock):
        clock.until_somebody_waits()
        assert versions(plane) == ["toy-1"]
        eventually(lambda: clock.advance(5.0) or "as toy-2" in caplog.text)
    assert versions(plane) == ["toy-2", "toy-1"]
