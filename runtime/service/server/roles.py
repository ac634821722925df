"""The caller that a connection's certificate names, and the role that each call needs."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from functools import lru_cache

from cryptography import x509
from cryptography.x509.oid import NameOID

from lightpage.errors import NotAllowedError
from lightpage.runtime.service.caller import ROLE_URI, Identity, Role

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


@lru_cache(CERTIFICATES_KEPT)
def identity_of(certificate: bytes) -> Identity:
    """The owner of a certificate, PEM or DER, that has been verified.

    Raises:
        NotAllowedError: it cannot be read.
    """
    load = x509.load_pem_x509_certificate if certificate.startswith(b"-----") else x509.load_der_x509_certificate
    uris: list[str] = []
    try:
        read = load(certificate)
        names = read.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
        with suppress(x509.ExtensionNotFound):
            told = read.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
            uris = told.get_values_for_type(x509.UniformResourceIdentifier)
    except (ValueError, x509.DuplicateExtension, x509.UnsupportedGeneralNameType) as error:
        raise NotAllowedError("certificate of the caller", error, "one that can be read") from None
    name = str(names[0].value) if names else f"certificate {read.serial_number:x}"
    name = name if name.isprintable() else ascii(name)[1:-1]
    roles = (Role(role) for uri in uris if (role := uri.removeprefix(ROLE_URI)) != uri and role in list(Role))
    return Identity(name, frozenset(roles), read.not_valid_after_utc.timestamp())
