"""Rays through spherical caps on a panel's far face, dozens at a time: closed forms that compile to vector code.

The optics are those of `spherical_refraction.leave_far_face`, which the tests hold them to. Where the rays of pixels
meet the face, and at what angle, changes smoothly over the image: over a tile of it, it is a polynomial through nine
nodes of a lattice that is made once for a camera and a pane. A cap's centre is subtracted from the nodes in double
precision; from there on everything is small, and single precision does.

All numbers about a tile stand in one array, in planes of 64: so the compiler sees that nothing overlaps.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .cap_lanes import POLYNOMIALS, of_tile, taken_up, through_hard, through_soft, to_scene, with_room
from .cap_vectors import EIGHT
from .compile import fused_part

PX, PY, KX, KY, KZ, DIM, RISE, SHARE, ROOM, NEXT, FREE = (np.uint64(64 * i) for i in range(11))
OWN, ABOVE, BELOW = (np.uint64(64 * i) for i in (11, 14, 17))
"""Rays of a row of pixels: through their middles, and their upper and lower left corners; places, and gain."""
SUB = np.uint64(64 * 20)  # of one pixel
PATCH = np.uint64(64 * 23)
HIDDEN, RIVAL = (np.uint64(64 * i) for i in (43, 44))
"""Of a row: the share of each pixel that a cap hides; and 1 + the number of another that shows some of it, or 0."""
SHOWN = np.uint64(64 * 45)
"""What a row shows, three channels a pixel."""
WEIGHT, STRETCH = np.uint64(64 * 51), np.uint64(64 * 52)
SPREAD, PER = np.uint64(64 * 53), np.uint64(64 * 54)
"""Of a pixel's own rays: see `cross`, and how a box's size follows from how far a ray looks (`cap_edges`)."""
MARK = np.uint64(64 * 55)
"""Of a row: above 0 in the lanes that something is to be done about."""
SHARPNESS = np.uint64(64 * 56)  # 1 / `SPREAD`
PLANES = 57
Y_, GAIN = np.uint64(64), np.uint64(128)  # from where x of the places is

ZERO, ONE, HALF = np.float32(0), np.float32(1), np.float32(0.5)
ALONG = np.float32(1e-9)  # as in the tracer
CAP_X, CAP_Y, CAP_SQUARE, CAP_DEPTH, CAP_CURVATURE, CAP_INDEX, CAP_DIM = range(7)
"""Columns of a table of caps, float64: centre in the panel frame, contact radius squared, depth of the sphere's centre
below the face, 1 / its radius, index, and which of the lattice's planes says how the index dims."""

VIEW_C, VIEW_Z, VIEW_INVERSE, VIEW_FOLD, VIEW_LENS = 9, 11, 12, 13, 14
"""Parts of a view, float32: rows of the matrix from the panel frame to the camera's, the first two times the focal
lengths (9); the principal point (2); distance of the last face; 1 / depth of the scene; the square of the radius at
which the lens model folds back; fx, fy and its coefficients, OpenCV's first 12 (14)."""

STEP = 8  # pixels between nodes
X_NODE, Y_NODE, KX_NODE, KY_NODE, DIM_NODE = range(5)


