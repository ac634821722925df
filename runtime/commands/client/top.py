"""`lightpage top`: how a running service fares, live in a terminal."""

import math
import os
import select
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from datetime import timedelta
from pathlib import Path

import click
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from lightpage.cli.options import JSON
from lightpage.errors import LightpageError
from lightpage.files import write_json
from lightpage.runtime.client.wire.channel import TlsFiles
from lightpage.runtime.commands.client.connection import with_tls
from lightpage.runtime.console.figures import DeviceSigns, Load, Process, ServiceFigures, StageTimes, service_figures
from lightpage.runtime.console.scrapes import WINDOW_S, Scrapes, scrape

try:
    import termios
    import tty
except ModuleNotFoundError:  # as on Windows, where Ctrl-C ends it
    termios = None  # type: ignore[assignment]

_WIDTH = 100
"""Columns where the output is no terminal."""


@click.command()
@click.option("--address", default="127.0.0.1:9100", show_default=True, help="HOST:PORT of its --metrics-port.")
@click.option(
    "--interval", default=2.0, show_default=True, type=click.FloatRange(0.1, 60), help="Seconds between two scrapes."
)
@click.option("--once", is_flag=True, help="Print what two scrapes say, and end; also where nobody has a terminal.")
@JSON
@with_tls
def top(address: str, interval: float, once: bool, json_path: Path | None, tls: TlsFiles | None) -> None:
    """Show how a service fares that runs with --metrics-port. The key q ends it, as --once and --json do."""
    scrapes = Scrapes()
    scrapes.add(scrape(address, tls))
    terminal = sys.stdout.isatty()
    if once or json_path is not None or not terminal:
        time.sleep(interval)
        scrapes.add(scrape(address, tls))
        write_json(json_path, {"address": address, **asdict(_figures(scrapes))})
        Console(width=None if terminal else _WIDTH, highlight=False).print(view(_figures(scrapes), address))
        return
    silent = ""
    with _keys() as pressed, Live(view(_figures(scrapes), address), screen=True, auto_refresh=False) as live:
        while "q" not in pressed(interval):
            try:
                scrapes.add(scrape(address, tls))
                silent = ""
            except LightpageError as error:
                silent = silent or f"no answer since {time.strftime('%H:%M:%S')}: {error.got}"
            live.update(view(_figures(scrapes), address, silent), refresh=True)


def _figures(scrapes: Scrapes) -> ServiceFigures:
    change = scrapes.change
    assert change is not None  # there is a scrape
    return service_figures(change, scrapes.restarts)


def view(found: ServiceFigures, address: str, silent: str = "") -> RenderableType:
    """Return what a service says, for a terminal; `silent` says since when nobody answers, empty if somebody does."""
    parts: list[RenderableType] = [_header(found, address)]
    if silent:
        parts.append(Text(silent, style="bold white on red"))
    upper = Table.grid(padding=(0, 1))
    right = Group(_panel("device", _device(found.device)), _panel("process", _process(found.process)))
    upper.add_row(_panel("load", _load(found.load)), right)
    return Group(*parts, upper, _panel("stages", _stages(found.stages)))


def _panel(title: str, table: Table) -> Panel:
    return Panel(table, title=title, expand=False)


def _header(found: ServiceFigures, address: str) -> Text:
    text = Text.assemble(("lightpage top", "bold"), f"  {address}  model ", (found.model_version, "bold"))
    if math.isfinite(found.up_s):
        text.append(f"  up {timedelta(seconds=round(found.up_s))}")
    text.append(f"  figures of {found.seconds:.0f} s" if found.seconds < WINDOW_S else f"  of {WINDOW_S:.0f} s")
    if found.restarts:
        times = f" {found.restarts} times" if found.restarts > 1 else ""
        text.append(f"  restarted{times} meanwhile", "yellow")
    return text


def _table() -> Table:
    table = Table.grid(padding=(0, 2))
    table.add_column()
    table.add_column(justify="right")
    return table


