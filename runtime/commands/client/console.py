"""`lightpage console`: opens the web page of a running service."""

import json
import webbrowser
from pathlib import Path

import click

from lightpage.cli.options import JSON
from lightpage.errors import LightpageError
from lightpage.files import write_json
from lightpage.runtime.client.wire.channel import TlsFiles
from lightpage.runtime.commands.client.connection import with_tls
from lightpage.runtime.console.scrapes import fetch, url_of


@click.command()
@click.option("--address", default="127.0.0.1:9100", show_default=True, help="HOST:PORT of its --metrics-port.")
@click.option("--browser/--no-browser", default=True, show_default=True, help="Open it, or print its address alone.")
@with_tls
@JSON
def console(address: str, browser: bool, tls: TlsFiles | None, json_path: Path | None) -> None:
    """Open the console of a service that runs with --metrics-port.

    Where the service has TLS, the browser needs a certificate of its own. The figures of --json are what the console
    shows.
    """
    subject = f"console at {address}"
    try:
        state = json.loads(fetch(subject, address, "state.json", tls))
    except ValueError:
        raise LightpageError(subject, "another page", "a service that runs with --metrics-port") from None
    url = url_of(address, tls=tls)
    write_json(json_path, {"url": url, "state": state})
    click.echo(url)
    if browser:
        webbrowser.open(url)
