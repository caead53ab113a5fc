"""What falls on a pane: sizes, places, cover and angles against their laws, within standard errors."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.spatial.distance import pdist, squareform

from rainstereo import Camera, Chamber, Panel
from rainstereo.droplet import SphericalCap, cap_volume
from rainstereo.panel_plane import PanelFrame
from rainstereo.rain.contacts import clusters, touching
from rainstereo.rain.pane import Pane
from rainstereo.rain.population import (
    PRESETS,
    Clustering,
    Drops,
    GridPopulation,
    LogNormal,
    Population,
    ScatteredPopulation,
)
from rainstereo.refraction import project
from rainstereo.young_laplace_drop import YoungLaplaceDrop

from .test_trace import CAMERA, pane, two_panels

SIGMAS = 4.5  # a test of a right law fails once in 150000 seeds
PANE = Pane((-0.03, -0.02), (0.03, 0.02))


def within(values: np.ndarray, expected: float) -> None:
    """The mean of independent values agrees with what is expected of them."""
    error = values.std(ddof=1) / math.sqrt(len(values))
    assert abs(values.mean() - expected) < SIGMAS * error, (values.mean(), expected, error)


def inner(pane: Pane, margin: float) -> Pane:
    return Pane((pane.low[0] + margin, pane.low[1] + margin), (pane.high[0] - margin, pane.high[1] - margin))


# -- the pane ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("chamber", "panel", "face"),
    [(pane(), 0, "far"), (pane(35, 20), 0, "near"), (two_panels(25, 200), 1, "far"), (two_panels(40, 90), 0, "far")],
)
def test_the_pane_holds_what_the_camera_sees(chamber: Chamber, panel: int, face: str) -> None:
    """Forwards, by projection: points just beyond any edge are outside the image, some just within each are inside."""
    seen, frame = Pane.seen(CAMERA, chamber, panel, face), PanelFrame.of(chamber)
    (x0, y0), (x1, y1) = seen.low, seen.high
    t = np.linspace(-0.2, 1.2, 400)
    for out, expect in ((0.004, False), (-0.004, True)):
        dx, dy = out * seen.size[0], out * seen.size[1]
        x, y = x0 + t * (x1 - x0), y0 + t * (y1 - y0)
        for edge in (
            np.stack([x, np.full(400, y0 - dy)], -1),
            np.stack([x, np.full(400, y1 + dy)], -1),
            np.stack([np.full(400, x0 - dx), y], -1),
            np.stack([np.full(400, x1 + dx), y], -1),
        ):
            points = np.stack([frame.base(chamber, (a, b), panel, face) for a, b in edge])
            pixels, status = project(frame.to_camera(points), CAMERA, chamber)
            u, v = pixels[status == 0].T
            inside = (u > -0.5) & (u < 1279.5) & (v > -0.5) & (v < 959.5)
            assert inside.any() == expect
    wider = Pane.seen(CAMERA, chamber, panel, face, margin=0.002)
    assert wider.low == pytest.approx((x0 - 0.002, y0 - 0.002))
    assert wider.high == pytest.approx((x1 + 0.002, y1 + 0.002))


def test_a_grid_tiles_the_pane() -> None:
    x, y = PANE.grid(300)
    assert (len(x), len(y)) == (300, 200)
    np.testing.assert_allclose(np.diff(x), 2e-4)
    np.testing.assert_allclose(np.diff(y), 2e-4)
    np.testing.assert_allclose([x[0] - 1e-4, y[0] - 1e-4], PANE.low)
    np.testing.assert_allclose([x[-1] + 1e-4, y[-1] + 1e-4], PANE.high)


def test_a_pane_that_cannot_be() -> None:
    with pytest.raises(ValueError, match="never meet panel 0"):
        Pane.seen(CAMERA, pane(75, 90))
    with pytest.raises(ValueError, match="panel 1, but this chamber has 1"):
        Pane.seen(CAMERA, pane(), 1)
    with pytest.raises(ValueError, match="margin"):
        Pane.seen(CAMERA, pane(), margin=-1)
    with pytest.raises(ValueError, match="metres"):
        Pane((-30, -20), (30, 20))
    with pytest.raises(ValueError, match="corner"):
        Pane((0.01, 0.0), (0.0, 0.01))
    with pytest.raises(ValueError, match="cells wide"):
        PANE.grid(0)


# -- sizes -------------------------------------------------------------------------------------------------------------

LAWS = [LogNormal(1e-3, 0.5, 0.5e-3, 3e-3), LogNormal(4e-3, 0.3, 2e-3, 8e-3), LogNormal(1e-4, 1.5, 5e-5, 5e-4)]


@pytest.mark.parametrize("law", LAWS)
def test_sizes_follow_their_law(law: LogNormal, rng: np.random.Generator) -> None:
    """Moments of the samples, and in closed form, against the integral of the density."""

    def density(log: float) -> float:
        return math.exp(-0.5 * ((log - math.log(law.median)) / law.spread) ** 2)

    ends = math.log(law.smallest), math.log(law.largest)
    drawn = law.sample(rng, 40_000)
    assert law.smallest <= drawn.min()
    assert drawn.max() <= law.largest
    whole = quad(density, *ends, epsabs=0)[0]
    for order in (1, 2, 3, -1):
        expected = quad(lambda v, k=order: math.exp(k * v) * density(v), *ends, epsabs=0)[0] / whole
        assert law.moment(order) == pytest.approx(expected, rel=1e-9)
        within(drawn**order, expected)
    np.testing.assert_allclose(law.quantile(np.array([0.0, 1.0])), [law.smallest, law.largest], rtol=1e-12)


def test_one_size() -> None:
    law = LogNormal(1e-3, 0.0, 1e-3, 1e-3)
    np.testing.assert_array_equal(law.sample(np.random.default_rng(0), 5), np.full(5, 1e-3))
    assert law.moment(3) == pytest.approx(1e-9)


@pytest.mark.parametrize(
    "given", [(1e-3, -1, 1e-4, 1e-2), (1e-3, 1, 2e-3, 1e-2), (1e-3, 1, 0, 1e-2), (1, 1, 1, np.inf)]
)
def test_a_size_law_that_cannot_be(given: tuple[float, float, float, float]) -> None:
    with pytest.raises(ValueError, match="smallest <= median <= largest"):
        LogNormal(*given)


# -- how many, where, how steep ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", PRESETS)
def test_the_cover_is_met(name: str) -> None:
    """Away from the border, where drops centred outside the pane are missing."""
    population = Population.preset(name)
    edge = 0.5 * population.diameter.largest
    small = Pane((-0.012, -0.009), (0.012, 0.009)) if name == "mist" else PANE
    samples = [population.sample(seed, small) for seed in range(40)]
    within(np.array([drops.cover(inner(small, edge)) for drops in samples]), population.cover)
    within(np.array([float(len(drops)) for drops in samples]), population.density() * small.area)


@pytest.mark.parametrize("cover", [0.01, 0.4])
@pytest.mark.parametrize("name", ["paper", "drops", "large"])
def test_another_cover(name: str, cover: float) -> None:
    population = PRESETS[name].with_cover(cover)
    assert population.cover == cover
    found = [population.sample(seed, PANE).cover(inner(PANE, 0.004)) for seed in range(60)]
    within(np.array(found), cover)


def test_cover_is_the_area_within_the_circles() -> None:
    """A lattice of 512 points along a side, against circles that are known; overlaps once."""
    drops = Drops(np.array([0, 0.0, 0.01]), np.zeros(3), np.array([4e-3, 3e-3, 2e-3]), np.ones(3))
    assert drops.cover(PANE) == pytest.approx(math.pi * (16 + 4) / (60 * 40), rel=5e-3)
    assert Drops.none().cover(PANE) == 0


def test_drops_lie_in_the_pane_with_angles_at_rest() -> None:
    for name, population in PRESETS.items():
        drops = population.sample(1, PANE)
        assert len(drops) > 10, name
        assert (abs(drops.x) <= 0.03).all()
        assert (abs(drops.y) <= 0.02).all()
        angles = drops.contact_angle
        assert population.hysteresis.receding <= angles.min()
        assert angles.max() <= population.hysteresis.advancing
    angles = PRESETS["drops"].sample(0, Pane((-0.1, -0.1), (0.1, 0.1))).contact_angle
    within(angles, math.radians(67.5))  # the range is symmetric about the mean


@pytest.mark.parametrize("name", PRESETS)
def test_the_seed_decides(name: str) -> None:
    np.random.seed(1)  # noqa: NPY002  that it does not matter is the point
    small = Pane((-0.01, -0.01), (0.01, 0.01))
    one = PRESETS[name].sample(7, small)
    np.random.seed(2)  # noqa: NPY002
    two = PRESETS[name].sample(np.random.default_rng(7), small)
    for column in ("x", "y", "radius", "contact_angle", "birth", "id"):
        assert getattr(one, column).tobytes() == getattr(two, column).tobytes()
    other = PRESETS[name].sample(8, small)
    assert one.x.tobytes() != other.x.tobytes()


def ripley(drops: Drops, pane: Pane, r: float) -> float:
    """Ripley's K: neighbours within r of points at least r from the border, over the density."""
    distance = squareform(pdist(np.c_[drops.x, drops.y]))
    core = inner(pane, r)
    deep = (abs(drops.x) < core.high[0]) & (abs(drops.y) < core.high[1])
    return float(((distance < r).sum(1) - 1)[deep].sum()) / max(int(deep.sum()), 1) / (len(drops) / pane.area)


