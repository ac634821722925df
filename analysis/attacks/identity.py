"""Every call with no, a wrong, an expired and each role's certificate: is that allowed which the documentation says?

    python -m analysis.attacks.identity --json FILE

The certificates are made by the very commands of docs/guides/serving.md, and the table of roles is read from there. A
service in a process of its own is called over TLS; each call's request is empty. A caller without a good certificate
must find no connection (UNAVAILABLE), and one whose role is lacking must hear PERMISSION_DENIED. Any other end means
that a call was let in. UNAVAILABLE for a caller with a good certificate is wrong, whatever its role.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
import grpc
from google.protobuf.descriptor import MethodDescriptor
from google.protobuf.message_factory import GetMessageClass

from analysis.service.running import PagesToSend, RunningService
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.metrics.provenance import write_figures
from lightpage.progress import track
from lightpage.runtime.client.wire.channel import TlsFiles, open_channel
from lightpage.runtime.service.frames.inference_calls import INFERENCE, PREFIX
from lightpage.runtime.service.server.dispatcher import SERVICE

SERVING = Path(__file__).resolve().parents[2] / "docs" / "guides" / "serving.md"
CALL_S = 10.0
_UNKNOWN = ("none", "wrong", "expired", "service")
"""Callers without a good certificate, who may not even connect."""
LET_IN, REFUSED, NO_CONNECTION = "let in", "refused", "no connection"
_MORE = r"""
role=urn:lightpage:role
issue recalibrator extendedKeyUsage=clientAuth "subjectAltName=URI:$role:recalibrate"
issue nobody extendedKeyUsage=clientAuth
issue expired extendedKeyUsage=clientAuth "subjectAltName=URI:$role:admin"
openssl x509 -req -in expired.csr -CA ca.pem -CAkey ca.key -CAcreateserial -days -1 \
    -extfile expired.ext -out expired.pem
openssl ecparam -name prime256v1 -genkey -noout -out other.key
openssl req -x509 -new -key other.key -days 10 -subj "/CN=Another authority" \
    -addext keyUsage=critical,keyCertSign,cRLSign -out other.pem
issue wrong extendedKeyUsage=clientAuth "subjectAltName=URI:$role:admin"
openssl x509 -req -in wrong.csr -CA other.pem -CAkey other.key -CAcreateserial -days 10 \
    -extfile wrong.ext -out wrong.pem
