"""Key frames: as many as the scene moved, none while it stood still.

Between one dry image and the next the scene moves by the upper quartile of the dense optical flow (DIS: T. Kroeger et
al., "Fast optical flow using dense inverse search", ECCV 2016) on small copies, so that neither sky without texture nor
one passing car decides. A key frame is due each time that the sum reaches a threshold.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from rainstereo.types import Array, Image, Mask

SMALL = (160, 120)
"""Width and height of the copies that flow is measured on."""
QUARTILE = 0.75


def small_copy(gray: Image) -> Image:
    """(120, 160) uint8 of a gray image of 8 bits; the shape is not kept, since only shares of the width matter."""
    return cv2.resize(gray, SMALL, interpolation=cv2.INTER_AREA)


def movement(before: Image, after: Image) -> float:
    """How far the scene moved between two small copies, as a share of the image's width."""
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    dis.setFinestScale(1)
    flow = dis.calc(before, after, np.zeros((*before.shape, 2), np.float32))
    return float(np.quantile(np.hypot(flow[..., 0], flow[..., 1])[::2, ::2], QUARTILE)) / SMALL[0]


@dataclass(frozen=True, eq=False)
class Keyframes:
    """Of each frame of one drive, (N,): whether it is a key frame; whether the scene stands still there."""

    key: Mask
    still: Mask


def keyframes(moved: Array, step: float, least: float) -> Keyframes:
    """Key frames of one drive, in order of time.

    moved: (N,) movement from the frame before, share of the width; NaN where it is unknown, as for the first frame.
    step: sum of movement between key frames. least: movement of a frame below which the scene stands still; such
    frames are never key frames, but for the first of all, and add nothing.
    """
    if step < 0 or least < 0:
        raise ValueError(f"a step of {step} and a least movement of {least} were given; expected 0 or more")
    moved = np.asarray(moved, dtype=np.float64)
    still = moved < least  # NaN is not
    key = np.zeros(len(moved), np.bool_)
    total = np.inf
    for i, share in enumerate(moved):
        if np.isnan(share):
            total = np.inf
        elif not still[i]:
            total += share
        if total >= step and not still[i]:
            key[i], total = True, 0.0
    return Keyframes(key, still & ~key)
