"""The dashboard of deploy/grafana, drawn from what a real Prometheus has scraped from a real service under load.

    python -m analysis.dashboard.dashboard --out docs/images/dashboard.png

The panels are those of the dashboard's JSON: their titles, expressions, units, stacking and colours. Only the drawing
is matplotlib's, in place of Grafana's. Pages of user bytes are sent and read; then the device has drifted; it is
recalibrated with known pages; at last more calls come than can be served.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path

import click

from analysis.dashboard.drawing import Drawing
from analysis.dashboard.load import SESSION, scenario
from analysis.dashboard.prometheus import DEPLOY, RunningPrometheus
from analysis.service.running import RunningService
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.runtime.model.bundle.shipped import DEFAULT, bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder

DASHBOARD = DEPLOY / "grafana" / "lightpage.json"


@click.command()
@click.option(
    "--seconds", default=60.0, show_default=True, type=click.FloatRange(5.0), help="Seconds of each of four phases."
)
@click.option("--threads", default=1, show_default=True, type=click.IntRange(1), help="Threads of an inference.")
@click.option("--out", required=True, type=OutputFile(), help="The picture, PNG.")
def main(seconds: float, threads: int, out: Path) -> None:
    """Draw the dashboard of a service under load."""
    decoder = Decoder.load(bundle_path(DEFAULT), threads)
    with tempfile.TemporaryDirectory(prefix="lightpage-") as name:
        folder = Path(name)
        settings = folder / "settings.toml"
        settings.write_text(f'[self_calibration]\ndevice_sessions = ["{SESSION}"]\n')
        service = RunningService("--store", f"{folder}/models", "--threads", str(threads), "--config", str(settings))
        with service, RunningPrometheus(service.metrics.removeprefix("http://").partition("/")[0]) as prometheus:
            begun = time.time()
            scenario(service, decoder, seconds, folder)
            time.sleep(2.0)  # for the last scrape
            empty = Drawing(prometheus, begun, time.time()).draw(json.loads(DASHBOARD.read_text("utf-8")), out)
    click.echo(f"{out}: no data in {', '.join(empty) if empty else 'no panel'}")


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.dashboard.dashboard"))
