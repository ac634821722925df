"""An authority that issues certificates for tests."""

import inspect
import ipaddress
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from lightpage.runtime.client.wire.channel import TlsFiles
from lightpage.runtime.service.caller import ROLE_URI

_DAY = timedelta(days=1)
_USES = inspect.signature(x509.KeyUsage).parameters
_SIGNS_CERTIFICATES = x509.KeyUsage(**{name: name in ("key_cert_sign", "crl_sign") for name in _USES})


@dataclass
class Authority:
    """Writes `NAME.pem` and `NAME.key` to a folder, and its own certificate as `ca.pem`."""

    folder: Path
    name: str = "authority"
    valid_for: timedelta = _DAY

    def __post_init__(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        self._key = ec.generate_private_key(ec.SECP256R1())
        subject = _named(self.name)
        builder = _begun(subject, subject, self._key.public_key(), self.valid_for)
        builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        builder = builder.add_extension(_SIGNS_CERTIFICATES, critical=True)
        (self.folder / "ca.pem").write_bytes(_pem(builder.sign(self._key, hashes.SHA256())))

    def service(self, name: str = "service", valid_for: timedelta = 90 * _DAY) -> TlsFiles:
        """A certificate for a server on this machine."""
        names = [x509.DNSName("localhost"), x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]
        return self._issue(name, names, ExtendedKeyUsageOID.SERVER_AUTH, valid_for)

    def caller(self, name: str, roles: Sequence[str] = (), valid_for: timedelta = _DAY) -> TlsFiles:
        """A certificate for a caller."""
        names = [x509.UniformResourceIdentifier(ROLE_URI + role) for role in roles]
        return self._issue(name, names, ExtendedKeyUsageOID.CLIENT_AUTH, valid_for)

    def _issue(
        self, name: str, names: Sequence[x509.GeneralName], usage: x509.ObjectIdentifier, valid_for: timedelta
    ) -> TlsFiles:
        key = ec.generate_private_key(ec.SECP256R1())
        builder = _begun(_named(name), _named(self.name), key.public_key(), valid_for)
        builder = builder.add_extension(x509.ExtendedKeyUsage([usage]), critical=False)
        issuer = x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key())
        builder = builder.add_extension(issuer, critical=False)
        if names:
            builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
        files = TlsFiles(self.folder / "ca.pem", self.folder / f"{name}.pem", self.folder / f"{name}.key")
        files.certificate.write_bytes(_pem(builder.sign(self._key, hashes.SHA256())))
        private = key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
        files.key.write_bytes(private)
        return files


def _begun(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, valid_for: timedelta
) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    builder = x509.CertificateBuilder(
        issuer_name=issuer,
        subject_name=subject,
        public_key=key,
        serial_number=x509.random_serial_number(),
        not_valid_before=now - 2 * _DAY,
        not_valid_after=now + valid_for,
    )
    return builder.add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)


def _named(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)
