"""Settings of a camera say what is wrong with them."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from runtime.cameras.settings import CameraSettings


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({}, "neither serial nor"),
        ({"serial": "1", "address": "10.0.0.1"}, "serial and address"),
        ({"serial": "1", "exposure_us": "200"}, "exposure_us"),
        ({"serial": "1", "exposure_us": True}, "exposure_us"),
        ({"serial": 1}, "serial"),
        ({"serial": "1", "pixel_format": "RGB8"}, "RGB8"),
        ({"serial": "1", "exposure_us": 0}, "exposure_us"),
        ({"serial": "1", "exposure_us": float("inf")}, "exposure_us"),
        ({"serial": "1", "buffers": 1}, "buffers"),
        ({"serial": "1", "packet_bytes": 70_000}, "packet_bytes"),
        ({"serial": "1", "driver": "vendor"}, "aravis"),
        ({"serial": "1", "driver": "gentl"}, "no producer"),
        ({"serial": "1", "producer": "maker.cti"}, "producer with"),
        ({"address": "10.0.0.1", "driver": "gentl", "producer": "maker.cti"}, "address with"),
        ({"serial": "1", "packet_bytes": 1400, "driver": "gentl", "producer": "maker.cti"}, "packet_bytes with"),
        ({"serial": "1", "exposure_ms": 1}, "exposure_ms"),
    ],
)
def test_what_makes_no_sense_is_refused(given: dict[str, Any], told: str) -> None:
    with pytest.raises(ValidationError, match=told):
        CameraSettings.model_validate(given)


def test_settings_stay_as_they_are() -> None:
    settings = CameraSettings(serial="A1", pixel_format="Mono12p")
    assert settings.label == "A1"
    with pytest.raises(ValidationError, match="frozen"):
        settings.serial = "B"
