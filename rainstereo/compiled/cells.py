"""Weighted sums of texels, cell by cell (`rain.cells`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import compiled, fused
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
def pair(
    counts: Any, found: Any, given: Any, number: Any, largest: int, work: Any, pairs: Any, places: Any, weights: Any
) -> None:  # fmt: skip
    """Write rows anew, as pairs of places that follow one another in an eight, and their weights, each one byte.

    counts, found, given, number: as in `interleave`. largest: what weighs more, up or down, is in several pairs. work:
    (`PLACES`,) int32, of 0, and so again. pairs: (M,) of each row. places: (T + sum |given| / largest,) uint16, in the
    cell, of the first of a pair, weights: int8, twice as long, and as interleaved.
    """
    tap, made, limit, none = U(0), U(0), np.int64(largest), np.int64(0)
    for row in range(U(len(counts))):
        begun, end = made, tap + U(counts[row])
        for each in range(tap, end):
            at = U(found[each])
            work[U(number[at // EIGHT]) + at % EIGHT] += given[each]
        for each in range(tap, end):
            start = U(number[U(found[each]) // EIGHT])
            place, last = start, start + EIGHT - U(1)
            while place <= last:
                one, other = np.int64(work[place]), none
                if one == 0:
                    place += U(1)
                    continue
                work[place] = 0
                if place < last:
                    other = np.int64(work[place + U(1)])
                    work[place + U(1)] = 0
                while one != 0 or other != 0:
                    part, beside = min(max(one, -limit), limit), min(max(other, -limit), limit)
                    places[made], weights[U(2) * made], weights[U(2) * made + U(1)] = place, part, beside
                    one -= part
                    other -= beside
                    made += U(1)
                place += U(2)
        tap = end
        pairs[row] = made - begun


@compiled
def interleave(
    counts: Any, found: Any, given: Any, number: Any, clear: Any, below: int, largest: int, most: Any, places: Any,
    weights: Any,
) -> None:  # fmt: skip
    """Write the taps of eight rows, in turn, the first of each, the second of each, ...; weights of 0 fill up.

    counts: (M,), found, given: (T,) of rows, places in the row of texels, and weights. number: (n,) uint16, of pieces,
    the place of the first of the eight in the cell. clear: (M,) uint16, the weight of what is below, if not 0, whose
    places follow one another, the first being `below`; `largest` at most in a tap. most: (ceil(M / 8),) the largest
    number of taps of eight rows, 1 at least, by which `places`, uint16, and `weights`, int16, are long. Rows that are
    missing to eight are as the last.

    So are pairs (`pair`), whose weights, two bytes, are one number: it is that of the first if that of the second is 0.
    """
    rows: Any = U(len(counts))
    tap, first, last = rows - rows, rows - rows, rows - rows
    place, limit = U(below) - U(1), np.int64(largest)
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
                places[to], weights[to] = U(number[at // EIGHT]) + at % EIGHT, given[each]
                to += EIGHT
            tap += U(counts[row])
            left = np.int64(clear[row])
            place += U(left > 0)
            while left > 0:
                places[to], weights[to] = place, min(left, limit)
                left -= limit
                to += EIGHT
        first += U(most[eight]) * EIGHT


@fused
def draw(
    out: Any, channels: int, row: Any, below: Any, shift: int, near: Any, pieces: Any, soft: Any, pixels: Any,
    most: Any, places: Any, weights: Any, roundings: Any,
) -> None:  # fmt: skip
    """Write the pixels of a cell: sums of bytes times weights.

    out: (P * channels,) uint8, of one to four channels. row: (8 n,) uint32 quads of texels. below: (P, channels)
    uint8. shift: bits of a weight's unit. near: (`PLACES`,) uint32, to work in, and one more that is
    read. pieces: (n,) uint32 numbers of those of the row that are copied there, one after the other. soft: (S,) uint32
    pixels below that follow them. pixels: (M,) uint32, M a multiple of 8. most, places, weights: of `interleave`,
    weights of pairs as int8. roundings: (M,) int16, units of weights, for every channel.
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
