"""The service's certificates, read anew when their files change: nobody restarts a service for a certificate."""

import logging
import math
import os
import ssl
import threading
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from typing import Any

import grpc
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from lightpage.errors import InvalidInputError, NotAllowedError
from lightpage.runtime.client.wire.channel import Pem, TlsFiles
from lightpage.runtime.service.caller import ROLE_URI, Identity, Role

_log = logging.getLogger(__name__)

SOON = timedelta(days=14)
"""A certificate that ends within this time is warned of."""

CERTIFICATES_KEPT = 256
"""Certificates whose contents are remembered; others are read again."""

_Stamp = tuple[tuple[int, ...], ...]
"""Number, size and times of change of each file: of its contents, and of what the system knows of it, as its owner."""


class Certificates:
    """The certificates with which a service meets its callers. Its methods may be called from many threads.

    New files count from the next connection on. Where they are no good, as while they are being replaced, or no caller
    would take them, the earlier ones stay, and the log says why.

    Args:
        files: files whose `ca` is that of the callers.

    Raises:
        InvalidInputError: see `TlsFiles.read`.
    """

    def __init__(self, files: TlsFiles) -> None:
        self._files = files
        self._lock = threading.Lock()
        self._stamp = self._stamp_now()
        self._refused: _Stamp | None = None
        """Of files that were no good, as long as those of `_stamp` count."""
        self._pem, self._context = files.read(), self._loaded()
        _warn_of(_own(self._pem))

    def pem(self) -> Pem:
        """Return the certificates that count now, PEM."""
        with self._lock:
            stamp = self._stamp_now()
            if stamp not in (self._stamp, self._refused):
                try:
                    pem = self._files.read()
                    own = _own(pem)
                    if (trouble := _trouble(own)) is not None:
                        expected = "one that callers take"
                        raise InvalidInputError(f"certificate {self._files.certificate}", trouble, expected)
                    self._pem, self._context, self._stamp, self._refused = pem, self._loaded(), stamp, None
                    _log.info("certificates: read anew from %s", self._files.certificate)
                    _warn_of(own)
                except InvalidInputError as error:
                    self._refused = stamp
                    _log.warning("certificates: the earlier ones stay: %s", error)
            return self._pem

    def server_credentials(self, *, callers_too: bool = True) -> grpc.ServerCredentials:
        """Return what a gRPC server listens with; `callers_too`: whether callers must have a certificate."""
        told = self.pem()

        def changed() -> grpc.ServerCertificateConfiguration | None:
            nonlocal told
            if (pem := self.pem()) is told:
                return None
            told = pem
            return _configuration(pem, callers_too)

        fetch: Any = changed  # its stubs know of no None, which stands for no change
        return grpc.dynamic_ssl_server_credentials(_configuration(told, callers_too), fetch, callers_too)

    def context(self) -> ssl.SSLContext:
        """Return what an HTTP server meets the next caller with, who must have a certificate."""
        self.pem()
        return self._context

    def ends_s(self) -> float:
        """When the first ends of the service's own certificates and its callers' authorities, seconds since 1970.

        One that only OpenSSL can read is left out; where there is no other, this is infinite.
        """
        pem = self.pem()
        try:
            own = x509.load_pem_x509_certificates(pem.certificate)
        except ValueError:  # it was warned of
            own = []
        ends = [each.not_valid_after_utc.timestamp() for each in own]
        ends += [ssl.cert_time_to_seconds(str(each["notAfter"])) for each in self._context.get_ca_certs()]
        return min(ends, default=math.inf)

    def names(self) -> frozenset[str]:
        """Names of the service in its own certificate, in lower case; none where only OpenSSL can read it."""
        try:
            own = x509.load_pem_x509_certificate(self.pem().certificate)
            told = own.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        except (ValueError, x509.ExtensionNotFound):
            return frozenset()
        return frozenset(name.lower() for name in told.get_values_for_type(x509.DNSName))

    def _loaded(self) -> ssl.SSLContext:
        """The context of the files as they are.

        Raises:
            InvalidInputError: they have changed since they were read.
        """
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        context.verify_mode = ssl.CERT_REQUIRED
        try:
            context.load_verify_locations(self._files.ca)
            context.load_cert_chain(self._files.certificate, self._files.key)
        except (OSError, ValueError) as error:
            expected = "files that do not change while they are read"
            raise InvalidInputError(f"certificate {self._files.certificate}", error, expected) from None
        return context

    def _stamp_now(self) -> _Stamp:
        found: list[tuple[int, ...]] = []
        for path in vars(self._files).values():
            try:
                status = os.stat(path)
            except OSError:
                found.append(())
            else:
                found.append((status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns))
        return tuple(found)


def _own(pem: Pem) -> x509.Certificate | None:
    """The service's own certificate; None where only OpenSSL can read it."""
    try:
        return x509.load_pem_x509_certificate(pem.certificate)
    except ValueError as error:
        _log.warning("certificates: that of the service cannot be looked at: %s", error)
        return None


def _trouble(own: x509.Certificate | None) -> str | None:
    """Why no caller takes the service's own certificate, None where nothing is known against it."""
    if own is None:
        return None
    if own.not_valid_after_utc <= datetime.now(UTC):
        return f"one that has expired, at {own.not_valid_after_utc.isoformat()}"
    try:
        usage = own.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    except x509.ExtensionNotFound:
        return None
    return None if ExtendedKeyUsageOID.SERVER_AUTH in usage else "one for callers, without extendedKeyUsage=serverAuth"


def _warn_of(own: x509.Certificate | None) -> None:
    """Say what callers have, or will soon have, against the service's own certificate."""
    if (trouble := _trouble(own)) is not None:
        _log.warning("certificates: that of the service is %s", trouble)
    elif own is not None and own.not_valid_after_utc - datetime.now(UTC) <= SOON:
        _log.warning("certificates: that of the service expires soon, at %s", own.not_valid_after_utc.isoformat())


def _configuration(pem: Pem, callers_too: bool) -> grpc.ServerCertificateConfiguration:
    own = [(pem.key, pem.certificate)]
    return grpc.ssl_server_certificate_configuration(own, pem.ca if callers_too else None)


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
