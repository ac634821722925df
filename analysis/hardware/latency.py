"""Times trigger to user bytes: encoded pages through the simulated device as hardware, and what each step takes.

    python -m analysis.hardware.latency --pages 100 --json runs/latency.json

Runs in a private network. The simulated device computes a page's light before it is on display; that is not counted.
"""

from __future__ import annotations

import io
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import click
import numpy as np

from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.codec.volume import DATA_PAGES, PARITY_PAGES, Volume, encode_volume
from lightpage.device.state import Device
from lightpage.errors import LostPageError
from lightpage.metrics.provenance import write_figures
from lightpage.progress import track
from lightpage.recording.pages import PagesWriter
from lightpage.runtime.device.acquisition.camera_source import CameraSource
from lightpage.runtime.device.acquisition.source import open_source
from lightpage.runtime.device.trigger.trigger import Trigger
from lightpage.runtime.model.bundle.shipped import bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.image_tracker import tracker_for
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.models.loader import Loader
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.pages.reading import read_page
from lightpage.virtual_device.device import VirtualDevice
from lightpage.virtual_device.namespace import go_on_inside


class TimedTrigger:
    """A trigger that remembers when it fired last."""

    def __init__(self, trigger: Trigger) -> None:
        self._trigger, self.name, self.fired = trigger, trigger.name, 0.0
        self.arm, self.disarm, self.close = trigger.arm, trigger.disarm, trigger.close

    def fire(self) -> float:
        """See `Trigger`."""
        self.fired = self._trigger.fire()
        return self.fired


def measure(pages: int, folder: Path) -> dict[str, Any]:
    """Read encoded pages one after the other."""
    decoder = Decoder.load(bundle_path("bench"))
    codec, profile = decoder.page_codec, decoder.bundle.profile
    levels = codec.code.levels
    content = np.random.default_rng(0).bytes(codec.user_bytes * pages)
    volume = Volume.of_file(io.BytesIO(content), 1, codec.user_bytes, DATA_PAGES, PARITY_PAGES)
    with PagesWriter(folder / "pages.h5", profile, levels, codec.code.model_dump() | volume.to_json()) as writer:
        for some in encode_volume(codec, volume, io.BytesIO(content), decoder.bundle.written_pilots(levels)):
            writer.append(some)
    seconds, shots, lost, unread = [], [], 0, 0
    with VirtualDevice(profile, Device(), folder) as device:
        source = open_source(f"camera:{device.config}?pages={folder / 'pages.h5'}")
        assert isinstance(source, CameraSource)
        with source:
            timed = TimedTrigger(source._trigger)
            source._trigger = source._pairing.trigger = timed
            plane = DataPlane(Models(decoder, loader=Loader(tracker_for)), source)
            read_page(plane, 0, None, Caller(), user_data=True)
            for page in track(range(pages), "pages", total=pages):
                try:
                    found = read_page(plane, page, None, Caller(), user_data=True)
                except LostPageError:
                    lost += 1
                    continue
                unread += found.answer.user_data is None or found.answer.user_data.data is None
                seconds.append(time.monotonic() - timed.fired)
                shots.append(seconds[-1] - found.answer.page.timings.total_s)
    return {
        "pages": pages,
        "pages_lost": lost,
        "pages_unread": unread,
        "trigger_to_bytes_s_p50": float(np.percentile(seconds, 50)),
        "trigger_to_bytes_s_p99": float(np.percentile(seconds, 99)),
        "without_decoding_s_p50": float(np.percentile(shots, 50)),
    }


@click.command()
@click.option("--pages", default=100, show_default=True, type=click.IntRange(2, 10_000))
@click.option("--json", "json_path", type=OutputFile(), help="Write the figures to this file.")
def main(pages: int, json_path: Path | None) -> None:
    """Print the time from the trigger to a page's user bytes."""
    go_on_inside("analysis.hardware.latency")
    with tempfile.TemporaryDirectory(prefix="lightpage-") as folder:
        found = measure(pages, Path(folder))
    given = f"{found['pages_lost']} pages lost, {found['pages_unread']} unread"
    click.echo(
        f"trigger to user bytes, {found['pages']} pages: p50 {1e3 * found['trigger_to_bytes_s_p50']:.0f} ms, "
        f"p99 {1e3 * found['trigger_to_bytes_s_p99']:.0f} ms; all but decoding p50 "
        f"{1e3 * found['without_decoding_s_p50']:.0f} ms; {given}"
    )
    if json_path is not None:
        write_figures(json_path, found)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.hardware.latency"))
