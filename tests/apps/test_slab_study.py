"""The Monte Carlo study of calibrations through panels: what it draws, and what it holds errors against."""

from dataclasses import replace

import numpy as np
import pytest

from rainstereo import Camera, Rig
from rainstereo.apps import slab_images
from rainstereo.apps.rig_error import infinity_error
from rainstereo.apps.slab_study import COARSE, Capture, Setting, infinity_bound, one, outcomes
from rainstereo.calib import contributions

pytest.importorskip("mrcal")


@pytest.fixture(scope="module")
def capture() -> Capture:
    return Capture.of(Setting("known", 15, 10, board=COARSE), 3)


def test_bound_at_infinity_is_what_rigs_drawn_from_the_covariance_err_by(capture: Capture) -> None:
    solution = capture.calibrated(1, 0)
    cov = contributions.contributions(solution).total
    rng, layout, rig = np.random.default_rng(5), cov.layout, solution.rig
    sd = np.sqrt(np.diag(cov.matrix))
    w, U = np.linalg.eigh(cov.matrix / np.outer(sd, sd))
    root = sd[:, None] * U * np.sqrt(np.maximum(w, 0))
    squares = []
    for _ in range(200):
        step = 0.1 * root @ rng.standard_normal(layout.size)  # small, so that directions move linearly
        dry, wet = (
            Camera(camera.model, camera.intrinsics + step[span], *camera.size)
            for camera, span in zip((rig.dry, rig.wet), layout.intrinsics, strict=True)
        )
        drawn = Rig(dry, wet.with_pose(rig.rt_wet_dry + step[layout.extrinsics]), None)
        squares.append(infinity_error(drawn, rig) ** 2)
    assert infinity_bound(solution, cov) == pytest.approx(10 * np.sqrt(np.mean(squares)), rel=0.12)


def test_a_run_with_its_errors_turned_errs_the_other_way(capture: Capture) -> None:
    there, back = (capture.drawn(1, 2, sign) for sign in (1.0, -1.0))
    np.testing.assert_allclose((there.dry + back.dry) / 2, capture.exact[0], atol=1e-12)
    found = outcomes(capture, 2, 1)
    depth = found.errors["depth at 2 m, mm"]
    assert np.abs(depth + found.mirrored["depth at 2 m, mm"]).max() < 0.2 * np.abs(depth).max()
    assert abs(found.bias("depth at 2 m, mm")) < 0.1 * found.scatter("depth at 2 m, mm")
    again = one(capture, 1, 1)
    assert again.told["depth at 2 m, mm"][0] == depth[1]


def test_descriptions_are_drawn_anew_in_each_run_and_exact_where_asked(capture: Capture) -> None:
    first, second = (capture.sought(1, run) for run in range(2))
    assert first != second
    exact = replace(capture, setting=replace(capture.setting, mode="exact")).sought(1, 0)
    assert exact is not None
    assert capture.truth.chamber is not None
    assert replace(exact, uncertainty=None) == replace(capture.truth.chamber, uncertainty=None)  # type: ignore[type-var]
    with pytest.raises(ValueError, match="mode 'guessed' was given"):
        Capture.of(Setting("guessed", 15, 10), 0)


def test_corners_found_from_the_other_end_are_put_in_order() -> None:
    exact = np.random.default_rng(0).uniform(0, 100, (4, 5, 2))
    for found in (exact + 0.01, exact[::-1, ::-1] + 0.01):
        np.testing.assert_allclose(slab_images._ordered(found, exact), exact, atol=0.02)


@pytest.mark.slow
def test_corners_from_pictures_err_little_and_calibrate() -> None:
    sharp, noisy = slab_images.capture_of(Setting("known", 15, 8, board=COARSE), (1.0, 14.0), 0)
    assert sharp.found == noisy.found == 1
    assert sharp.corner_px < 0.03
    assert 2 * sharp.corner_px < noisy.corner_px < 0.2
    assert sharp.run.infinity_px < 0.15
    assert noisy.run.infinity_px < 2.5 * noisy.run.bound_px
