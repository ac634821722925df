"""Bundles that come from a folder or as uploads: what is whole, good and signed goes to the store, all else is said."""

import logging
import os
import signal
import sqlite3
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from lightpage.errors import BundleError, ModelExistsError, StoreError
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.signature import BundleKey
from lightpage.runtime.model.bundle.signature_file import signature_path
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.service.caller import NOBODY
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.models.audit import AuditLog
from lightpage.runtime.service.models.database import DATABASE
from lightpage.runtime.service.models.incoming import Incoming
from lightpage.runtime.service.models.loader import Loader
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.models.store import Store
from lightpage.runtime.service.models.uploads import take_in
from tests.clock import HandClock
from tests.lightpage.full_disk import full_disk
from tests.runtime import toy
from tests.waiting import eventually


@pytest.fixture
def plane(decoder: Decoder, tmp_path: Path) -> DataPlane:
    return DataPlane(Models(decoder, Store(tmp_path / "store", decoder.bundle)))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (made := tmp_path / "incoming").mkdir()
    return made


def incoming_of(plane: DataPlane, folder: Path, *options: Any) -> Incoming:
    return Incoming(plane.models, plane.limits.model_bytes, plane.uploads, folder, *options)


def versions(plane: DataPlane) -> list[str]:
    return [entry.manifest.version for entry in plane.models.entries(stored=True)]


def test_a_bundle_is_moved_to_the_store_once_it_is_whole(plane: DataPlane, folder: Path) -> None:
    incoming, path = incoming_of(plane, folder), folder / "new.zip"
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
    assert plane.models.current.version == "toy-1"