def test_groups_are_a_thomas_process() -> None:
    """K(r) = pi r^2 + (1 - exp(-r^2 / 4 sigma^2)) / groups; pi r^2 without groups, less with a gap."""
    law, sigma, r = LogNormal(0.4e-3, 0.2, 0.3e-3, 0.5e-3), 1.5e-3, 2e-3
    wide = Pane((-0.04, -0.04), (0.04, 0.04))
    grouped = ScatteredPopulation(law, 0.02, clustering=Clustering(5, sigma))
    alone = ScatteredPopulation(law, 0.02)
    apart = ScatteredPopulation(law, 0.02, gap=3.0)

    def found(population: Population) -> np.ndarray:
        return np.array([ripley(population.sample(seed, wide), wide, r) for seed in range(24)])

    expected = math.pi * r**2 - math.expm1(-(r**2) / (4 * sigma**2)) / (grouped.density() / 5)
    ratio = found(grouped)
    assert abs(ratio.mean() / expected - 1) < 0.06  # the density is that of the sample, a bias of a few per cent
    assert ratio.mean() > 1.5 * math.pi * r**2
    within(found(alone), math.pi * r**2)
    assert found(apart).mean() < 0.9 * math.pi * r**2


def test_groups_cover_less_for_their_number() -> None:
    """They overlap more, so that more drops are needed; hardly any more where a group is wide."""
    law = LogNormal(1e-3, 0.5, 0.5e-3, 3e-3)
    alone = ScatteredPopulation(law, 0.2).density()
    tight = ScatteredPopulation(law, 0.2, clustering=Clustering(6, 1e-3)).density()
    wide = ScatteredPopulation(law, 0.2, clustering=Clustering(6, 0.1)).density()
    assert tight > 1.2 * alone
    assert wide == pytest.approx(alone, rel=2e-3)


