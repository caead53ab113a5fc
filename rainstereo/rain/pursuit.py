"""The few texels, of many sizes and shapes, that tell best what a pixel shows which looks at the scene along many rays.

A pixel is a weighted sum of values of the scene, w. So is a sum of texels with weights v, whatever texels are taken;
of a scene of known statistics (`SceneStatistics.natural`) the expected square of the difference of both is a quadratic
form in w and v. Texels are taken one after the other, each time the one that lowers it most, all weights being anew the
best ones, as long as it falls by `worth` for each: orthogonal least squares (S. Chen, S. A. Billings and W. Luo,
"Orthogonal least squares methods and their application to non-linear system identification", Int. J. Control 50, 1989),
with a field's covariance for the inner product. Weights can be negative: a large texel less what it has too much.

The texels offered are those of a window of `SIDE` x `SIDE` in the finest level in which it holds all of the pixel's
rays, and the coarser ones there, of which some are up to four times as wide as high or the reverse (`pyramid.copies`).
What they have in common with one another depends on the level alone, and is tabulated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import product
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from rainstereo import compiled
from rainstereo.patch import folded_along
from rainstereo.scene_statistics import SceneStatistics
from rainstereo.types import Array, Image, Indices, Mask

from .best_weights import NEGATIVE, RIDGE, RIDGE_GROWS, gentle_weights
from .exchange import GAIN, ROUNDS, exchanged
from .parts import halved, leaps
from .pyramid import LONG, Copy, copies, copy_starts, sizes
from .quadtree import Quadtree, Steps, Taps, ends_of, mixed, of_some, span_of, whole

HALVINGS = 3
SHAPES = tuple((a, b) for a in range(HALVINGS + 1) for b in range(HALVINGS + 1) if abs(a - b) <= LONG)
"""Of texels offered: halvings across and down, from the window's."""
ALIGNED = 1 << HALVINGS
SIDE = 3 * ALIGNED  # texels along a window
BINS = 4  # places along one of them to which rays are rounded
ROOM = SIDE - ALIGNED + 1  # texels that rays may span, wherever they are
POINTS = 4  # along a texel's side that stand for its area
MOST = 40  # texels of a pixel
SMALL = 6.0
"""Pixels that rays must span: up to there their own four texels each are few enough, and exact."""
SHRUNK = 4
"""Times that the photographs are shrunk whose statistics are taken: sharp images have more of what is fine."""
FRESH = 1e-4  # part of a texel's variance that must be news after those taken before
SCREENED = 10
NEAR, STILL = 0.7, 0.5
"""After so many texels of a pixel, and in exchanges, only some others are offered to it: those that were once worth so
much of what the one was that was taken then, as the third or later, or that are worth so much of their price still."""
TOGETHER = 128  # pixels: few enough for the caches
FINER, MOST_RAYS = 2, 0.5
"""Levels by which a window must be finer that holds the most of a pixel's rays, so that it and the rest are apart."""
FEW, DEAR = 2, 1.5
"""Levels below this have so many texels that making and finding them costs, too; what one of these counts for."""
LARGE, UNEVEN = 4, 2.0
"""Level of windows from which, and at which, the finest, photographs are more uneven than their statistics say: edges
and whole objects; what errors there count for."""
AROUND = 1  # texels of the window around the rays in which, or in part, are the texels offered
POINTS_ALONG, MOST_ALONG = 16, 2
"""Points along a pixel's side that rays stand for, each for its part, and along such a part, at most."""
DENSE = 2.0
"""Such points a texel of the window, along each side of a ray's part of the pixel."""


@dataclass(frozen=True, eq=False)
class _Chosen:
    """Texels of M pixels: texel, weight (M, MOST), counts (M,) of those before others of weight 0."""

    texel: Indices
    weight: Array
    counts: Indices


