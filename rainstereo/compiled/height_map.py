"""Heights and slopes of a smooth height map (`rainstereo.height_map`), place by place."""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import compiled, inlined

U = np.uint64


@compiled
def interpolate(x: Any, y: Any, spacing: Any, metres: float, nodes: Any, found: Any) -> None:
    """Write height and slopes along x and y, found: (3, N) of the places' type; all 0 outside the grid.

    x, y: (N,) metres. spacing: of the nodes, metres, of the places' type. nodes: (H + 2, W + 2), see
    `HeightMap._nodes`. metres: what sums of them are to be multiplied by.
    """
    nobody, down, across = found.dtype.type(0), nodes.shape[0] - 3, nodes.shape[1] - 3
    for at in range(U(len(x))):
        u, v = np.float64(x[at] / spacing) + 0.5 * across, np.float64(y[at] / spacing) + 0.5 * down
        if not (u >= 0.0 and v >= 0.0 and u <= across and v <= down):
            found[0, at], found[1, at], found[2, at] = nobody, nobody, nobody
            continue
        i, j = min(int(v), down - 1), min(int(u), across - 1)
        (w0, w1, w2, w3), (d0, d1, d2, d3) = weights(u - j)
        values, alongs = weights(v - i)
        height, along_u, along_v = 0.0, 0.0, 0.0
        for a in range(4):
            row, first = U(i + a), U(j)
            n0, n1 = nodes[row, first], nodes[row, first + U(1)]
            n2, n3 = nodes[row, first + U(2)], nodes[row, first + U(3)]
            ahead = w0 * n0 + w1 * n1 + w2 * n2 + w3 * n3
            tilt = d0 * n0 + d1 * n1 + d2 * n2 + d3 * n3
            height += values[a] * ahead
            along_u += values[a] * tilt
            along_v += alongs[a] * ahead
        found[0, at], found[1, at], found[2, at] = height * metres, along_u * (1 / 12), along_v * (1 / 12)


@inlined
def weights(s: float) -> Any:
    """`HeightMap._weights`."""
    rest, square = 1.0 - s, s * s
    cube = square * s
    values = rest * rest * rest, 3.0 * cube - 6.0 * square + 4.0, 3.0 * (s + square - cube) + 1.0, cube
    return values, (-(rest * rest), 3.0 * square - 4.0 * s, 2.0 * s - 3.0 * square + 1.0, square)
