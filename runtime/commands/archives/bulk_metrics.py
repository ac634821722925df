"""The metrics of `lightpage bulk`: served while it works, and in a file after its end."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import click

from lightpage.errors import InvalidInputError
from lightpage.runtime.archives.run.driver import Watch
from lightpage.runtime.archives.run.ledger import Ledger
from lightpage.runtime.archives.run.task import Operation
from lightpage.runtime.client.wire.address import check_address, is_local

METRICS_SUFFIX = ".prom"


def check_metrics(address: str | None, insecure: bool, file: Path | None) -> None:
    """Check the options that say where metrics are shown, and whether others may read them.

    Raises:
        InvalidInputError: they do not go together, or name what is none.
    """
    if file is not None and file.suffix != METRICS_SUFFIX:
        raise InvalidInputError("--metrics-file", file, f"*{METRICS_SUFFIX}: node_exporter reads no others")
    if address is None:
        return
    check_address("--metrics", address, least_port=0)
    if address.startswith("unix:"):
        raise InvalidInputError("--metrics", address, "HOST:PORT")
    if not insecure and not is_local(address):
        expected = "an address of this machine alone, since others reach it; or --metrics-insecure"
        raise InvalidInputError("--metrics", address, expected)


@contextmanager
def watched(ledger: Ledger, operation: Operation, address: str | None, file: Path | None) -> Iterator[Watch]:
    """Return what keeps the metrics that were asked for; the file is written however the run ends."""
    if address is None and file is None:
        yield Watch()
        return
    from lightpage.runtime.archives.run.metrics import BulkMetrics  # for who asks for metrics
    from lightpage.runtime.console.application import metrics_routes
    from lightpage.runtime.console.server import serving

    metrics = BulkMetrics(ledger.folder.name, operation, ledger.part)
    try:
        with ExitStack() as stack:
            if address is not None:
                host, _, asked = address.rpartition(":")
                port = stack.enter_context(serving(metrics_routes(metrics.registry), int(asked), host))
                click.echo(f"metrics at http://{host}:{port}/metrics", err=True)
            yield metrics
    finally:
        metrics.end()
        if file is not None:
            metrics.write(file)
