"""What a capture lacks is named, and only that."""

import numpy as np
import pytest

pytest.importorskip("mrcal", reason="mrcal is not installed")

from rainstereo import pose
from rainstereo.calib import missing_views
from rainstereo.calib.solve import Solution, solve
from rainstereo.types import Array

from . import synthetic


def placed(leans_deg: list[tuple[float, float]], depths: list[float], at: tuple[float, float] = (0.0, 0.0)) -> Array:
    middle = synthetic.BOARD.points.reshape(-1, 3).mean(0)
    rt = []
    for depth in depths:
        for x, y in leans_deg:
            r = np.deg2rad([x, y, 5.0])
            centre = np.array([*at, 1.0]) * depth
            rt.append(np.concatenate([r, centre - pose.rotation_matrix(r) @ middle]))
    return np.array(rt)


def solved(rt: Array) -> Solution:
    return solve(synthetic.observe(synthetic.rig(), rt, noise=0.05), "LENSMODEL_OPENCV4")


ALL = [(30.0, 0.0), (-30.0, 0.0), (0.0, 30.0), (0.0, -30.0)]


def test_a_good_capture_lacks_nothing() -> None:
    found = solve(synthetic.observe(synthetic.rig(), synthetic.poses(16, 1), noise=0.05), "LENSMODEL_OPENCV4")
    assert missing_views.leans(found) == []
    assert missing_views.distances(found) == []
    assert not any("middle" in words for words in missing_views.places(found))


@pytest.mark.parametrize(
    ("missing", "side"),
    [((30.0, 0.0), "top"), ((-30.0, 0.0), "bottom"), ((0.0, 30.0), "right"), ((0.0, -30.0), "left")],
)
def test_the_lean_that_is_missing_is_named(missing: tuple[float, float], side: str) -> None:
    others = [lean for lean in ALL if lean != missing]
    found = solved(placed(others, [0.3, 0.6]))
    (words,) = missing_views.leans(found)
    assert f"its {side} side nearer" in words
    # second formulation: that side is nearer to the camera in a board that leans so
    board = synthetic.BOARD.points
    seen = pose.transform(placed([missing], [0.5])[0], board)
    edge = {"top": seen[0], "bottom": seen[-1], "left": seen[:, 0], "right": seen[:, -1]}
    assert edge[side][:, 2].mean() == min(e[:, 2].mean() for e in edge.values())


def test_distances_and_places() -> None:
    far = solved(placed(ALL, [0.6, 0.7]))
    words = " ".join(missing_views.distances(far))
    assert "nearest board was 0.6" in words
    assert "all boards were" in words
    one_side = solved(placed(ALL, [0.3, 0.5], at=(-0.25, -0.1)))
    (dry, wet) = missing_views.places(one_side)
    assert "right edge" in dry
    assert "bottom right corner" in dry
    assert "wet camera" in wet
