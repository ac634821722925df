"""Settings of a camera say what is wrong with them; ranges are those of the documents' table."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from runtime.cameras.settings import CameraSettings


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"pixel_format": "RGB8"}, "RGB8"),
        ({"driver": "gentl"}, "no producer"),
        ({"producer": "maker.cti"}, "producer with"),
        ({"address": "10.0.0.1", "serial": None, "driver": "gentl", "producer": "maker.cti"}, "address with"),
        ({"packet_bytes": 1400, "driver": "gentl", "producer": "maker.cti"}, "packet_bytes with"),
    ],
)
def test_what_makes_no_sense_is_refused(given: dict[str, Any], told: str) -> None:
    with pytest.raises(ValidationError, match=told):
        CameraSettings.model_validate({"serial": "1", **given})
