"""Read a file on drives that were never calibrated, with the bundle of the drive that it was written on.

    python -m analysis.calibration.other_drives --share 0.5 --devices 20 --json F
    python -m analysis.calibration.other_drives --share 0.5 --code wide.toml --angle -0.6 --json F

A file of 20,000 bytes is encoded with the code and simulated on drawn devices, whose numbers scatter by a share of a
rough device's deviations about nominal. At most eight of its pages show the device (`of_other_device`), six heal it,
and all are read. Beside it stands what the bundle's decoder reads with the device's true geometry, which is the most
that any calibration by known pages brings. An interrupted run goes on: devices in the JSON file are not measured again.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import click
import numpy as np

from lightpage.calibration.parameters import as_dict
from lightpage.cli.main import run
from lightpage.cli.paths import OutputFile
from lightpage.codec.code import Code, load_code
from lightpage.codec.page_bytes import FileFacts, Header
from lightpage.codec.page_codec import PageCodec
from lightpage.device.state import Device, draw_rough
from lightpage.errors import RecalibrationRefusedError
from lightpage.metrics.measures import measure
from lightpage.metrics.provenance import write_figures
from lightpage.page.pilots import Pilots
from lightpage.progress import track
from lightpage.recording.frame_pair import FramePair
from lightpage.runtime.model.bundle.shipped import bundle_path
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.execution.twin import OnnxTwin
from lightpage.runtime.recalibration.healing import LostPages, heal
from lightpage.runtime.recalibration.other_device import of_other_device
from lightpage.runtime.recalibration.recalibration import refitted_bundle
from lightpage.runtime.recalibration.refit import traced
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import true_parameters

FILE_BYTES = 20_000
HEADER = (
    f"{'seed':>5} {'angle':>7} {'true: AIR':>9} {'read':>5} {'pilots':>7} {'AIR':>6} {'read':>8} {'wrong':>5} rounds"
    "  seconds"
)


@dataclass(frozen=True)
class Outcome:
    """Figures of a device: mean AIRs of the pages, bits a symbol, and how many of them give bytes.

    `true` is with the true geometry, `start` with the one that pilots show, `found` with the healed one; `wrong` counts
    bytes that were given out and are not those written, `refused` says why there are none.
    """

    seed: int
    angle_deg: float
    true: float
    read_true: int
    pages: int
    start: float | None = None
    found: float | None = None
    read: int = 0
    wrong: int = 0
    rounds: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    refused: str | None = None

    def line(self) -> str:
        """A row of the table."""
        start, found = ("-" if air is None else f"{air:.3f}" for air in (self.start, self.found))
        return (
            f"{self.seed:>5} {self.angle_deg:>7.3f} {self.true:>9.3f} {self.read_true:>5} {start:>7} {found:>6} "
            f"{self.read:>2} of {self.pages:<2} {self.wrong:>5} {self.rounds:>6} {self.seconds:>8.0f}"
            f"{f'  {self.refused}' if self.refused else ''}"
        )


class _Drives:
    """A bundle, and a file that is written with its pilots.

    Args:
        decoder: decoder of the bundle.
        code: code of the file's pages.
    """

    def __init__(self, decoder: Decoder, code: Code) -> None:
        self._decoder, self._code = decoder, code
        codec = self._codec(decoder)
        count = -(-FILE_BYTES // codec.user_bytes)
        self._data = np.random.default_rng(0).integers(0, 256, (count, codec.user_bytes), dtype=np.uint8)
        self._headers = [Header(code.id, 1, page, count * codec.user_bytes) for page in range(count)]
        pilots = decoder.bundle.written_pilots(code.levels)
        self._symbols = codec.encode(self._headers, self._data, FileFacts(count, 0, 0), pilots)

    def _codec(self, decoder: Decoder) -> PageCodec:
        return PageCodec(self._code, decoder.bundle.pilot_mask, decoder.bundle.levels(self._code.levels))

    def measured(self, seed: int, device: Device) -> Outcome:
        """Write on the bundle's drive, read on `device`."""
        bundle, simulator = (
            self._decoder.bundle,
            Simulator(self._decoder.bundle.profile, device, self._code.levels, seed),
        )
        pairs, references = [simulator.page(page) for page in self._symbols], simulator.references()
        truth = {
            "parameters": as_dict(true_parameters(bundle.profile, device)),
            "turn_rad": device.homodyne.turn_rad,
        }
        table = traced(self._decoder, OnnxTwin(bundle), references, bundle.calibration.model_copy(update=truth))
        true, read_true, _ = self._read(self._decoder.of_bundle(refitted_bundle(bundle, table)), pairs)
        known = Outcome(seed, device.geometry.pipe_angle_deg, true, read_true, len(pairs))
        lost = LostPages(tuple(pairs), self._code, references=references)
        start, begun, begun_cpu = None, time.perf_counter(), time.process_time()
        found, read, wrong, rounds, refused = None, 0, 0, 0, None
        try:
            nearly = of_other_device(self._decoder, lost, lambda what, share: None)
            start, _, _ = self._read(nearly, pairs[:1])
            healed = heal(nearly, lost)
        except RecalibrationRefusedError as error:
            refused = str(error)
        else:
            found, read, wrong = self._read(healed.decoder, pairs)
            rounds = healed.rounds
        seconds, cpu_seconds = time.perf_counter() - begun, time.process_time() - begun_cpu
        told = {"start": start, "found": found, "read": read, "wrong": wrong, "rounds": rounds, "refused": refused}
        return Outcome(**{**asdict(known), **told, "seconds": seconds, "cpu_seconds": cpu_seconds})

    def _read(self, decoder: Decoder, pairs: list[FramePair]) -> tuple[float, int, int]:
        """Mean AIR of pages, how many give bytes, and how many of these bytes are wrong."""
        mask, levels, codec = decoder.bundle.pilot_mask, decoder.bundle.levels(self._code.levels), self._codec(decoder)
        airs, read, wrong = list[float](), 0, 0
        for pair, symbols, data in zip(pairs, self._symbols, self._data, strict=False):
            pilots = Pilots.of_symbols(mask, symbols, levels)
            page = decoder.post_process(decoder.infer(pair, doubtful=True), levels.count, pilots)
            given = codec.decode(page.phase, page.concentration).data
            if given is not None:
                read += 1
                wrong += int(np.count_nonzero(np.frombuffer(given, np.uint8) != data))
            found = measure(page.phase[~mask], page.concentration[~mask], symbols[~mask], levels)
            airs.append(found.air_bits_per_symbol)
        return float(np.mean(airs)), read, wrong


