"""Who calls, by the certificate of the connection, and which call needs which role."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache

from cryptography import x509
from cryptography.x509.oid import NameOID

from lightpage.errors import NotAllowedError


class Role(StrEnum):
    """What a caller may do. Every role may look; none but `ADMIN` includes another."""

    READ = "read"
    """See what the service is and does."""
    DECODE = "decode"
    """Have pages decoded and read, and show pages."""
    RECALIBRATE = "recalibrate"
    """Start and cancel recalibrations."""
    ADMIN = "admin"
    """All of it, and change models."""


ROLE_URI = "urn:lightpage:role:"
"""A certificate's subject alternative names of this kind, with a role behind, say what its owner may do."""

NEEDED: Mapping[str, Role] = {
    **dict.fromkeys(["Describe", "ListModels", "ListJobs", "GetJob", "WatchJob"], Role.READ),
    **dict.fromkeys(["DecodeFrames", "DecodePages", "ReadPage", "ReadPages", "ReadData"], Role.DECODE),
    **dict.fromkeys(["inference/ServerLive", "inference/ServerReady", "inference/ModelReady"], Role.READ),
    **dict.fromkeys(["inference/ServerMetadata", "inference/ModelMetadata"], Role.READ),
    "inference/ModelInfer": Role.DECODE,
    **dict.fromkeys(["UploadPages", "WatchDisplay", "ReportDisplay"], Role.DECODE),
    **dict.fromkeys(["Recalibrate", "StartRecalibration", "RecalibrateFrames", "CancelJob"], Role.RECALIBRATE),
    **dict.fromkeys(["UploadModel", "ActivateModel", "PinModel", "Rollback", "RollForward"], Role.ADMIN),
}
"""Of each call the role that it needs."""

CERTIFICATES_KEPT = 256
"""Certificates whose contents are remembered; others are read again."""


@dataclass(frozen=True)
class Identity:
    """A caller.

    Attributes:
        name: the common name of its certificate; empty on a connection that needs none.
        roles: of it.
        until: when the certificate ends, seconds since 1970.
    """

    name: str
    roles: frozenset[Role]
    until: float = math.inf

    def may(self, role: Role) -> bool:
        """Whether it has a role, or one that includes it."""
        return role in self.roles or Role.ADMIN in self.roles or (role is Role.READ and bool(self.roles))

    def check(self, role: Role, what: str, now: float) -> None:
        """Check that it may do something.

        Args:
            role: that this needs.
            what: it does, e.g. ``call Rollback``.
            now: seconds since 1970.

        Raises:
            NotAllowedError: it may not, or its certificate has ended while it was connected.
        """
        if now >= self.until:
            raise NotAllowedError(what, f"a certificate of {self.name} that has expired", "one that is valid")
        if not self.may(role):
            got = f"{self.name} with {_listed(self.roles)}"
            raise NotAllowedError(what, got, f"a certificate with {ROLE_URI}{role}")


LOCAL = Identity("", frozenset(Role))
"""Whoever reaches a service that asks for no certificates: a process of this machine."""
NOBODY = Identity("nobody", frozenset())
"""Whoever has no certificate where one is asked for."""


@lru_cache(CERTIFICATES_KEPT)
def identity_of(certificate: bytes) -> Identity:
    """The owner of a certificate, PEM or DER, that has been verified.

    Raises:
        NotAllowedError: it cannot be read.
    """
    try:
        return _identity_of(certificate)
    except (ValueError, x509.DuplicateExtension, x509.UnsupportedGeneralNameType) as error:
        raise NotAllowedError("certificate of the caller", error, "one that can be read") from None


def _identity_of(certificate: bytes) -> Identity:
    is_pem = certificate.startswith(b"-----")
    read = x509.load_pem_x509_certificate(certificate) if is_pem else x509.load_der_x509_certificate(certificate)
    names = read.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    name = str(names[0].value) if names else f"certificate {read.serial_number:x}"
    name = name if name.isprintable() else ascii(name)[1:-1]
    try:
        told = read.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        uris = told.get_values_for_type(x509.UniformResourceIdentifier)
    except x509.ExtensionNotFound:
        uris = []
    roles = (Role(role) for uri in uris if (role := uri.removeprefix(ROLE_URI)) != uri and role in list(Role))
    return Identity(name, frozenset(roles), read.not_valid_after_utc.timestamp())


def _listed(roles: Iterable[Role]) -> str:
    return ", ".join(f"role {role}" for role in sorted(roles)) or "no role"
