"""Pictures for documents: small where nobody sees the difference, whole elsewhere."""

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lightpage.pictures import write_png

GREYS = np.repeat(np.random.default_rng(1).integers(0, 256, (40, 50, 1), dtype=np.uint8), 3, axis=2)
COLOURS = np.random.default_rng(2).integers(0, 256, (40, 50, 3), dtype=np.uint8)


@pytest.mark.parametrize(("pixels", "mode"), [(GREYS, "P"), (COLOURS, "RGB")])
def test_a_picture_has_a_palette_unless_that_would_show(pixels: np.ndarray, mode: str, tmp_path: Path) -> None:
    drawn = io.BytesIO()
    Image.fromarray(pixels).save(drawn, "PNG")
    write_png(tmp_path / "picture.png", drawn.getvalue())
    with Image.open(tmp_path / "picture.png") as found:
        assert found.mode == mode
        off = np.abs(np.asarray(found.convert("RGB"), int) - pixels)
    assert off.max() <= (8 if mode == "P" else 0)
    again = tmp_path / "again.png"
    write_png(again, drawn.getvalue())
    assert again.read_bytes() == (tmp_path / "picture.png").read_bytes()