@pytest.mark.parametrize("clustering", [None, Clustering(4, 3e-3)])
def test_a_gap_is_kept(clustering: Clustering | None) -> None:
    """By all pairs; the size law is kept too, since drops without room move and do not vanish."""
    population = ScatteredPopulation(LogNormal(1e-3, 0.5, 0.5e-3, 3e-3), 0.15, clustering=clustering, gap=0.2)
    drops = population.sample(4, PANE)
    distance, reach = squareform(pdist(np.c_[drops.x, drops.y])), drops.radius[:, None] + drops.radius
    np.fill_diagonal(distance, np.inf)
    assert (distance >= 1.2 * reach * (1 - 1e-12)).all()
    within(2 * drops.radius, population.diameter.moment(1))


def test_the_paper() -> None:
    """P_r is the share of the grid's places that hold a drop; sizes are those of two scales."""
    law = LogNormal(2e-3, 0.5, 0.5e-3, 8e-3)
    population = GridPopulation.of_probability(0.02, law)
    assert population.probability() == pytest.approx(0.02, rel=1e-12)
    counts = np.array([float(len(population.sample(seed, PANE))) for seed in range(60)])
    within(counts, 0.02 * 60 * 40)
    assert counts.var(ddof=1) == pytest.approx(0.02 * 0.98 * 2400, rel=0.6)
    many = population.sample(0, Pane((-0.5, -0.5), (0.5, 0.5)))
    within(4 * many.radius**2, law.moment(1) ** 2)
    # on a grid: all places are whole steps from one another
    steps = (many.x - many.x[0]) / 1e-3
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert len(GridPopulation.of_probability(0.0, law).sample(0, PANE)) == 0


