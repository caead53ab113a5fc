"""A moment as both cameras saw it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property

from rainstereo.rig import Role
from rainstereo.types import Image

from .pixel_format import demosaic


class PairStatus(StrEnum):
    """How sure it is that both frames show the same moment."""

    OK = "ok"
    """The ids are equal, and so are the intervals since the pair before, on both cameras' clocks."""
    UNCHECKED = "unchecked"
    """The ids are equal; there are no device timestamps to check them by."""


@dataclass(frozen=True, eq=False)
class CameraFrame:
    """One camera's frame as it came: image (raw, a mosaic stays one), the camera's own number of it, its time on the
    camera's clock and the host's time when it was there (nanoseconds; None if unknown)."""

    image: Image
    id: int
    device_ts_ns: int | None = None
    host_ts_ns: int | None = None
    pixel_format: str = "BGR8"


@dataclass(frozen=True, eq=False)
class PairFrame:
    """Both cameras' frames of one trigger.

    id: number of the trigger, which goes on where the cameras' counters wrap or start again. sync_us: how much later
    the wet camera exposed, as far as their clocks tell; NaN if they do not. regime: what the pump did, "" if unknown.
    """

    id: int
    dry_frame: CameraFrame
    wet_frame: CameraFrame
    status: PairStatus = PairStatus.UNCHECKED
    sync_us: float = math.nan
    regime: str = ""

    @cached_property
    def dry(self) -> Image:
        """The dry camera's image, gray or BGR."""
        return demosaic(self.dry_frame.image, self.dry_frame.pixel_format)

    @cached_property
    def wet(self) -> Image:
        """The wet camera's image, gray or BGR."""
        return demosaic(self.wet_frame.image, self.wet_frame.pixel_format)

    @property
    def device_ts_ns(self) -> int | None:
        """The dry camera's clock at the exposure."""
        return self.dry_frame.device_ts_ns

    @property
    def host_ts_ns(self) -> int | None:
        """The host's clock when the dry camera's frame was there."""
        return self.dry_frame.host_ts_ns

    def frame(self, role: Role) -> CameraFrame:
        """That camera's frame."""
        return self.dry_frame if role == "dry" else self.wet_frame