def test_what_is_refused_is_said_once_and_stays(
    plane: DataPlane, folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    incoming, path = incoming_of(plane, folder), folder / "bad.zip"
    path.write_bytes(b"no zip")
    (folder / "link.zip").symlink_to(toy.write_toy_bundle(folder.parent / "elsewhere.zip", version="toy-3"))
    for _ in range(4):
        incoming.look()
    assert sum("bad.zip" in record.getMessage() for record in caplog.records) == 1
    assert path.exists()
    path.unlink()
    toy.write_toy_bundle(path, version="toy-2")
    incoming.look()
    incoming.look()
    assert versions(plane) == ["toy-2", "toy-1"]


def test_what_the_store_cannot_take_is_tried_again(
    plane: DataPlane, folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    incoming = incoming_of(plane, folder)
    toy.write_toy_bundle(folder / "new.zip", version="toy-2")
    incoming.look()
    with full_disk(10):
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
    with incoming_of(plane, folder, 5.0, clock):
        clock.until_somebody_waits()
        assert versions(plane) == ["toy-1"]
        eventually(lambda: clock.advance(5.0) or "as toy-2" in caplog.text)
    assert versions(plane) == ["toy-2", "toy-1"]


class Signer:
    """A private key, and the public one in a file."""

    def __init__(self, folder: Path, name: str = "signing") -> None:
        self._key = ec.generate_private_key(ec.SECP256R1())
        self.path = folder / f"{name}.pem"
        form = serialization.PublicFormat.SubjectPublicKeyInfo
        self.path.write_bytes(self._key.public_key().public_bytes(serialization.Encoding.PEM, form))

    def signature(self, bundle: Path) -> bytes:
        return self._key.sign(bundle.read_bytes(), ec.ECDSA(hashes.SHA256()))

    def sign(self, bundle: Path) -> None:
        signature_path(bundle).write_bytes(self.signature(bundle))


running: list[Models] = []


def begin(folder: Path, signer: Signer | None, **options: int) -> DataPlane:
    """A service as it is after a restart, which ends the one before; without a signer it has no key."""
    while running:
        running.pop().store.close()
    base = folder / "base.zip"
    if not base.exists():
        toy.write_toy_bundle(base)
    if signer is not None:
        signer.sign(base)
    key = None if signer is None else BundleKey(signer.path)
    decoder = Decoder(Bundle.open(base, key=key), threads=1)
    running.append(Models(decoder, Store(folder / "store", decoder.bundle, **options), Loader(key=key)))
    return DataPlane(running[0])


class Signed:
    def __init__(self, folder: Path) -> None:
        self.signer, self.folder, self.store = Signer(folder), folder, folder / "store"
        self.plane = begin(folder, self.signer)
        self.models = self.plane.models
        self.incoming = folder / "incoming"
        self.incoming.mkdir()

    def bundle(self, version: str) -> tuple[Path, bytes]:
        path = toy.write_toy_bundle(self.folder / f"{version}.zip", version=version)
        return path, self.signer.signature(path)

    def take_in(self, version: str) -> None:
        path, signature = self.bundle(version)
        take_in(self.models, path, signature=signature)

    def looked(self) -> set[str]:
        taking = incoming_of(self.plane, self.incoming)
        taking.look()
        taking.look()
        return set(self.models.versions())


@pytest.fixture
def service(tmp_path: Path) -> Signed:
    return Signed(tmp_path)


def test_a_new_bundle_needs_a_signature(service: Signed) -> None:
    (good, signature), (bad, _) = service.bundle("toy-2"), service.bundle("toy-3")
    for wrong in (b"", signature):
        with pytest.raises(BundleError, match="new bundle: signature"):
            take_in(service.models, bad, signature=wrong)
    take_in(service.models, good, signature=signature)
    assert service.models.activate("toy-2")[0].version == "toy-2"
    assert signature_path(service.store / "toy-2.zip").read_bytes() == signature
    assert not list(service.store.glob("*toy-3*"))


def test_incoming_bundles_need_one(service: Signed) -> None:
    for version in ("toy-2", "toy-3"):
        service.bundle(version)[0].rename(service.incoming / f"{version}.zip")
    service.signer.sign(service.incoming / "toy-2.zip")
    assert service.looked() == {"toy-1", "toy-2"}
    assert sorted(path.name for path in service.incoming.iterdir()) == ["toy-3.zip"]
    service.signer.sign(service.incoming / "toy-3.zip")
    assert service.looked() == {"toy-1", "toy-2", "toy-3"}
    assert not list(service.incoming.iterdir())


@pytest.mark.parametrize("kind", ["link", "pipe"])
def test_a_signature_that_is_no_plain_file_is_refused(service: Signed, kind: str) -> None:
    (secret := service.folder / "secret").write_bytes(b"a private key")
    path = toy.write_toy_bundle(service.incoming / "toy-2.zip", version="toy-2")
    make = {"link": lambda at: at.symlink_to(secret), "pipe": os.mkfifo}
    make[kind](signature_path(path))
    assert service.looked() == {"toy-1"}
    assert not list(service.store.glob("*.sig"))


def test_a_stored_bundle_without_its_own_signature_is_refused(service: Signed) -> None:
    for version in ("toy-2", "toy-3"):
        service.take_in(version)
    other = toy.write_toy_bundle(service.folder / "other.zip", kappa=1.0, version="toy-2")
    (service.store / "toy-2.zip").write_bytes(other.read_bytes())
    signature_path(service.store / "toy-3.zip").unlink()
    for version in ("toy-7", "toy-1+r9"):  # put there by somebody else
        toy.write_toy_bundle(service.store / f"{version}.zip", version=version)
    for version in ("toy-2", "toy-3", "toy-7", "toy-1+r9"):
        with pytest.raises(BundleError, match="signature"):
            service.models.activate(version)


def recalibrated(plane: DataPlane, folder: Path, version: str) -> Path:
    """The bundle of a recalibration that the service has made and put in service."""
    path = toy.write_toy_bundle(folder / "store" / f"{version}.zip", version=version)
    plane.models.adopt(plane.models.current.decoder.of_another(Bundle.open(path)))
    return path


@pytest.mark.parametrize("earlier", ["no", "another"])
def test_a_recalibration_under_no_key_or_another_one_needs_a_signature(tmp_path: Path, earlier: str) -> None:
    signer, before = Signer(tmp_path), Signer(tmp_path, "before")
    own = recalibrated(begin(tmp_path, before if earlier == "another" else None), tmp_path, "toy-1+r1")
    plane = begin(tmp_path, signer)
    assert plane.models.current.version == "toy-1"
    found = plane.models.store.trouble()
    assert found is not None
    assert f"under {earlier} bundle" in found.text
    with pytest.raises(BundleError, match=f"under {earlier} bundle"):
        plane.models.activate("toy-1+r1")
    recalibrated(plane, tmp_path, "toy-1+r2")
    assert begin(tmp_path, signer).models.current.version == "toy-1+r2"
    signer.sign(own)
    assert begin(tmp_path, signer).models.activate("toy-1+r1")[0].version == "toy-1+r1"
    for key in (signer, None):
        assert begin(tmp_path, key).models.current.version == "toy-1+r1"


def test_its_own_models_need_none_and_the_note_names_their_key(service: Signed) -> None:
    recalibrated(service.plane, service.folder, "toy-1+r1")
    service.take_in("toy-2")
    assert begin(service.folder, service.signer).models.current.version == "toy-1+r1"
    found = begin(service.folder, service.signer).models.now.state.bundles
    assert {version for version, known in found.items() if known.key} == {"toy-1+r1"}


def test_without_a_key_no_signature_is_kept(tmp_path: Path) -> None:
    path = toy.write_toy_bundle(tmp_path / "new.zip", version="toy-2")
    take_in(begin(tmp_path, None).models, path, signature=b"some")
    assert [path.name for path in (tmp_path / "store").glob("*toy*")] == ["toy-2.zip"]


def test_pruning_takes_signatures_along(service: Signed) -> None:
    for version in ("toy-2", "toy-3"):
        service.take_in(version)
    begin(service.folder, service.signer, kept=1).models.prune()
    assert sorted(path.name for path in service.store.glob("toy-*")) == ["toy-3.zip", "toy-3.zip.sig"]


def test_a_bundle_of_the_same_version_that_came_meanwhile_stays(service: Signed) -> None:
    path, signature = service.bundle("toy-2")
    with pytest.raises(ModelExistsError, match=r"^new bundle: version"):
        take_in(service.models, path, NOBODY, (service.store / "toy-2.zip").touch, signature)
    assert (service.store / "toy-2.zip").read_bytes() == b""


@pytest.mark.parametrize("end", ["save", "done"])
def test_a_bundle_whose_taking_in_was_killed_is_there_with_all_that_belongs_to_it_or_not(
    service: Signed, end: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, signature = service.bundle("toy-2")
    hidden = path.rename(service.store / ".upload-x")
    if not os.fork():
        die = lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL)  # noqa: E731
        monkeypatch.setattr(*{"save": (service.models.store, "save"), "done": (AuditLog, "done")}[end], die)
        take_in(service.models, hidden, signature=signature)
    os.wait()
    assert signature_path(service.store / "toy-2.zip").read_bytes() == signature
    after = begin(service.folder, service.signer).models
    assert not hidden.exists()
    assert sorted(path.name for path in service.store.glob("toy*")) == ["toy-2.zip", "toy-2.zip.sig"] * (end == "done")
    assert (after.now.state.known("toy-2").origin == "uploaded") == (end == "done")


def test_a_bundle_that_cannot_be_noted_is_not_taken(service: Signed) -> None:
    with sqlite3.connect(service.store / DATABASE) as database:
        database.execute("DROP TABLE audit")
    with pytest.raises(StoreError, match="model store"):
        service.take_in("toy-2")
    assert not list(service.store.glob("toy-2*"))
