"""Whom a service calls in its whole life: every connection and packet that it begins, seen by the kernel.

    python -m analysis.attacks.outgoing --json FILE

The service is started under strace, with all the processes that it starts. Health is asked, pages are decoded and read,
the device is recalibrated, models are changed, metrics and the console are shown, and the service is stopped. Each
address that one of its processes connects or sends to is listed. Addresses of this machine are wanted and no other; a
question to a name server is none of them, wherever that is. The exit status is 1 where another was called.

First a program that does call two others is traced, so that a trace that sees nothing is not taken for silence. These
calls fail before the kernel sends anything; their addresses are those kept for documentation (RFC 5737 and 3849).
"""

from __future__ import annotations

import ipaddress
import re
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import click

from analysis.service.running import PagesToSend, RunningService, until
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.errors import LightpageError
from lightpage.metrics.provenance import write_figures
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.commands.service.healthcheck import is_serving

CALLS = ("connect", "sendto", "sendmsg", "sendmmsg")
UNSEEN = "io_uring_setup"
"""System call that is not seen: what is sent through a ring is in no trace. Nobody may make one."""
TRACE = (
    *("strace", "--follow-forks", "--timestamps=unix,us", "--quiet=attach", "--signal=none"),
    *("--trace", ",".join((*CALLS, UNSEEN))),
)
PLANTED = {"192.0.2.1": 443, "2001:db8::1": 443, "192.0.2.2": 53}
_PLANT = """
import socket
for address, port, kind in (("192.0.2.1", 443, socket.SOCK_STREAM), ("2001:db8::1", 443, socket.SOCK_STREAM)):
    with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, kind) as line:
        line.connect_ex((address, port))
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
    try:
        line.sendto(b"asked", ("192.0.2.2", 53))
    except OSError:
        pass
"""
_DNS = 53
_END_S = 20.0
_LINE = re.compile(r"^\d+ +(?P<time>\d+\.\d+) (?:<\.\.\. )?(?P<call>\w+)")
_ADDRESS = re.compile(
    r"sin6?_port=htons\((?P<port>\d+)\).*?(?:inet_addr\(\"|inet_pton\(AF_INET6, \")(?P<address>[^\"]+)\""
)
_PATH = re.compile(r"sun_path=(?P<path>@?\"[^\"]*\")")


@dataclass(frozen=True)
class Called:
    """A call to an address.

    Args:
        at: time of the call, seconds since the epoch.
        call: name of the system call.
        address: numeric, or the path of a socket in the file system.
        port: 0 of such a path.
    """

    at: float
    call: str
    address: str
    port: int = 0

    @property
    def outgoing(self) -> bool:
        """Return whether a call leaves this machine, or may make another do so: a local name server asks others."""
        if "/" in self.address or self.address.startswith("@"):
            return False
        address = ipaddress.ip_address(self.address)
        return self.port == _DNS or not (address.is_loopback or address.is_unspecified)


def calls(trace: Path) -> Iterator[Called]:
    """Return what a trace that `TRACE` made tells.

    Raises:
        LightpageError: a process made a ring, through which it may have sent anything.
    """
    for line in trace.read_text(errors="replace").splitlines():
        head = _LINE.match(line)
        if head is None:
            continue
        if head["call"] == UNSEEN:
            raise LightpageError("trace", line, f"no call of {UNSEEN}, past which nothing is seen")
        at = float(head["time"])
        for found in _ADDRESS.finditer(line):
            yield Called(at, head["call"], found["address"], int(found["port"]))
        for found in _PATH.finditer(line):
            yield Called(at, head["call"], found["path"].replace('"', ""))


def traced(out: Path, *options: str) -> tuple[str, ...]:
    """The words before a command that trace it into a file."""
    return (*TRACE, *options, "--output", str(out), "--")


def seen_when_planted(folder: Path) -> list[Called]:
    """The calls of a program that calls `PLANTED`. None is sent: the kernel is told to fail them."""
    trace = folder / "planted.txt"
    words = traced(trace, f"--inject={','.join(CALLS)}:error=ENETUNREACH")
    subprocess.run([*words, sys.executable, "-I", "-c", _PLANT], check=True, timeout=60, stdin=subprocess.DEVNULL)
    return [call for call in calls(trace) if call.outgoing]


def control(folder: Path) -> int:
    """Number of planted calls that were seen.

    Raises:
        LightpageError: not all of them; a trace here would prove nothing.
    """
    if shutil.which("strace") is None:
        raise LightpageError("strace", "none", "the Debian package strace")
    seen = {call.address: call.port for call in seen_when_planted(folder)}
    if seen != PLANTED:
        raise LightpageError("planted calls", seen, PLANTED)
    return len(seen)


