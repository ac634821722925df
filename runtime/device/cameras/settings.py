"""Address and settings of one camera."""

from typing import Literal, Self

from pydantic import Field, field_validator, model_validator

from lightpage.device.profile import StrictTable
from lightpage.errors import InvalidInputError
from lightpage.runtime.device.cameras.pixel_formats import pixel_format


class CameraSettings(StrictTable):
    """Identity of one camera, and every setting that a frame depends on."""

    driver: Literal["aravis", "gentl"] = "aravis"
    """`aravis`: GigE Vision and USB3 Vision. `gentl`: any camera with a GenTL producer."""
    producer: str | None = Field(default=None, min_length=1)
    """File of the GenTL producer, `*.cti`. Needed with `gentl`."""
    serial: str | None = Field(default=None, min_length=1)
    """The camera's number. Give either this or `address`."""
    address: str | None = Field(default=None, min_length=1)
    """IP address or host name of a GigE camera, with `aravis` only."""
    pixel_format: str = "Mono8"
    """A grey format, as GenICam names it, e.g. `Mono8`, `Mono12p`. The same for both cameras."""
    exposure_us: float = Field(default=10_000.0, gt=0, allow_inf_nan=False)
    """Exposure time, microseconds."""
    gain_db: float | None = Field(default=None, ge=0, allow_inf_nan=False)
    """Gain, dB, or the camera's own steps. Without it the gain stays as it is."""
    black_level_counts: int | None = Field(default=None, ge=0)
    """Counts that the camera adds to each pixel. Without it the level stays as it is."""
    offset_x_px: int = Field(default=0, ge=0)
    """First column of the region that is read."""
    offset_y_px: int = Field(default=0, ge=0)
    """First row of the region that is read."""
    trigger_source: str = Field(default="Line0", min_length=1)
    """Input of the trigger, as the camera names it. `Software` for a command."""
    trigger_activation: str = Field(default="RisingEdge", min_length=1)
    """Edge that triggers, as the camera names it."""
    packet_bytes: int | None = Field(default=None, ge=576, le=65_535)
    """Size of a GigE packet, headers included, with `aravis` only. Without it camera and network agree."""
    buffers: int = Field(default=8, ge=2, le=256)
    """Frames that may wait in this machine."""

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
