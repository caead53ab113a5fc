"""Rays through caps, eight at a time, as vector code by construction: what `cap_rays` calls for its longest loops.

The compiler puts such loops into vectors by itself, too; but each time they begin it then compares where all planes of
numbers are, and it stores under masks, which processors do slowly. `Lanes` stands for eight numbers in its own language
(see `cap_vectors`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba.core import cgutils, types
from numba.extending import intrinsic

from .cap_vectors import REALS, WIDE, WORDS, folded
from .llvm import FOUR, LONG, REAL, arguments, ir, load, spread, store

POLYNOMIALS = 16
"""Coefficients of a row: three for each of five polynomials along it, and one more that fills whole vectors."""
SIDE = 4  # samples along a pixel's side where a cap hangs over
declared: Any = vars(cgutils)["get_or_insert_function"]
Number = Any  # Lanes, or a float that is the same in all of them
FUSED = ("contract",)
KX, KY, KZ, DIM, RISE, NEXT, LITS = (64 * i for i in (2, 3, 4, 5, 6, 9, 23 + 17))
PY, Y_, GAIN = 64, 64, 128


class Lanes:
    """Eight numbers, and what is computed of them."""

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder, self.value = builder, value

    @classmethod
    def of(cls, builder: Any, number: Any) -> Lanes:
        """One number in all lanes."""
        return cls(builder, spread(builder, number, REALS))

    @classmethod
    def at(cls, builder: Any, data: Any, place: Any) -> Lanes:
        """Those that stand side by side in memory."""
        return cls(builder, load(builder, data, place, REALS))

    def put(self, data: Any, place: Any) -> None:
        """Write them there."""
        store(self.builder, self.value, data, place)

    def _value(self, other: Number) -> Any:
        return other.value if isinstance(other, Lanes) else ir.Constant(REALS, [float(other)] * WIDE)

    def _with(self, name: str, other: Number, turned: bool = False) -> Lanes:
        pair = self._value(other), self.value
        one, two = pair if turned else pair[::-1]
        return Lanes(self.builder, getattr(self.builder, name)(one, two, flags=FUSED))

    def __add__(self, other: Number) -> Lanes:
        return self._with("fadd", other)

    def __sub__(self, other: Number) -> Lanes:
        return self._with("fsub", other)

    def __rsub__(self, other: Number) -> Lanes:
        return self._with("fsub", other, True)

    def __mul__(self, other: Number) -> Lanes:
        return self._with("fmul", other)

    def __truediv__(self, other: Number) -> Lanes:
        return self._with("fdiv", other)

    def __rtruediv__(self, other: Number) -> Lanes:
        return self._with("fdiv", other, True)

    def root(self) -> Lanes:
        """The square root; NaN of what is negative."""
        return self._each("sqrt")

    def _each(self, name: str) -> Lanes:
        kind = ir.FunctionType(REALS, [REALS])
        call = declared(self.builder.module, kind, f"llvm.{name}.v{WIDE}f32")
        return Lanes(self.builder, self.builder.call(call, [self.value]))

    def size(self) -> Lanes:
        """Without their signs."""
        return self._each("fabs")

    def floor(self) -> Lanes:
        """Rounded down."""
        return self._each("floor")

    def above(self, other: Number) -> Any:
        """Which lanes are, to choose by."""
        return self.builder.fcmp_ordered(">", self.value, self._value(other))

    def where(self, which: Any, other: Number = 0.0) -> Lanes:
        """These numbers in some lanes, and others in the others."""
        return Lanes(self.builder, self.builder.select(which, self.value, self._value(other)))


def _loop(signature: Callable[[Any], Any], body: Callable[..., None]) -> Any:
    """A loop over lanes from `first` to before `last`, whole vectors, as a function (rays, first, last, to, ...)."""

    def code(context: Any, builder: Any, found: Any, given: Any) -> Any:
        data, first, last, to, *numbers = arguments(context, builder, found, given)
        every = [Lanes.of(builder, each) if each.type == REAL else each for each in numbers]
        with cgutils.for_range_slice(builder, first, last, LONG(WIDE), LONG) as (lane, _):

            def at(plane: int) -> Lanes:
                return Lanes.at(builder, data, builder.add(lane, LONG(plane)))

            def put(plane: int, value: Lanes) -> None:
                value.put(data, builder.add(lane, LONG(plane)))

            def there(part: int) -> Any:
                return builder.add(lane, builder.add(to, LONG(part)))

            body(builder, data, at, put, there, *every)
        return context.get_dummy_value()

    return signature, code


def _on_line(builder: Any, line: Any, lane: Any, s: Lanes, planes: int) -> list[Lanes]:
    """Polynomials of a row, three coefficients each, at eight of its places: s + lane and on."""
    numbers = builder.add(spread(builder, builder.trunc(lane, FOUR), WORDS), ir.Constant(WORDS, list(range(WIDE))))
    at = Lanes(builder, builder.sitofp(numbers, REALS)) + s
    c = [Lanes.of(builder, builder.load(builder.gep(line, [LONG(k)]))) for k in range(3 * planes)]
    return [c[3 * k] + at * (c[3 * k + 1] + at * c[3 * k + 2]) for k in range(planes)]


def _arguments(rays: Any, count: int, *others: Any) -> Any:
    return types.void(rays, types.uint64, types.uint64, types.uint64, *others, *[types.float32] * count)


def of_light(inside: Lanes, spread: Lanes, per: Lanes) -> tuple[Lanes, Lanes]:
    """Of light about rays, behind the cap: the mean of the component along the normal, 0 in the dark, and the mean of
    its square; per: 1 / spread. See `cap_rays.cross`."""
    high, low = inside + spread, inside - spread
    high, low = high.where(high.above(0.0)), low.where(low.above(0.0))
    mean = (high * high.root() - low * low.root()) * (per * (1 / 3))
    return mean, (high + low) * (high - low) * (per * 0.25)


def refracted(before: Lanes, mean: Lanes, square: Lanes, curvature: Lanes, q: Lanes) -> tuple[Lanes, Lanes, Lanes]:
    """By how much of its way from the sphere's middle a wave vector changes there; which part of the light passes; and
    the component before the surface over that behind it, which is `square` / `mean`."""
    less = before * mean
    p, t = less + q * square, less + square
    both = p * t
    every = both * square
    over = 1.0 / every.where(every.above(0.0), 1.0)  # one division for all
    per = mean * square * over
    passed = (less + less) * (p * p + q * t * t) * (per * per)
    return (1.0 - q) * curvature * (p * per), passed, less * both * over


def _through_cap(soft: bool) -> Callable[..., None]:
    """See `cap_rays.cross`."""
    spread_, sharp_, stretch_ = (64 * i for i in (53, 56, 52))

    def body(
        builder: Any, data: Any, at: Any, put: Any, there: Any, square: Any, depth: Any, curvature: Any, q: Any
    ) -> None:
        px, py, kx, ky, dim = at(0), at(PY), at(KX), at(KY), at(DIM)
        kz = at(KZ) if soft else (q - kx * kx - ky * ky).root()
        room = square - px * px - py * py
        b = kz * depth + px * kx + py * ky
        root = (b * b + room * q).root()
        towards = builder.fcmp_ordered(">=", b.value, b._value(0.0))
        # the root of the quadratic, as the product of both roots over the other
        s = room.where(towards, root - b) / (b + root).where(towards, q)
        before = root * curvature  # component of the wave vector along the sphere's normal
        inside = before * before + (1.0 - q)
        if soft:
            mean, squared = of_light(inside, at(spread_), at(sharp_))
        else:
            squared, mean = inside, inside.root()
        bend, passed, stretch = refracted(before, mean, squared, curvature, q)
        if soft:
            put(stretch_, stretch)
        rise = s * kz
        px, py = px + s * kx, py + s * ky
        up = kz + bend * (rise + depth)
        put(0, px)
        put(PY, py)
        put(RISE, rise)
        put(KX, kx + bend * px)
        put(KY, ky + bend * py)
        put(KZ, up)
        # beside the contact circle the sphere goes on below the face, for pixels at the edge, unless it hangs over
        lit = builder.and_(builder.or_(towards, room.above(0.0)), builder.and_(mean.above(0.0), up.above(0.0)))
        (passed * dim).where(lit).put(data, there(GAIN))

    return body


@intrinsic
def _through_hard(
    _context: Any, rays: Any, _first: Any, _last: Any, _to: Any, _a: Any, _b: Any, _c: Any, _d: Any
) -> Any:
    return _loop(_arguments(rays, 4), _through_cap(False))


@intrinsic
def _through_soft(
    _context: Any, rays: Any, _first: Any, _last: Any, _to: Any, _a: Any, _b: Any, _c: Any, _d: Any
) -> Any:
    return _loop(_arguments(rays, 4), _through_cap(True))


def _row_of_tile(combined: Callable[[Lanes, Lanes, Lanes, Lanes], Lanes]) -> Any:
    """A step (tile, line, t): all of a row's coefficients from those of its tile's three powers of t."""

    @intrinsic
    def step(_context: Any, tile: Any, line: Any, _t: Any) -> Any:
        def code(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            powers, out, down = arguments(context, builder, signature, given)
            t = Lanes.of(builder, down)
            for first in range(0, POLYNOMIALS, WIDE):
                parts = [Lanes.at(builder, powers, LONG(POLYNOMIALS * power + first)) for power in range(3)]
                combined(t, *parts).put(out, LONG(first))
            return context.get_dummy_value()

        return types.void(tile, line, types.float32), code

    return step


@intrinsic
def _taken_up(_context: Any, rays: Any, _first: Any, _last: Any, _to: Any, line: Any, _s: Any) -> Any:
    def body(builder: Any, data: Any, at: Any, put: Any, there: Any, line: Any, s: Lanes) -> None:
        px, py, kx, ky, dim = _on_line(builder, line, there(0), s, 5)
        put(0, px)
        put(PY, py)
        put(KX, kx)
        put(KY, ky)
        put(DIM, dim)

    return _loop(_arguments(rays, 1, line), body)


@intrinsic
def _with_room(_context: Any, rays: Any, _first: Any, _last: Any, _to: Any, line: Any, _s: Any, _square: Any) -> Any:
    def body(builder: Any, data: Any, at: Any, put: Any, there: Any, line: Any, s: Lanes, square: Lanes) -> None:
        x, y = _on_line(builder, line, there(0), s, 2)
        put(NEXT, square - x * x - y * y)

    return _loop(_arguments(rays, 2, line), body)


@intrinsic
def _behind(_context: Any, rays: Any, _first: Any, _last: Any, _to: Any, _a: Any, _b: Any, _c: Any, _d: Any) -> Any:
    def body(
        builder: Any, data: Any, at: Any, put: Any, there: Any, square: Lanes, depth: Lanes, scale: Lanes, q: Lanes
    ) -> None:
        px, py, kx, ky = at(0), at(PY), at(KX), at(KY)
        b = (q - kx * kx - ky * ky).root() * depth + px * kx + py * ky
        ((b * b + (square - px * px - py * py) * q) * scale + (1.0 - q)).put(data, there(0))

    return _loop(_arguments(rays, 4), body)


@intrinsic
def _lit_of(
    _context: Any, rays: Any, _first: Any, _last: Any, _to: Any, above: Any, below: Any, _whole: Any, _partly: Any
) -> Any:
    def body(
        builder: Any, data: Any, at: Any, put: Any, there: Any, above: Any, below: Any, whole: Lanes, partly: Lanes
    ) -> None:
        lane = there(0)
        corners = [
            Lanes.at(builder, data, builder.add(builder.add(lane, plane), LONG(right)))
            for plane in (above, below)
            for right in range(2)
        ]
        least, most = corners[0], corners[0]
        for gain in corners[1:]:
            least, most = least.where(gain.above(least), gain), most.where(most.above(gain), gain)
        put(LITS, whole.where(least.above(0.0), partly.where(most.above(0.0))))

    return _loop(_arguments(rays, 2, above, below), body)


def _to_scene(
    builder: Any, data: Any, at: Any, put: Any, there: Any, cx: Any, cy: Any, m0: Any, m1: Any, m2: Any, m3: Any,
    m4: Any, m5: Any, m6: Any, m7: Any, m8: Any, u0: Any, v0: Any, end: Any, inverse: Any, along: Any,
) -> None:  # fmt: skip
    kx, ky, kz = at(KX), at(KY), at(KZ)
    x, y, z = at(0) + cx, at(PY) + cy, at(RISE) + end
    dz = m6 * kx + m7 * ky + m8 * kz
    oz = m6 * x + m7 * y + m8 * z
    per = 1.0 / dz
    du = (m0 * kx + m1 * ky + m2 * kz) * per
    dv = (m3 * kx + m4 * ky + m5 * kz) * per
    (du + ((m0 * x + m1 * y + m2 * z) - oz * du) * inverse + u0).put(data, there(0))
    (dv + ((m3 * x + m4 * y + m5 * z) - oz * dv) * inverse + v0).put(data, there(Y_))
    gain = Lanes.at(builder, data, there(GAIN))
    seen = builder.and_(dz.above(along), (1.0 - oz * inverse).above(0.0))
    gain.where(builder.and_(seen, gain.above(0.0))).put(data, there(GAIN))


@intrinsic
def _project(
    _context: Any, rays: Any, _first: Any, _last: Any, _to: Any, _a: Any, _b: Any, _c: Any, _d: Any, _e: Any, _f: Any,
    _g: Any, _h: Any, _i: Any, _j: Any, _k: Any, _l: Any, _m: Any, _n: Any, _o: Any, _p: Any,
) -> Any:  # fmt: skip
    return _loop(_arguments(rays, 16), _to_scene)


@intrinsic
def _side_sum(
    _context: Any, _px: Any, _py: Any, _kx: Any, _ky: Any, _kz: Any, _radius: Any, _depth: Any, _xu: Any, _xv: Any,
    _yu: Any, _yv: Any, _per: Any,
) -> Any:  # fmt: skip
    def code(_context: Any, builder: Any, _signature: Any, given: Any) -> Any:
        px, py, kx, ky, kz, radius, depth, xu, xv, yu, yv, per = (Lanes.of(builder, number) for number in given)
        shares = []
        for half in range(2):
            places = ([(number + 0.5) / SIDE - 0.5 for number in some] for some in _places_of(half))
            s, t = (Lanes(builder, ir.Constant(REALS, some)) for some in places)
            x, y = px + s * xu + t * xv, py + s * yu + t * yv
            square = x * x + y * y
            b = x * kx + y * ky + kz * depth
            away = radius - square.root()
            gx, gy = b * kx - x, b * ky - y
            to_side = (b * b + radius * radius - square) * 0.5 / (gx * gx + gy * gy).root()
            before = builder.and_((b * -1.0).above(0.0), (to_side - away).above(0.0))
            share = to_side.where(before, away) * per + 0.5
            share = share.where(share.above(0.0))
            shares.append(share.where((1.0 - share).above(0.0), 1.0))
        return folded(builder, (shares[0] + shares[1]).value, builder.fadd, WIDE)

    return types.float32(*[types.float32] * 12), code


def _places_of(half: int) -> tuple[list[int], list[int]]:
    """Columns and rows of eight of a pixel's samples."""
    return [lane % SIDE for lane in range(WIDE)], [(WIDE * half + lane) // SIDE for lane in range(WIDE)]


of_tile: Any = _row_of_tile(lambda t, a, b, c: a + t * (b + t * c))
"""of_tile(tile, line, t): the polynomials of a row, t pixels from that which a tile's are about."""
slopes_of_tile: Any = _row_of_tile(lambda t, a, b, c: b + (t + t) * c)
"""slopes_of_tile(tile, slopes, t): how they change a pixel down."""
taken_up: Any = _taken_up
"""taken_up(rays, first, last, 0, line, s): rays of lanes, from a row's polynomials, s + lane pixels along it."""
with_room: Any = _with_room
"""with_room(rays, first, last, 0, line, s, square): contact radius squared less the square of the distance from the
centre, of a row's rays on the face."""
behind: Any = _behind
"""behind(rays, first, last, to, square, depth, curvature squared, q): the square of the component, along the normal
behind the cap, of rays that have been taken up; negative where no light comes through."""
lit_of: Any = _lit_of
"""lit_of(rays, first, last, 0, above, below, whole, partly): of pixels, by the gains at their corners, whose planes are
those given: whether all are lit, some, or none."""
side_sum: Any = _side_sum
"""side_sum(px, py, kx, ky, kz, radius, depth, xu, xv, yu, yv, per): of the shares that a pixel's samples stand for
which a cap hides (`cap_shares.side_share`); per: samples along a side over metres a pixel."""
through_hard: Any = _through_hard
"""through_hard(rays, first, last, to, square, depth, curvature, q): `cross` (`cap_rays`) up to behind the cap."""
through_soft: Any = _through_soft
"""The same of rays that stand for the light about them."""
to_scene: Any = _project
"""to_scene(rays, first, last, to, x, y, ...): where the camera sees rays; the cap's place, and numbers of the view."""
