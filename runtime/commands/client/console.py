"""`lightpage console`: opens the web page of a running service."""

from __future__ import annotations

import webbrowser

import click

from lightpage.runtime.client.wire.channel import TlsFiles
from lightpage.runtime.commands.client.connection import with_tls
from lightpage.runtime.console.scrapes import fetch, url_of


@click.command()
@click.option("--address", default="127.0.0.1:9100", show_default=True, help="HOST:PORT of its --metrics-port.")
@click.option("--browser/--no-browser", default=True, show_default=True, help="Open it, or print its address alone.")
@with_tls
def console(address: str, browser: bool, tls: TlsFiles | None) -> None:
    """Open the console of a service that runs with --metrics-port.

    Where the service has TLS, the browser needs a certificate of its own.
    """
    fetch(f"console at {address}", address, "state.json", tls)
    url = url_of(address, tls=tls)
    click.echo(url)
    if browser:
        webbrowser.open(url)
