"""Signed bundles: no other is loaded where a key is given."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519

from lightpage.errors import BundleError, InvalidInputError
from runtime.bundle.bundle import Bundle
from runtime.bundle.signature import BundleKey
from runtime.bundle.signature_file import signature_path


class Signer:
    """A private key, and the public one in a file."""

    def __init__(self, folder: Path, name: str = "signing") -> None:
        self._key = ec.generate_private_key(ec.SECP256R1())
        self.path = folder / f"{name}.pem"
        self.path.write_bytes(_pem(self._key.public_key()))

    def signature(self, bundle: Path) -> bytes:
        return self._key.sign(bundle.read_bytes(), ec.ECDSA(hashes.SHA256()))

    def sign(self, bundle: Path) -> None:
        signature_path(bundle).write_bytes(self.signature(bundle))


def _pem(key: ec.EllipticCurvePublicKey | ed25519.Ed25519PublicKey) -> bytes:
    return key.public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)


@pytest.fixture
def bundle(toy_zip: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(toy_zip, tmp_path / "mine.zip"))


def test_a_signed_bundle_is_loaded(bundle: Path, tmp_path: Path) -> None:
    signer = Signer(tmp_path)
    signer.sign(bundle)
    assert Bundle.open(bundle, key=BundleKey(signer.path)).version == "toy-1"
    signature_path(bundle).unlink()
    with pytest.raises(BundleError, match=r"mine\.zip: signature"):
        Bundle.open(bundle, key=BundleKey(signer.path))
    assert Bundle.open(bundle, key=BundleKey(signer.path), signature=signer.signature(bundle)).version == "toy-1"
    assert Bundle.open(bundle).version == "toy-1"


def test_another_key_and_another_bundle_are_refused(bundle: Path, tmp_path: Path) -> None:
    signer, other = Signer(tmp_path), Signer(tmp_path, "other")
    signer.sign(bundle)
    with pytest.raises(BundleError, match="signature"):
        Bundle.open(bundle, key=BundleKey(other.path))
    with bundle.open("ab") as file:
        file.write(b"\0")
    with pytest.raises(BundleError, match="signature"):
        Bundle.open(bundle, key=BundleKey(signer.path))


def test_a_folder_is_refused(toy_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(BundleError, match="signature"):
        Bundle.open(toy_folder, key=BundleKey(Signer(tmp_path).path))


def test_what_openssl_signs_is_confirmed(bundle: Path, tmp_path: Path) -> None:
    private, public = tmp_path / "signing.key", tmp_path / "signing.pem"
    for command in (
        f"openssl ecparam -name prime256v1 -genkey -noout -out {private}",
        f"openssl ec -in {private} -pubout -out {public}",
        f"openssl dgst -sha256 -sign {private} -out {bundle}.sig {bundle}",
    ):
        subprocess.run(command.split(), check=True, capture_output=True, timeout=30)
    assert Bundle.open(bundle, key=BundleKey(public)).version == "toy-1"


def test_a_file_that_is_no_public_key_of_a_curve_is_named(tmp_path: Path) -> None:
    path = tmp_path / "key.pem"
    for content in (None, b"no key", _pem(ed25519.Ed25519PrivateKey.generate().public_key())):
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(InvalidInputError, match=r"key\.pem"):
            BundleKey(path)
