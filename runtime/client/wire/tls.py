"""Certificates of one end of a connection: where they lie, and whether they are any good."""

from __future__ import annotations

import ssl
from dataclasses import dataclass
from pathlib import Path

import grpc

from lightpage.errors import InvalidInputError


@dataclass(frozen=True)
class Pem:
    """The contents of three files, PEM."""

    ca: bytes
    certificate: bytes
    key: bytes


@dataclass(frozen=True)
class TlsFiles:
    """What one end of a connection proves with who it is, and believes the other end by.

    Attributes:
        ca: certificates of the authorities that the other end's certificate may come from, PEM.
        certificate: this end's own, PEM, with those between it and its authority behind it.
        key: its private key, PEM, without a password.
    """

    ca: Path | str
    certificate: Path | str
    key: Path | str

    def read(self) -> Pem:
        """Read the files.

        Raises:
            InvalidInputError: one cannot be read, or holds no certificate, or the key belongs to another certificate.
        """
        pem = Pem(*(_read(name, Path(path)) for name, path in vars(self).items()))
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        try:
            context.load_verify_locations(self.ca)
        except (OSError, ValueError):  # an SSLError is an OSError
            raise InvalidInputError(f"ca {self.ca}", "no certificate", "certificates of authorities, PEM") from None
        try:
            context.load_cert_chain(self.certificate, self.key, password=_no_password)
        except (OSError, ValueError) as error:  # an SSLError is an OSError
            got = getattr(error, "reason", None) or error
            expected = "a certificate and its private key, PEM, without a password"
            raise InvalidInputError(f"certificate {self.certificate} with key {self.key}", got, expected) from None
        return pem

    def client_context(self) -> ssl.SSLContext:
        """What an HTTP client connects with; raises as `read`."""
        self.read()
        context = ssl.create_default_context(cafile=str(self.ca))
        context.load_cert_chain(self.certificate, self.key)
        return context

    def channel_credentials(self) -> grpc.ChannelCredentials:
        """What a client connects with; raises as `read`."""
        pem = self.read()
        return grpc.ssl_channel_credentials(pem.ca, pem.key, pem.certificate)


def _read(name: str, path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InvalidInputError(f"{name} {path}", error, "a file that can be read") from None


def _no_password() -> str:
    raise ValueError("a key with a password")
