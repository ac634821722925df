"""Asks the HTTP server of a running service."""

from __future__ import annotations

from http.client import BadStatusLine, HTTPException
from urllib.error import HTTPError
from urllib.request import HTTPSHandler, ProxyHandler, build_opener

from lightpage.errors import LightpageError
from lightpage.runtime.client.wire.tls import TlsFiles

_ANSWER_S = 5.0
_MOST_BYTES = 16 << 20
_SAID_BYTES = 200
"""Of a refusal's text."""


def url_of(address: str, path: str = "", tls: TlsFiles | None = None) -> str:
    """Where a page is of the service whose `--metrics-port` is at HOST:PORT; `tls` as in `fetch`."""
    return f"http{'s' if tls else ''}://{address}/{path}"


def fetch(subject: str, address: str, path: str, tls: TlsFiles | None = None) -> bytes:
    """A page of the service whose `--metrics-port` is at HOST:PORT, its first 16 MiB.

    Args:
        subject: of the error.
        address: HOST:PORT.
        path: of the page, without a slash in front.
        tls: certificates to connect with; None for a service without TLS.

    Raises:
        InvalidInputError: certificates that are no good.
        LightpageError: nobody answers there, or not with this page.
    """
    opener = build_opener(ProxyHandler({}), *([HTTPSHandler(context=tls.client_context())] if tls else []))
    got: object
    try:
        try:
            with opener.open(url_of(address, path, tls), timeout=_ANSWER_S) as reply:
                return bytes(reply.read(_MOST_BYTES))
        except HTTPError as refusal:
            with refusal:
                said = refusal.read(_SAID_BYTES).decode("utf-8", "replace").strip()
            got = f"{refusal.code} {refusal.reason}: {said}"
    except OSError as error:
        got = getattr(error, "reason", error)
    except BadStatusLine:  # its text is what came, in whatever bytes
        got = "an answer that is not HTTP"
    except (HTTPException, ValueError) as error:
        got = error
    raise LightpageError(subject, got, wanted(tls))


def wanted(tls: TlsFiles | None) -> str:
    """What an address is to be of, for people."""
    expected = "a service that runs with --metrics-port: `lightpage serve --metrics-port 9100`"
    return expected if tls else f"{expected}; if it has TLS, --ca, --certificate and --key too"
