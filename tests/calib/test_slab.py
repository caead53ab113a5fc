"""A slab's parameters: derivatives against differences, the wedge against a ray traced through its two faces."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo import Chamber, Panel
from rainstereo.calib import slab as slabs
from rainstereo.calib.slab import Slab
from rainstereo.chamber import ChamberUncertainty

CENTRE = np.array([-0.029, 0.001, 0.002])


def chamber(pitch_deg: float = 15.0, yaw_deg: float = 4.0, **changes: object) -> Chamber:
    pitch, yaw = np.deg2rad([pitch_deg, yaw_deg])
    normal = (np.sin(yaw), np.sin(pitch) * np.cos(yaw), np.cos(pitch) * np.cos(yaw))
    made = Chamber(normal, 0.04, (Panel(0.004, 1.49), Panel(0.003, 1.52), Panel(0.005, 1.49)), (0.01, 0.02))
    return replace(made, **changes)  # type: ignore[arg-type]


def points(count: int = 60, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    depth = np.exp(rng.uniform(np.log(0.15), np.log(5), (count, 1)))
    return np.concatenate([rng.uniform(-0.5, 0.5, (count, 2)), np.ones((count, 1))], -1) * depth


def snell(direction: np.ndarray, normal: np.ndarray, ratio: float) -> np.ndarray:
    """Direction behind a face; ratio: index before over index behind."""
    c = direction @ normal
    return ratio * direction + (np.sqrt(1 - ratio**2 * (1 - c**2)) - ratio * c) * normal


def traced(d: np.ndarray, faces: list[tuple[np.ndarray, float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Where a ray from the origin leaves the last face (normal, distance, index behind it), and which way."""
    at, index = np.zeros(3), 1.0
    for normal, distance, behind in faces:
        at = at + (distance - at @ normal) / (d @ normal) * d
        d, index = snell(d, normal, index / behind), behind
    return at, d


@pytest.mark.parametrize("pitch_deg", [0, 15, 60])
@pytest.mark.parametrize("wedge", [(0.0, 0.0), (4e-3, -2e-3)])
def test_derivatives_match_differences(pitch_deg: float, wedge: tuple[float, float]) -> None:
    start = Slab(chamber(pitch_deg), slabs.KINDS)
    start = start.moved(np.concatenate([np.zeros(6), wedge]))
    P = points()
    P = P[P @ np.array(start.chamber.normal) > start.chamber.depth + 0.01] - CENTRE
    at = slabs.view(start, P, CENTRE)
    np.testing.assert_allclose(at.seen, slabs.apparent(start, P, CENTRE)[0], atol=1e-15)
    assert len(P) > 20
    for k in range(8):
        h = 1e-5 if k not in (2, 3) else 1e-6
        ends = [slabs.apparent(start.moved(s * h * np.eye(8)[k]), P, CENTRE)[0] for s in (1, -1)]
        np.testing.assert_allclose(at.parameters[..., k], (ends[0] - ends[1]) / (2 * h), atol=2e-8, rtol=1e-6)
    for k, h in enumerate(1e-6 * np.eye(3)):
        ends = [slabs.apparent(start, P + s * h, CENTRE)[0] for s in (1, -1)]
        np.testing.assert_allclose(at.point[..., k], (ends[0] - ends[1]) / 2e-6, atol=1e-8)
        ends = [slabs.apparent(start, P, CENTRE + s * 1e3 * h)[0] for s in (1, -1)]
        np.testing.assert_allclose(at.centre[..., k], (ends[0] - ends[1]) / 2e-3, atol=1e-8)


@settings(max_examples=40, deadline=None)
@given(
    st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)),
    st.tuples(st.floats(-1e-3, 1e-3), st.floats(-1e-3, 1e-3)),
    st.floats(0, 45),
)
def test_a_wedge_turns_rays_as_snell_has_it_at_two_faces(
    slope: tuple[float, float], wedge: tuple[float, float], pitch_deg: float
) -> None:
    """A point on the traced ray seems to lie where the ray set out to, to second order in the wedge."""
    inside = chamber(pitch_deg, panels=(Panel(0.004, 1.49),), gaps=())
    n = np.array(inside.normal)
    W = slabs.across(n) @ wedge
    d = np.array([*slope, 1.0]) / np.linalg.norm([*slope, 1.0])
    back = (n + W) / np.linalg.norm(n + W)
    foot = n * 0.044  # where the far face crosses the normal through the camera
    at, out = traced(d, [(n, 0.04, 1.49), (back, float(back @ foot), 1.0)])
    for far in (0.1, 1.0, 30.0):
        P = at + far * out
        seen, _ = slabs.apparent(Slab(inside, wedge=tuple(W)), P[None], np.zeros(3))
        plain, _ = slabs.apparent(Slab(inside), P[None], np.zeros(3))
        turned, before = (np.linalg.norm(np.cross(x[0] / np.linalg.norm(x[0]), d)) for x in (seen, plain))
        # what is left: that the panel is thicker here than on the normal, and second order
        thicker = float(np.linalg.norm(W)) * 0.06 / far
        assert turned <= 3e-6 + 3 * float(np.linalg.norm(W)) ** 2 + 0.35 * thicker
        if np.linalg.norm(W) > 3e-4 and far >= 1.0:
            assert turned < 0.2 * before


