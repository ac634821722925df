"""Address and settings of one camera."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, field_validator, model_validator

from lightpage.device.profile import StrictTable
from lightpage.errors import InvalidInputError
from lightpage.runtime.device.cameras.pixel_formats import pixel_format


class CameraSettings(StrictTable):
    """Address of one camera, and every setting that a frame depends on.

    Attributes:
        driver: ``aravis``, for GigE Vision and USB3 Vision; ``gentl``, for whatever the camera's maker has a GenTL
            producer for.
        producer: file of that producer, ``*.cti``.
        serial: number of the camera; either this or `address`.
        address: IP address or host name of a GigE camera; of ``aravis`` only.
        pixel_format: as GenICam names it.
        exposure_us: exposure time in microseconds.
        gain_db: gain in dB, in the camera's own steps where it knows no dB; None leaves it as it is.
        black_level_counts: what the camera adds to every pixel; None leaves it as it is.
        offset_x_px: first column of the region that is read.
        offset_y_px: first row of it.
        trigger_source: where the trigger comes in, as the camera names it, e.g. ``Line0``; ``Software`` for a command.
        trigger_activation: which edge triggers, as the camera names it.
        packet_bytes: size of a GigE packet, headers included; None for what camera and network agree on. A producer
            chooses by itself.
        buffers: frames that may wait in this machine.
    """

    driver: Literal["aravis", "gentl"] = "aravis"
    producer: str | None = Field(default=None, min_length=1)
    serial: str | None = Field(default=None, min_length=1)
    address: str | None = Field(default=None, min_length=1)
    pixel_format: str = "Mono8"
    exposure_us: float = Field(default=10_000.0, gt=0, allow_inf_nan=False)
    gain_db: float | None = Field(default=None, ge=0, allow_inf_nan=False)
    black_level_counts: int | None = Field(default=None, ge=0)
    offset_x_px: int = Field(default=0, ge=0)
    offset_y_px: int = Field(default=0, ge=0)
    trigger_source: str = Field(default="Line0", min_length=1)
    trigger_activation: str = Field(default="RisingEdge", min_length=1)
    packet_bytes: int | None = Field(default=None, ge=576, le=65_535)
    buffers: int = Field(default=8, ge=2, le=256)

    @field_validator("pixel_format")
    @classmethod
    def _known(cls, name: str) -> str:
        try:
            return pixel_format(name).name
        except InvalidInputError as error:
            raise ValueError(f"{error.got}, wanted {error.expected}") from None

    @model_validator(mode="after")
    def _one_camera(self) -> Self:
        if (self.serial is None) == (self.address is None):
            got = "neither serial nor address" if self.serial is None else "serial and address"
            raise ValueError(f"{got}, wanted one of them")
        return self

    @model_validator(mode="after")
    def _of_its_driver(self) -> Self:
        if self.driver == "aravis" and self.producer is not None:
            raise ValueError('producer with driver = "aravis", wanted driver = "gentl"')
        if self.driver == "gentl":
            if self.producer is None:
                raise ValueError('no producer, wanted one with driver = "gentl"')
            for setting in ("address", "packet_bytes"):
                if getattr(self, setting) is not None:
                    raise ValueError(f'{setting} with driver = "gentl", wanted driver = "aravis"')
        return self

    @property
    def label(self) -> str:
        """The camera as it was asked for, for people."""
        return self.serial or self.address or ""