"""
"""Certificates beside those of the documentation: one with a role of its own, and some that must not help anybody."""

CALLERS: Mapping[str, Sequence[str]] = {
    "none": (),
    "wrong": (),
    "expired": (),
    "service": (),
    "nobody": (),
    "watcher": ("read",),
    "controller": ("decode",),
    "recalibrator": ("recalibrate",),
    "keeper": ("decode", "recalibrate"),
    "operator": ("admin",),
}
"""Certificates by name, and their roles; `none` connects without one."""


def commands_of(section: str) -> str:
    """The first commands of a section of the documentation, for bash."""
    found = re.search(rf"### {section}\n.*?```\n(.*?)```", SERVING.read_text("utf-8"), re.DOTALL)
    if found is None:
        raise RuntimeError(f"{SERVING.name}: no commands in {section}")
    return found[1]


def documented() -> tuple[str, dict[str, str]]:
    """The commands that make certificates, and the role that each call needs, as the documentation has them."""
    text = SERVING.read_text("utf-8")
    rows = re.findall(r"^\| `(read|decode|recalibrate|admin)` \| (.+) \|$", text, re.MULTILINE)
    needed = {call: role for role, calls in rows for call in re.findall(r"`([\w/]+)`", calls)}
    return commands_of("Make certificates"), needed


def expected(caller: str, role: str) -> str:
    """Return the outcome that the documentation promises to a caller whose call needs a role."""
    if caller in _UNKNOWN:
        return NO_CONNECTION
    roles = CALLERS[caller]
    return LET_IN if roles and (role == "read" or role in roles or "admin" in roles) else REFUSED


def outcome(code: str) -> str:
    """Return the outcome of a call by its status code."""
    return {"UNAVAILABLE": NO_CONNECTION, "PERMISSION_DENIED": REFUSED}.get(code, LET_IN)


def methods() -> Iterator[tuple[str, MethodDescriptor]]:
    """Every call that the service has, under the name that the documentation gives it."""
    for service, prefix in ((SERVICE, ""), (INFERENCE, PREFIX)):
        for method in service.methods:
            yield prefix + method.name, method


def ended(channel: grpc.Channel, method: MethodDescriptor) -> str:
    """Call with an empty request, and return the name of the status code."""
    request, path = GetMessageClass(method.input_type)(), f"/{method.containing_service.full_name}/{method.name}"
    ways = "stream" if method.client_streaming else "unary", "stream" if method.server_streaming else "unary"
    call: Any = getattr(channel, "_".join(ways))(path, type(request).SerializeToString, None)
    try:
        answer = call(iter([request]) if method.client_streaming else request, timeout=CALL_S)
        if method.server_streaming:
            next(answer, None)
            answer.cancel()
    except grpc.RpcError as error:
        told: Any = error
        return str(told.code().name)
    return "OK"


@contextmanager
def connected(target: str, caller: str, folder: Path) -> Iterator[grpc.Channel]:
    """A connection with a caller's certificate."""
    if caller == "none":
        credentials = grpc.ssl_channel_credentials((folder / "ca.pem").read_bytes())
        with grpc.secure_channel(target, credentials) as channel:
            yield channel
    else:
        files = TlsFiles(folder / "ca.pem", folder / f"{caller}.pem", folder / f"{caller}.key")
        with open_channel(target, files) as channel:
            yield channel


def measured() -> dict[str, Any]:
    """Return the status code of every call for every caller, and the calls that should have ended otherwise."""
    commands, needed = documented()
    undocumented = sorted(name for name, _ in methods() if name not in needed)
    found: dict[str, dict[str, str]] = {}
    with tempfile.TemporaryDirectory(prefix="lightpage-") as name:
        folder = Path(name)
        script = f"set -euo pipefail\n{commands}\ncd tls\n{_MORE}"
        subprocess.run(["bash", "-c", script], cwd=folder, check=True, capture_output=True, timeout=120)
        source, tls = PagesToSend().record(folder / "pages.h5"), folder / "tls"
        own = (
            "--ca",
            str(tls / "ca.pem"),
            "--certificate",
            str(tls / "service.pem"),
            "--key",
            str(tls / "service.key"),
        )
        with RunningService(*own, "--threads", "1", "--source", f"recording:{source}") as service:
            for caller in track(CALLERS, "callers", total=len(CALLERS)):
                with connected(service.target, caller, tls) as channel:
                    found[caller] = {call: ended(channel, method) for call, method in methods()}
    wrong = [
        f"{caller}: {call} ended with {code}"
        for caller, calls in found.items()
        for call, code in calls.items()
        if call in needed and outcome(code) != expected(caller, needed[call])
    ]
    return {"ended": found, "undocumented": undocumented, "wrong": wrong}


@click.command()
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(json_path: Path | None) -> None:
    """Print how many calls each caller may make, and what is not as documented."""
    found = measured()
    for caller, calls in found["ended"].items():
        counts = Counter(map(outcome, calls.values()))
        click.echo(
            f"{caller:<14}" + ", ".join(f"{counts[each]:>3} {each}" for each in (LET_IN, REFUSED, NO_CONNECTION))
        )
    for each in [*found["wrong"], *(f"{call} is not in the table of roles" for call in found["undocumented"])]:
        click.echo(f"  {each}")
    calls = sum(map(len, found["ended"].values()))
    click.echo(f"{calls} calls: {len(found['wrong'])} not as documented, {len(found['undocumented'])} undocumented")
    if json_path is not None:
        write_figures(json_path, found)
    if found["wrong"] or found["undocumented"]:
        sys.exit(1)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.attacks.identity"))
