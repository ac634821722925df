"""Detached signatures of bundles: a file beside a zip says that whoever has the private key has seen it."""

import hashlib
from pathlib import Path

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from lightpage.errors import BundleError, InvalidInputError
from lightpage.runtime.model.bundle.signature_file import SUFFIX


class BundleKey:
    """A public key of an elliptic curve. Signatures are ECDSA over SHA-256, as ``openssl dgst -sha256 -sign`` has them.

    Args:
        path: path of the key, PEM.

    Raises:
        InvalidInputError: there is no such key.
    """

    def __init__(self, path: Path) -> None:
        subject, expected = f"bundle key {path}", "a public key of an elliptic curve, PEM"
        try:
            key = serialization.load_pem_public_key(path.read_bytes())
        except OSError as error:
            raise InvalidInputError(subject, error, "a file that can be read") from None
        except (ValueError, UnsupportedAlgorithm):
            raise InvalidInputError(subject, "no public key", expected) from None
        if not isinstance(key, ec.EllipticCurvePublicKey):
            raise InvalidInputError(subject, "a key of another kind", expected)
        self._key = key

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the key as DER (SubjectPublicKeyInfo), hexadecimal."""
        kind = serialization.PublicFormat.SubjectPublicKeyInfo
        return hashlib.sha256(self._key.public_bytes(serialization.Encoding.DER, kind)).hexdigest()

    def check(self, content: bytes, signature: bytes, subject: str) -> None:
        """Check that a bundle is signed.

        Args:
            content: bytes of the bundle's zip.
            signature: signature of the zip; empty for none.
            subject: the bundle, for errors.

        Raises:
            BundleError: it is not.
        """
        expected = f"one that the bundle key confirms; it is the file with {SUFFIX} behind the bundle's name"
        if not signature:
            raise BundleError(f"{subject}: signature", "none", expected)
        try:
            self._key.verify(signature, content, ec.ECDSA(hashes.SHA256()))
        except InvalidSignature:
            raise BundleError(f"{subject}: signature", "one of another bundle or key", expected) from None
