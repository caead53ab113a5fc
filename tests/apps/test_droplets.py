"""`rainstereo droplets`: its verdict, maps and checks against calls made here, and what it says of bad input."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rainstereo import Chamber, Panel, Rig, fermat
from rainstereo.apps import droplet_verdict, droplets
from rainstereo.apps.cli import main
from rainstereo.apps.digital_rig import RigOptions, digital_rig
from rainstereo.apps.droplet_bench import Bench, fitted, grid, look_up
from rainstereo.apps.droplet_checks import checks
from rainstereo.apps.droplet_pictures import gain_for, rim, signed
from rainstereo.apps.droplet_verdict import Answer, Verdict, choice_for, words
from rainstereo.apps.droplets import Options, set_up
from rainstereo.apps.regime_maps import Sweep, errors, misuses, regime_map, steepest
from rainstereo.droplet import SphericalCap
from rainstereo.fidelity import choose_tier, displacement_error
from rainstereo.scene_statistics import SceneStatistics
from rainstereo.thin_lens import ThinLens
from rainstereo.tiers import Method, Tier, tracer
from rainstereo.trace import Fate, trace

SLOPES, BAKED, EXACT = Tier(Method.SLOPES), Tier(Method.BAKED, 32), Tier(Method.EXACT)


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rig") / "rig"
    digital_rig(RigOptions(width=320, height=240, fx=300, panels=1, lens="LENSMODEL_PINHOLE")).save(folder)
    return folder


@pytest.fixture(scope="module")
def photograph(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("scene") / "scene.png"
    rng = np.random.default_rng(5)
    coarse = rng.integers(0, 255, (24, 32, 3), dtype=np.uint8)
    cv2.imwrite(str(file), cv2.resize(coarse, (640, 480), interpolation=cv2.INTER_CUBIC))
    return file


@pytest.fixture(scope="module")
def report(rig: Path, photograph: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """The command, run once from end to end on a small rig."""
    out = tmp_path_factory.mktemp("out")
    arguments = ["--rig", str(rig), "--image", str(photograph), "--radius-mm", "1.5", "--quick"]
    assert main(["droplets", "--out", str(out), "--pictures", str(out / "pictures"), *arguments]) == 0
    return json.loads((out / "report.json").read_text()), out


@pytest.fixture(scope="module")
def reference(photograph: Path) -> tuple[Bench, SphericalCap]:
    """The reference set-up with the default drop."""
    return set_up(Options(Path("unused"), image=photograph))


# -- the command -------------------------------------------------------------------------------------------------------


def test_it_writes_a_page_numbers_and_pictures(report: tuple[dict[str, Any], Path]) -> None:
    numbers, out = report
    assert numbers["status"] == "ok"
    page = (out / "report.html").read_text()
    assert numbers["verdict"]["sentence"].startswith("Your rig needs ")
    assert numbers["verdict"]["sentence"] in page
    assert page.count("<svg") == 9
    assert len(list((out / "pictures").iterdir())) == 10
    assert all(check["passed"] for check in numbers["checks"])


def test_its_choices_are_those_of_choose_tier(report: tuple[dict[str, Any], Path], rig: Path, photograph: Path) -> None:
    numbers, _ = report
    loaded = Rig.load(rig)
    chamber = loaded.chamber_in("wet")
    assert chamber is not None
    bench, _ = set_up(Options(Path("unused"), rig=rig, image=photograph))
    answers = [a for a in numbers["verdict"]["answers"] if a["unit"] == "pixels"]
    assert {(a["radius_mm"], a["angle_deg"], a["field"]) for a in answers} >= {(0.25, 20, 0), (4, 80, 1)}
    for answer in answers[::5]:
        drop = SphericalCap(bench.place(answer["field"]), answer["radius_mm"] / 1000, math.radians(answer["angle_deg"]))
        choice = choose_tier(drop, loaded.wet, chamber, 20.0, 1.0, unit="pixels")
        assert answer["tier"] == choice.tier.name
        assert answer["met"] == choice.met
        assert answer["error"] == pytest.approx(choice.bound.pixels)


def test_the_sentence_names_the_dearest_tier_that_is_needed(report: tuple[dict[str, Any], Path]) -> None:
    numbers, _ = report
    answers = [a for a in numbers["verdict"]["answers"] if a["unit"] == "pixels"]
    dearest = max(answers, key=lambda a: a["cost"])["tier"]
    assert dearest == "exact"
    assert "exact tracing" in numbers["verdict"]["sentence"]
    steep = f"{numbers['verdict']['slope_texture_to_deg']:.2g} degrees"
    assert steep in numbers["verdict"]["sentence"]


def test_the_numbers_of_the_page_are_measured(report: tuple[dict[str, Any], Path], rig: Path, photograph: Path) -> None:
    numbers, _ = report
    bench, drop = set_up(Options(Path("unused"), rig=rig, image=photograph, radius_mm=1.5))
    exact = tracer(EXACT, drop, bench.camera, bench.chamber, 20.0)
    look = tracer(SLOPES, drop, bench.camera, bench.chamber, 20.0)
    expected, _ = displacement_error(bench.lattice(drop, 24), look, exact, bench.camera)
    shown = {tier["tier"]: tier for tier in numbers["tiers_sharp"]}
    assert shown["slope texture"]["rms_px"] == pytest.approx(expected)
    assert shown["exact"]["rms_px"] == 0
    assert shown["exact, 4 x 4"]["rms_gray"] < shown["exact, 2 x 2"]["rms_gray"] < shown["exact"]["rms_gray"]
    radius = next(m for m in numbers["regime_maps"] if m["varied"] == "radius")
    row, column = radius["contact_angles_deg"].index(60), radius["values"].index(1)
    smaller = replace(drop, radius=1e-3)
    assert radius["error_px"][1][row][column] == pytest.approx(errors(bench, smaller, (SLOPES,))[0][0])
    times = {t["tier"]: t for t in numbers["time_against_error"]}
    assert all(t["us_per_pixel"] > 0 for t in times.values())
    assert times["defocused layer"]["us_per_pixel"] < times["64 aperture samples"]["us_per_pixel"]  # by far


def test_a_broken_tracer_is_not_trusted(
    rig: Path, photograph: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def wrong_index(pixels: Any, drop: Any, *rest: Any, **more: Any) -> Any:
        return trace(pixels, replace(drop, index=1.34), *rest, **more)

    monkeypatch.setattr(fermat, "trace", wrong_index)
    monkeypatch.setattr(
        droplet_verdict, "_questions", lambda bench, quick: [(u, 1.0, 50.0, 0.0) for u in ("pixels", "gray")]
    )
    monkeypatch.setattr(droplets, "sweeps", lambda bench, quick: [Sweep("radius", "mm", (1.0, 2.0))])
    arguments = ["--rig", str(rig), "--image", str(photograph), "--quick", "--f-number", "inf"]
    assert main(["droplets", "--out", str(tmp_path), *arguments]) == 1
    numbers = json.loads((tmp_path / "report.json").read_text())
    assert numbers["status"] == "failed"
    assert [check["name"] for check in numbers["checks"] if not check["passed"]] == ["fermat"]
    assert "1 of 7 self-checks failed" in capsys.readouterr().out
    assert 'class="verdict bad"' in (tmp_path / "report.html").read_text()


@pytest.mark.slow
def test_the_reference_set_up_in_full(tmp_path: Path) -> None:
    assert main(["droplets", "--out", str(tmp_path)]) == 0
    numbers = json.loads((tmp_path / "report.json").read_text())
    assert numbers["verdict"]["sentence"].startswith("The reference set-up needs exact tracing")
    layer = next(tier for tier in numbers["tiers_blurred"] if tier["tier"] == "defocused layer")
    assert layer["rms_gray"] < 1.5
    cap = dict(zip(numbers["gravity"]["diameters_mm"], numbers["gravity"]["cap_error_px"][0], strict=True))
    assert cap[0.5] < 1 < cap[1.0]


# -- bad input ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--contact-angle-deg", "0"], "--contact-angle-deg 0 was given; expected degrees, above 0"),
        (["--contact-angle-deg", "95"], "at most 90"),
        (["--radius-mm", "-1"], "--radius-mm -1 was given; expected"),
        (["--radius-mm", "0.001"], "That looks like metres: try --radius-mm 1."),
        (["--face", "far", "--panel", "2"], "a drop sits on panel 2, but this chamber has 1 panel"),
        (["--depth-m", "0.01"], "lies before a drop"),
        (["--focus-m", "0.001"], "focus distance"),
        (["--f-number", "0"], "F-number of 0"),
        (["--focal-length-mm", "0.0045"], "expected millimetres"),
        (["--tolerance-px", "0"], "--tolerance-px 0 was given; expected more than 0"),
        (["--field", "2"], "--field 2 was given"),
        (["--image", "nowhere.png"], "nowhere.png"),
        (["--rig", "nowhere"], "nowhere"),
    ],
)
def test_bad_input_is_told_in_a_sentence(
    arguments: list[str], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["droplets", "--out", str(tmp_path / "out"), "--quick", *arguments]) == 2
    assert told in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def test_a_rig_without_panels_or_with_panels_behind_it_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bare = digital_rig(RigOptions(width=320, height=240, panels=0))
    bare.save(tmp_path / "bare")
    assert main(["droplets", "--out", str(tmp_path / "out"), "--rig", str(tmp_path / "bare")]) == 2
    assert "chamber.toml" in capsys.readouterr().err
    behind = Chamber((0.0, 0.0, -1.0), 0.04, (Panel(0.004, 1.49),))
    Rig(bare.dry, bare.wet, behind).save(tmp_path / "behind")
    assert main(["droplets", "--out", str(tmp_path / "out"), "--rig", str(tmp_path / "behind")]) == 2
    assert "points away from what the camera sees" in " ".join(capsys.readouterr().err.split())


def test_a_drop_taller_than_its_gap_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    digital_rig(RigOptions(width=320, height=240, gap_mm=1.0)).save(tmp_path / "rig")
    arguments = ["--rig", str(tmp_path / "rig"), "--panel", "0", "--radius-mm", "3"]
    assert main(["droplets", "--out", str(tmp_path / "out"), *arguments]) == 2
    assert "1 mm of air" in " ".join(capsys.readouterr().err.split())


# -- its parts ---------------------------------------------------------------------------------------------------------


def test_the_drop_is_placed_where_it_is_asked_for(rig: Path, photograph: Path) -> None:
    bench, _ = set_up(Options(Path("unused"), rig=rig, image=photograph))
    for field in (0.0, 0.5, 0.9):
        rows, columns = bench.window(bench.cap(1e-3, 0.1, field))
        middle = np.array([columns.start + columns.stop - 1, rows.start + rows.stop - 1]) / 2
        wanted = (np.array(bench.camera.size) - 1) * (0.5 + 0.5 * field)
        assert np.abs(middle - wanted).max() < 1.0


def test_figures_of_the_literature_come_out(reference: tuple[Bench, SphericalCap]) -> None:
    bench, drop = reference
    found = rim(bench, drop)
    assert found.shares["TOTAL_REFLECTION"] == pytest.approx(0.24, abs=0.01)
    assert 0.05 < found.shares["outside"] < 0.12
    literal, slopes = errors(bench, drop, (Tier(Method.LITERAL), SLOPES))
    assert literal[0] == pytest.approx(140, rel=0.05)
    flat = errors(bench, replace(drop, contact_angle=math.radians(10)), (Tier(Method.LITERAL), SLOPES))
    assert flat[0][0] == pytest.approx(28, rel=0.1)
    assert flat[1][0] < 0.15 < slopes[0]


def test_gray_levels_are_those_of_the_picture(reference: tuple[Bench, SphericalCap]) -> None:
    # the slope texture, rendered pixel by pixel with nothing but its trace
    bench, drop = reference
    window = bench.window(drop)
    shown, touched = bench.render(SLOPES, drop, window)
    pixels = grid(window)
    seen = bench.tracer(SLOPES, drop)(pixels)
    for row, column in ((10, 12), (20, 30), (33, 18)):
        assert touched[row, column]
        x, y = seen.source[row, column]
        patch = cv2.getRectSubPix(bench.image.astype(np.float32), (1, 1), (float(x), float(y)))[0, 0]
        assert np.abs(shown[row, column] - patch).max() < 0.6  # OpenCV's 1/32 of a pixel, on slopes of 15 gray levels
    assert np.array_equal(shown[~touched], bench.image[window][~touched])


def test_beyond_its_edges_the_image_is_mirrored() -> None:
    image = np.repeat(np.arange(5, dtype=np.float32)[None, :, None], 3, 2).repeat(4, 0)
    places = np.array([[-1.0, 0], [-3.5, 0], [5.0, 1], [11.0, 1], [1e9, 2], [np.nan, 0]])
    values = look_up(image, places, np.array([True] * 5 + [False]))
    assert values[:4, 0] == pytest.approx([1, 3.5, 3, 3])
    assert 0 <= values[4, 0] <= 4
    assert not values[5].any()


def test_the_steepest_drop_is_where_the_tolerance_ends(reference: tuple[Bench, SphericalCap]) -> None:
    bench, drop = reference
    limit = steepest(bench, SLOPES, drop.radius, 0.0, 1.0)
    assert 15 < limit < 21
    below, above = (errors(bench, bench.cap(drop.radius, math.radians(a), 0.0), (SLOPES,))[0][0]
                    for a in (limit * 0.99, limit * 1.02))  # fmt: skip
    assert below <= 1.0 < above
    assert steepest(bench, EXACT, drop.radius, 0.0, 1.0) == 90
    assert math.isnan(steepest(bench, Tier(Method.LITERAL), drop.radius, 0.0, 1e-4))


def test_a_map_leaves_out_drops_that_do_not_fit(rig: Path, photograph: Path) -> None:
    bench, _ = set_up(Options(Path("unused"), rig=rig, image=photograph, face="near"))
    narrow = replace(bench, chamber=replace(bench.chamber, distance=0.012))
    found = regime_map(narrow, Sweep("radius", "mm", (0.3, 18.0)), 1e-3, 0.0, quick=True)
    assert np.isfinite(found.pixels[1, -1, 0])
    assert np.isnan(found.pixels[:, -1, 1]).all()  # 15 mm tall before 12 mm of air


def test_a_texture_out_of_its_place_is_wrong(reference: tuple[Bench, SphericalCap]) -> None:
    bench, drop = reference
    found = [m.pixels for m in misuses(bench, drop.radius, math.radians(45), 0.0)]
    every, single, half, corner = found
    at_home, _, _ = errors(bench, replace(drop, contact_angle=math.radians(45)), (BAKED,))[0]
    assert every == pytest.approx(at_home, rel=0.1)
    assert single > every + 3
    assert min(half, corner) > 40


@pytest.mark.parametrize("face", ["near", "far"])
def test_checks_hold_anywhere_and_without_an_answer_fail(face: Any, photograph: Path, tmp_path: Path) -> None:
    digital_rig(RigOptions(width=320, height=240, fx=300)).save(tmp_path / "rig")  # a barrel lens and two panels
    options = Options(Path("unused"), rig=tmp_path / "rig", image=photograph, face=face)
    for field, angle, radius in ((0.0, 20.0, 3.0), (0.8, 80.0, 3.0), (1.0, 60.0, 1.0)):
        bench, drop = set_up(replace(options, field=field, contact_angle_deg=angle, radius_mm=radius))
        found = checks(bench, drop, quick=True)
        assert len(found) == 7
        assert all(check.passed for check in found), [check for check in found if not check.passed]
    assert not replace(found[0], found=math.nan).passed


def test_the_dark_rim_is_dark_and_only_there(reference: tuple[Bench, SphericalCap]) -> None:
    bench, drop = reference
    found = rim(bench, drop)
    assert (found.brightness[found.fate == Fate.TOTAL_REFLECTION] == 0).all()
    assert (found.brightness[found.fate == Fate.NO_DROP] == 1).all()
    middle = found.brightness[found.brightness.shape[0] // 2, found.brightness.shape[1] // 2]
    assert middle == pytest.approx(1.016, abs=0.003)  # acrylic to water to air reflects less than acrylic to air


def answer(angle: float, tier: Tier, unit: str = "pixels", met: bool = True, cost: float = 1.0) -> Answer:
    return Answer(1.0, angle, 0.0, unit, tier, met, 1.5, cost, ())


def test_the_sentence_follows_the_answers() -> None:
    layer, many = Tier(Method.LAYER), Tier(Method.APERTURE, 256)
    flat = [answer(20, SLOPES, cost=0.3), answer(35, SLOPES, cost=0.3), answer(50, EXACT)]
    blurred = [answer(20, layer, "gray"), answer(50, many, "gray", cost=300), answer(80, many, "gray", False, 300)]

    def sentence(answers: list[Answer], steepest_deg: float = 18.0) -> str:
        return words(Verdict(tuple(answers), 1.0, 2.0, 1.0, steepest_deg, ""), "Your rig", 1.4)

    mixed = sentence(flat + blurred)
    assert "needs the slope texture up to 35 degrees and exact tracing for steeper drops to place" in mixed
    assert "through the lens at F/1.4, one defocused layer keeps 2 gray levels for 1 of 3 drops" in mixed
    assert "256 aperture samples for 1 more, none for 1 (256 aperture samples comes closest: 1.5)" in mixed
    plain = sentence(flat[:2] + blurred[:1], math.nan)
    assert "needs the slope texture for drops of 20 to 35 degrees" in plain
    assert "never does" in plain
    assert "one defocused layer keeps 2 gray levels for all drops (worst bound 1.5)" in plain
    assert "no tier keeps 2 gray levels" in sentence(flat + blurred[2:])
    assert "no room" in sentence([])


def test_sharp_tiers_are_judged_where_there_is_hardly_any_blur(reference: tuple[Bench, SphericalCap]) -> None:
    bench, _ = reference
    stopped = replace(bench, lens=ThinLens(0.0045, 128.0), statistics=SceneStatistics.natural())
    names = {b.tier.method for b in choice_for(stopped, 4e-3, 0.3, 0.0, "gray", 50.0).bounds}
    assert Method.SLOPES in names or Method.LITERAL in names
    wide = choice_for(bench, 0.25e-3, 0.5, 0.0, "gray", 2.0)
    assert all(b.tier.is_defocused for b in wide.bounds)


def test_differences_are_white_where_there_are_none() -> None:
    difference = np.zeros((1, 3, 3))
    difference[0, 1], difference[0, 2] = 64, -64
    white, red, blue = signed(difference, 1.0)[0].astype(int)
    assert (white == 255).all()
    assert red[2] > 2 * red[0]
    assert blue[0] > 2 * blue[2]
    assert [gain_for(e) for e in (40, 10, 1, 0.1)] == [1, 2, 20, 20]


def test_a_photograph_is_cut_in_its_middle() -> None:
    image = np.zeros((100, 300, 3), dtype=np.uint8)
    image[:, 100:200] = 200
    small = fitted(image, (50, 50))
    assert small.shape == (50, 50, 3)
    assert (small[:, 1:-1] == 200).all()
