"""A picture of the report of a bulk run: `python -m analysis.scaling.report_picture --out docs/images/bulk_report.png`.

Five simulated bench devices have drifted differently far. Some of their pages are black or overexposed, and a recording
is cut off. They are evaluated by two workers, of which one is killed; the run is interrupted and taken up again. Then
the device that has drifted furthest is recalibrated, and what was not read well is read again with the new bundle.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import click
import h5py
import numpy as np
from playwright.sync_api import sync_playwright

from analysis.scaling.processes import children
from analysis.service.running import until
from lightpage.cli.main import run as run_command
from lightpage.cli.paths import OutputFile, OutputFolder
from lightpage.demo.drift import drifted
from lightpage.device.profile import load_profile
from lightpage.device.state import Device
from lightpage.errors import InvalidInputError
from lightpage.helper_process import same_packages
from lightpage.page.symbols import random_symbols
from lightpage.pictures import write_png
from lightpage.progress import track
from lightpage.recording.writer import RecordingWriter
from lightpage.report.contents.from_bulk import PAUSE_S
from lightpage.runtime.archives.run.shard import RECORD
from lightpage.runtime.model.bundle.shipped import DEFAULT
from lightpage.simulator.simulator import Simulator

DRIFTS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Drifts of each device, as shares of the demo's drift."""
LEVELS, RANGE_PAGES = 256, 4
WIDTH_PX, HEIGHT_PX = 1240, 900
_SHOWN = "nav, #losses, #rounds, #workers { display: none }"
_LIMIT_S = 1800.0
_LOOK_S = 0.1
_PAUSE_S = PAUSE_S + 5.0


def fleet(folder: Path, pages: int) -> Path:
    """Recordings of the devices, some of whose pages are spoilt, and the file that names them; made once."""
    profile, file = load_profile(DEFAULT), folder / "fleet.toml"
    if file.exists():
        return file
    for number, share in track(list(enumerate(DRIFTS, 1)), "simulate", unit="device"):
        device, path = drifted(Device(), share), folder / f"shelf-{number}.h5"
        simulator = Simulator(profile, device, LEVELS, number)
        symbols = random_symbols(profile, LEVELS, pages, np.random.default_rng(number))
        with RecordingWriter(path, profile, LEVELS, device.sensor.bit_depth, simulator.references()) as writer:
            for page in symbols:
                writer.append(page, simulator.page(page))
        with h5py.File(str(path), "r+") as recording:
            if number in (1, 3):
                recording["in_phase"][number] = 0
            if number == 4:
                recording["quadrature"][3:5] = 2**device.sensor.bit_depth - 1
    (folder / "shelf-2b.h5").write_bytes((folder / "shelf-2.h5").read_bytes()[:4096])
    tables = [
        f'[[device]]\nname = "shelf-{number}"\nbundle = "{DEFAULT}"\nrecordings = ["shelf-{number}*.h5"]\n'
        for number in range(1, 1 + len(DRIFTS))
    ]
    file.write_text("\n".join(tables))
    return file


def disturbed_run(folder: Path, fleet_file: Path) -> None:
    """Evaluate the fleet: a worker is killed, the run is interrupted and taken up, and poor pages are read again."""
    asked = ("evaluate", str(folder), "--fleet", str(fleet_file), "--range-pages", str(RANGE_PAGES))
    workers = ("--workers", "2", "--threads", "1")
    first = _bulk(*asked, *workers)
    _wait(first, folder, 3)
    if working := children(first.pid):
        os.kill(working[0], signal.SIGKILL)
    _wait(first, folder, 8)
    first.send_signal(signal.SIGINT)
    first.wait(_LIMIT_S)
    time.sleep(_PAUSE_S)  # long enough for the report to tell the two parts
    _bulk("evaluate", str(folder), *workers).wait(_LIMIT_S)
    newer, worst = folder.with_name("newer.zip"), fleet_file.with_name(f"shelf-{len(DRIFTS)}.h5")
    newer.unlink(missing_ok=True)
    _lightpage("recalibrate", "--bundle", DEFAULT, "--recording", str(worst), "--out", str(newer)).wait(_LIMIT_S)
    _bulk("evaluate", str(folder), "--again-with", str(newer), *workers).wait(_LIMIT_S)


def photograph(page: Path, out: Path) -> None:
    """Take a page as a browser shows it, without the sections that most readers skip.

    Raises:
        InvalidInputError: there is no browser.
    """
    chromium = shutil.which("chromium")
    if chromium is None:
        raise InvalidInputError("program chromium", "none", "one: apt-get install chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        seen = browser.new_page(viewport={"width": WIDTH_PX, "height": HEIGHT_PX}, color_scheme="light")
        seen.goto(page.absolute().as_uri())
        seen.add_style_tag(content=_SHOWN)
        write_png(out, seen.screenshot(full_page=True))
        browser.close()


def _lightpage(*words: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "lightpage.cli.main", *words]
    return subprocess.Popen(command, env=same_packages(1), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def _bulk(*words: str) -> subprocess.Popen[bytes]:
    return _lightpage("bulk", *words)


def _wait(run: subprocess.Popen[bytes], folder: Path, ranges: int) -> None:
    """Wait until a run has done so many ranges, or has ended."""
    for _ in until(time.monotonic() + _LIMIT_S, _LOOK_S):
        if run.poll() is not None or sum(1 for _ in folder.glob(f"shards/*/*{RECORD}")) >= ranges:
            return


@click.command()
@click.option("--pages", default=16, show_default=True, type=click.IntRange(6), help="Pages of each device.")
@click.option("--work", type=OutputFolder(), help="Recordings, run and page; a temporary folder by default.")
@click.option("--out", required=True, type=OutputFile(), help="The picture, PNG.")
def main(pages: int, work: Path | None, out: Path) -> None:
    """Draw it."""
    with tempfile.TemporaryDirectory(prefix="lightpage-") as temporary:
        folder = work or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        fleet_file = fleet(folder, pages)
        shutil.rmtree(folder / "archive", ignore_errors=True)
        disturbed_run(folder / "archive", fleet_file)
        status = _lightpage("report", str(folder / "archive"), "--out", str(folder / "report.html")).wait(_LIMIT_S)
        if status:
            raise RuntimeError(f"lightpage report ended with status {status}")
        photograph(folder / "report.html", out)


if __name__ == "__main__":
    sys.exit(run_command(main, name="python -m analysis.scaling.report_picture"))
