"""Pixels inside a cap that only some light reaches, or whose patch is bent too much: rays of their own, of eight pixels
side by side (`cap_beams`). What they stand for, and what they look at, is as in `cap_edges`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .cap_beams import BEAMS, HALVES, NOTED, TOGETHER, summed, traced
from .cap_bytes import WHITE
from .cap_edges import NO_SIZE, RAYS, REST, SIZE_SHIFT, box_of, boxes_of_rays
from .cap_rays import (
    CAP_CURVATURE,
    CAP_DEPTH,
    CAP_INDEX,
    CAP_SQUARE,
    GAIN,
    HALF,
    HIDDEN,
    ONE,
    PER,
    PLANES,
    SHARE,
    STRETCH,
    SUB,
    WEIGHT,
    Y_,
    ZERO,
    onward,
)
from .cap_tiles import OUT_X, OUT_Y
from .cap_vectors import EIGHT, WIDE, lowest
from .compile import fused, fused_part
from .prefetch import to_read

PLACE, PLACE_DOWN, SHARE_HIDDEN, HANGS, UNIT = (NOTED * k for k in range(5))
"""Planes of what is noted: see `cap_beams.traced`."""


@fused_part
def _note(noted: Any, k: Any, s: Any, t: Any, hidden: Any, hangs: bool) -> None:
    noted[k], noted[k + PLACE_DOWN], noted[k + SHARE_HIDDEN] = s, t, hidden
    noted[k + HANGS] = ONE if hangs else ZERO


@fused_part
def _copy(noted: Any, k: Any, to: Any) -> None:
    for plane in range(PLACE, UNIT, NOTED):
        noted[to + plane] = noted[k + plane]


@fused_part
def note_light(
    left: Any, s: Any, t: Any, first: Any, channels: Any, hangs: bool, rays: Any, light: Any, count: Any
) -> Any:  # fmt: skip
    """Note pixels of a row, after `count` others on its tile, and take them out of `HIDDEN`. Returns how many there
    are.

    left: which, as bits. s, t: pixels from the tile's own to lane 0. first: number of its pixel.
    """
    noted, pixels = light[1], light[2]
    while left:
        j = lowest(left)
        left &= left - np.uint64(1)
        lane = np.int64(j)
        _note(noted, count, s + np.float32(lane), t, rays[HIDDEN + j], hangs)
        rays[HIDDEN + j] = ZERO
        pixels[count] = (first + lane) * channels
        count += 1
    return count


@fused
def trace_light(
    cap: Any, outline: Any, tile: Any, u0: Any, v0: Any, later: Any, view: Any, noted: Any, first: Any, beams: Any
) -> None:  # fmt: skip
    """The rays of eight of the pixels that have been noted, from `first` on, to the planes `SUB`, and to `WEIGHT` what
    each has of its pixel's light.

    u0, v0: the tile's own pixel. beams: `HALVES` times all planes; a ray's lanes are the pixels.
    """
    square, depth = np.float32(cap[CAP_SQUARE]), np.float32(cap[CAP_DEPTH])
    curvature, q = np.float32(cap[CAP_CURVATURE]), np.float32(cap[CAP_INDEX]) * np.float32(cap[CAP_INDEX])
    u, v = np.float32(outline[OUT_X]) - u0, np.float32(outline[OUT_Y]) - v0
    traced(beams, noted, np.uint64(first), tile, square, depth, curvature, q, u, v)
    for half in range(HALVES):
        rays = beams[half * PLANES * 64 : (half + 1) * PLANES * 64]
        onward(cap, later, view, rays, np.uint64(0), np.uint64(64), SUB)
        for j in range(np.uint64(64)):
            rays[WEIGHT + j] = rays[SUB + GAIN + j] * rays[SHARE + j]


@fused
def one_light(
    s: Any, t: Any, hidden: Any, hangs: bool, cap: Any, outline: Any, tile: Any, u0: Any, v0: Any, later: Any,
    view: Any, rays: Any, light: Any,
) -> None:  # fmt: skip
    """The rays of one such pixel, lanes from 0 on, as `trace_own` leaves them; hidden: the share that its cap hides."""
    beams, noted = light[0], light[1]
    for k in range(WIDE):
        _note(noted, k, s, t, hidden, hangs)
    trace_light(cap, outline, tile, u0, v0, later, view, noted, 0, beams)
    for k in range(np.uint64(RAYS)):
        j = k // EIGHT * BEAMS + k % EIGHT * EIGHT
        rays[SUB + k], rays[SUB + Y_ + k] = beams[SUB + j], beams[SUB + Y_ + j]
        rays[PER + k], rays[STRETCH + k] = beams[PER + j], beams[STRETCH + j]
        rays[WEIGHT + k] = beams[WEIGHT + j] * noted[UNIT]


@fused_part
def keep_to_boxes(at: Any, lanes: Any) -> None:
    """Let rays look at the smallest box there is where it would be the image itself; at: see `boxes_of_rays`."""
    for j in range(np.uint64(lanes)):
        at[j] = at[j] & REST if at[j] >> SIZE_SHIFT == NO_SIZE else at[j]


@fused_part
def call_light(
    words: Any, starts: Any, last: Any, shift: Any, border: Any, outline: Any, beams: Any, light: Any, to: Any
) -> None:  # fmt: skip
    """Find the boxes that rays which have been traced look at, and call for them; numbers and weights from `to` on."""
    at, weights, boxes = light[3], light[4], light[6]
    for half in range(HALVES):
        rays = beams[half * PLANES * 64 : (half + 1) * PLANES * 64]
        boxes_of_rays(outline, last, shift, border, len(starts), rays, 64, boxes)
        keep_to_boxes(boxes, 64)
        for j in range(np.uint64(64)):
            weights[to + j] = rays[WEIGHT + j]
        for j in range(np.uint64(64)):
            number = box_of(boxes[j], starts)
            to_read(words, number)
            at[to + j] = np.uint32(number)
        to += np.uint64(64)


@fused
def draw_light(
    count: Any, words: Any, starts: Any, last: Any, shift: Any, border: Any, cap: Any, outline: Any, tile: Any,
    u0: Any, v0: Any, later: Any, view: Any, channels: Any, light: Any, out: Any,
) -> Any:  # fmt: skip
    """Draw pixels that have been noted, all on one tile: `count`, or, if they are many, whole vectors of them. Returns
    how many are left, and noted anew."""
    beams, noted, pixels, at, weights, shown, _ = light
    left = count % WIDE if count >= TOGETHER else 0
    stop, nothing = np.uint64(count - left), np.uint64(0)
    for k in range(count, (count + WIDE - 1) // WIDE * WIDE):  # a vector is filled up with what is there
        _copy(noted, count - 1, k)
    for begin in range(nothing, stop, np.uint64(TOGETHER)):
        end = min(begin + np.uint64(TOGETHER), stop)
        for first in range(begin, end, EIGHT):
            trace_light(cap, outline, tile, u0, v0, later, view, noted, first, beams)
            call_light(words, starts, last, shift, border, outline, beams, light, (first - begin) * np.uint64(RAYS))
        for first in range(begin, end, EIGHT):
            summed(words, at, weights, (first - begin) * np.uint64(RAYS), shown)
            for k in range(first, min(first + EIGHT, end)):
                clear, unit = ONE - noted[k + np.uint64(SHARE_HIDDEN)], noted[k + np.uint64(UNIT)]
                for channel in range(np.uint64(channels)):
                    number = np.uint64(pixels[k]) + channel
                    value = shown[EIGHT * channel + k - first] * unit + clear * np.float32(out[number]) + HALF
                    out[number] = np.uint8(np.int32(value if value < WHITE else WHITE))
    for k in range(left):
        pixels[k] = pixels[stop + np.uint64(k)]
        _copy(noted, np.int64(stop) + k, k)
    return left


def room_for_light() -> tuple[Any, ...]:
    """Beams, what is noted, addresses, numbers of boxes, weights, what is shown, and numbers of boxes of 64 rays."""
    return (
        np.zeros(int(BEAMS) * HALVES, np.float32), np.zeros(5 * NOTED, np.float32), np.zeros(NOTED, np.int64),
        np.zeros(TOGETHER * RAYS, np.uint32), np.zeros(TOGETHER * RAYS, np.float32), np.zeros(3 * WIDE, np.float32),
        np.zeros(64, np.uint32),
    )  # fmt: skip
