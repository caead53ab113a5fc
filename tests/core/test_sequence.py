"""Rain on frame after frame: the same bits as frame by frame, and what does not change is traced once."""

import math
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage import data

from rainstereo import Camera, Chamber, Panel
from rainstereo.droplet import Drop, SphericalCap
from rainstereo.height_map import HeightMap
from rainstereo.rain import minified
from rainstereo.rain.drops import Drops
from rainstereo.rain.motion import Motion
from rainstereo.rain.pane import Pane
from rainstereo.rain.render import Plan, Renderer
from rainstereo.rain.sequence import MOST_GENERATIONS, TrailShapes
from rainstereo.thin_lens import ThinLens

CAMERA = Camera.pinhole(800, 800, 199.5, 149.5, 400, 300)
PANE = Chamber((0, 0, 1), 0.057, (Panel(0.003, 1.49),))
TWO = Chamber((0.05, 0.1, 0.99), 0.05, (Panel(0.003, 1.49), Panel(0.002, 1.6)), (0.01,))
FIELDS = ("image", "drop_mask", "opacity", "displacement", "unknown")


def photograph() -> np.ndarray:
    return np.asarray(cv2.resize(data.astronaut(), (400, 300), interpolation=cv2.INTER_AREA))


def assert_same(one: Plan, other: Plan) -> None:
    image = photograph()
    a, b = one.render(image), other.render(image)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def scattered(seed: int, count: int, chamber: Chamber = PANE) -> list[Drop]:
    """Caps of many sizes, on all faces of the chamber in turn."""
    rng = np.random.default_rng(seed)
    faces = [(panel, face) for panel in range(len(chamber.panels)) for face in ("near", "far")]
    return [
        SphericalCap(
            (rng.uniform(-0.014, 0.014), rng.uniform(-0.01, 0.01)), rng.uniform(2e-4, 1.2e-3), rng.uniform(0.2, 1.2),
            panel=faces[i % len(faces)][0], face=faces[i % len(faces)][1], index=(1.333, 1.36)[i % 5 == 0],
        )
        for i in range(count)
    ]  # fmt: skip


def moved(drop: Drop, down: float) -> Drop:
    return replace(drop, centre=(drop.centre[0], drop.centre[1] + down))


@pytest.mark.parametrize("tolerance", [1.0, 8.0, math.inf])
@pytest.mark.parametrize("chamber", [PANE, TWO], ids=["pane", "two panels"])
def test_as_frame_by_frame(chamber, tolerance):
    renderer = Renderer(CAMERA, chamber, 20.0, tolerance=tolerance)
    sequence, drops = renderer.sequence(), scattered(3, 24, chamber)
    for frame in range(6):
        drops = [moved(drop, 2e-4) if i % 4 == 0 else drop for i, drop in enumerate(drops)]
        if frame == 3:
            drops = drops[2:]
        assert_same(sequence.plan(drops), renderer.plan(drops))


