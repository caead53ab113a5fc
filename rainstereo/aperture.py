"""Drops out of focus by brute force: every point of the aperture has rays of its own. The reference for `defocus`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .camera import Camera
from .chamber import Chamber
from .droplet import Drop
from .layer import Layer
from .patch import Patch, sample_pixels
from .thin_lens import ThinLens
from .trace import clear_transmittance, trace_rays
from .types import Image


def aperture(
    drops: Drop | Sequence[Drop],
    camera: Camera,
    chamber: Chamber,
    lens: ThinLens,
    depth: float,
    image: Image,
    samples: int = 1024,
    *,
    window: tuple[slice, slice],
    density: float = 1.0,
    border: str = "mirror",
) -> Layer:
    """What a lens shows of a clear image through drops: the mean over `samples` points of its aperture.

    The rays of a pixel through each point are traced exactly (`trace_rays`); those that pass beside the drops count as
    clear, so that the layer's opacity is the share of the aperture that drops cover. The image shows the scene in
    focus.

    window: rows and columns; widen the drops' own by half of `ThinLens.blur`. The time is that of tracing the window
    `samples` times. The error of N points falls roughly as 1/N for edges, which Vogel's points fill evenly.
    """
    everyone = [drops] if isinstance(drops, Drop) else list(drops)
    rows, columns = window
    pixels = sample_pixels(rows, columns, density)
    clear = clear_transmittance(pixels, camera, chamber)
    points = lens.points(samples)
    colour = opacity = np.zeros(1, dtype=np.float32)
    for point in points:
        origins, directions = lens.rays(pixels, camera, point[None])
        traced = trace_rays(origins[0], directions[0], everyone, camera, chamber, depth)
        layer = Patch.of_trace(traced, rows, columns, density, clear).layer(image, border)
        colour, opacity = colour + layer.colour, opacity + layer.opacity
    return Layer(rows, columns, colour / np.float32(samples), opacity / np.float32(samples))
