"""Frames with caps, every drop traced anew: drawn, or as tables of what each pixel looks at."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .cap_beams import TOGETHER as TOGETHER_LIGHT
from .cap_bytes import call_for, write_bytes
from .cap_edges import (
    RAYS,
    TOGETHER,
    boxes_of_rays,
    draw_own,
    form_of,
    has_own,
    own_of_row,
    set_out,
    share_out,
    slopes_of_row,
    trace_own,
)
from .cap_lanes import POLYNOMIALS
from .cap_light import draw_light, keep_to_boxes, note_light, one_light, room_for_light
from .cap_looks import is_whole, show_alone
from .cap_patches import PLACES, show_whole
from .cap_rays import CAP_SQUARE, HALF, HIDDEN, ONE, PLANES, RIVAL, ROOM, SHOWN, ZERO, fit
from .cap_records import PIXELS, TAPS, add_places, record_rays, record_whole
from .cap_shares import shares_of_row, taken
from .cap_tiles import (
    AXX,
    AYY,
    BXX,
    BYY,
    CX,
    CY,
    FAR,
    LITS,
    OUT_RADIUS,
    PARTLY,
    SIZE,
    TILE,
    TINY,
    bounds,
    hangs_over,
    move_up,
    next_span,
    patches,
    row_of_tile,
    widest,
)  # fmt: skip
from .cap_vectors import above, above_zero, lanes_from, lowest
from .compile import fused
from .layout import DRAW, FILL

NONE, ONE_LANE = np.uint64(0), np.uint64(1)


@fused
def frame(
    mode: Any, out: Any, size: Any, scene: Any, words: Any, boxes: Any, border: Any, shift: Any, bands: Any,
    nodes: Any, caps: Any, outlines: Any, span: Any, rivals: Any, rival_starts: Any, later: Any, view: Any,
    record: Any, desk: Any,
) -> None:  # fmt: skip
    """Go over the pixels of some caps, in the order of the caps.

    mode: DRAW: into `out`, (H W C,) of up to three channels of bytes, which holds the clear image, from boxes of the
    scene in `words`. COUNT: how many pixels and taps there are, to record's counters. FILL: write them to record, taps
    only if it has room for any.
    scene: (h, w, C) bytes; only its size matters unless drawing. boxes: starts, widths, inverse distances (`boxes`).
    border, shift: how the scene goes on, and where the frame is in it. bands: of patches' areas (`cap_tiles`).
    nodes, caps, ...: see `cap_rays`, `cap_tiles`. span: first number of those to go over, and that after the last.
    rivals, rival_starts: the numbers of all caps that meet those, and where each cap's start, see `cap_rivals`.
    record: pixels, caps' numbers, taps a pixel, clear shares, displacements, unknown; texels, weights; counters.
    """
    starts, pitches, inverses = boxes
    width, height = size
    last = np.float32(scene.shape[1] - 1), np.float32(scene.shape[0] - 1)
    rays, line, tile, slopes, total, at, beams, pixels, hidden, places, parts, light = desk
    for number in range(span[0], span[1]):
        cap, outline = caps[number], outlines[number]
        if not outline[OUT_RADIUS] > 0:
            continue
        left, right, top, bottom = bounds(outline, width, height)
        some_rivals, made = (rival_starts[number - span[0]], rival_starts[number - span[0] + 1]), 0
        for v1 in range(top, bottom, TILE):
            v2 = min(v1 + TILE, bottom)
            for u1 in range(left, right, TILE):
                lanes = min(TILE, right - u1)
                reach = (max(lanes, v2 - v1) + 1) // 2
                u0, v0 = fit(nodes, cap, u1 + lanes // 2, (v1 + v2) // 2, reach, tile)
                wide, radius = widest(tile), math.sqrt(cap[CAP_SQUARE])
                edge = np.float32(
                    1.45 * radius * wide + wide * wide
                )  # of room: a pixel's corner is 0.71 pixels from its middle
                hangs, tiny = hangs_over(tile, cap, wide, 1.5 * reach), radius < TINY * wide
                s, known, waiting = np.float32(u1) - u0, False, 0
                following = next_span(tile, np.float32(v1) - v0, s, lanes, cap, edge, line, rays)
                for v in range(v1, v2):
                    low, high = following
                    call_for(out, width, scene.shape[2], v + 2, v2, u1, lanes)
                    t = np.float32(v) - v0
                    move_up(rays)
                    following = (0, 0)
                    if v + 1 < v2:
                        following = next_span(tile, t + ONE, s, lanes, cap, edge, line, rays)
                    if high <= low and not hangs:
                        known = False
                        continue
                    begin, end = row_of_tile(
                        tile, t, s, not known, (low, high), following, cap, later, view, line, rays
                    )  # fmt: skip
                    known = low < high
                    patches(rays, begin, end, bands, len(starts), shift, last)
                    shares_of_row(tile, t, s, lanes, low, high, edge, wide, hangs, cap, line, rays)
                    if some_rivals[0] < some_rivals[1]:
                        taken(tile, t, s, u1, v, lanes, wide, caps, number, rivals, some_rivals, outlines, line, rays)
                    share_out(rays, begin, end)
                    if mode != DRAW:
                        slopes_of_row(tile, t, slopes)
                        record_row(
                            mode == FILL, u1, v, number, lanes, low, high, begin, end, tiny, hangs, s, t, u0, v0,
                            tile, edge, caps, outlines, later, view, line, slopes, (scene.shape[1], scene.shape[0]),
                            starts, pitches, inverses, border, shift, rays, at, light, total, len(words), width, record,
                        )  # fmt: skip
                        continue
                    for j in range(np.uint64(3 * 64)):
                        rays[SHOWN + j] = ZERO
                    hidden_by = above_zero(rays, HIDDEN)
                    shared = hidden_by if tiny else hidden_by & above_zero(rays, RIVAL)
                    lone, whole = hidden_by & ~shared, above(rays, LITS, PARTLY)
                    every = lanes_from(lone & whole, begin, end)
                    alone = every & ~above(rays, SIZE, -HALF)
                    every &= ~alone
                    waiting = note_light(
                        lanes_from(lone & ~whole & above_zero(rays, LITS), low, high), s, t, v * width + u1,
                        scene.shape[2], hangs, rays, light, waiting,
                    )  # fmt: skip
                    if waiting >= TOGETHER_LIGHT:
                        waiting = draw_light(
                            waiting, words, starts, last, shift, border, cap, outline, tile, u0, v0, later, view,
                            scene.shape[2], light, out,
                        )  # fmt: skip
                    shared = lanes_from(shared, low, high)
                    if shared:
                        slopes_of_row(tile, t, slopes)
                        made = own_of_row(
                            words, scene, starts, last, shift, border, s, u1, v, edge, hangs, tiny, caps, number,
                            outlines, later, view, shared, line, slopes, rays, beams, made, at, pixels, hidden, total,
                            width, out,
                        )  # fmt: skip
                    if every:
                        show_whole(every, words, starts, last, border, rays, places, parts)
                    while alone:
                        show_alone(scene, last, border, rays, lowest(alone), total)
                        alone &= alone - ONE_LANE
                    some = (0, lanes) if hangs else (low // 8 * 8, high)  # nothing is hidden beyond
                    write_bytes(out, width, scene.shape[2], v, u1, some, rays)
                if waiting > 0:
                    draw_light(
                        waiting, words, starts, last, shift, border, cap, outline, tile, u0, v0, later, view,
                        scene.shape[2], light, out,
                    )  # fmt: skip
        if made > 0:
            draw_own(
                words, scene, starts, last, shift, border, cap, outline, later, view, beams, at, pixels[:made],
                hidden[:made], total, out,
            )  # fmt: skip


@fused
def record_row(
    filling: bool, u: Any, v: Any, number: Any, lanes: Any, low: Any, high: Any, begin: Any, end: Any, tiny: bool,
    hangs: bool, s: Any, t: Any, u0: Any, v0: Any, tile: Any, edge: Any, caps: Any, outlines: Any, later: Any,
    view: Any, line: Any, slopes: Any, size: Any, starts: Any, pitches: Any, inverses: Any, border: Any,
    shift: Any, rays: Any, at: Any, light: Any, mean: Any, boxes: Any, width: Any, record: Any,
) -> None:  # fmt: skip
    """Count, or write down, a row's pixels. u, v: column of lane 0, and row. boxes: how many there are."""
    pixels, of_caps, taps, clear, moved, unknown, texels, weights, cursor = record
    last = np.float32(size[0] - 1), np.float32(size[1] - 1)
    for lane in range(lanes):
        j = np.uint64(lane)
        if not rays[HIDDEN + j] > ZERO:
            continue
        before, off = cursor[TAPS], False
        mean[:] = ZERO
        if begin <= lane < end and is_whole(rays, j) and not tiny:
            record_whole(
                starts, pitches, inverses, size, border, rays, lane, boxes, texels, weights, cursor,
            )  # fmt: skip
            bend = np.float32(1 / 24)
            mean[0] = rays[CX + j] - shift[0] + (rays[AXX + j] + rays[BXX + j]) * bend
            mean[1] = rays[CY + j] - shift[1] + (rays[AYY + j] + rays[BYY + j]) * bend
            mean[2] = ONE
            off = not rays[FAR + j] >= ZERO
        elif low <= lane < high and rays[LITS + j] == ONE and not rays[RIVAL + j] > ZERO and not tiny:
            one_light(
                s + np.float32(lane), t, rays[HIDDEN + j], hangs, caps[number], outlines[number], tile, u0, v0, later,
                view, rays, light,
            )  # fmt: skip
            off = add_places(rays, shift, last, mean)
            boxes_of_rays(outlines[number], last, shift, border, len(starts), rays, RAYS, at)
            keep_to_boxes(at, RAYS)
            record_rays(starts, size, rays, at, boxes, texels, weights, cursor)
        elif low <= lane < high and has_own(rays, lane, tiny):
            rival, hidden = np.int64(rays[RIVAL + j]) - 1, ZERO
            near = bool(rival >= 0 or not rays[ROOM + j] > edge)
            form = form_of(u + lane, v, outlines[number], tiny, rival)
            for which in (number, rival):
                if which >= 0:
                    hidden += set_out(
                        s + np.float32(lane), u + lane, v, near, form, which, caps, number, rival, outlines, line,
                        slopes, rays, np.uint64(0),
                    )  # fmt: skip
                    trace_own(caps[which], later, view, rays, RAYS)
                    off |= add_places(rays, shift, last, mean)
                    boxes_of_rays(outlines[which], last, shift, border, len(starts), rays, RAYS, at)
                    record_rays(starts, size, rays, at, boxes, texels, weights, cursor)
            rays[HIDDEN + j] = max(hidden, rays[HIDDEN + j]) if hangs and not tiny else min(hidden, ONE)
        if not rays[HIDDEN + j] > ZERO:
            cursor[TAPS] = before
            continue
        if filling:
            row, pixel = cursor[PIXELS], v * width + u + lane
            pixels[row], of_caps[row], taps[row] = pixel, number, cursor[TAPS] - before
            clear[row], unknown[row] = max(ONE - rays[HIDDEN + j], ZERO), off
            moved[row, 0] = mean[0] / mean[2] - np.float32(u + lane) if mean[2] > ZERO else np.float32(np.nan)
            moved[row, 1] = mean[1] / mean[2] - np.float32(v) if mean[2] > ZERO else np.float32(np.nan)
        cursor[PIXELS] += 1


def desk() -> tuple[Any, ...]:
    """Room for what `frame` works on."""
    return (
        np.zeros(PLANES * 64, np.float32), np.zeros(POLYNOMIALS, np.float32), np.zeros((3, POLYNOMIALS), np.float32),
        np.zeros(POLYNOMIALS, np.float32), np.zeros(4, np.float32), np.zeros(64, np.uint32),
        np.zeros(PLANES * 64, np.float32), np.zeros(TOGETHER, np.int64), np.zeros(TOGETHER, np.float32),
        np.zeros(PLACES, np.uint32), np.zeros(PLACES, np.uint32), room_for_light(),
    )  # fmt: skip