def life(folder: Path, options: tuple[str, ...]) -> tuple[Path, dict[str, float]]:
    """Trace a service from its start to its end; the trace, and when each phase began."""
    trace, phases = folder / "trace.txt", {"start": time.time()}
    device = folder / "device.toml"
    device.write_text("[geometry]\npipe_angle_deg = -0.57\n")  # drifted: without a gain no model is installed
    own = ("--source", f"simulator:bench?device={device}", "--store", str(folder / "store"))
    service = RunningService(
        *own,
        *("--flight-recorder", str(folder / "flight"), *options),
        before=traced(trace, "--daemonize=grandchild"),  # so that a signal reaches the service, not strace
        environment={"ORT_DISABLE_TELEMETRY": "0"},  # the service itself must keep it off
    )
    pages = PagesToSend()
    with service.start(), LightpageClient(service.target) as client:

        def models() -> None:
            client.models.list(stored=True)
            client.models.roll_back()
            client.models.roll_forward()

        steps: Mapping[str, Callable[[], object]] = {
            "health": lambda: [is_serving(service.health, service=name) for name in ("", "lightpage.store")],
            "decode": lambda: [client.frames.decode(pages.pair) for _ in range(3)],
            "read pages": lambda: [client.pages.read() for _ in range(3)],
            "recalibrate": lambda: client.jobs.recalibrate(count=2),
            "jobs": client.jobs.list,
            "models": models,
            "metrics, console": lambda: [fetch(service.page(path)) for path in ("metrics", "")],
        }
        for name, step in steps.items():
            phases[name] = time.time()
            step()
        phases["stop"] = time.time()
        if (status := service.stop()) != 0:
            raise LightpageError("service's end", f"status {status}: {service.log()[-2000:]}", "status 0")
    wait_for_end(trace, service.pid)
    return trace, phases


def wait_for_end(trace: Path, process: int) -> None:
    """Wait until a trace tells of a process's end: strace writes it after all else, and a little later.

    Raises:
        LightpageError: it does not.
    """
    for _ in until(time.monotonic() + _END_S, 0.05):
        if re.search(rf"^{process} .* \+\+\+ exited with", trace.read_text(errors="replace"), re.MULTILINE):
            return
    raise LightpageError("trace", f"no end of process {process} within {_END_S:g} s", "a whole one")


def fetch(url: str) -> bytes:
    """A page of the service's own web server."""
    with urllib.request.urlopen(url, timeout=20) as answer:
        content: bytes = answer.read()
    return content


def by_phase(found: list[Called], phases: Mapping[str, float]) -> dict[str, Counter[str]]:
    """Calls by phase and address: `ADDRESS:PORT`, or the path of a socket."""
    counted: dict[str, Counter[str]] = {name: Counter() for name in phases}
    for call in found:
        name = max((began, name) for name, began in phases.items() if began <= call.at or name == "start")[1]
        counted[name][f"{call.address}:{call.port}" if call.port else call.address] += 1
    return counted


@click.command(context_settings={"ignore_unknown_options": True})
@click.argument("options", nargs=-1, type=click.UNPROCESSED)
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
@click.pass_context
def main(context: click.Context, options: tuple[str, ...], json_path: Path | None) -> None:
    """Print whom a service calls from its start to its end. OPTIONS are further ones of `lightpage serve`."""
    with tempfile.TemporaryDirectory(prefix="lightpage-") as name:
        folder = Path(name)
        planted = control(folder)
        click.echo(f"control: {planted} of {len(PLANTED)} planted calls seen, by address, port and protocol")
        trace, phases = life(folder, options)
        found = list(calls(trace))
    outgoing = [call for call in found if call.outgoing]
    questions = [call for call in outgoing if call.port == _DNS]
    table, bad = by_phase(found, phases), by_phase(outgoing, phases)
    click.echo(f"{'phase':18} {'calls':>6} {'outgoing':>9}  addresses")
    for phase, counted in table.items():
        where = ", ".join(f"{address} x{times}" for address, times in sorted(counted.items())) or "-"
        click.echo(f"{phase:18} {counted.total():6} {bad[phase].total():9}  {where}")
    click.echo(f"{len(found)} calls, {len(outgoing)} of them outgoing, {len(questions)} to name servers")
    if json_path is not None:
        figures = {"planted_seen": planted, "outgoing": len(outgoing), "name_server": len(questions)}
        write_figures(json_path, {**figures, "phases": table})
    if outgoing:
        context.exit(1)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.attacks.outgoing"))