def _load(load: Load) -> Table:
    table = _table()
    table.add_row("pages", f"{_number(load.pages_per_s)}/s")
    for reason, count in load.pages_lost.items():
        table.add_row(f"lost, {reason}", Text(f"{count:.0f}", "red"))
    for code, rate in load.calls_per_s.items():
        table.add_row(f"calls, {code}", Text(f"{_number(rate)}/s", "" if code == "OK" else "yellow"))
    for reason, count in load.rejects.items():
        table.add_row(f"rejects, {reason}", f"{count:.0f}")
    table.add_row("waiting", _number(load.decodes_waiting))
    table.add_row("decoded now", f"{_number(load.decodes_busy)} of {_number(load.decodes_slots)}")
    table.add_row("frames in memory", f"{_bytes(load.frames_bytes)} of {_bytes(load.frames_limit_bytes)}")
    table.add_row("frames received", f"{_bytes(load.received_bytes_per_s)}/s")
    return table


def _device(device: DeviceSigns) -> Table:
    table, margin = _table(), device.margin_bits
    table.add_row("margin", "-" if math.isnan(margin) else f"{_number(margin)} bit")
    table.add_row("trust", _number(device.pilot_trust))
    table.add_row("AIR share", _number(device.air_share))
    table.add_row("AIR", f"{_number(device.air_bits)} bit")
    table.add_row("image shift", f"{_number(device.image_shift_x_px)}, {_number(device.image_shift_y_px)} px")
    due = device.recalibration_due
    table.add_row("recalibration", Text("due" if due else "not due", "red" if due else "green"))
    for sign in device.signs_raised:
        table.add_row("sign raised", Text(sign, "red"))
    for result, count in device.recalibrations.items():
        table.add_row(f"recalibrations {result}", f"{count:.0f}")
    if not device.source_ok:
        table.add_row("source", Text("a beam may be blocked", "red"))
    if not device.store_ok:
        table.add_row("store", Text(", ".join(device.store_trouble) or "in trouble", "red"))
    return table


def _process(process: Process) -> Table:
    table = _table()
    table.add_row("CPU", f"{_number(process.cpu_cores)} cores")
    table.add_row("memory", _bytes(process.memory_bytes))
    table.add_row("descriptors", f"{_number(process.descriptors)} of {_number(process.descriptors_limit)}")
    table.add_row("calls in flight", _number(process.calls_in_flight))
    return table


def _stages(stages: Iterable[StageTimes]) -> Table:
    table = Table(box=None, padding=(0, 2))
    for name in ("", "pages", "share", "mean", "p50", "p99"):
        table.add_column(name, justify="right" if name else "left")
    for each in stages:
        percent = f"{100 * each.share:.0f}%" if math.isfinite(each.share) else "-"
        times = map(_seconds, (each.mean_s, each.p50_s, each.p99_s))
        table.add_row(each.stage.replace("_", " "), f"{each.pages:.0f}", percent, *times)
    return table


def _number(value: float) -> str:
    if not math.isfinite(value):
        return "-"
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def _seconds(value: float) -> str:
    if not math.isfinite(value):
        return "-"
    return f"{value:.3g} s" if value >= 1 else f"{1e3 * value:.3g} ms"


def _bytes(value: float) -> str:
    if not math.isfinite(value):
        return "-"
    for unit in ("B", "KiB", "MiB"):
        if value < 1024:
            return f"{value:.3g} {unit}"
        value /= 1024
    return f"{value:.3g} GiB"


@contextmanager
def _keys() -> Iterator[Callable[[float], str]]:
    """Yields what waits up to so many seconds for keys, and tells which were pressed."""
    keyboard = sys.stdin.fileno()
    typed = termios is not None and os.isatty(keyboard)
    before = termios.tcgetattr(keyboard) if typed else None

    def pressed(seconds: float) -> str:
        if not typed:
            time.sleep(seconds)
            return ""
        ready, _, _ = select.select([keyboard], [], [], seconds)
        return os.read(keyboard, 64).decode("utf-8", "replace") if ready else ""

    try:
        if typed:
            tty.setcbreak(keyboard)
        yield pressed
    finally:
        if before is not None:
            termios.tcsetattr(keyboard, termios.TCSADRAIN, before)
