"""The realism sheet: measures of known shapes, and a fit to rain whose parameters are known."""

import html
import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo.apps import realism, realism_fit
from rainstereo.apps.photographs import photograph
from rainstereo.apps.rain_presets import Setup, preset
from rainstereo.apps.rain_settings import Rain
from rainstereo.apps.realism import WORDS, Comparison, findings, realism_sheet
from rainstereo.apps.realism_fit import Fit, Scene, fit
from rainstereo.apps.realism_measures import FITTED, SPECK, elongation, granulometry, look, without_specks
from rainstereo.apps.run_record import jsonable
from rainstereo.rain.appearance import WINDOW
from rainstereo.rain.population import LogNormal
from rainstereo.types import Image, Mask


def ellipse(width: float, height: float, size: int = 160) -> Mask:
    y, x = np.indices((size, size)) - (size - 1) / 2
    return (2 * x / width) ** 2 + (2 * y / height) ** 2 <= 1


@pytest.fixture(scope="module")
def clear() -> Image:
    return cv2.resize(photograph("coffee"), (480, 320), interpolation=cv2.INTER_AREA)


ADHERENT = preset("robotcar").population
BASE = replace(preset("robotcar"), focal=1.0, population=replace(ADHERENT, diameter=LogNormal(2e-3, 0.4, 0.5e-3, 6e-3)))
"""Drops of few sizes, so that chance decides little in a small image."""


def known(cover: float, f_number: float, scale: float = 1.0) -> Setup:
    """Rain whose parameters a fit must find."""
    setup = BASE
    law = setup.population.diameter
    law = replace(law, median=law.median * scale, smallest=law.smallest * scale, largest=law.largest * scale)
    return replace(setup, population=replace(setup.population, cover=cover, diameter=law), f_number=f_number)


def rainy(clear: Image, setup: Setup, seed: int) -> Image:
    """The rain on a clear image, in another exposure."""
    plan, _ = Rain(setup, seed).plan(clear, "truth")
    return np.clip(np.rint(0.85 * plan.apply(clear) + 12.0), 0, 255).astype(np.uint8)


# -- measures ----------------------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=15)
@given(st.floats(8, 120))
def test_a_disc_has_its_own_diameter(diameter: float) -> None:
    found = granulometry(ellipse(diameter, diameter))
    assert (diameter - 3.5) / 1.15 < np.median(found) < diameter + 1  # steps of 15 %, and whole pixels
    assert found.size == ellipse(diameter, diameter).sum()


def test_touching_discs_count_apart() -> None:
    alone, both = ellipse(40, 40), np.roll(ellipse(40, 40), -18, 1) | np.roll(ellipse(40, 40), 18, 1)
    assert np.median(granulometry(both)) == np.median(granulometry(alone))


def test_a_drop_that_the_image_cuts_is_not_small() -> None:
    half = ellipse(60, 60)[:, 80:]
    assert np.median(granulometry(half)) == np.median(granulometry(ellipse(60, 60)))


@settings(deadline=None, max_examples=15)
@given(st.floats(20, 120), st.floats(20, 120))
def test_elongation_is_that_of_an_ellipse(width: float, height: float) -> None:
    found = elongation(ellipse(width, height))
    assert (height - 1.5) / (width + 1.5) < found < (height + 1.5) / (width - 1.5)  # whole pixels
    assert found == pytest.approx(1 / elongation(ellipse(width, height).T), rel=1e-9)


def test_specks_go_and_pinholes_close() -> None:
    mask = ellipse(60, 60)
    spotted = mask.copy()
    spotted[80, 80] = False
    spotted[5:8, 5:8] = True
    assert 9 < math.pi / 4 * SPECK**2
    assert np.array_equal(without_specks(spotted), mask)


def test_known_drops_are_measured(rng: np.random.Generator) -> None:
    clear = rng.integers(0, 256, (300, 420)).astype(np.uint8)
    clear = cv2.GaussianBlur(clear, (0, 0), 1.0)
    wet = clear.copy()
    for x, y in ((80, 80), (220, 100), (340, 180), (130, 210)):
        cv2.ellipse(wet, (x, y), (30, 30), 0, 0, 180, 190, -1)  # the lower half
        cv2.ellipse(wet, (x, y), (30, 30), 0, 180, 360, 60, -1)
    truth = wet != clear
    found = look(wet, clear)
    assert found.cover == pytest.approx(truth.mean(), rel=0.15)
    assert (found.mask & truth).sum() > 0.85 * (found.mask | truth).sum()
    assert 40 < found.size < 66  # corners of regions hold small discs alone
    assert found.brightness == pytest.approx((wet.astype(float) - clear)[found.mask].mean(), abs=0.01)
    assert found.below == pytest.approx(130, abs=25)
    assert found.rim_up < -35
    assert found.rim_down > 35
    assert found.elongation == pytest.approx(1, abs=0.1)
    assert found.opacity == pytest.approx(1, abs=0.1)


def test_a_sharp_drop_before_something_flat_looks_wider_by_less_than_four_windows() -> None:
    clear = np.full((160, 160), 128, np.uint8)
    wet = np.where(ellipse(40, 40), np.uint8(20), clear)
    width = math.sqrt(look(wet, clear).mask.sum() * 4 / math.pi)
    assert 40 < width < 40 + 2 * 4 * WINDOW


def test_two_equal_images_show_no_drop(clear: Image) -> None:
    found = look(clear, clear)
    assert found.cover == 0
    assert math.isnan(found.size)
    assert math.isnan(found.blur)
    assert math.isnan(found.brightness)


