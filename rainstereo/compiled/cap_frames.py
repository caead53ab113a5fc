"""Frames with caps, every drop traced anew: drawn, or as tables of what each pixel looks at."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .cap_looks import rays_of_words, whole_of_words
from .cap_rays import BLUE, CAP_SQUARE, GREEN, HALF, HIDDEN, ONE, PLANES, RED, ROOM, ZERO, fit
from .cap_records import PIXELS, TAPS, record_rays, record_whole
from .cap_tiles import (
    AXX,
    AYY,
    BXX,
    BYY,
    CX,
    CY,
    FAR,
    LIT,
    LITS,
    OUT_RADIUS,
    OUT_RIVALS,
    TILE,
    TINY,
    bounds,
    hangs_over,
    move_up,
    next_span,
    own_rays,
    patches,
    row_of_tile,
    shares_of_row,
    taken,
    widest,
)  # fmt: skip
from .compile import compiled
from .layout import DRAW, FILL

WHITE = np.float32(255)


@compiled
def frame(
    mode: Any, out: Any, scene: Any, words: Any, boxes: Any, border: Any, shift: Any, looks: Any,
    side: Any, parts: Any, nodes: Any, caps: Any, outlines: Any, rivals: Any, later: Any, view: Any,
    record: Any,
) -> None:  # fmt: skip
    """Go over the pixels of caps, in the order of the caps.

    mode: DRAW: into `out`, (H, W, C) of up to three channels of bytes, which holds the clear image, from boxes of the
    scene in `words`. COUNT: how many pixels and taps there are, to record's counters. FILL: write them to record.
    scene: (h, w, C) bytes; only its size matters unless drawing. boxes: starts, widths, inverse distances (`boxes`).
    border, shift: how the scene goes on, and where the frame is in it. looks: grids, and how many looks each has.
    side, parts: rays of pixels at edges. nodes, caps, ...: see `cap_rays`, `cap_tiles`.
    record: pixels, caps' numbers, taps a pixel, clear shares, displacements, unknown; texels, weights; counters.
    """
    starts, pitches, inverses = boxes
    grids, counts = looks
    height, width = out.shape[0], out.shape[1]
    last = np.float32(scene.shape[1] - 1), np.float32(scene.shape[0] - 1)
    rays, line = np.zeros(PLANES * 64, dtype=np.float32), np.zeros(15, dtype=np.float32)
    tile, total, at = np.zeros((5, 3, 3), np.float32), np.zeros(4, np.float32), np.zeros(64, np.uint32)
    most, number_of_looks = len(counts) - 1, counts[0]
    for number in range(len(caps)):
        cap, outline = caps[number], outlines[number]
        if not outline[OUT_RADIUS] > 0:
            continue
        left, right, top, bottom = bounds(outline, width, height)
        for v1 in range(top, bottom, TILE):
            v2 = min(v1 + TILE, bottom)
            for u1 in range(left, right, TILE):
                lanes = min(TILE, right - u1)
                reach = (max(lanes, v2 - v1) + 1) // 2
                u0, v0 = fit(nodes, cap, u1 + lanes // 2, (v1 + v2) // 2, reach, tile)
                wide, radius = widest(tile), math.sqrt(cap[CAP_SQUARE])
                edge = 1.45 * radius * wide + wide * wide  # of room: a pixel's corner is 0.71 pixels from its middle
                hangs, tiny = hangs_over(tile, cap, wide, 1.5 * reach), radius < TINY * wide
                s, known = np.float32(u1) - u0, False
                following = next_span(tile, np.float32(v1) - v0, s, lanes, cap, edge, line, rays)
                for v in range(v1, v2):
                    low, high = following
                    t = np.float32(v) - v0
                    move_up(rays)
                    following = (0, 0)
                    if v + 1 < v2:
                        following = next_span(tile, t + ONE, s, lanes, cap, edge, line, rays)
                    if high <= low and not hangs:
                        known = False
                        continue
                    row_of_tile(tile, t, s, not known, (low, high), following, cap, later, view, line, rays)
                    known = low < high
                    patches(rays, low, high, number_of_looks, most, shift, last)
                    shares_of_row(tile, t, s, lanes, edge, wide, hangs, cap, line, rays)
                    if outline[OUT_RIVALS] > 0:
                        taken(tile, t, s, lanes, wide, caps, number, rivals, outline, line, rays)
                    if mode != DRAW:
                        record_row(
                            mode == FILL, v * width + u1, number, lanes, low, high, tiny, hangs, tile, t, s, edge, cap,
                            later, view, side, parts, (scene.shape[1], scene.shape[0]), starts, pitches, inverses,
                            border, shift, grids, counts, rays, at, total, len(words), width, record,
                        )  # fmt: skip
                        continue
                    nothing_shown(rays)
                    if not tiny:
                        whole_of_words(
                            words, scene, starts, pitches, inverses, last, border, grids, counts, low, high, rays,
                            total, at,
                        )  # fmt: skip
                    for lane in range(low, high):
                        j = np.uint64(lane)
                        if not rays[HIDDEN + j] > ZERO or not (tiny or ZERO < rays[LITS + j] < np.float32(LIT)):
                            continue
                        near = not rays[ROOM + j] > edge
                        share = own_rays(tile, t, s + np.float32(lane), near, cap, later, view, side, parts, rays)
                        rays[HIDDEN + j] = max(share, rays[HIDDEN + j]) if hangs and not tiny else share
                        total[0] = total[1] = total[2] = ZERO
                        rays_of_words(
                            words, scene, starts, pitches, inverses, last, shift, border, rays, side, parts, total
                        )
                        rays[RED + j], rays[GREEN + j], rays[BLUE + j] = total[0], total[1], total[2]
                    write_bytes(out, v, u1, lanes, rays)


@compiled
def record_row(
    filling: bool, first: Any, number: Any, lanes: Any, low: Any, high: Any, tiny: bool, hangs: bool, tile: Any,
    t: Any, s: Any, edge: Any, cap: Any, later: Any, view: Any, side: Any, parts: Any, size: Any,
    starts: Any, pitches: Any, inverses: Any, border: Any, shift: Any, grids: Any,
    counts: Any, rays: Any, at: Any, mean: Any, boxes: Any, width: Any, record: Any,
) -> None:  # fmt: skip
    """Count, or write down, a row's pixels. first: number of the pixel of lane 0. boxes: how many there are."""
    pixels, of_caps, taps, clear, moved, unknown, texels, weights, cursor = record
    for lane in range(lanes):
        j = np.uint64(lane)
        if not rays[HIDDEN + j] > ZERO:
            continue
        lit = rays[LITS + j] if low <= lane < high else ZERO
        before, off = cursor[TAPS], False
        mean[0] = mean[1] = np.float32(np.nan)
        if lit == np.float32(LIT) and not tiny:
            record_whole(
                starts, pitches, inverses, size, border, grids, counts, rays, lane, boxes, at, texels, weights, cursor,
                filling,
            )  # fmt: skip
            bend = np.float32(1 / 24)
            mean[0] = rays[CX + j] - shift[0] + (rays[AXX + j] + rays[BXX + j]) * bend
            mean[1] = rays[CY + j] - shift[1] + (rays[AYY + j] + rays[BYY + j]) * bend
            off = not rays[FAR + j] >= ZERO
        elif (lit > ZERO or tiny) and low <= lane < high:
            near = not rays[ROOM + j] > edge
            share = own_rays(tile, t, s + np.float32(lane), near, cap, later, view, side, parts, rays)
            rays[HIDDEN + j] = max(share, rays[HIDDEN + j]) if hangs and not tiny else share
            off = record_rays(
                starts, pitches, inverses, size, shift, border, rays, side, parts, boxes, texels, weights, cursor,
                filling, mean,
            )  # fmt: skip
        if not rays[HIDDEN + j] > ZERO:
            cursor[TAPS] = before
            continue
        if filling:
            row, pixel = cursor[PIXELS], first + lane
            pixels[row], of_caps[row], taps[row] = pixel, number, cursor[TAPS] - before
            clear[row], unknown[row] = max(ONE - rays[HIDDEN + j], ZERO), off
            moved[row, 0] = mean[0] - np.float32(pixel % width)
            moved[row, 1] = mean[1] - np.float32(pixel // width)
        cursor[PIXELS] += 1


@compiled
def nothing_shown(rays: Any) -> None:
    """Of a row, to begin with."""
    for j in range(np.uint64(3 * 64)):
        rays[RED + j] = ZERO


@compiled
def write_bytes(out: Any, v: Any, u: Any, lanes: Any, rays: Any) -> None:
    """Mix what a row shows with what is there, where a cap hides it."""
    channels = np.uint64(out.shape[2])
    row, plane = out[v].ravel(), np.uint64(64)
    for j in range(np.uint64(lanes)):
        hidden = rays[HIDDEN + j]
        if hidden > ZERO:
            at = (np.uint64(u) + j) * channels
            for channel in range(channels):
                value = rays[RED + plane * channel + j] + HALF
                if hidden < ONE:
                    value += (ONE - hidden) * np.float32(row[at + channel])
                row[at + channel] = np.uint8(np.int32(value if value < WHITE else WHITE))
