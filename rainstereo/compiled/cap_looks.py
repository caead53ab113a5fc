"""What whole patches of the scene show: means over looks at boxes of the image (`boxes`).

A patch is sampled on a grid of looks, more along its longer side, each a mean of the four boxes of its part's size that
are nearest, weighted by how near.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .cap_rays import HALF, HIDDEN, ONE, RIVAL, SHOWN, ZERO
from .cap_tiles import (
    ABX,
    ABY,
    ACROSS,
    AX,
    AXX,
    AY,
    AYY,
    BX,
    BXX,
    BY,
    BYY,
    CX,
    CY,
    DOWN,
    GAINS,
    LITS,
    WHOLE,
)  # fmt: skip
from .compile import fused, fused_part

BIAS = np.float32(0.125)
"""Gray levels by which words are too large: halves are rounded up where an image is halved."""
MIRROR, EDGE, INSIDE = 0, 1, 2
"""How the scene goes on beyond its edges; or that nothing lies beyond them."""
EIGHTHS = 8  # to which the place between four boxes is told, along and down
FARTHEST = np.float32(1e6)  # pixels; what lies beyond is not told apart
MOST = 12
"""Looks along a small patch's side."""


@fused_part
def folded(at: Any, last: Any, border: Any) -> Any:
    """A coordinate brought between 0 and `last`, as `patch.folded_along` does."""
    if border == MIRROR:
        at = abs(at)
        at = at if at < FARTHEST else FARTHEST
        period = last + last if last > HALF else ONE
        at -= period * np.float32(np.int32(at / period))
        at = last - abs(last - at)
    at = at if at > ZERO else ZERO
    return at if at < last else last


@fused_part
def pixel_value(scene: Any, x: Any, y: Any, channel: Any) -> Any:
    """An image's value, bilinear, at a place inside it."""
    i, j = int(y), int(x)
    v, u = y - np.float32(i), x - np.float32(j)
    lower, right = min(i + 1, scene.shape[0] - 1), min(j + 1, scene.shape[1] - 1)
    top = np.float32(scene[i, j, channel]) * (ONE - u) + np.float32(scene[i, right, channel]) * u
    bottom = np.float32(scene[lower, j, channel]) * (ONE - u) + np.float32(scene[lower, right, channel]) * u
    return top * (ONE - v) + bottom * v


@fused_part
def place_on(rays: Any, j: Any, s: Any, t: Any) -> Any:
    """Where a place on a pixel, -1/2 to 1/2 each way, looks."""
    x = rays[CX + j] + s * (rays[AX + j] + HALF * s * rays[AXX + j] + t * rays[ABX + j])
    y = rays[CY + j] + s * (rays[AY + j] + HALF * s * rays[AYY + j] + t * rays[ABY + j])
    return x + t * (rays[BX + j] + HALF * t * rays[BXX + j]), y + t * (rays[BY + j] + HALF * t * rays[BYY + j])


@fused_part
def sides(rays: Any, j: Any) -> Any:
    """Looks along a patch of a few pixels, across and down: some two pixels apart."""
    ax, ay, bx, by = rays[AX + j], rays[AY + j], rays[BX + j], rays[BY + j]
    across = min(max(int(HALF * min(np.float32(math.sqrt(ax * ax + ay * ay)), np.float32(64))) + 1, 2), MOST)
    down = min(max(int(HALF * min(np.float32(math.sqrt(bx * bx + by * by)), np.float32(64))) + 1, 2), MOST)
    return across, down


@fused_part
def look_at(rays: Any, j: Any, a: Any, b: Any, across: Any, down: Any, last: Any, border: Any) -> Any:
    """Where look a, b of those along a patch of a few pixels falls in the image."""
    s, t = (np.float32(a) + HALF) / np.float32(across) - HALF, (np.float32(b) + HALF) / np.float32(down) - HALF
    x, y = place_on(rays, j, s, t)
    return folded(x, last[0], border), folded(y, last[1], border)


@fused
def patch_of_pixels(scene: Any, last: Any, border: Any, rays: Any, j: Any, total: Any) -> None:
    """The mean of a patch of a few pixels, from the image itself; added to `total`, (C,)."""
    across, down = sides(rays, j)
    part = ONE / np.float32(across * down)
    for b in range(down):
        for a in range(across):
            x, y = look_at(rays, j, a, b, across, down, last, border)
            for channel in range(scene.shape[2]):
                total[channel] += part * pixel_value(scene, x, y, channel)


@fused_part
def look_at_box(
    start: Any, pitch: Any, inverse: Any, last: Any, border: Any, rays: Any, j: Any, a: Any, b: Any
) -> Any:  # fmt: skip
    """The number of the upper left of the four boxes that look a, b of a patch falls between, and how far it lies from
    that, parts of their distance along and down, in eighths.

    start, pitch, inverse: of the boxes' size. border: `INSIDE`, if all looks of the patch are.
    """
    one = inverse * np.float32(EIGHTHS)
    s = (np.float32(a) + HALF) / rays[ACROSS + j] - HALF
    t = (np.float32(b) + HALF) / rays[DOWN + j] - HALF
    x, y = place_on(rays, j, s, t)
    if border != INSIDE:
        x, y = folded(x, last[0], border), folded(y, last[1], border)
    middle = HALF * one + HALF
    column, row = np.int64(x * one + middle), np.int64(y * one + middle)
    u, v = np.float32(column % EIGHTHS) / np.float32(EIGHTHS), np.float32(row % EIGHTHS) / np.float32(EIGHTHS)
    return start + row // EIGHTHS * pitch + column // EIGHTHS, u, v


@fused_part
def is_whole(rays: Any, j: Any) -> Any:
    """Whether a pixel is shown as a patch."""
    return rays[HIDDEN + j] > ZERO and rays[LITS + j] == WHOLE and not rays[RIVAL + j] > ZERO


@fused
def show_alone(scene: Any, last: Any, border: Any, rays: Any, j: Any, total: Any) -> None:
    """What a pixel that looks at the image itself shows, lane j, to `SHOWN`."""
    total[:] = ZERO
    patch_of_pixels(scene, last, border, rays, j, total)
    gain = rays[GAINS + j] * rays[HIDDEN + j]
    for channel in range(np.uint64(3)):
        rays[SHOWN + j + j + j + channel] = gain * total[channel]
