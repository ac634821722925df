"""Both ends of a connection, one way for all who call a service and for all that serve, and their certificates."""

import json
import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc

from lightpage.errors import InvalidInputError
from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.messages import REPLY_BYTES

REPEATABLE = ("Describe", "ListModels", "ListJobs", "GetJob", "WatchJob", "WatchDisplay")
"""Calls that change nothing: gRPC repeats them by itself where the service did not answer."""

RECONNECT_MS = 100, 1000
"""Between two attempts to connect, at first and at most: a service that is back is found within about a second."""

CONNECT_MS = 2000
"""An attempt to connect may take so long; gRPC's option is named for the pause, and means this. A service whose cores
are all at work takes its time to answer, and a host that is being switched on drops what it is sent."""


KEEPALIVE_MS = 30_000
"""A connection silent for so long is asked for a sign of life, so that either end notices that the other has gone."""

SERVER_KEEPALIVE = (
    ("grpc.keepalive_time_ms", KEEPALIVE_MS),
    ("grpc.keepalive_permit_without_calls", 1),
    # By default a server hangs up on whoever asks more often than once in five minutes while no data flows.
    ("grpc.http2.min_ping_interval_without_data_ms", 5_000),
)
"""Of every server of this project: callers may ask for a sign of life every 10 s, with calls or without."""


@dataclass(frozen=True)
class Pem:
    """The contents of three files, PEM."""

    ca: bytes
    certificate: bytes
    key: bytes


@dataclass(frozen=True)
class TlsFiles:
    """Certificates of one end of a connection: its own, and the authorities that it trusts.

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
        """Return what an HTTP client connects with; raises as `read`."""
        self.read()
        context = ssl.create_default_context(cafile=str(self.ca))
        context.load_cert_chain(self.certificate, self.key)
        return context


def _read(name: str, path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InvalidInputError(f"{name} {path}", error, "a file that can be read") from None


def _no_password() -> str:
    raise ValueError("a key with a password")


def open_channel(target: str, tls: TlsFiles | None = None) -> grpc.Channel:
    """A channel to `target` (HOST:PORT); it connects at the first call, and again whenever the connection was lost.

    Args:
        target: where.
        tls: certificates to connect with; None for no TLS.

    Raises:
        InvalidInputError: see `TlsFiles.read`.
    """
    first_ms, most_ms = RECONNECT_MS
    options: tuple[tuple[str, Any], ...] = (
        ("grpc.max_receive_message_length", REPLY_BYTES),
        ("grpc.enable_http_proxy", 0),  # the device is on the local network
        ("grpc.initial_reconnect_backoff_ms", first_ms),
        ("grpc.max_reconnect_backoff_ms", most_ms),
        ("grpc.min_reconnect_backoff_ms", CONNECT_MS),
        ("grpc.service_config", _service_config()),
        ("grpc.keepalive_time_ms", KEEPALIVE_MS),
        ("grpc.keepalive_timeout_ms", 20_000),  # a service whose cores are all at work takes its time
    )
    if tls is None:
        return grpc.insecure_channel(target, options=options)
    pem = tls.read()
    credentials = grpc.ssl_channel_credentials(pem.ca, pem.key, pem.certificate)
    return grpc.secure_channel(target, credentials, options=options)


def add_port(server: grpc.aio.Server, address: str, credentials: grpc.ServerCredentials | None) -> int:
    """Have a server listen at an address (HOST:PORT or unix:PATH); returns the port.

    Raises:
        RuntimeError: it cannot.
    """
    if credentials is None:
        return server.add_insecure_port(address)
    return server.add_secure_port(address, credentials)


def _service_config() -> str:
    """Five attempts within about two seconds, for calls that change nothing."""
    service = pb.DESCRIPTOR.services_by_name["Lightpage"].full_name
    policy = {
        "maxAttempts": 5,
        "initialBackoff": "0.1s",
        "maxBackoff": "1s",
        "backoffMultiplier": 2,
        "retryableStatusCodes": ["UNAVAILABLE"],
    }
    names = [{"service": service, "method": method} for method in REPEATABLE]
    return json.dumps({"methodConfig": [{"name": names, "retryPolicy": policy}]})