@dataclass(frozen=True)
class Pursuit:
    """size: (width, height) of the image. worth: square gray levels that a texel must be worth. tree: for pixels that
    windows do not suit."""

    size: tuple[int, int]
    worth: float
    tree: Quadtree

    def level(self, span: Array) -> Indices:
        """Of pixels whose rays span squares of such sides, (M,) pixels, the level of the window; -1: none suits."""
        level = np.maximum(np.ceil(np.log2(np.maximum(span / ROOM, 1e-6)) - 1e-6), 0).astype(np.intp)
        return np.where((span < SMALL) | (level >= len(sizes(self.size))), -1, level)

    def taps(self, x: Array, y: Array, weights: Array) -> Taps:
        """Texels of M pixels for rays that meet the image's plane at x, y, of weights, (K, M) float32, K a square."""
        given = x, y
        x, y, steps, span, _ = self.tree.placed(x, y, weights)
        able = np.flatnonzero(self.level(span) >= 0)
        rest = np.ones(len(span), dtype=np.bool_)
        rest[able] = False
        tree = self.tree.taps(given[0][:, rest], given[1][:, rest], weights[:, rest])
        owner, share = self._parts(x[:, able], y[:, able], weights[:, able], of_some(steps, able), span[able])
        columns = able[owner]
        chosen = self._choose(x[:, columns], y[:, columns], share, of_some(steps, columns))
        there = np.arange(MOST) < chosen.counts[:, None]
        pixel = np.repeat(owner, chosen.counts)
        taps = whole(pixel, chosen.texel[there], chosen.weight[there], len(able), np.zeros(len(able)))
        return mixed(~rest, tree, taps)

    def _parts(self, x: Array, y: Array, weights: Array, steps: Steps, span: Array) -> tuple[Indices, Array]:
        """Parts of pixels that are told by windows of their own: whose each is, (P,) in order, and its weights, (K, P).

        Rays on both sides of a wide gap, as in two drops, are two parts; and so are those of which most meet in a small
        place, and the rest, as beside a dark rim.
        """
        leap, first = leaps(x, y, weights, steps)
        owner, share = halved(weights, leap & (self.level(span) > 0), first)
        x, y = x[:, owner], y[:, owner]
        level = self.level(span_of(x, y, share))
        wide = np.flatnonzero(level >= FINER)
        inside = self._dense(x[:, wide], y[:, wide], share[:, wide], level[wide] - FINER)
        two, first = np.zeros(len(owner), dtype=np.bool_), np.zeros(share.shape, dtype=np.bool_)
        two[wide], first[:, wide] = inside.any(0), inside
        half, share = halved(share, two, first)
        return owner[half], share

    def _dense(self, x: Array, y: Array, weights: Array, level: Indices) -> Mask:
        """Which rays are in a window of a level, (M,), around the pixel's middle ray, (K, M), if `MOST_RAYS` are."""
        away = np.zeros(weights.shape, dtype=np.float32)
        for at in (x, y):
            order = np.argsort(at, axis=0)
            so_far = np.cumsum(np.take_along_axis(weights, order, 0), axis=0)
            middle = (so_far < 0.5 * so_far[-1:]).sum(0)
            centre = np.take_along_axis(at, np.take_along_axis(order, middle[None], 0), 0)
            np.maximum(away, np.abs(at - centre), out=away)
        inside = away <= 0.5 * ROOM * np.exp2(level.astype(np.float32))
        dense = (weights * inside).sum(0) >= MOST_RAYS * weights.sum(0)
        return np.asarray(inside & dense)

    def _choose(self, x: Array, y: Array, weights: Array, steps: Steps) -> _Chosen:
        """Texels for rays at x, y (K, M)."""
        count = weights.shape[1]
        level = np.maximum(self.level(span_of(x, y, weights)), 0)
        low = np.stack([ends_of(at, weights)[0] for at in (x, y)])
        texel: Indices = np.zeros((count, MOST), dtype=np.intp)
        weight: Array = np.zeros((count, MOST))
        counts: Indices = np.zeros(count, dtype=np.intp)
        for each in np.unique(level).tolist():
            some = np.flatnonzero(level == each)
            for first in range(0, len(some), TOGETHER):
                part = some[first : first + TOGETHER]
                rays = (x[:, part], y[:, part], weights[:, part], of_some(steps, part))
                found = self._of_level(each, *rays, low[:, part])
                texel[part], weight[part], counts[part] = found.texel, found.weight, found.counts
        return _Chosen(texel, weight, counts)

    def _of_level(self, level: int, x: Array, y: Array, weights: Array, steps: Steps, low: Array) -> _Chosen:
        words, scale, count = _dictionary(level), 0.5**level, weights.shape[1]
        first = np.floor((low + 0.5) * scale).astype(np.intp) & -ALIGNED  # column and row of the window
        each = min(max(POINTS_ALONG // math.isqrt(len(weights)), 1), MOST_ALONG)
        if compiled.available():
            return self._compiled(level, first, x, y, weights, steps, each)
        places, fine = SIDE * BINS, np.float32(scale * BINS)
        across, down = (
            np.clip(np.ceil(np.maximum(abs(one), abs(other)) * np.float32(DENSE * scale)), 1, each)
            for one, other in (steps[:2], steps[2:])
        )
        bins: Indices = np.empty((each**2, *weights.shape), dtype=np.intp)
        shares: Image = np.zeros(bins.shape, dtype=np.float32)
        for part, (n, m) in enumerate(product(range(each), range(each))):
            a, b = (m + np.float32(0.5)) / across - np.float32(0.5), (n + np.float32(0.5)) / down - np.float32(0.5)
            j, i = (
                (folded_along(at + b * below + a * right, end - 1, self.tree.border) + np.float32(0.5)) * fine - start
                for at, right, below, end, start in zip(
                    (x, y), steps[:2], steps[2:], self.size, first * BINS, strict=True
                )
            )
            j, i = (np.clip(at, 0, places - 1).astype(np.intp) for at in (j, i))
            bins[part] = i * places + j
            shares[part] = np.where((m < across) & (n < down), weights / (across * down), 0)
        where: Indices = bins.T.reshape(count, -1)
        share: Image = shares.T.reshape(count, -1)
        common = _common(words, where, share)
        offered, numbers = self._offered(level, first, _boxes(where, share))
        along = _sums(common.reshape(count, SIDE, SIDE))
        price, least = self._prices(level), np.float32(FRESH) * np.diag(words.gram)
        taken, counts, others = _taken(words, along, offered, price)
        taken, counts = exchanged(words.gram, along, others, price, least, taken, counts)
        weight = gentle_weights(words.gram, along, taken, counts, share.sum(1, dtype=np.float64))
        texel = np.take_along_axis(numbers, taken, 1)
        return _Chosen(texel, weight, counts)

    def _compiled(
        self, level: int, first: Indices, x: Array, y: Array, weights: Array, steps: Steps, each: int
    ) -> _Chosen:
        from rainstereo.compiled.pursuit import choose

        words, count = _dictionary(level), weights.shape[1]
        texel: Indices = np.zeros((count, MOST), dtype=np.intp)
        weight: Array = np.zeros((count, MOST))
        counts: Indices = np.zeros(count, dtype=np.intp)
        shapes = np.array([(*shape, *self._limits(level, shape)) for shape in SHAPES], dtype=np.int64)
        (pairs, begin, variance), scale = words.pairs, 0.5**level
        last = tuple(np.float32(n - 1) for n in self.size)
        rays = np.stack([x.T, y.T, *(step.T for step in steps), weights.T], axis=1)
        first = np.ascontiguousarray(first)  # as `compile_ahead` has it: another layout would be compiled anew
        choose(
            words.lags, pairs, begin, variance, _atoms(), shapes, self._prices(level), np.float32(FRESH) * variance,
            SCREENED, (np.float32(NEAR), np.float32(STILL)), ROUNDS, GAIN, NEGATIVE, RIDGE, RIDGE_GROWS, AROUND, first,
            rays, each, np.float32(BINS * scale), np.float32(DENSE * scale), last, self.tree.border == "mirror", texel,
            weight, counts,
        )  # fmt: skip
        return _Chosen(texel, weight, counts)

    def _prices(self, level: int) -> Any:
        """What each texel of a window must be worth, (A,) float32."""
        uneven = UNEVEN if level == 0 or level >= LARGE else 1.0
        dear = np.array([DEAR if level + min(shape) < FEW else 1.0 for shape in SHAPES]) / uneven
        return (self.worth * dear[_atoms()[:, 0]]).astype(np.float32)

    def _limits(self, level: int, shape: tuple[int, int]) -> tuple[int, int, int, int]:
        """Columns and rows of texels of a shape that are offered, 0 if there is no copy of these, the number of the
        copy's first, and its width. Long ones that end beyond the image are not: finer ones tell more of its edge."""
        across, down = level + shape[0], level + shape[1]
        copy, start = self._copies.get((across, down), (Copy(0, 0, 0, 0), 0))
        if across == down or not copy.width:
            return copy.width, copy.height, start, copy.width
        return self.size[0] >> across, self.size[1] >> down, start, copy.width

    def _offered(self, level: int, first: Indices, boxes: Indices) -> tuple[Mask, Indices]:
        """Which texels of windows the image has and boxes meet, and their numbers, (M, A)."""
        number, j, i = _atoms().T
        across, down = np.array(SHAPES)[number].T
        wide, high, start, width = np.array([self._limits(level, shape) for shape in SHAPES])[number].T
        x, y = (first[0][:, None] >> across) + j, (first[1][:, None] >> down) + i
        left, right, top, bottom = boxes.T[:, :, None]
        near = ((j << across) <= right) & (((j + 1) << across) > left)
        near &= ((i << down) <= bottom) & (((i + 1) << down) > top)
        return near & (x < wide) & (y < high), start + y * width + x

    @cached_property
    def _copies(self) -> dict[tuple[int, int], tuple[Copy, int]]:
        every = zip(copies(self.size), copy_starts(self.size), strict=False)
        return {(copy.across, copy.down): (copy, start) for copy, start in every}


@cache
def _atoms() -> Indices:
    """Of each texel offered, (A, 3), the number of its shape, its column and row among those of the shape."""
    found = []
    for number, (across, down) in enumerate(SHAPES):
        i, j = np.mgrid[: SIDE >> down, : SIDE >> across]
        found.append(np.stack([np.full(i.size, number), j.ravel(), i.ravel()], -1))
    return np.asarray(np.concatenate(found), dtype=np.intp)


def _boxes(where: Indices, share: Array) -> Indices:
    """First and last column, first and last row, (M, 4), of the window's texels that rays meet, and one more around."""
    lit, found = share > 0, []
    for place in (where % (SIDE * BINS) // BINS, where // (SIDE * BINS) // BINS):
        found += [np.where(lit, place, SIDE).min(1) - AROUND, np.where(lit, place, -1).max(1) + AROUND]
    return np.stack(found, -1)


@dataclass(frozen=True, eq=False)
class _Dictionary:
    """What texels of a window have in common. Square gray levels.

    lags: (2, 2, n, n) of a place with a texel so far away, even and odd steps of `BINS` apart; the last place first.
    own: (2 side - 1, 2 side - 1) of the window's own texels that are so far apart, the nearest in the middle.
    """

    lags: Image
    own: Array

    @cached_property
    def gram(self) -> Image:
        """(A, A) float32 of texels with one another."""
        lag = np.arange(SIDE) - np.arange(SIDE)[:, None] + SIDE - 1
        base = self.own[lag[:, None, :, None], lag[None, :, None, :]].reshape(SIDE**2, SIDE**2)
        whole = _sums(base.reshape(-1, SIDE, SIDE))
        return _sums(np.ascontiguousarray(whole.T).reshape(-1, SIDE, SIDE)).astype(np.float32)

    @cached_property
    def pairs(self) -> tuple[Image, Indices, Image]:
        """The same by how far texels are apart, and where each pair of shapes begins, see `compiled.pursuit.common_of`;
        and the texels' variances, (A,)."""
        tables, begin, variances = [], np.zeros((len(SHAPES),) * 2, dtype=np.int64), []
        total = 0
        for i, one in enumerate(SHAPES):
            for j, other in enumerate(SHAPES):
                (across, down), begin[i, j] = map(_distances, one, other), total
                tables.append((down @ self.own @ across.T).astype(np.float32).ravel())
                total += tables[-1].size
            (x, y) = map(_together, one, one)
            variances.append(float(y @ self.own @ x))
        tables.append(np.zeros(2 * SIDE, dtype=np.float32))  # a loop may read a little more
        return np.concatenate(tables), begin, np.array(variances, dtype=np.float32)[_atoms()[:, 0]]

    @cached_property
    def of_bins(self) -> Image:
        """(bins, side^2) of places with the window's own texels."""
        place, cell = np.arange(SIDE * BINS), np.arange(SIDE)
        odd, step = place % BINS, SIDE - 1 - place[:, None] // BINS + cell
        table = self.lags[odd[:, None, None, None], odd[:, None, None], step[:, None, :, None], step[None, :, None]]
        return np.asarray(table.reshape(len(place) ** 2, SIDE**2))


def _together(one: int, other: int, apart: int = 0) -> Array:
    """How often parts of two texels of so many halvings, the other so far beside the one, are how far apart: a share
    for each of the 2 `SIDE` - 1 distances, of those that there are in a window."""
    first, second = np.arange(1 << one), np.arange(1 << other)
    lag = np.clip(apart + second - first[:, None] + SIDE - 1, 0, 2 * SIDE - 2)
    return np.bincount(lag.ravel(), minlength=2 * SIDE - 1) / lag.size


@cache
def _distances(one: int, other: int) -> Array:
    """`_together` for each phase of a texel in the grid of the other, and each distance along it, one in each row."""
    phases, cells = 1 << max(other - one, 0), SIDE >> other
    return np.stack(
        [
            _together(one, other, (step << other) + (phase << one))
            for phase in range(phases)
            for step in range(-cells, cells)
        ]
    )


@cache
def _dictionary(level: int) -> _Dictionary:
    scene, texel = _scene(level), 2.0**level
    points = min(POINTS, 2**level)
    inside = (np.arange(points) + 0.5) / points - 0.5
    inside = np.stack(np.meshgrid(inside, inside), -1).reshape(-1, 2)
    bins = (np.arange(-(SIDE - 1) * BINS - 1, SIDE * BINS + 1) + 0.5) / BINS - 0.5
    of_places = _covariance(scene, bins, inside, texel)
    for _ in range(2):  # points stand for three bins by three
        of_places = (of_places[:-2] + of_places[1:-1] + of_places[2:]).T / 3
    split = of_places.astype(np.float32).reshape(2 * SIDE - 1, BINS, 2 * SIDE - 1, BINS)
    lags = np.ascontiguousarray(np.moveaxis(split, (1, 3), (0, 1))[:, :, ::-1, ::-1])
    between = (inside[:, None] - inside).reshape(-1, 2)
    return _Dictionary(lags, _covariance(scene, np.arange(1.0 - SIDE, SIDE), between, texel))


def forget() -> None:
    """Give up what is tabulated of windows, 14 MB for each level without numba; it is found anew when it is needed."""
    _dictionary.cache_clear()


def _common(words: _Dictionary, where: Indices, share: Image) -> Image:
    """Covariances of pixels with the texels of a window, (M, side^2). where, share: (M, K) of rays."""
    ends = np.arange(0, where.size + 1, where.shape[1])
    matrix = csr_array((share.ravel(), where.ravel(), ends), shape=(len(where), (SIDE * BINS) ** 2))
    return np.asarray(matrix @ words.of_bins)


def _scene(level: int) -> SceneStatistics:
    """Of photographs shrunk `SHRUNK` times: sharp ones."""
    scene = SceneStatistics.natural()
    return SceneStatistics(scene.mean, scene.lags / SHRUNK, scene.covariance)


def _covariance(scene: SceneStatistics, away: Array, parts: Array, texel: float) -> Array:
    """E[I(p) I(q)] for lags in texels, y and x from `away`, the mean over `parts`."""
    x, y = np.meshgrid(away, away)
    total = np.zeros(x.shape)
    for dx, dy in parts:
        total += scene.at(texel * np.hypot(x - dx, y - dy))
    return np.asarray(total / len(parts) + scene.mean**2)


def _sums(values: Array) -> Array:
    """Of what a window's texels have in common with pixels, (M, side, side), that of all texels offered, (M, A)."""
    found = {(0, 0): values}
    for across, down in SHAPES[1:]:
        if (across - 1, down) in found:
            finer = found[across - 1, down]
            found[across, down] = 0.5 * (finer[:, :, ::2] + finer[:, :, 1::2])
        else:
            finer = found[across, down - 1]
            found[across, down] = 0.5 * (finer[:, ::2] + finer[:, 1::2])
    return np.concatenate([found[shape].reshape(len(values), -1) for shape in SHAPES], 1)


def _taken(words: _Dictionary, along: Array, offered: Mask, price: Any) -> tuple[Indices, Indices, Mask]:
    """Numbers of texels taken, (M, MOST), how many, (M,), and which may take their place, (M, A).

    along: (M, A) covariances with the pixels.
    """
    gram, count, variance = words.gram, len(along), np.diag(words.gram)
    taken: Indices = np.zeros((count, MOST), dtype=np.intp)
    counts: Indices = np.zeros(count, dtype=np.intp)
    others, rows, least = np.zeros_like(offered), np.arange(count), np.float32(FRESH) * variance
    rest: Image = along.astype(np.float32)
    news: Image = np.where(offered, variance, np.float32(np.inf))
    near: Image = np.zeros_like(rest)
    bases: list[Image] = []
    for number in range(MOST + 1):
        score: Image = rest * rest
        score /= news * price
        highest: Image = score.max(1, keepdims=True)
        if number > 1:
            np.maximum(near, score * (1 / np.maximum(highest, np.float32(1))), out=near)
        kept = (near >= np.float32(NEAR)) | (score > np.float32(STILL))
        # the first is taken whatever it is worth: sums of weights are kept
        good = (highest[:, 0] > (number > 0)) & (number < MOST)
        others[rows[~good]] = kept[~good]
        if not good.all():
            rows, kept = rows[good], kept[good]
            score, rest, news, near = (each[good] for each in (score, rest, news, near))
            bases = [before[good] for before in bases]
        if not rows.size:
            break
        best, every = score.argmax(1), np.arange(len(rows))
        if number == SCREENED:
            news[~kept], near[~kept] = np.inf, 0
        taken[rows, number] = best
        counts[rows] += 1
        base = gram[best]
        for before in bases:
            base -= before[every, best][:, None] * before
        base *= (1 / np.sqrt(news[every, best]))[:, None]
        rest -= (rest[every, best] / np.sqrt(news[every, best]))[:, None] * base
        bases.append(base)
        news -= base * base
        news[news <= least] = np.inf
    return taken, counts, others
