"""The Open Inference Protocol from outside: the unmodified tritonclient, a health check and a reflection client.

    python -m analysis.service.inference_protocol --out FOLDER --json FILE

These programs come from the package index, in the versions below, into an environment of their own in FOLDER: they want
another protobuf than the service has. `triton_checks.py` runs there against a service in a process of its own, and
compares each answer bit by bit with that of the service's own client. The exit status is 1 where a check fails.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import click
import numpy as np

from analysis.service.running import RunningService
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile, OutputFolder
from lightpage.metrics.provenance import write_figures
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path
from lightpage.runtime.service.settings import ADDRESS

PACKAGES = ("tritonclient[grpc]==2.73.0", "grpcio-health-checking==1.81.1", "grpcio-reflection==1.81.1")
"""The last two of the last version that goes with tritonclient's protobuf."""

_INSTALL_S = 600.0
_CHECKS_S = 1800.0
_PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "contract.md"
_PROGRAM = Path(__file__).with_name("triton_checks.py")


def environment(folder: Path) -> Path:
    """Make an environment with `PACKAGES` below a folder, unless it is there, and return its python.

    Raises:
        CalledProcessError: a package cannot be had.
    """
    python, done = folder / "bin" / "python", folder / "packages.txt"
    wanted = "\n".join(PACKAGES)
    if done.exists() and done.read_text("utf-8") == wanted:
        return python
    subprocess.run([sys.executable, "-m", "venv", "--clear", "--without-pip", folder], check=True)
    pip = [sys.executable, "-m", "pip", "--python", str(python), "--disable-pip-version-check"]
    subprocess.run([*pip, "install", "--quiet", *PACKAGES], check=True, timeout=_INSTALL_S)
    done.write_text(wanted, "utf-8")
    return python


def expect(service: RunningService, bundle: Bundle, folder: Path) -> None:
    """Write the golden pair of a bundle, what the service's own client gets for it, and the documentation's example."""
    pair, has_code = bundle.golden.pair, bundle.code is not None
    with LightpageClient(service.target, timeout_s=300) as client:
        page = client.frames.decode(pair, stateless=True, want_phase=True, want_concentration=True)
        coded = client.frames.decode(pair, stateless=True, user_data=True) if has_code else None
    found = None if coded is None else coded.user_data
    assert (found is None) == (coded is None)  # asked for
    assert page.image is not None  # the service follows it
    names = ("levels", "piston_rad", "pilot_coherence", "pilot_trust", "claimed_bits", "confirmed_bits")
    figures = {name: getattr(page, name) for name in (*names, "recalibration_due")}
    figures |= {f"image.{name}": value for name, value in vars(page.image).items()}
    told = {
        "model_version": page.model_version,
        "bit_depth": bundle.manifest.camera_bit_depth,
        "figures": figures,
        "user_data_loss": None if found is None else found.loss.name if found.loss is not None else "",
        "user_data": "" if found is None else (found.data or b"").hex(),
    }
    assert page.phase is not None  # asked for, as the next one
    assert page.concentration is not None
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(
        folder / "expected.npz",
        in_phase=pair.in_phase,
        quadrature=pair.quadrature,
        symbols=page.symbols,
        confidence=page.confidence,
        phase=page.phase,
        concentration=page.concentration,
        pilot_mask=bundle.pilot_mask.astype(np.uint8),
    )
    (folder / "expected.json").write_text(json.dumps(told), "utf-8")
    section = _PAGE.read_text("utf-8").partition("\n## Open Inference Protocol\n")[2]
    found_example = re.search(r"```python\n(.*?)```", section, re.DOTALL)
    assert found_example is not None  # the page has one
    (folder / "example.py").write_text(found_example[1].replace(ADDRESS, service.target), "utf-8")


def checks(python: Path, service: RunningService, folder: Path) -> list[dict[str, Any]]:
    """Run the checks; one that could not be run is a failed one."""
    done = subprocess.run(
        [python, _PROGRAM, service.target, service.health, folder],
        stdout=subprocess.PIPE,
        text=True,
        timeout=_CHECKS_S,
        check=False,
    )
    found = [json.loads(line) for line in done.stdout.splitlines()]
    if done.returncode != 0:
        found.append({"check": "all of them", "trouble": f"exit status {done.returncode}", "seconds": 0.0})
    return found


@click.command()
@click.option("--bundle", show_default=True, default=DEFAULT, help="A bundle's path, or the name of a shipped one.")
@click.option("--threads", type=click.IntRange(1), help="Threads of an inference; by default all cores.")
@click.option("--out", required=True, type=OutputFolder(), help="The environment, and what is expected.")
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
@click.pass_context
def main(context: click.Context, bundle: str, threads: int | None, out: Path, json_path: Path | None) -> None:
    """Print what other people's clients of the protocol meet."""
    python = environment(out / "environment")
    own = () if threads is None else ("--threads", str(threads))
    with RunningService("--bundle", bundle, *own) as service:
        expect(service, Bundle.open(bundle_path(bundle)), out)
        found = checks(python, service, out)
        log, status = service.log(), service.stop()
    for each in found:
        click.echo(f"{each['check']:28} {each['seconds']:7.2f} s  {each['trouble'] or 'as it should be'}")
    tracebacks = log.count("Traceback")
    failed = [each["check"] for each in found if each["trouble"]]
    click.echo(f"{len(found)} checks, {len(failed)} failed; exit status {status}, tracebacks in the log: {tracebacks}")
    if json_path is not None:
        figures = {"packages": PACKAGES, "checks": found, "exit_status": status, "tracebacks": tracebacks}
        write_figures(json_path, figures)
    if failed or status or tracebacks or not found:
        context.exit(1)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.service.inference_protocol"))
