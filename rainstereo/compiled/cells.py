"""Weighted sums of texels, cell by cell (`rain.cells`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import compiled, fused, inlined
from .eights import copy_eight, four_channels, one_channel, three_channels, two_channels
from .layout import LANES, PLACES
from .quads import quad_of

U = np.uint64
EIGHT = U(LANES)
SOON = U(3)
"""Eights by which the memory of pixels is asked for before they are written: those of a cell lie all over the frame."""


@compiled
def cut(counts: Any, taps: Any, places: Any, clear: Any, seen: Any, pieces: Any, ends: Any) -> Any:
    """Write which rows are a cell, and which pieces of the row of texels they look at; returns how many there are.

    counts: (M,) of taps, M > 0. taps: (T,) texels, in whose stead their places are written; places: (N,) uint32, of
    each texel. clear: (M,) uint16, not 0 where a row shows what is below, too, which takes a place of its own. seen:
    (ceil(N / 8),) uint32, 0 at first, of pieces, to work in. pieces: (T,) uint32. ends: (2, M) int64, of each cell, the
    number of the row after its last, and of the piece.
    """
    cell: Any = np.uint32(1)
    taken, found, tap, begun = U(0), U(0), U(0), U(0)
    row: Any
    for row in range(U(len(counts))):
        end, first = tap + U(counts[row]), found
        for each in range(tap, end):
            taps[each] = places[U(taps[each])]
        while True:
            for each in range(tap, end):
                piece = U(taps[each]) // EIGHT
                if seen[piece] != cell:
                    seen[piece] = cell
                    pieces[found] = piece
                    found += U(1)
            fresh = EIGHT * (found - first) + U(clear[row] != 0)
            if taken + fresh <= U(PLACES) or row == begun:
                break
            ends[U(0), U(cell) - U(1)], ends[U(1), U(cell) - U(1)] = row, first
            cell += np.uint32(1)
            found, taken, begun = first, U(0), row
        taken += fresh
        tap = end
    ends[U(0), U(cell) - U(1)], ends[U(1), U(cell) - U(1)] = len(counts), found
    return np.int64(cell)


@compiled
def split(counts: Any, given: Any, clear: Any, largest: int, taps: Any) -> None:
    """Write how many taps rows have, (M,), if none weighs more than so much; all else as in `interleave`."""
    tap, limit = U(0), np.int64(largest)
    for row in range(U(len(counts))):
        made = (np.int64(clear[row]) + limit - 1) // limit
        for each in range(tap, tap + U(counts[row])):
            made += max((abs(np.int64(given[each])) + limit - 1) // limit, 1)
        taps[row] = made
        tap += U(counts[row])


@compiled
def interleave(
    counts: Any, found: Any, given: Any, number: Any, clear: Any, below: int, largest: int, most: Any, places: Any,
    weights: Any,
) -> None:  # fmt: skip
    """Write the taps of eight rows, in turn, the first of each, the second of each, ...; weights of 0 fill up.

    What weighs more than `largest`, up or down, becomes several taps of one place.

    counts: (M,), found, given: (T,) of rows, places in the row of texels, and weights. number: (n,) uint16, of pieces,
    the place of the first of the eight in the cell. clear: (M,) uint16, the weight of what is below, if not 0, whose
    places follow one another, the first being `below`. most: (ceil(M / 8),) the largest number of taps of eight rows, 1
    at least, by which `places`, uint16, and `weights`, int8 or int16, are long. Rows that are missing to eight are as
    the last.
    """
    rows: Any = U(len(counts))
    tap, first, last = rows - rows, rows - rows, rows - rows
    place, limit = U(below), np.int64(largest)
    places[:] = 0
    weights[:] = 0
    for eight in range(U(len(most))):
        for lane in range(EIGHT):
            row = eight * EIGHT + lane
            if row >= rows:
                for each in range(U(most[eight])):
                    places[first + each * EIGHT + lane] = places[first + each * EIGHT + last]
                    weights[first + each * EIGHT + lane] = weights[first + each * EIGHT + last]
                continue
            last, to = lane, first + lane
            for each in range(tap, tap + U(counts[row])):
                at = U(found[each])
                to = _put(places, weights, to, U(number[at // EIGHT]) + at % EIGHT, np.int64(given[each]), limit)
            tap += U(counts[row])
            if clear[row]:
                _put(places, weights, to, place, np.int64(clear[row]), limit)
                place += U(1)
        first += U(most[eight]) * EIGHT


@inlined
def _put(places: Any, weights: Any, to: Any, place: Any, weight: Any, limit: Any) -> Any:
    """Write one place, as often as its weight takes; returns where the row's next tap goes."""
    while True:
        part = min(max(weight, -limit), limit)
        places[to], weights[to] = place, part
        weight -= part
        to += EIGHT
        if weight == 0:
            return to


@fused
def draw(
    out: Any, channels: int, row: Any, below: Any, shift: int, near: Any, pieces: Any, soft: Any, pixels: Any,
    most: Any, places: Any, weights: Any, roundings: Any,
) -> None:  # fmt: skip
    """Write the pixels of a cell: sums of bytes times weights.

    out: (P * channels,) uint8, of one to four channels. row: (8 n,) uint32 quads of texels. below: (P, channels)
    uint8. shift: bits of a weight's unit. near: (`PLACES`,) uint32, to work in. pieces: (n,) uint32 numbers of those of
    the row that are copied there, one after the other. soft: (S,) uint32 pixels below that follow them.
    pixels: (M,) uint32, M a multiple of 8. most, places, weights: of `interleave`. roundings: (M,) int16, units of
    weights, for every channel.
    """
    unit, tap, held, last = np.uint32(shift), U(0), U(0), U(len(most)) - U(1)
    for i in range(U(len(pieces))):
        copy_eight(row, EIGHT * U(pieces[i]), near, held)
        held += EIGHT
    for i in range(U(len(soft))):
        near[held + i] = quad_of(below, U(soft[i]))
    for eight in range(U(len(most))):
        number, later, start = eight * EIGHT, min(eight + SOON, last) * EIGHT, tap
        tap += U(most[eight]) * EIGHT
        if channels == 1:
            one_channel(out, near, unit, pixels, number, later, places, weights, start, tap, roundings)
        elif channels == 2:
            two_channels(out, near, unit, pixels, number, later, places, weights, start, tap, roundings)
        elif channels == 3:
            three_channels(out, near, unit, pixels, number, later, places, weights, start, tap, roundings)
        else:
            four_channels(out, near, unit, pixels, number, later, places, weights, start, tap, roundings)
