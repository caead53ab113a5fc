"""What a camera's numbers mean: GenICam's names of pixel formats, and a mosaic made into colours."""

from __future__ import annotations

import cv2
import numpy as np

from rainstereo.types import Image

MONO = ("Mono8", "Mono10", "Mono12", "Mono16")
BAYER = {
    "BayerRG": cv2.COLOR_BayerRGGB2BGR,
    "BayerGR": cv2.COLOR_BayerGRBG2BGR,
    "BayerBG": cv2.COLOR_BayerBGGR2BGR,
    "BayerGB": cv2.COLOR_BayerGBRG2BGR,
}
"""Mosaics by the colours of their first two pixels (the rows below have the others)."""
COLOUR = ("BGR8", "BGR16")
PIXEL_FORMATS = (*MONO, *(f"{mosaic}{bits}" for mosaic in BAYER for bits in (8, 10, 12, 16)), *COLOUR)
"""Formats of frames. 10 and 12 bits lie in the low bits of 16, as cameras send them unpacked."""


def is_bayer(pixel_format: str) -> bool:
    """Whether the format is a mosaic."""
    return pixel_format[:7] in BAYER


def check_format(image: Image, pixel_format: str) -> None:
    """ValueError unless an image can be of that format."""
    if pixel_format not in PIXEL_FORMATS:
        raise ValueError(f"the pixel format {pixel_format!r} is unknown; expected one of {', '.join(PIXEL_FORMATS)}")
    dtype = np.uint8 if pixel_format.endswith("8") else np.uint16
    planes = 3 if pixel_format in COLOUR else 2
    shaped = image.ndim == planes and (planes == 2 or image.shape[2] == 3)
    if image.dtype != dtype or not shaped or 0 in image.shape:
        wanted = "(height, width, 3)" if planes == 3 else "(height, width)"
        raise ValueError(f"a {pixel_format} frame is {image.dtype} {image.shape}; expected {np.dtype(dtype)} {wanted}")


def demosaic(image: Image, pixel_format: str) -> Image:
    """The frame as (height, width) gray or (height, width, 3) BGR, uint8 or uint16.

    A mosaic is interpolated bilinearly; what is no mosaic comes back as it is. 10 and 12 bits stay in the low bits.
    """
    check_format(image, pixel_format)
    if not is_bayer(pixel_format):
        return image
    if min(image.shape) < 3:
        raise ValueError(f"a mosaic of {image.shape} pixels has no colours to interpolate; expected 3 x 3 or more")
    return np.asarray(cv2.cvtColor(image, BAYER[pixel_format[:7]]))


def mosaic(image: Image, pixel_format: str) -> Image:
    """What a sensor behind such a mosaic sees of a BGR image: one colour a pixel, (height, width)."""
    if not is_bayer(pixel_format):
        raise ValueError(f"{pixel_format!r} is no mosaic; expected one of {', '.join(BAYER)} with 8, 10, 12 or 16")
    first = pixel_format[5:7]
    rows = {"RG": ("RG", "GB"), "GR": ("GR", "BG"), "BG": ("BG", "GR"), "GB": ("GB", "RG")}[first]
    out: Image = np.empty(image.shape[:2], image.dtype)
    for y, row in enumerate(rows):
        for x, colour in enumerate(row):
            out[y::2, x::2] = image[y::2, x::2, "BGR".index(colour)]
    return out
