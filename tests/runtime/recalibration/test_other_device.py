"""A file that was written on one drive, read on another one that nobody has calibrated."""

import json
from pathlib import Path

import numpy as np
import pytest

from lightpage.cli.simulate import simulate
from lightpage.errors import RecalibrationRefusedError
from lightpage.recording.frame_pair import FramePair
from lightpage.recording.reader import Recording
from lightpage.runtime.commands.archives.encode import encode
from lightpage.runtime.commands.archives.recover import recover
from lightpage.runtime.commands.client.recalibrate import recalibrate
from lightpage.runtime.model.bundle.bundle import Bundle, npz, write_bundle
from lightpage.runtime.model.bundle.manifest import PILOTS
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.recalibration.healing import LostPages
from lightpage.runtime.recalibration.other_device import of_other_device
from tests.lightpage.command import run
from tests.runtime.recalibration.test_healing import CODE

CONTENT = bytes(range(250)) * 5
OTHER = [
    "geometry.pipe_angle_deg=-0.3",
    "geometry.page_shift_x_px=0",
    "in_phase_camera.shift_x_px=-6",
    "quadrature_camera.shift_y_px=-7",
    "homodyne.quadrature_sign=-1",
]
"""A drive whose arms stand the other way round: no healing about the first one's geometry finds it."""


@pytest.fixture(scope="module")
def archive(small_bundle: Path, small_device: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one drive's bundle, whose pages have as many pilots as a bench page, and another's recording."""
    folder, bundle = tmp_path_factory.mktemp("archive"), Bundle.open(small_bundle)
    mask = np.zeros(bundle.profile.page_shape, bool)
    mask.flat[np.random.default_rng(2).choice(mask.size, 54, replace=False)] = True
    write_bundle(folder / "A.zip", bundle.manifest, {**bundle.files, PILOTS: npz(mask=mask)})
    (folder / "file").write_bytes(CONTENT)
    CODE.save(folder / "code.toml")
    named = ["--bundle", folder / "A.zip", "--code", folder / "code.toml"]
    run(encode, folder / "file", *named, "--parity-pages", 0, "--out", folder / "pages.h5")
    other = [word for setting in OTHER for word in ("--set", setting)]
    run(simulate, *small_device[:2], "--symbols", folder / "pages.h5", *other, "--seed", 5, "--out", folder / "R.h5")
    return folder


def test_a_file_of_another_drive_comes_back(archive: Path) -> None:
    read = ["--recording", archive / "R.h5", "--out"]
    told = run(
        recalibrate, "--bundle", archive / "A.zip", *read, archive / "B.zip", "--other-device", "--json", archive / "r"
    )
    figures = json.loads((archive / "r").read_text())
    assert figures["version"] in told
    calibration = Bundle.open(archive / "B.zip").calibration
    assert calibration.reference_coherence == calibration.coherence_after > 0
    assert figures["angle_deg"] == pytest.approx(-0.3, abs=0.01)
    run(recover, "--bundle", archive / "B.zip", "--code", archive / "code.toml", *read, archive / "out", "--no-heal")
    assert (archive / "out").read_bytes() == CONTENT


@pytest.mark.long  # two hopeless searches; that pilots tell nothing of other light is shown beside the search itself
def test_pages_without_the_pilots_and_a_repeated_page_are_refused(archive: Path) -> None:
    decoder = Decoder.load(archive / "A.zip", threads=1)
    with Recording.open(archive / "R.h5") as recording:
        references, pairs = recording.references(), [recording.frames(page) for page in range(3)]
    upside_down = [FramePair(*(np.ascontiguousarray(one[::-1]) for one in (p.in_phase, p.quadrature))) for p in pairs]
    for shown in (upside_down, pairs[:1] * 8):
        lost = LostPages(tuple(shown), CODE, references=references)
        with pytest.raises(RecalibrationRefusedError, match="pilots"):
            of_other_device(decoder, lost, lambda what, share: None)