@fused_part
def fit(nodes: Any, cap: Any, u: Any, v: Any, reach: Any, tile: Any) -> Any:
    """Polynomials of x, y, kx, ky and dimming over a tile, and the pixel that they are about.

    tile: (3, `POLYNOMIALS`) float32, a row for each power down the tile, of one after the other's powers along it.
    nodes: (h, w, 4 + D) float64. u, v: the tile's middle; reach: pixels from there to its sides.
    """
    height, width = nodes.shape[0], nodes.shape[1]
    most = max(min((width - 1) // 2, (height - 1) // 2), 1)
    step = min(max(int(0.87 * reach / STEP + 0.5), 1), most)  # about where the error is least
    i = min(max((u + STEP // 2) // STEP, step), width - 1 - step)
    j = min(max((v + STEP // 2) // STEP, step), height - 1 - step)
    scale = 1.0 / (STEP * step)
    for row in range(3):
        line = nodes[j + (row - 1) * step]
        for plane in range(5):
            source = plane if plane < 4 else 4 + int(cap[CAP_DIM])
            base = cap[CAP_X] if plane == X_NODE else cap[CAP_Y] if plane == Y_NODE else 0.0
            a, b, c = line[i - step, source] - base, line[i, source] - base, line[i + step, source] - base
            tile[row, 3 * plane] = np.float32(b)
            tile[row, 3 * plane + 1] = np.float32(0.5 * (c - a) * scale)
            tile[row, 3 * plane + 2] = np.float32(0.5 * (a + c - 2 * b) * scale * scale)
    for k in range(POLYNOMIALS):
        a, b, c = tile[0, k], tile[1, k], tile[2, k]
        tile[0, k] = b
        tile[1, k] = np.float32(0.5 * (c - a) * scale)
        tile[2, k] = np.float32(0.5 * (a + c - b - b) * scale * scale)
    return np.float32(i * STEP), np.float32(j * STEP)


@fused_part
def of_row(tile: Any, t: Any, line: Any) -> None:
    """The polynomials, (`POLYNOMIALS`,), of a row, t pixels from that which a tile's are about."""
    of_tile(tile, line, np.float32(t))


@fused_part
def take_up(line: Any, s: Any, low: Any, high: Any, rays: Any) -> None:
    """Rays of lanes low to before high, whole vectors, s + lane pixels along a row."""
    taken_up(rays, np.uint64(low), np.uint64(high), PX, line, np.float32(s))


@fused_part
def room_of_row(line: Any, s: Any, lanes: Any, square: Any, rays: Any) -> None:
    """Contact radius squared less the square of the distance from the centre, of a row's rays on the face."""
    with_room(rays, PX, np.uint64(lanes), PX, line, np.float32(s), square)


@fused_part
def cross(cap: Any, later: Any, view: Any, rays: Any, low: Any, high: Any, to: Any, soft: bool) -> None:
    """Rays that have been taken up, through the cap, the rest of the chamber and to the scene; written from `to` on.

    The gain is 0 where no light comes through. later: (F, 3) float32, thickness before a face and the indices
    on both sides, of the faces behind the cap's.
    soft: the components of wave vectors along the panel's normal, `KZ`, are known, and each ray stands for light about
    it, over which the square of the wave vector's component along the normal behind the cap goes from `SPREAD` below to
    as much above the ray's. That component is what places and gains depend on, nearly linearly, also where it ends, at
    the critical angle, and they as steeply as a square root: so its mean gives the light's gain, and its mean weighted
    with itself the light's middle. The plane `STRETCH` gets the component before the cap's surface over that behind it.
    """
    square, depth, curvature = np.float32(cap[CAP_SQUARE]), np.float32(cap[CAP_DEPTH]), np.float32(cap[CAP_CURVATURE])
    q = np.float32(cap[CAP_INDEX]) * np.float32(cap[CAP_INDEX])
    first, last = np.uint64(low), np.uint64(high)
    if soft:
        through_soft(rays, first, last, to, square, depth, curvature, q)
    else:
        through_hard(rays, first, last, to, square, depth, curvature, q)
    onward(cap, later, view, rays, first, last, to)


@fused_part
def onward(cap: Any, later: Any, view: Any, rays: Any, first: Any, last: Any, to: Any) -> None:
    """Rays behind a cap's surface, through the rest of the chamber and to the scene; see `cross`."""
    for face in range(len(later)):
        thick, q1, q2 = later[face, 0], later[face, 1] * later[face, 1], later[face, 2] * later[face, 2]
        for block in range(np.uint64(first), np.uint64(last), EIGHT):
            for lane in range(EIGHT):
                j = block + lane
                kz = rays[KZ + j]
                step = (thick - rays[RISE + j]) / kz
                rays[PX + j] += step * rays[KX + j]
                rays[PY + j] += step * rays[KY + j]
                rays[RISE + j] = ZERO
                inside = kz * kz + (q2 - q1)
                turned = np.float32(math.sqrt(inside))
                p, t = q2 * kz + q1 * turned, kz + turned
                pt = p * t
                passed = (kz * turned + kz * turned) * (p * p + q1 * q2 * t * t) / (pt * pt)
                rays[KZ + j] = turned
                rays[to + GAIN + j] *= passed if inside > ZERO else ZERO
    _project(np.float32(cap[CAP_X]), np.float32(cap[CAP_Y]), view, rays, first, last, to)


@fused_part
def _project(cx: Any, cy: Any, view: Any, rays: Any, first: Any, last: Any, to: Any) -> None:
    """Where the camera sees what the rays meet at the scene's depth."""
    to_scene(
        rays, first, last, to, cx, cy, view[0], view[1], view[2], view[3], view[4], view[5], view[6], view[7], view[8],
        view[VIEW_C], view[VIEW_C + 1], view[VIEW_Z], view[VIEW_INVERSE], ALONG,
    )  # fmt: skip
    if len(view) > VIEW_LENS:
        _distort(view, rays, first, last, to)


@fused_part
def _distort(view: Any, rays: Any, first: Any, last: Any, to: Any) -> None:
    """The lens's distortion of places; what lies beyond the radius where it folds back goes to that radius."""
    u0, v0, fold = view[VIEW_C], view[VIEW_C + 1], view[VIEW_FOLD]
    fx, fy = view[VIEW_LENS], view[VIEW_LENS + 1]
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = (
        view[VIEW_LENS + 2], view[VIEW_LENS + 3], view[VIEW_LENS + 4], view[VIEW_LENS + 5], view[VIEW_LENS + 6],
        view[VIEW_LENS + 7], view[VIEW_LENS + 8], view[VIEW_LENS + 9], view[VIEW_LENS + 10], view[VIEW_LENS + 11],
        view[VIEW_LENS + 12], view[VIEW_LENS + 13],
    )  # fmt: skip
    two = np.float32(2)
    for j in range(first, last):
        x, y = (rays[to + j] - u0) / fx, (rays[to + Y_ + j] - v0) / fy
        r2 = x * x + y * y
        shrink = np.float32(math.sqrt(fold / r2)) if r2 > fold else ONE
        x *= shrink
        y *= shrink
        r2 = x * x + y * y
        radial = (ONE + r2 * (k1 + r2 * (k2 + r2 * k3))) / (ONE + r2 * (k4 + r2 * (k5 + r2 * k6)))
        xy = two * x * y
        a = x * radial + p1 * xy + p2 * (r2 + two * x * x) + r2 * (s1 + r2 * s2)
        b = y * radial + p2 * xy + p1 * (r2 + two * y * y) + r2 * (s3 + r2 * s4)
        rays[to + j] = a * fx + u0
        rays[to + Y_ + j] = b * fy + v0
