"""`lightpage top`: how a running service fares, live in a terminal."""

from __future__ import annotations

import math
import os
import select
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta

import click
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from lightpage.errors import LightpageError
from lightpage.runtime.client.wire.channel import TlsFiles
from lightpage.runtime.commands.client.connection import with_tls
from lightpage.runtime.console.scrapes import WINDOW_S, Change, Scrapes, scrape
from lightpage.runtime.service.stages import Stage

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
@with_tls
def top(address: str, interval: float, once: bool, tls: TlsFiles | None) -> None:
    """Show how a service fares that runs with --metrics-port. The key q ends it."""
    scrapes = Scrapes()
    scrapes.add(scrape(address, tls))
    terminal = sys.stdout.isatty()
    if once or not terminal:
        time.sleep(interval)
        scrapes.add(scrape(address, tls))
        Console(width=None if terminal else _WIDTH, highlight=False).print(view(scrapes, address))
        return
    silent = ""
    with _keys() as pressed, Live(view(scrapes, address), screen=True, auto_refresh=False) as live:
        while "q" not in pressed(interval):
            try:
                scrapes.add(scrape(address, tls))
                silent = ""
            except LightpageError as error:
                silent = silent or f"no answer since {time.strftime('%H:%M:%S')}: {error.got}"
            live.update(view(scrapes, address, silent), refresh=True)


def view(scrapes: Scrapes, address: str, silent: str = "") -> RenderableType:
    """Return the scrapes as text for a terminal; `silent` says since when nobody answers, empty where somebody does."""
    change = scrapes.change
    assert change is not None  # there is a scrape
    parts: list[RenderableType] = [_header(change, scrapes.restarts, address)]
    if silent:
        parts.append(Text(silent, style="bold white on red"))
    upper = Table.grid(padding=(0, 1))
    right = Group(_panel("device", _device(change)), _panel("process", _process(change)))
    upper.add_row(_panel("load", _load(change)), right)
    return Group(*parts, upper, _panel("stages", _stages(change)))


def _panel(title: str, table: Table) -> Panel:
    return Panel(table, title=title, expand=False)


def _header(change: Change, restarts: int, address: str) -> Text:
    now = change.now
    model = next((dict(own)["version"] for own in now.values("lightpage_model_info")), "none")
    up_s = time.time() - now.value("process_start_time_seconds")
    text = Text.assemble(("lightpage top", "bold"), f"  {address}  model ", (model, "bold"))
    if math.isfinite(up_s):
        text.append(f"  up {timedelta(seconds=round(max(0.0, up_s)))}")
    text.append(f"  figures of {change.seconds:.0f} s" if change.seconds < WINDOW_S else f"  of {WINDOW_S:.0f} s")
    if restarts:
        text.append(f"  restarted {restarts} times meanwhile" if restarts > 1 else "  restarted meanwhile", "yellow")
    return text


def _table() -> Table:
    table = Table.grid(padding=(0, 2))
    table.add_column()
    table.add_column(justify="right")
    return table


def _load(change: Change) -> Table:
    now, table = change.now, _table()
    table.add_row("pages", f"{_number(change.rate('lightpage_pages_total'))}/s")
    lost = change.rises("lightpage_pages_lost_total", "reason")
    for reason, count in lost.items():
        table.add_row(f"lost, {reason}", Text(f"{count:.0f}", "red"))
    for code, count in change.rises("lightpage_calls_total", "code").items():
        rate = count / change.seconds if change.seconds > 0 else math.nan
        table.add_row(f"calls, {code}", Text(f"{_number(rate)}/s", "" if code == "OK" else "yellow"))
    for reason, count in change.rises("lightpage_rejects_total", "reason").items():
        table.add_row(f"rejects, {reason}", f"{count:.0f}")
    waiting, busy = now.value("lightpage_decodes_waiting"), now.value("lightpage_decodes_busy")
    table.add_row("waiting", _number(waiting))
    table.add_row("decoded now", f"{_number(busy)} of {_number(now.value('lightpage_decodes_slots'))}")
    used, limit = now.value("lightpage_receive_buffer_bytes"), now.value("lightpage_receive_buffer_limit_bytes")
    table.add_row("frames in memory", f"{_bytes(used)} of {_bytes(limit)}")
    table.add_row("frames received", f"{_bytes(change.rate('lightpage_received_bytes_total'))}/s")
    return table


def _device(change: Change) -> Table:
    now, table = change.now, _table()
    read = change.now.value("lightpage_data_pages_total", loss="none") > 0
    margin = now.value("lightpage_margin_bits")
    table.add_row("margin", f"{_number(margin)} bit" if read else "-")
    table.add_row("trust", _number(now.value("lightpage_pilot_trust")))
    table.add_row("AIR share", _number(now.value("lightpage_pilot_share")))
    table.add_row("AIR", f"{_number(now.value('lightpage_monitor_sign', sign='air_bits'))} bit")
    shift = [now.value("lightpage_image_shift_px", axis=axis) for axis in ("x", "y")]
    table.add_row("image shift", f"{', '.join(map(_number, shift))} px")
    due = now.value("lightpage_monitor_due") == 1
    table.add_row("recalibration", Text("due" if due else "not due", "red" if due else "green"))
    raised = [dict(own)["sign"] for own, value in now.values("lightpage_monitor_sign_raised").items() if value == 1]
    for sign in raised:
        table.add_row("sign raised", Text(sign, "red"))
    for own, count in now.values("lightpage_recalibrations_total").items():
        if count:
            table.add_row(f"recalibrations {dict(own)['result']}", f"{count:.0f}")
    if now.value("lightpage_source_ok") == 0:
        table.add_row("source", Text("a beam may be blocked", "red"))
    if now.value("lightpage_store_ok") == 0:
        trouble = [dict(own)["reason"] for own, value in now.values("lightpage_store_trouble").items() if value == 1]
        table.add_row("store", Text(", ".join(trouble) or "in trouble", "red"))
    return table


def _process(change: Change) -> Table:
    now, table = change.now, _table()
    table.add_row("CPU", f"{_number(change.rate('process_cpu_seconds_total'))} cores")
    table.add_row("memory", _bytes(now.value("process_resident_memory_bytes")))
    descriptors = _number(now.value("process_open_fds")), _number(now.value("process_max_fds"))
    table.add_row("descriptors", f"{descriptors[0]} of {descriptors[1]}")
    table.add_row("calls in flight", _number(now.value("lightpage_calls_in_flight")))
    return table


def _stages(change: Change) -> Table:
    table = Table(box=None, padding=(0, 2))
    for name in ("", "pages", "share", "mean", "p50", "p99"):
        table.add_column(name, justify="right" if name else "left")
    name = "lightpage_stage_seconds"
    whole = change.rise(f"{name}_sum")
    for stage in Stage:
        count = change.rise(f"{name}_count", stage=stage.value)
        share = change.rise(f"{name}_sum", stage=stage.value) / whole if whole > 0 else math.nan
        quantiles = (change.quantile(q, name, stage=stage.value) for q in (0.5, 0.99))
        times = map(_seconds, (change.mean(name, stage=stage.value), *quantiles))
        percent = f"{100 * share:.0f}%" if math.isfinite(share) else "-"
        table.add_row(stage.value.replace("_", " "), f"{count:.0f}", percent, *times)
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
