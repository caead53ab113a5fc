"""What turns a raw pair into an aligned one: two warps, a photometric map perhaps, a validity mask perhaps."""

from __future__ import annotations

from dataclasses import dataclass

from .occlusion import Occlusion
from .photometric import Photometric
from .types import Image
from .warp import Warp


@dataclass(frozen=True, eq=False)
class Recipe:
    """Raw pair in, aligned pair out; each image is interpolated once.

    calibrated: whether sizes are those of a calibration. photometric: what takes the wet image's gray levels to the
    dry one's. occlusion: how to find what only one camera sees; None: no validity mask.
    """

    dry: Warp
    wet: Warp
    interpolation: str = "linear"
    photometric: Photometric | None = None
    occlusion: Occlusion | None = None
    calibrated: bool = True

    def make(self, dry: Image, wet: Image) -> dict[str, Image]:
        """Aligned images by the folder that they belong in: dry, wet, and valid where it is asked for."""
        made = {
            "dry": self.dry.apply(dry, interpolation=self.interpolation),
            "wet": self.wet.apply(wet, interpolation=self.interpolation),
        }
        if self.photometric is not None:
            made["wet"] = self.photometric.apply(made["wet"])
        if self.occlusion is not None:
            made["valid"] = self.occlusion.mask(made["dry"], made["wet"], self.dry.valid & self.wet.valid)
        return made

    def size_words(self, size: tuple[int, int]) -> str:
        """Why an image of another size is refused."""
        known = "the rig was calibrated at" if self.calibrated else "the alignment was estimated at"
        return f"{known} {size[0]} x {size[1]}"