def test_a_step_and_its_way_back() -> None:
    start = Slab(chamber(), slabs.KINDS, (1e-4, 0, 0))
    start = start.moved(np.zeros(8))  # the wedge across the normal
    step = np.array([0.01, -0.02, 1e-4, -2e-4, 0.002, 0.001, 3e-4, -1e-4])
    there = start.moved(step)
    assert abs(np.dot(there.wedge, there.chamber.normal)) < 1e-15
    angle = np.arccos(np.dot(start.chamber.normal, there.chamber.normal))
    assert angle == pytest.approx(np.hypot(0.01, 0.02), rel=1e-9)
    assert there.thickness(0) - start.thickness(0) == pytest.approx(1e-4)
    assert there.chamber.panels[0].index == there.chamber.panels[2].index == pytest.approx(1.492)
    still = start.moved(np.zeros(8))
    assert still.chamber == start.chamber
    assert still.wedge == pytest.approx(start.wedge, abs=1e-18)


def test_pitch_lowers_the_normal_and_yaw_moves_it_right() -> None:
    for axis in (0, 1):
        slab = Slab(chamber(0, 0), ("tilt",))
        moved = slab.moved(np.deg2rad(2) * np.eye(2)[axis])
        np.testing.assert_allclose(np.rad2deg(moved.values), 2 * np.eye(2)[axis], atol=1e-12)


def test_a_change_of_thickness_is_shared_by_variance() -> None:
    sd = ChamberUncertainty((1e-5, 2e-5, 3e-5), 0.01, (0.0,) * 3)
    slab = Slab(chamber(uncertainty=sd), ("thickness",))
    assert slab.names == ("thickness 0", "thickness 1")
    np.testing.assert_allclose(slab.shares(), [0.1, 1.0, 0.9])
    moved = slab.moved(np.array([1e-4, 0])).chamber.panels
    assert [panel.thickness for panel in moved] == pytest.approx([0.00401, 0.003, 0.00509])
    equal = Slab(chamber(), ("thickness",)).shares()
    np.testing.assert_allclose(equal, [4 / 9, 1, 5 / 9])


def test_what_cannot_be_is_not_stepped_into() -> None:
    slab = Slab(chamber(), ("tilt", "thickness", "index"))
    thin = slab.moved(np.array([3.0, 0, -1.0, 0, -2.0, 0]))
    assert thin.thickness(0) == 0
    assert thin.chamber.panels[0].index == 1
    np.testing.assert_array_equal(thin.limited()[0], [False, False, True, False, True, False])
    assert np.arccos(np.dot(slab.chamber.normal, thin.chamber.normal)) == pytest.approx(slabs.LONGEST_TURN)
    with pytest.raises(ValueError, match="6 parameters"):
        slab.moved(np.zeros(3))
    with pytest.raises(ValueError, match=r"gap.*cannot be estimated"):
        Slab(chamber(), ("gap",))  # type: ignore[arg-type]


def test_a_medium_without_end_has_no_thickness_to_find() -> None:
    tank = Chamber((0, 0, 1), 0.04, (Panel(0.006, 1.49), Panel(np.inf, 1.333)), (0.0,))
    slab = Slab(tank, ("thickness", "index"))
    assert slab.names == ("thickness 0", "index 0", "index 1")
    moved = slab.moved(np.array([1e-4, 0, 1e-3])).chamber.panels
    assert moved[0].thickness == pytest.approx(0.0061)
    assert moved[1].thickness == np.inf
    assert moved[1].index == pytest.approx(1.334)
    at = slabs.view(slab, points(), np.zeros(3))
    assert np.isfinite(at.parameters).all()