def test_many_and_none() -> None:
    wide = Pane((-0.14, -0.14), (0.14, 0.14))
    assert abs(len(PRESETS["drops"].sample(0, wide)) - 8080) < 1000
    for name, population in PRESETS.items():
        dry = population.with_cover(0.0).sample(0, wide)
        assert len(dry) == 0, name
        assert dry.shapes() == []
    with pytest.raises(ValueError, match="at most 1000000"):
        PRESETS["mist"].sample(0, Pane((-5, -5), (5, 5)))


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: Population.preset("hail"), "'mist'"),
        (lambda: PRESETS["drops"].with_cover(1.0), "0 to 0.95"),
        (lambda: PRESETS["drops"].with_cover(math.nan), "0 to 0.95"),
        (lambda: PRESETS["mist"].with_cover(0.6), "at most 0.5"),
        (lambda: PRESETS["paper"].with_cover(0.95).with_cover(-1), "0 to 0.95"),
        (lambda: GridPopulation(LogNormal(1e-5, 0, 1e-5, 1e-5), 0.5, pitch=0), "pitch"),
        (lambda: GridPopulation.of_probability(1.0, LAWS[0]), "probability"),
        (lambda: ScatteredPopulation(LAWS[0], 0.1, contact_angle=(67.0, 5.0)), "radians"),
        (lambda: ScatteredPopulation(LAWS[0], 0.1, gap=-0.1), "gap"),
        (lambda: Clustering(0, 1e-3), "groups"),
        (lambda: Clustering(4, 3), "metres"),
        (
            lambda: ScatteredPopulation(LAWS[0], 0.1, clustering=Clustering(4, 1.0)).sample(0, PANE),
            "spread is in metres",
        ),
    ],
)
def test_bad_input(call, match: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=match):
        call()


# -- the table ---------------------------------------------------------------------------------------------------------


def some(count: int = 5) -> Drops:
    rng = np.random.default_rng(count)
    x, y = rng.uniform(-0.02, 0.02, (2, count))
    return Drops(x, y, rng.uniform(2e-4, 3e-3, count), rng.uniform(0.2, 1.5, count), panel=1, face="near", index=1.4)


def test_columns_become_shapes() -> None:
    drops = some()
    caps = drops.shapes()
    for i, drop in enumerate(caps):
        assert drop == SphericalCap(
            (drops.x[i], drops.y[i]), drops.radius[i], drops.contact_angle[i], panel=1, face="near", index=1.4
        )
        assert drops.volume[i] == pytest.approx(cap_volume(drops.radius[i], drops.contact_angle[i]), rel=1e-14)
        assert drops.top[i] == pytest.approx(drop.top, rel=1e-14)
    small = Drops(np.zeros(2), np.zeros(2), np.array([2e-4, 1e-3]), np.full(2, 1.1))
    kinds = [type(drop) for drop in small.shapes(gravity=(0, 1, 0), bond=0.05)]
    assert kinds == [SphericalCap, YoungLaplaceDrop]