@click.command()
@click.option("--bundle", default="bench", show_default=True, help="A bundle's path, or the name of a shipped one.")
@click.option("--code", "code_path", type=click.Path(path_type=Path), help="Code of the file; the bundle's.")
@click.option("--share", default=0.5, show_default=True, help="Share of a rough device's deviations.")
@click.option("--angle", type=float, help="Angle of every device's pipe about which it is drawn.  [default: nominal]")
@click.option("--devices", default=20, show_default=True, type=click.IntRange(1))
@click.option("--first-seed", default=0, show_default=True, type=click.IntRange(0))
@click.option("--json", "json_path", required=True, type=OutputFile())
def main(
    bundle: str,
    code_path: Path | None,
    share: float,
    angle: float | None,
    devices: int,
    first_seed: int,
    json_path: Path,
) -> None:
    """Read a file on drawn drives with the bundle of another."""
    decoder = Decoder.load(bundle_path(bundle))
    code = decoder.page_codec.code if code_path is None else load_code(code_path)
    asked = {"bundle": bundle, "code": code.describe(), "share": share, "angle": angle}
    kept = json.loads(json_path.read_text("utf-8")) if json_path.exists() else {}
    done = {one["seed"]: Outcome(**one) for one in kept.get("outcomes", ()) if kept.get("asked") == asked}
    drives = _Drives(decoder, code)
    click.echo(HEADER)
    seeds = range(first_seed, first_seed + devices)
    for seed in track(seeds, "read", unit="device"):
        if seed not in done:
            device = draw_rough(np.random.default_rng(seed), share)
            if angle is not None:
                turned = angle + device.geometry.pipe_angle_deg
                device = device.with_values({"geometry.pipe_angle_deg": turned})
            done[seed] = drives.measured(seed, device)
            write_figures(json_path, {"asked": asked, "outcomes": [asdict(each) for each in done.values()]})
        click.echo(done[seed].line())
    chosen = [done[seed] for seed in seeds]
    for what, count in {
        "devices": len(chosen),
        "bit-exact": sum(one.read == one.pages and not one.wrong for one in chosen),
        "bit-exact with the true geometry": sum(one.read_true == one.pages for one in chosen),
        "refused": sum(one.refused is not None for one in chosen),
        "wrong bytes": sum(one.wrong for one in chosen),
    }.items():
        click.echo(f"{what:<33} {count}")


if __name__ == "__main__":
    sys.exit(run(main, name="python -m analysis.calibration.other_drives"))
