"""A service with a bundle key takes signed bundles only, whichever way they come; its own models need no signature."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

from lightpage.errors import BundleError
from runtime.bundle.bundle import Bundle
from runtime.bundle.signature import BundleKey
from runtime.bundle.signature_file import signature_path
from runtime.decoding.decoder import Decoder
from runtime.service.caller import Caller
from runtime.service.dataplane import DataPlane
from runtime.service.incoming import Incoming
from runtime.service.registry import ModelRegistry
from runtime.service.store import ModelStore
from tests.runtime import toy
from tests.runtime.bundle.test_signature import Signer


@dataclass
class Signed:
    """A service that wants signatures, and whoever can make them."""

    plane: DataPlane
    signer: Signer
    folder: Path

    def bundle(self, version: str, *, signed: bool) -> Path:
        path = toy.write_toy_bundle(self.folder / f"{version}.zip", version=version)
        if signed:
            self.signer.sign(path)
        return path


def begin(folder: Path, signer: Signer | None) -> DataPlane:
    """A service as it is after a restart; without a signer it has no key."""
    base = folder / "base.zip"
    if not base.exists():
        toy.write_toy_bundle(base)
    if signer is not None:
        signer.sign(base)
    key = None if signer is None else BundleKey(signer.path)
    registry = ModelRegistry(Decoder(Bundle.open(base, key=key), threads=1), key=key)
    plane = DataPlane(registry, store=ModelStore(folder / "store", registry.current.decoder.bundle))
    plane.models.resume()
    return plane


@pytest.fixture
def service(tmp_path: Path) -> Signed:
    signer = Signer(tmp_path)
    return Signed(begin(tmp_path, signer), signer, tmp_path)


def uploaded(service: Signed, path: Path, signature: bytes = b"") -> str:
    """Send a bundle to the service; returns the version that it then has."""
    content = path.read_bytes()
    upload = service.plane.models.upload(len(content), hashlib.sha256(content).digest(), Caller(), signature)
    try:
        upload.begin()
        upload.add(content)
        return upload.finish().manifest.version
    finally:
        upload.drop()


def test_an_upload_needs_a_signature(service: Signed) -> None:
    good, bad = service.bundle("toy-2", signed=True), service.bundle("toy-3", signed=False)
    signature = signature_path(good).read_bytes()
    for wrong in (b"", signature):
        with pytest.raises(BundleError, match="new bundle: signature"):
            uploaded(service, bad, wrong)
    assert uploaded(service, good, signature) == "toy-2"
    assert service.plane.models.activate("toy-2")[0].version == "toy-2"
    stored = service.folder / "store" / "toy-2.zip"
    assert signature_path(stored).read_bytes() == signature
    assert not [path for path in stored.parent.iterdir() if "toy-3" in path.name or "upload" in path.name]


def test_incoming_bundles_need_one(service: Signed) -> None:
    incoming = service.folder / "incoming"
    incoming.mkdir()
    for version, signed in (("toy-2", True), ("toy-3", False)):
        made = service.bundle(version, signed=signed)
        for path in (made, signature_path(made)):
            if path.exists():
                path.rename(incoming / path.name)
    taking = Incoming(service.plane, incoming)
    taking.look()
    taking.look()
    assert sorted(path.name for path in incoming.iterdir()) == ["toy-3.zip"]
    assert set(service.plane.models.versions()) == {"toy-1", "toy-2"}
    service.signer.sign(incoming / "toy-3.zip")
    taking.look()
    taking.look()
    assert not list(incoming.iterdir())
    assert set(service.plane.models.versions()) == {"toy-1", "toy-2", "toy-3"}


def test_a_stored_bundle_that_was_changed_is_refused(service: Signed, tmp_path: Path) -> None:
    good = service.bundle("toy-2", signed=True)
    signature = signature_path(good).read_bytes()
    service.plane.models.take_in(good, signature=signature)
    stored = tmp_path / "store" / "toy-2.zip"
    stored.write_bytes(toy.write_toy_bundle(tmp_path / "other.zip", kappa=1.0, version="toy-2").read_bytes())
    with pytest.raises(BundleError, match="signature"):
        service.plane.models.activate("toy-2")


def test_a_bundle_that_somebody_puts_into_the_store_needs_one(service: Signed, tmp_path: Path) -> None:
    toy.write_toy_bundle(tmp_path / "store" / "toy-7.zip", version="toy-7")
    toy.write_toy_bundle(tmp_path / "store" / "toy-1+r9.zip", version="toy-1+r9")
    good = service.bundle("toy-2", signed=True)
    service.plane.models.take_in(good, signature=signature_path(good).read_bytes())
    signature_path(tmp_path / "store" / "toy-2.zip").unlink()
    for version in ("toy-7", "toy-1+r9", "toy-2"):
        with pytest.raises(BundleError, match="signature"):
            service.plane.models.activate(version)


def test_a_signature_may_be_put_beside_a_bundle_that_was_taken_in_without_one(tmp_path: Path) -> None:
    signer, new = Signer(tmp_path), toy.write_toy_bundle(tmp_path / "new.zip", version="toy-2")
    signature = signer.signature(new)
    begin(tmp_path, None).models.take_in(new)
    plane = begin(tmp_path, signer)
    with pytest.raises(BundleError, match="signature"):
        plane.models.activate("toy-2")
    signature_path(tmp_path / "store" / "toy-2.zip").write_bytes(signature)
    assert plane.models.activate("toy-2")[0].version == "toy-2"
    assert begin(tmp_path, signer).registry.current.version == "toy-2"


def test_without_a_key_no_signature_is_kept(toy_zip: Path, tmp_path: Path) -> None:
    registry = ModelRegistry(Decoder.load(toy_zip, threads=1))
    plane = DataPlane(registry, store=ModelStore(tmp_path / "store", registry.current.decoder.bundle))
    plane.models.take_in(toy.write_toy_bundle(tmp_path / "new.zip", version="toy-2"), signature=b"anything")
    assert sorted(path.name for path in (tmp_path / "store").glob("*toy*")) == ["toy-2.zip"]


@pytest.mark.parametrize("kind", ["link", "pipe", "folder"])
def test_a_signature_that_is_no_plain_file_is_refused(service: Signed, kind: str) -> None:
    incoming = service.folder / "incoming"
    incoming.mkdir()
    secret = service.folder / "secret"
    secret.write_bytes(b"a private key")
    path = toy.write_toy_bundle(incoming / "toy-2.zip", version="toy-2")
    make = {"link": lambda at: at.symlink_to(secret), "pipe": os.mkfifo, "folder": Path.mkdir}
    make[kind](signature_path(path))
    taking = Incoming(service.plane, incoming)
    taking.look()
    taking.look()
    assert set(service.plane.models.versions()) == {"toy-1"}
    assert not list((service.folder / "store").glob("*.sig"))


def test_its_own_models_need_none(service: Signed, tmp_path: Path) -> None:
    recalibrated(service.plane, tmp_path, "toy-1+r1")
    assert begin(tmp_path, service.signer).registry.current.version == "toy-1+r1"


def recalibrated(plane: DataPlane, folder: Path, version: str) -> Path:
    """The bundle of a recalibration that the service has made and put in service."""
    path = toy.write_toy_bundle(folder / "store" / f"{version}.zip", version=version)
    plane.adopt(plane.registry.current.decoder.of_another(Bundle.open(path)))
    return path


@pytest.mark.parametrize("earlier", ["no", "another"])
def test_a_recalibration_under_no_key_or_another_one_needs_a_signature(tmp_path: Path, earlier: str) -> None:
    signer, before = Signer(tmp_path), Signer(tmp_path, "before")
    own = recalibrated(begin(tmp_path, before if earlier == "another" else None), tmp_path, "toy-1+r1")
    plane = begin(tmp_path, signer)
    assert plane.registry.current.version == "toy-1"
    assert f"under {earlier} bundle" in plane.store_trouble()
    with pytest.raises(BundleError, match=f"under {earlier} bundle"):
        plane.models.activate("toy-1+r1")
    recalibrated(plane, tmp_path, "toy-1+r2")
    assert begin(tmp_path, signer).registry.current.version == "toy-1+r2"
    signer.sign(own)
    assert begin(tmp_path, signer).models.activate("toy-1+r1")[0].version == "toy-1+r1"
    assert begin(tmp_path, signer).registry.current.version == "toy-1+r1"
    assert begin(tmp_path, None).registry.current.version == "toy-1+r1"


def test_the_note_names_the_key_of_recalibrations_and_of_nothing_else(service: Signed, tmp_path: Path) -> None:
    recalibrated(service.plane, tmp_path, "toy-1+r1")
    good = service.bundle("toy-2", signed=True)
    service.plane.models.take_in(good, signature=signature_path(good).read_bytes())
    told = json.loads((tmp_path / "store" / "current.json").read_text())["keys"]
    command = f"openssl pkey -pubin -in {service.signer.path} -outform DER"
    key = subprocess.run(command.split(), check=True, capture_output=True, timeout=30).stdout
    assert told == {"toy-1+r1": hashlib.sha256(key).hexdigest()}


def test_pruning_takes_signatures_along(service: Signed) -> None:
    store = ModelStore(service.folder / "store", service.plane.registry.current.decoder.bundle, kept=1)
    for version in ("toy-2", "toy-3"):
        good = service.bundle(version, signed=True)
        service.plane.models.take_in(good, signature=signature_path(good).read_bytes())
    store.note = service.plane.store.note  # type: ignore[union-attr]
    store.prune(())
    assert sorted(path.name for path in (service.folder / "store").glob("toy-*")) == ["toy-3.zip", "toy-3.zip.sig"]