@pytest.fixture
def traced(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many drops each plan traces."""
    counts: list[int] = []
    original = minified.Minifier.lookups

    def counted(self, batches):  # type: ignore[no-untyped-def]
        counts.append(sum(len(batch.drops) for batch in batches))
        return original(self, batches)

    monkeypatch.setattr(minified.Minifier, "lookups", counted)
    return counts


def test_what_stands_still_is_traced_once(traced):
    far_apart = [SphericalCap((x / 1000, 0.0), 1e-3, 0.7) for x in (-12, -8, -4, 0, 4, 8)]
    sequence = Renderer(CAMERA, PANE, tolerance=4).sequence()
    first = sequence.plan(far_apart)
    assert traced == [6]
    assert sequence.plan(list(far_apart)) is first
    for _ in range(7):
        far_apart[2] = moved(far_apart[2], 3e-4)
        sequence.plan(far_apart)
    assert traced == [6] + [1] * 7
    sequence.plan([*far_apart[:3], *far_apart[4:]])
    assert traced == [6] + [1] * 7  # one fewer, nothing new


def test_shapes_that_are_the_very_same(traced):
    """A height map is known again by being the same object; an equal one is traced, to the same bits."""
    cap = SphericalCap((0.002, 0.001), 1e-3, 0.6)
    body, lone = HeightMap.of(cap, nodes=33), SphericalCap((-0.006, 0.0), 1e-3, 0.7)
    sequence = Renderer(CAMERA, PANE, tolerance=4).sequence()
    sequence.plan([body, lone])
    after = sequence.plan([body, moved(lone, 1e-4)])
    again = sequence.plan([HeightMap.of(cap, nodes=33), moved(lone, 1e-4)])
    assert traced == [2, 1, 1]
    assert_same(again, after)


def test_blurred_layers_are_kept():
    renderer = Renderer(CAMERA, TWO, 20.0, lens=ThinLens(0.0045, 4.0))
    drops = scattered(5, 12, TWO)
    sequence = renderer.sequence()
    first = sequence.plan(drops)
    assert len(first.layers) >= 2
    drops = [moved(drop, 1e-4) if drop.panel == 0 else drop for drop in drops]
    second = sequence.plan(drops)
    kept = [layer for layer in second.layers if any(layer is one for one in first.layers)]
    assert kept
    assert {drop.panel for layer in kept for drop in layer.drops} == {1}
    assert_same(second, renderer.plan(drops))


def running() -> Motion:
    rng = np.random.default_rng(8)
    large = Drops(np.array([-0.006, 0.003]), np.array([-0.008, -0.006]), np.full(2, 3.2e-3), np.full(2, 1.1))
    small = Drops(
        rng.uniform(-0.013, 0.013, 40), rng.uniform(-0.01, 0.01, 40), rng.uniform(2e-4, 6e-4, 40), np.full(40, 0.9)
    )
    both = Drops.joined([large, small])
    drops = replace(both, id=np.arange(len(both)))
    return Motion.physical(drops, Pane.seen(CAMERA, PANE, margin=0.004), seed=4)


def test_motion():
    """Drops that run, their trails and bodies: the frames are those of a fresh start, and not all is traced again."""
    renderer = Renderer(CAMERA, PANE, 20.0, tolerance=8)
    sequence, image = renderer.sequence(running()), photograph()
    frames = [sequence.at(time).apply(image) for time in (0.0, 0.1, 0.2, 0.3)]
    assert any((a != b).any() for a, b in pairwise(frames))
    late = renderer.sequence(running()).at(0.3)
    np.testing.assert_array_equal(late.apply(image), frames[-1])
    assert_same(late, renderer.plan(late.drops))


def test_trails_that_rest_stay_the_same_shapes():
    """Those of a trail that has not changed are the very same, others are made anew; one frame's are kept."""
    state, shapes = running().at(0.2), TrailShapes()
    assert len(state.trails) >= 2
    wider = replace(state.trails[0], half_width=1.01 * state.trails[0].half_width)
    changed = replace(state, trails=(wider, *state.trails[1:]))
    before, after = shapes.of(state), shapes.of(changed)
    fresh = [list(trail.streak(**state.drops.place).pieces()) for trail in changed.trails]
    assert len({id(piece) for piece in after} & {id(piece) for piece in before}) == sum(map(len, fresh[1:])) > 0
    assert [(piece.centre, piece.reach, piece.volume) for piece in after] == [
        (piece.centre, piece.reach, piece.volume) for pieces in fresh for piece in pieces
    ]
    assert all(a is b for a, b in zip(after, shapes.of(changed), strict=True))
    shapes.of(replace(state, trails=()))
    assert not {id(piece) for piece in after} & {id(piece) for piece in shapes.of(changed)}


def test_without_motion_there_are_no_times():
    with pytest.raises(ValueError, match="no motion"):
        Renderer(CAMERA, PANE).sequence().at(0.0)


@settings(max_examples=15, deadline=None)
@given(st.lists(st.lists(st.integers(0, 11), max_size=8, unique=True), min_size=2, max_size=5))
def test_drops_may_come_and_go(frames):
    drops = scattered(11, 12)
    renderer = Renderer(CAMERA, PANE, 20.0, tolerance=16)
    sequence, image = renderer.sequence(), photograph()
    for frame in frames:
        shown = [drops[i] for i in frame]
        np.testing.assert_array_equal(sequence.plan(shown).apply(image), renderer.plan(shown).apply(image))


def test_caps_and_other_shapes_for_moving_drops() -> None:
    """Some are traced as they are drawn, and some by looks: frame after frame the same bits as each by itself."""
    renderer = Renderer(CAMERA, PANE, moving=True)
    sequence, drops = renderer.sequence(), list[Drop]()
    for number in range(MOST_GENERATIONS + 4):
        cap = SphericalCap((-0.01 + 0.0028 * number, 1e-3 * (-1) ** number), 1e-3, 0.5 + 0.02 * number)
        drops.append(HeightMap.of(cap, nodes=33) if number > 1 and number % 2 else cap)
        found = sequence.plan(drops)
        assert len({type(table) for table in found.tables}) == (2 if number > 2 else 1)
        assert_same(found, renderer.plan(drops))


def test_a_plan_that_is_kept_is_drawn_as_before() -> None:
    """What it has for drawing is given up for the next one's sake, and made anew if it is needed."""
    sequence, drops, image = Renderer(CAMERA, PANE).sequence(), scattered(6, 6), photograph()
    kept = sequence.plan(drops)
    frame = kept.apply(image)
    sequence.plan([moved(drops[0], 2e-4), *drops[1:]]).apply(image)
    assert "_paste_all" not in vars(kept)
    np.testing.assert_array_equal(kept.apply(image), frame)


def test_a_plan_that_failed_costs_no_drop(monkeypatch: pytest.MonkeyPatch) -> None:
    renderer, drops, image = Renderer(CAMERA, PANE), scattered(6, 6), photograph()
    sequence = renderer.sequence()
    sequence.plan(drops)
    other = [moved(drops[0], 2e-4), *drops[1:]]
    with monkeypatch.context() as patch:

        def out_of_memory(*_: object) -> None:
            raise MemoryError

        patch.setattr(Renderer, "lookups", out_of_memory)
        with pytest.raises(MemoryError):
            sequence.plan(other)
    for some in (other, drops):
        np.testing.assert_array_equal(sequence.plan(some).apply(image), renderer.plan(some).apply(image))
