"""What a row of pixels shows, mixed into a frame of bytes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.core import types
from numba.extending import intrinsic

from .cap_lanes import Lanes
from .cap_rays import HALF, HIDDEN, ONE, SHOWN
from .cap_vectors import EIGHT, REALS, WIDE, WORDS
from .compile import fused_part
from .llvm import BYTE, LONG, arguments, ir, load, store
from .prefetch import to_write

THREE, WHITE = np.uint64(3), np.float32(255)
BYTES = ir.VectorType(BYTE, WIDE)


@fused_part
def call_for(out: Any, width: Any, channels: Any, v: Any, stop: Any, u: Any, lanes: Any) -> None:
    """Have a row's pixels, before `stop`, brought from memory."""
    if v < stop:
        first, line = np.uint64((v * width + u) * channels), np.uint64(64)
        for k in range(first, first + np.uint64(lanes * channels), line):
            to_write(out, k)


@intrinsic
def _mix_eight(_context: Any, rays: Any, _lane: Any, out: Any, _first: Any) -> Any:
    """mix_eight(rays, lane, out, first): what eight pixels of three channels show, with what is there, `first` on."""

    def code(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        data, lane, frame, first = arguments(context, builder, signature, given)
        hidden = load(builder, data, builder.add(lane, LONG(int(HIDDEN))), REALS)
        shown = builder.add(builder.mul(lane, LONG(3)), LONG(int(SHOWN)))
        for part in range(3):
            pixels = ir.Constant(WORDS, [(WIDE * part + k) // 3 for k in range(WIDE)])
            clear = 1.0 - Lanes(builder, builder.shuffle_vector(hidden, hidden, pixels))
            here = builder.add(first, LONG(WIDE * part))
            below = Lanes(builder, builder.uitofp(load(builder, frame, here, BYTES), REALS))
            value = Lanes.at(builder, data, builder.add(shown, LONG(WIDE * part))) + clear * below + 0.5
            value = value.where((255.0 - value).above(0.0), 255.0)
            store(builder, builder.trunc(builder.fptosi(value.value, WORDS), BYTES), frame, here)
        return context.get_dummy_value()

    return types.void(rays, types.uint64, out, types.uint64), code


mix_eight: Any = _mix_eight


@fused_part
def write_bytes(out: Any, width: Any, of_pixel: Any, v: Any, u: Any, some: Any, rays: Any) -> None:
    """Mix what lanes of a row show, some[0] to before some[1], with what is there, where a cap hides it."""
    channels, start, stop = np.uint64(of_pixel), np.uint64(some[0]), np.uint64(some[1])
    first = np.uint64((v * width + u) * of_pixel)
    if channels == THREE:
        while start < stop and start + EIGHT <= np.uint64(width - u):  # beyond the lanes, all is clear
            mix_eight(rays, start, out, first + THREE * start)
            start += EIGHT
    for j in range(start, stop):
        for channel in range(channels):
            k, at = THREE * j + channel, first + j * channels + channel
            value = rays[SHOWN + k] + (ONE - rays[HIDDEN + j]) * np.float32(out[at]) + HALF
            out[at] = np.uint8(np.int32(value if value < WHITE else WHITE))


@fused_part
def mix(out: Any, first: Any, channels: Any, shown: Any, hidden: Any) -> None:
    """Mix what a pixel shows, its first byte at `first`, with what is there, where a cap hides it."""
    for channel in range(np.uint64(channels)):
        k = np.uint64(first) + channel
        value = shown[channel] + (ONE - hidden) * np.float32(out[k]) + HALF
        out[k] = np.uint8(np.int32(value if value < WHITE else WHITE))