# -- the fit -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cover", "f_number", "scale", "gain_off", "seeds"),
    [(0.2, 4.0, 1.0, 0.05, (11, 12, 13)), (0.4, 2.5, 1.4, 0.13, (11,))],
)
def test_cover_size_and_blur_of_known_rain_are_found(
    clear: Image, cover: float, f_number: float, scale: float, gain_off: float, seeds: tuple[int, ...]
) -> None:
    """Each fit draws other drops of the law, about a hundred: where these are fewest, several are compared."""
    truth = known(cover, f_number, scale)
    scene = Scene.of(rainy(clear, truth, seed=5), clear, "known")
    assert scene.shift == (0, 0)
    assert scene.exposure.gain == pytest.approx(np.full(3, 0.85), abs=gain_off)
    fits = [fit(scene, BASE, seed=seed) for seed in seeds]
    found = fits[0]
    assert max(each.worst for each in fits) < 0.15
    assert np.mean([each.f_number for each in fits]) == pytest.approx(f_number, rel=0.1)
    assert np.mean([each.scale for each in fits]) == pytest.approx(scale, rel=0.1)
    # other drops of the same law, some 100 of them: the shares that both really hide are compared
    plan, _ = Rain(truth, 5).plan(clear, "truth")
    hidden = float((plan.opacity > 0.5).mean())
    assert (found.rendered(scene, 11).opacity > 0.5).mean() == pytest.approx(hidden, rel=0.15)
    assert found.cover == pytest.approx(cover, rel=0.4)


def test_where_no_rain_is_nothing_can_be_fitted(clear: Image) -> None:
    found = fit(Scene.of(clear, clear, "dry"), preset("robotcar"), seed=0)
    assert math.isnan(found.worst)
    assert all(math.isnan(error) for error in found.error.values())


def test_a_fit_is_the_same_each_time(clear: Image, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(realism_fit, "ROUNDS", 3)
    scene = Scene.of(rainy(clear, known(0.2, 6.0), seed=1), clear, "known")
    first, second = (fit(scene, BASE, seed=3) for _ in range(2))
    assert first == second


# -- the sheet ---------------------------------------------------------------------------------------------------------


def test_a_cut_camera_looks_where_the_whole_one_does(clear: Image) -> None:
    wet, other = clear[:, :-40], clear[:, 40:]  # things lie 40 px further right in the wet image
    scene = Scene.of(np.ascontiguousarray(wet), np.ascontiguousarray(other), "shifted")
    assert scene.shift == (40, 0)
    whole, cut = preset("robotcar").camera((440, 320)), scene.camera(preset("robotcar"))
    assert cut.size == (400, 320)
    rays = whole.unproject(np.array([[100.0, 50.0]])), cut.unproject(np.array([[60.0, 50.0]]))
    assert rays[0] == pytest.approx(rays[1], abs=1e-12)


@pytest.mark.slow
def test_the_sheet_says_what_it_measured(clear: Image, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(realism, "SEEDS", 5)
    wet = rainy(clear, known(0.3, 4.0), seed=2)
    before = wet.copy()
    numbers = realism_sheet([(wet, clear)], ["a <pair>"], known(0.3, 4.0), 4, tmp_path)
    assert np.array_equal(wet, before)
    json.dumps(jsonable(numbers), allow_nan=False)
    page = (tmp_path / "realism.html").read_text()
    assert "a &lt;pair&gt;" in page
    assert "No claim beyond what is shown." in page
    (pair,) = numbers["pairs"]
    assert set(pair["real"]) == set(pair["ours"]) == set(WORDS)
    assert not set(pair["real_outside_ours"]) & set(FITTED)
    # real and ours are of one law here: chance alone leaves 2 of 6 measures outside
    assert len(pair["real_outside_ours"]) <= 4
    assert len(numbers["findings"]) == len(pair["real_outside_ours"])
    assert all(html.escape(line) in page for line in numbers["findings"])
    low, middle, high = pair["displacement_px_10_50_90"]
    assert 0 <= low < middle < high


def test_what_is_darker_is_called_darker(clear: Image) -> None:
    setup = known(0.3, 4.0)
    scene = Scene.of(rainy(clear, setup, seed=2), clear, "pair")
    fitted = Fit(setup, 0.3, 1.0, 4.0, dict.fromkeys(FITTED, 0.0), 1)
    ours = [replace(scene.look, brightness=b, opacity=b / 10) for b in (1.0, 3.0, 2.0)]
    object.__setattr__(scene, "look", replace(scene.look, brightness=0.5, opacity=0.3, elongation=math.nan))
    compared = Comparison(scene, fitted, fitted.rendered(scene, 2), tuple(ours))
    assert compared.range_of("brightness") == (1.0, 3.0)
    assert compared.differences == {"brightness": -1}
    (line,) = findings([compared])
    assert line.startswith("Real drops are darker than ours in 1 of 1 pairs")
    assert line.endswith("0.500 against 1.00 to 3.00).")


def test_pairs_need_names(clear: Image, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="1 pairs and 0 names"):
        realism_sheet([(clear, clear)], [], "robotcar", 0, tmp_path)


@pytest.mark.slow
def test_the_rigs_own_photographs(shared_data: Path) -> None:
    folder = shared_data / "raindrop" / "robotcar_rainy"
    if not folder.is_dir():
        pytest.skip("the rig's photographs are not beside this checkout")
    for left in sorted(folder.glob("left_*.png")):
        wet, clear = (cv2.imread(str(p)) for p in (left, left.with_name(left.name.replace("left", "right"))))
        scene = Scene.of(wet, clear, left.stem)
        assert scene.shift[0] == pytest.approx(143, abs=4)
        assert scene.shift[1] == 0
        assert 0.3 < scene.look.cover < 0.55
        assert fit(scene, preset("robotcar"), 0).worst < 0.1
