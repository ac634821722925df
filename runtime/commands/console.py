"""`lightpage console`: opens the web page of a running service."""

from __future__ import annotations

import webbrowser
from urllib.error import URLError
from urllib.request import ProxyHandler, build_opener

import click

from lightpage.errors import LightpageError

_ANSWER_S = 5.0


@click.command()
@click.option("--address", default="127.0.0.1:9100", show_default=True, help="HOST:PORT of its --metrics-port.")
@click.option("--browser/--no-browser", default=True, show_default=True, help="Open it, or print its address alone.")
def console(address: str, browser: bool) -> None:
    """Open the console of a service that runs with --metrics-port."""
    url = f"http://{address}/"
    try:
        with build_opener(ProxyHandler({})).open(f"{url}state.json", timeout=_ANSWER_S) as reply:
            reply.read()
    except (URLError, OSError, ValueError) as error:
        reason = getattr(error, "reason", error)
        expected = "a service that runs with --metrics-port: `lightpage serve --metrics-port 9100`"
        raise LightpageError(f"console at {address}", reason, expected) from None
    click.echo(url)
    if browser:
        webbrowser.open(url)
