"""What a camera does to light before it is a file: optical blur, vignetting, noise, eight bits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .types import Array, Image


@dataclass(frozen=True)
class Sensor:
    """An 8-bit sensor behind a lens. Gray levels are proportional to the light.

    blur: standard deviation of the lens's point-spread function, a Gaussian, in pixels; pixels then add up the light
    on their square.
    vignetting: exponent of the cosine of the angle off the axis by which the image darkens (0 none, 4 the
    cosine-fourth law of a thin lens).
    noise: standard deviation of the noise, gray levels, the same at every pixel.
    """

    blur: float = 0.5
    vignetting: float = 2.0
    noise: float = 1.0

    def __post_init__(self) -> None:
        for name, high in (("blur", 20.0), ("vignetting", 20.0), ("noise", 100.0)):
            value = getattr(self, name)
            if not 0 <= value <= high:
                raise ValueError(f"a sensor's {name} of {value} was given; expected 0 to {high:g}")

    def expose(self, image: Array, cosine: Array, rng: np.random.Generator) -> Image:
        """The file's gray levels, uint8, of an image that has been blurred and added up over pixels already.

        image: (H, W) or (H, W, channels) gray levels, 255 = full well. cosine: (H, W) of the angle between each
        pixel's ray and the axis.
        """
        light = np.array(image, dtype=np.float32)
        if self.vignetting:
            gain = np.nan_to_num(cosine).astype(np.float32) ** np.float32(self.vignetting)
            light *= gain if light.ndim == 2 else gain[..., None]
        if self.noise:
            light += np.float32(self.noise) * rng.standard_normal(light.shape, dtype=np.float32)
        return np.clip(np.rint(light), 0, 255).astype(np.uint8)
