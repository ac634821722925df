"""A device for tests, an eighth of the full size: zones, symbols and sampling of `bench` on a quarter of its area."""

import numpy as np

from lightpage.calibration.goodness.verdict import Goodness
from lightpage.device.profile import Camera, Lens, LensPath, PageLayout, Pipe, Profile, load_profile
from lightpage.device.state import Device, ideal_device

THICK = LensPath(
    piston_rad=-5,
    distortion_rad=-4.4,
    astigmatism_rad=-2.8,
    field_curvature_rad=-2.1,
    coma_rad=-1.4,
    spherical_rad=-0.1,
)
"""Path that is about that of a real lens at the full size."""
EXPLAINED = Goodness(
    verdict="good",
    bits_lost=0.01,
    unexplained_relative=1e-4,
    noise_relative=2e-4,
    modulator_noise_rad=0.05,
    by_page=[[1.0] * 8] * 6,
    by_facet=[[1.0] * 8] * 6,
    cause="",
)
UNEXPLAINED = EXPLAINED.model_copy(update={"verdict": "wrong", "bits_lost": 1.2, "cause": "a curvature"})


def small_profile() -> Profile:
    """44 x 28 symbols, f = 10 mm, pipe 9.375 mm x 0.444815 mm, cameras 684 x 456."""
    bench = load_profile("bench")
    return bench.model_copy(
        update={
            "name": "small",
            "lens": Lens(focal_length_m=bench.lens.focal_length_m / 2),
            "pipe": Pipe(
                length_m=bench.pipe.length_m / 2,
                width_m=bench.pipe.width_m / 2,
                refractive_index=bench.pipe.refractive_index,
            ),
            "page": PageLayout(columns=44, rows=28, symbol_size_px=4),
            "camera": Camera(columns_px=684, rows_px=456, pitch_m=bench.camera.pitch_m),
        }
    )


def perfect_device(**tables: object) -> Device:
    """A device as its profile says, with no defect but those given, by table: `perfect_device(slm=SlmDefects(...))`."""
    return ideal_device().model_copy(update=tables)


def random_phases(profile: Profile, seed: int = 0) -> np.ndarray:
    """Independent uniform phases of a page's symbols, [ny, nx], radians."""
    return np.random.default_rng(seed).uniform(0, 2 * np.pi, profile.page_shape)


def on_slm(phases: np.ndarray, profile: Profile) -> np.ndarray:
    """Symbol phases [ny, nx] repeated over the SLM pixels of each symbol."""
    return np.kron(phases, np.ones((profile.page.symbol_size_px,) * 2))
