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


def _pem(key: ec.EllipticCurvePublicKey | ed25519.Ed25519PublicKey) -> bytes:
    return key.public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)


@pytest.fixture
def key(tmp_path: Path) -> ec.EllipticCurvePrivateKey:
    """A private key, and the public one in a file."""
    key = ec.generate_private_key(ec.SECP256R1())
    (tmp_path / "key.pem").write_bytes(_pem(key.public_key()))
    return key


@pytest.fixture
def bundle(toy_zip: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(toy_zip, tmp_path / "mine.zip"))


def test_a_bundle_is_loaded_if_it_is_signed_with_the_key_and_no_other(
    bundle: Path, key: ec.EllipticCurvePrivateKey, toy_folder: Path, tmp_path: Path
) -> None:
    signature, public = key.sign(bundle.read_bytes(), ec.ECDSA(hashes.SHA256())), BundleKey(tmp_path / "key.pem")
    assert Bundle.open(bundle, key=public, signature=signature).version == "toy-1"
    with pytest.raises(BundleError, match=r"mine\.zip: signature"):
        Bundle.open(bundle, key=public)
    signature_path(bundle).write_bytes(signature)
    assert Bundle.open(bundle, key=public).version == "toy-1"
    (tmp_path / "other.pem").write_bytes(_pem(ec.generate_private_key(ec.SECP256R1()).public_key()))
    with pytest.raises(BundleError, match="signature"):
        Bundle.open(bundle, key=BundleKey(tmp_path / "other.pem"))
    with bundle.open("ab") as file:
        file.write(b"\0")
    for path in (bundle, toy_folder):
        with pytest.raises(BundleError, match="signature"):
            Bundle.open(path, key=public)


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