def test_tables_are_taken_apart_and_joined() -> None:
    drops = some()
    again = Drops.joined([drops.take([0, 1]), drops.take(slice(2, None)), Drops.none(1, "near", 1.4)])
    for column in ("x", "y", "radius", "contact_angle", "birth", "id"):
        np.testing.assert_array_equal(getattr(again, column), getattr(drops, column))
        assert not getattr(again, column).flags.writeable
    assert list(drops.take(drops.id > 2).id) == [3, 4]
    with pytest.raises(ValueError, match="one panel, face"):
        Drops.joined([drops, Drops.none()])
    with pytest.raises(ValueError, match="no tables"):
        Drops.joined([])


def test_a_table_does_not_change_what_it_was_made_from() -> None:
    x = np.zeros(3)
    drops = Drops(x, np.zeros(3), np.full(3, 1e-3), np.ones(3), birth=2.5)
    x[0] = 1.0
    assert drops.x[0] == 0
    np.testing.assert_array_equal(drops.birth, [2.5] * 3)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"radius": np.array([1e-3, 1.0])}, r"radius of drop 1 is 1.*metres \(1 mm"),
        ({"radius": np.array([-1e-3, 1e-3])}, "radius of drop 0"),
        ({"radius": np.array([1e-3, np.nan])}, "column radius of 2 drops"),
        ({"contact_angle": np.array([0.0, 1.0])}, "contact_angle of drop 0"),
        ({"contact_angle": np.array([60.0, 1.0])}, "radians"),
        ({"x": np.array([0.0, 12.0])}, "x of drop 1"),
        ({"y": np.zeros(3)}, "column y of 2 drops"),
        ({"face": "top"}, "face 'top'"),
        ({"index": 0.0}, "refractive index"),
        ({"birth": np.zeros(1)}, "column birth"),
    ],
)
def test_bad_tables(change: dict[str, object], match: str) -> None:
    columns: dict[str, object] = {
        "x": np.zeros(2), "y": np.zeros(2), "radius": np.full(2, 1e-3), "contact_angle": np.ones(2),
    }  # fmt: skip
    with pytest.raises(ValueError, match=match):
        Drops(**(columns | change))  # type: ignore[arg-type]


# -- contacts ----------------------------------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 80), st.integers(0, 2**32 - 1))
def test_touching_circles_by_all_pairs(count: int, seed: int) -> None:
    """Sizes over three decades; all pairs, and those in which some take part."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, 1, (2, count))
    radius = 10 ** rng.uniform(-3, -0.5, count)
    chosen = rng.random(count) < 0.3
    meets = np.hypot(x[:, None] - x, y[:, None] - y) < radius[:, None] + radius
    every = {(int(i), int(j)) for i, j in np.argwhere(np.triu(meets, 1))}
    for of, expected in ((None, every), (chosen, {(i, j) for i, j in every if chosen[i] or chosen[j]})):
        i, j = touching(x, y, radius, of)
        found = [(min(pair), max(pair)) for pair in zip(i.tolist(), j.tolist(), strict=True)]
        assert len(found) == len(set(found))
        assert set(found) == expected
    labels = clusters(count, *touching(x, y, radius))
    reach = np.linalg.matrix_power((meets | np.eye(count, dtype=bool)).astype(float), 1) > 0
    for _ in range(7):  # paths of up to 128 steps
        reach = (reach.astype(int) @ reach.astype(int)) > 0
    np.testing.assert_array_equal(labels[:, None] == labels, reach)


def test_a_camera_of_another_size() -> None:
    """Half the field of view sees half the pane."""
    narrow = Pane.seen(Camera.pinhole(1200, 1200, 319.5, 239.5, 640, 480), Chamber((0, 0, 1), 0.06, (Panel(0.0, 1.5),)))
    assert narrow.size == pytest.approx((0.06 * 640 / 1200, 0.06 * 480 / 1200))
