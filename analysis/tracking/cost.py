"""Cost of the image search: compared with a page that needs none, and at full size."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from statistics import median

import numpy as np
import torch

from analysis.tracking.operating_points import LEVELS, OFFSETS_STREAM, STILL, Figures, Point
from lightpage.calibration.image_search import ImageSearch
from lightpage.calibration.sampling_table import registration_coefficients
from lightpage.device.profile import load_profile
from lightpage.device.state import Device
from lightpage.page.pilots import Pilots
from lightpage.page.symbols import random_symbols
from lightpage.progress import track
from lightpage.simulator.simulator import Simulator
from lightpage.simulator.true_optics import true_parameters
from lightpage.train.models.field import FieldRecovery, TorchFieldSolver
from lightpage.train.models.twin import RayTwin, TorchTwin

SETTLE_S = 0.2


def speed(point: Point, repeats: int) -> Figures:
    """A page that needs no search beside the bare decoder, and one that does, taking turns."""
    written = point.symbols(1)
    pair = point.simulator(1).page(written)
    settled = point.tracker.fork()
    settled.decode(pair, LEVELS)
    ways: dict[str, Callable[[], object]] = {
        "decoder alone": partial(point.decoder.decode, pair, LEVELS),
        "tracked": partial(settled.decode, pair, LEVELS),
        "searched": lambda: point.tracker.fork().decode(pair, LEVELS),
    }
    taken: dict[str, list[float]] = {name: [] for name in ways}
    for repeat in range(repeats + 1):
        for name, call in ways.items():
            time.sleep(SETTLE_S)
            begun = time.perf_counter()
            call()
            if repeat:
                taken[name].append(time.perf_counter() - begun)
    return {name: median(seconds) for name, seconds in taken.items()}


def full_size(seeds: int) -> Figures:
    """The search at full size: a square pipe, whose pages are simulated in seconds; geometry known, no decoder."""
    profile = load_profile("paper")
    device = Device().with_settings([*STILL, "geometry.pipe_angle_deg=0.0"])
    parameters, twin = true_parameters(profile, device), TorchTwin(RayTwin(profile))
    solve, search = TorchFieldSolver(FieldRecovery(profile)), ImageSearch(twin, parameters, profile)
    registration = registration_coefficients(twin, parameters, profile)
    quadrature_phase = device.homodyne.turn_rad
    homodyne = np.array([np.cos(quadrature_phase), np.sin(quadrature_phase)], np.float32)
    pilots, rows = Pilots.of_profile(profile, LEVELS), []
    for seed in track(range(seeds), "full size", unit="page"):
        simulator = Simulator(profile, device, LEVELS, seed)
        by = np.random.default_rng([OFFSETS_STREAM, 2, seed]).uniform(-12, 12, 2)
        simulator.knock((float(by[0]), float(by[1])))
        page = random_symbols(profile, LEVELS, 1, np.random.default_rng([OFFSETS_STREAM, 2, seed]))[0]
        pair, references = simulator.page(page), simulator.references()
        begun = time.perf_counter()
        with torch.no_grad():
            field, _ = solve(pair, references, registration, homodyne, {})
        recovered = time.perf_counter()
        found = search.find(field, pilots)
        rows.append(
            {
                "found": found.found,
                "error_px": float(np.abs(found.shift_px - by).max()),
                "field_seconds": recovered - begun,
                "search_seconds": time.perf_counter() - recovered,
                "significance": found.significance,
                "needed": found.needed,
            }
        )
    return {"rows": rows, "pilots": len(pilots.phases)}
