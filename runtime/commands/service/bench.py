"""`lightpage bench`: how long a page takes, inference alone, decoded, and through gRPC, timed side by side."""

import time
from collections.abc import Callable
from pathlib import Path

import click
import numpy as np

from lightpage.cli.options import JSON
from lightpage.codec.compiled.choice import in_use as page_code_in_use
from lightpage.files import write_json
from lightpage.progress import track
from lightpage.runtime.client.client import LightpageClient
from lightpage.runtime.commands.execution import Load, decoder_options
from lightpage.runtime.model.execution.cpus import available_cpus
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.jobs.recalibrator import Recalibrator
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.server.server import LightpageServer

LEVELS = 16
WARM_UP = 2


@click.command()
@decoder_options
@click.option("--rounds", default=20, show_default=True, type=click.IntRange(3, 1000), help="Timed rounds.")
@JSON
def bench(load: Load, rounds: int, json_path: Path | None) -> None:
    """Time one page three ways in turn, so that a machine whose speed drifts does not tilt the comparison."""
    decoder = load()
    pair = decoder.bundle.golden.pair
    plane = DataPlane(Models(decoder))
    with LightpageServer(plane, Recalibrator(plane)) as server, LightpageClient(server.target) as client:
        client.describe()
        ways: dict[str, Callable[[], object]] = {
            "inference": lambda: decoder.infer(pair),
            "decode": lambda: decoder.decode(pair, LEVELS),
            "grpc": lambda: client.frames.decode(pair, LEVELS),
        }
        seconds: dict[str, list[float]] = {name: [] for name in ways}
        for iteration in track(range(rounds + WARM_UP), "bench", unit="round"):
            for name, way in ways.items():
                start = time.perf_counter()
                way()
                if iteration >= WARM_UP:
                    seconds[name].append(time.perf_counter() - start)
    median = {name: float(np.median(values)) for name, values in seconds.items()}
    figures = {
        "bundle_version": decoder.version,
        "threads": decoder.threads or available_cpus(),
        "provider": str(decoder.graph.provider),
        "page_code": page_code_in_use(),
        "rounds": rounds,
        "steps_per_page": decoder.infer(pair).steps,
        **{f"{name}_p50_seconds": value for name, value in median.items()},
        "decode_over_inference": median["decode"] / median["inference"],
        "grpc_over_inference": median["grpc"] / median["inference"],
    }
    write_json(json_path, figures)
    click.echo(f"page code: {figures['page_code']}")
    for name, label in (("inference", "ONNX Runtime alone"), ("decode", "whole decode"), ("grpc", "through gRPC")):
        click.echo(f"{label:<20} p50 {1e3 * median[name]:8.1f} ms   {median[name] / median['inference']:5.2f} x")
