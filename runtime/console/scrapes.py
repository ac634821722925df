"""Scrapes of a running service over HTTP: its pages, its metrics, and the changes between two scrapes."""

from __future__ import annotations

import math
import time
from collections import defaultdict, deque
from collections.abc import Mapping
from dataclasses import dataclass
from http.client import BadStatusLine, HTTPException
from urllib.error import HTTPError
from urllib.request import HTTPSHandler, ProxyHandler, build_opener

from prometheus_client.parser import text_string_to_metric_families

from lightpage.errors import LightpageError
from lightpage.runtime.client.wire.channel import TlsFiles

WINDOW_S = 60.0
"""Rates and times are those of so many seconds, once it has been scraped for so long."""
_SERVES = "lightpage_calls_in_flight"
"""A metric that every service has from its start."""

_ANSWER_S = 5.0
_MOST_BYTES = 16 << 20
_SAID_BYTES = 200
"""Of a refusal's text."""

Labels = frozenset[tuple[str, str]]


def url_of(address: str, path: str = "", tls: TlsFiles | None = None) -> str:
    """Return where a page is of the service whose `--metrics-port` is at HOST:PORT; `tls` as in `fetch`."""
    return f"http{'s' if tls else ''}://{address}/{path}"


def fetch(subject: str, address: str, path: str, tls: TlsFiles | None = None) -> bytes:
    """A page of the service whose `--metrics-port` is at HOST:PORT, its first 16 MiB.

    Args:
        subject: subject of the error.
        address: HOST:PORT.
        path: path of the page, without a slash in front.
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
    raise LightpageError(subject, got, _wanted(tls))


def _wanted(tls: TlsFiles | None) -> str:
    """Return what an address is to be of, for people."""
    expected = "a service that runs with --metrics-port: `lightpage serve --metrics-port 9100`"
    return expected if tls else f"{expected}; if it has TLS, --ca, --certificate and --key too"


@dataclass(frozen=True)
class Scrape:
    """The metrics of a service at one moment.

    Attributes:
        at: `time.monotonic` seconds.
        samples: values by name and labels.
    """

    at: float
    samples: Mapping[tuple[str, Labels], float]

    def value(self, name: str, **labels: str) -> float:
        """A value; NaN where there is none."""
        return self.samples.get((name, frozenset(labels.items())), math.nan)

    def values(self, name: str, **labels: str) -> dict[Labels, float]:
        """Return the values of a name that have at least these labels."""
        asked = frozenset(labels.items())
        return {own: value for (known, own), value in self.samples.items() if known == name and asked <= own}


def scrape(address: str, tls: TlsFiles | None = None) -> Scrape:
    """The metrics of the service whose `--metrics-port` is at HOST:PORT.

    Args:
        address: HOST:PORT.
        tls: certificates to connect with; None for a service without TLS.

    Raises:
        InvalidInputError: certificates that are no good.
        LightpageError: nobody answers there, or something else than a Lightpage service.
    """
    subject = f"metrics at {address}"
    content = fetch(subject, address, "metrics", tls)
    try:
        samples = {
            (sample.name, frozenset(sample.labels.items())): float(sample.value)
            for family in text_string_to_metric_families(content.decode("utf-8"))
            for sample in family.samples
        }
    except ValueError:
        raise LightpageError(subject, "no metrics", _wanted(tls)) from None
    if (_SERVES, frozenset()) not in samples:
        raise LightpageError(subject, "metrics of something else", _wanted(tls))
    return Scrape(time.monotonic(), samples)


class Scrapes:
    """The scrapes of the last while.

    Args:
        window_s: how long they are kept, seconds.
    """

    def __init__(self, window_s: float = WINDOW_S) -> None:
        self._window_s = window_s
        self._kept: deque[Scrape] = deque()
        self.restarts = 0

    def add(self, newest: Scrape) -> None:
        """Take a scrape in; those before a restart of the service say nothing of what comes after it."""
        if self._kept and _restarted(self._kept[-1], newest):
            self._kept.clear()
            self.restarts += 1
        self._kept.append(newest)
        while len(self._kept) > 2 and self._kept[1].at <= newest.at - self._window_s:
            self._kept.popleft()

    @property
    def change(self) -> Change | None:
        """Return the change from the first scrape kept to the last; None where there is no scrape yet."""
        return Change(self._kept[0], self._kept[-1]) if self._kept else None


class Change:
    """The change between two scrapes.

    Args:
        before, now: scrapes of the same process.
    """

    def __init__(self, before: Scrape, now: Scrape) -> None:
        self.before, self.now = before, now

    @property
    def seconds(self) -> float:
        """Between them."""
        return self.now.at - self.before.at

    def _risen(self, name: str, **labels: str) -> list[tuple[dict[str, str], float]]:
        """Labels and rise of each counter that has at least these labels."""
        found = self.now.values(name, **labels)
        return [(dict(own), value - self.before.samples.get((name, own), 0.0)) for own, value in found.items()]

    def rise(self, name: str, **labels: str) -> float:
        """Return the rise of counters with at least these labels, all together."""
        return sum(rise for _, rise in self._risen(name, **labels))

    def rate(self, name: str, **labels: str) -> float:
        """Return the growth a second; NaN where no time has passed."""
        return self.rise(name, **labels) / self.seconds if self.seconds > 0 else math.nan

    def rises(self, name: str, label: str) -> dict[str, float]:
        """Return the rises of counters that rose, by one of their labels, the largest first."""
        sums = defaultdict[str, float](float)
        for own, rise in self._risen(name):
            sums[own.get(label, "")] += rise
        return dict(sorted(((key, rise) for key, rise in sums.items() if rise > 0), key=lambda one: -one[1]))

    def mean(self, name: str, **labels: str) -> float:
        """Mean of what a histogram counted; NaN where that is nothing."""
        count = self.rise(f"{name}_count", **labels)
        return self.rise(f"{name}_sum", **labels) / count if count > 0 else math.nan

    def quantile(self, share: float, name: str, **labels: str) -> float:
        """A quantile of what a histogram counted, as Prometheus estimates it: linear within a bucket.

        NaN where nothing was counted; the last finite bound for what lies beyond it. `share` is above 0.
        """
        counts = defaultdict[float, float](float)
        for own, rise in self._risen(f"{name}_bucket", **labels):
            counts[float(own["le"])] += rise
        rank = share * counts[math.inf]
        low = below = 0.0
        for bound, count in sorted(counts.items()):
            if count >= rank > 0:
                return low if math.isinf(bound) else low + (bound - low) * (rank - below) / (count - below)
            low, below = bound, count
        return math.nan


def _restarted(before: Scrape, now: Scrape) -> bool:
    """Return whether another process answers: its start is another one, or a counter fell."""
    started = "process_start_time_seconds"
    if not math.isnan(now.value(started)) and not math.isnan(before.value(started)):
        return now.value(started) != before.value(started)
    calls = [sum(each.values("lightpage_calls_total").values()) for each in (before, now)]
    return calls[1] < calls[0]
