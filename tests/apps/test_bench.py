"""The bench harness measures what it says, in the order it says, and judges without favour."""

import json
import math
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rainstereo import Camera, Chamber, Panel
from rainstereo.apps import bench, bench_page, bench_refraction, bench_warp, cli
from rainstereo.apps.bench_harness import (
    SINGLE_THREAD,
    Measurement,
    Outcome,
    Spread,
    Stage,
    Target,
    Variant,
    Work,
    machine,
    measure,
    steps,
)


def work(*variants: Variant, targets: tuple[Target, ...] = (), threads: int = 1, champion: str = "") -> Work:
    return Work(
        "w", "A work", "What.", variants, champion or variants[0].name, "px", "largest", 100, "points", targets, threads
    )


def variant(name: str, ours: bool = False, error: float = 0.0, every: int = 1, seconds: float = 0.0) -> Variant:
    return Variant(name, lambda: time.sleep(seconds) or name, lambda _: error, ours, every=every)


def outcome(times: dict[str, list[float]], errors: dict[str, float], targets: tuple[Target, ...] = ()) -> Outcome:
    """An outcome with given seconds by round and errors; the first is our champion."""
    first = next(iter(times))
    found = tuple(Measurement(n, n == first, "", dict(enumerate(t)), 1.0, errors[n]) for n, t in times.items())
    return Outcome(work(*(variant(n, n == first) for n in times), targets=targets), found)


def test_rounds_are_interleaved_after_a_warm_up_each() -> None:
    calls: list[str] = []
    errors: list[str] = []

    def noted(name: str, every: int = 1) -> Variant:
        return Variant(
            name, lambda: calls.append(name) or name, lambda result: errors.append(result) or 0.5, every=every
        )

    told: list[str] = []
    found = measure(work(noted("a"), noted("b"), noted("slow", 2)), 3, told.append)
    assert calls == ["a", "b", "slow", "a", "b", "slow", "a", "b", "a", "b", "slow"]
    assert errors == ["a", "b", "slow"]
    assert len(told) == steps(found.work, 3) == len(calls)
    assert [sorted(m.rounds) for m in found.measurements] == [[0, 1, 2], [0, 1, 2], [0, 2]]
    assert [m.error for m in found.measurements] == [0.5, 0.5, 0.5]


def test_time_is_wall_clock_and_idling_shows_in_the_cores() -> None:
    def spin() -> None:
        end = time.process_time() + 0.03
        while time.process_time() < end:
            pass

    found = measure(work(variant("sleeps", seconds=0.03), Variant("spins", spin, lambda _: 0.0)), 3)
    assert found["sleeps"].seconds.least >= 0.03
    assert found["spins"].seconds.least >= 0.029
    assert found["sleeps"].cores < 0.3
    assert found["sleeps"].cores < found["spins"].cores <= 1.1


def test_opencv_threads_are_set_while_measuring_and_put_back() -> None:
    before = cv2.getNumThreads()
    seen: list[int] = []
    measure(work(Variant("a", lambda: seen.append(cv2.getNumThreads()), lambda _: 0.0), threads=1), 1)
    assert set(seen) == {1}
    with pytest.raises(ZeroDivisionError):
        measure(work(Variant("a", lambda: 1 / 0, lambda _: 0.0), threads=1), 1)
    assert cv2.getNumThreads() == before


@given(st.lists(st.floats(1e-6, 1e3), min_size=1, max_size=30))
def test_spread_agrees_with_sorting(samples: list[float]) -> None:
    spread = Spread.of(samples)
    ordered = sorted(samples)
    assert (spread.least, spread.most) == (ordered[0], ordered[-1])
    middle = (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2
    assert math.isclose(spread.median, middle, rel_tol=1e-12)
    assert spread.least <= spread.low <= spread.median <= spread.high <= spread.most


def test_spread_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="no samples"):
        Spread.of([])


def test_ratio_is_taken_within_rounds() -> None:
    """A machine that slows down threefold slows both; the ratio stays what it is in every round."""
    found = outcome({"ours": [1, 1, 3, 3], "peer": [2, 2, 6, 6]}, {"ours": 0, "peer": 0})
    ratio = found.ratio("ours", "peer")
    assert (ratio.least, ratio.median, ratio.most) == (0.5, 0.5, 0.5)


@pytest.mark.parametrize(("limit", "met"), [(0.2, True), (0.19, False), (1.15, True)])
def test_targets(limit: float, met: bool) -> None:
    target = Target("ours", "peer", limit)
    found = outcome({"ours": [0.2, 0.2], "peer": [1, 1]}, {"ours": 0, "peer": 0}, (target,))
    assert found.met(target) is met


def test_target_in_words() -> None:
    assert Target("project", "optv", 1 / 5).words == "project at least 5 x as fast as optv"
    assert Target("align", "remap", 1.15).words == "align within 1.15 x the time of remap"


def test_target_in_seconds() -> None:
    target = Target("ours", None, 0.5)
    assert target.words == "ours within 0.5 s"
    assert outcome({"ours": [0.4, 0.5, 9], "peer": [1, 1, 1]}, {"ours": 0, "peer": 0}, (target,)).met(target)
    assert not outcome({"ours": [0.4, 0.6, 9], "peer": [1, 1, 1]}, {"ours": 0, "peer": 0}, (target,)).met(target)


def test_other_figures_of_a_result_get_columns_of_their_own() -> None:
    found = measure(work(Variant("a", lambda: 3.0, lambda _: 0.1, also=lambda result: {"baseline, mm": result})), 1)
    assert found["a"].also == {"baseline, mm": 3.0}
    columns, (row,) = bench_page.header(found), bench_page.rows(found)
    assert row[columns.index("baseline, mm")] == "3.0"
    assert len(row) == len(columns)


def test_works_must_name_variants_that_exist() -> None:
    with pytest.raises(ValueError, match="no variant 'c'"):
        work(variant("a"), variant("b"), champion="c")
    with pytest.raises(ValueError, match="no variant 'c'"):
        work(variant("a"), targets=(Target("a", "c", 1),))
    with pytest.raises(ValueError, match="share a name"):
        work(variant("a"), variant("a"))


@pytest.mark.parametrize(
    ("ours", "theirs", "our_error", "their_error", "verdict"),
    [
        ([1, 1, 1], [2, 2, 2], 1e-3, 1e-3, "wins"),
        ([1, 1, 1], [2, 2, 2], 1e-6, 1e-3, "wins"),
        ([1, 2, 1], [1, 1.5, 2], 1e-6, 1e-3, "wins"),
        ([1, 1, 1], [2, 2, 2], 1e-3, 1e-6, "trades"),
        ([2, 2, 2], [1, 1, 1], 1e-6, 1e-3, "trades"),
        ([2, 2, 2], [1, 1, 1], 1e-3, 1e-3, "loses"),
        ([2, 2, 2], [1, 1, 1], 1e-3, 1e-6, "loses"),
        ([2, 2, 2], [1, 1, 1], math.nan, math.nan, "loses"),
        ([1, 2, 1], [1, 1.5, 2], 1e-3, 1e-3, "ties"),
        ([1, 2, 1], [1, 1.5, 2], math.nan, 1e-3, "ties"),
        ([1, 1, 1], [2, 2, 2], 0.0, 0.0, "wins"),
        ([2, 2, 2], [1, 1, 1], 1e-9, 0.0, "loses"),
    ],
)
def test_verdicts(ours: list[float], theirs: list[float], our_error: float, their_error: float, verdict: str) -> None:
    found = outcome({"ours": ours, "peer": theirs}, {"ours": our_error, "peer": their_error})
    (comparison,) = bench_page.comparisons(found)
    assert comparison.verdict == verdict
    assert "`ours`" in comparison.words
    assert "`peer`" in comparison.words


STAGE = Stage("stage", "a stage", "The lead.", (), {"points": 3}, ("A note.",))


def test_pages_say_where_we_win_and_where_we_lose() -> None:
    times = {"ours": [2.0, 2.0, 2.0], "slower | worse": [4.0, 4.0, 4.0], "faster": [1.0, 1.0, 1.0]}
    errors = {"ours": 1e-6, "slower | worse": 1e-3, "faster": 1e-6}
    target = Target("ours", "faster", 1.15)
    found = (outcome(times, errors, (target,)),)
    text = bench_page.markdown(STAGE, found, machine(), "rainstereo bench stage --seed 0")
    wins, loses = text.split("## Where rainstereo wins")[1].split("## Where rainstereo loses")
    assert "2 x as fast as `slower | worse`" in wins
    assert "takes 2 x the time of `faster`" in loses
    assert "**missed**" in text
    assert "slower \\| worse" in text
    assert "rainstereo bench stage --seed 0" in text
    assert str(machine()["processor"]) in text
    page = bench_page.page(STAGE, found, machine(), bench_page.Record("bench", {})).html()
    assert "1 of 1 targets missed" in page
    assert "Where rainstereo loses" in page


@pytest.mark.parametrize("nothing", [0.0, math.nan])
def test_where_there_is_no_error_times_are_shown_alone(nothing: float) -> None:
    same = outcome({"ours": [1.0, 1.1], "peer": [2.0, 2.1]}, {"ours": nothing, "peer": nothing})
    (axes,) = bench_page.plot(same).axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["ours", "peer"]
    assert [float(line.get_xdata()[0]) for line in axes.lines] == pytest.approx([1050.0, 2050.0])
    assert "![times](" in bench_page.markdown(STAGE, (same,), machine(), "x")
    wrong = outcome({"ours": [1.0], "peer": [2.0]}, {"ours": nothing, "peer": 0.5})
    assert bench_page.plot(wrong).axes[0].get_ylabel().startswith("error")


def test_a_busy_machine_is_owned_up_to() -> None:
    quiet = outcome({"ours": [1.0], "peer": [1.0]}, {"ours": 0, "peer": 0})
    assert "busy" not in bench_page.markdown(STAGE, (quiet,), {**machine(), "load": 0.0}, "x")
    assert "busy" in bench_page.markdown(STAGE, (quiet,), {**machine(), "load": 9.0, "cores": 2}, "x")
    starved = Outcome(quiet.work, tuple(Measurement(m.name, m.ours, "", m.rounds, 0.5, 0) for m in quiet.measurements))
    assert "busy" in bench_page.markdown(STAGE, (starved,), {**machine(), "load": 0.0}, "x")


# -- the command -------------------------------------------------------------------------------------------------------


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stage `tiny` on one thread, in this process."""
    for name, value in SINGLE_THREAD.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setitem(bench.STAGES, "tiny", "a.module.of.this.test")

    class Module:
        @staticmethod
        def build(seed: int, quick: bool) -> Stage:
            rng = np.random.default_rng(seed)
            numbers = rng.normal(size=1000 if quick else 100_000)
            exact = math.fsum(numbers)
            variants = tuple(
                Variant(name, run, lambda total: abs(total - exact), name == "sum")
                for name, run in {"sum": numbers.sum, "loop": lambda: sum(numbers.tolist())}.items()
            )
            lost = work(*variants, targets=(Target("sum", "loop", 1e-9),))
            return Stage("tiny", "adding numbers", "Sums.", (lost,), {"seed": seed}, ())

    monkeypatch.setattr(bench, "importlib", SimpleNamespace(import_module=lambda name: Module))


@pytest.mark.usefixtures("tiny")
def test_bench_writes_everything_it_promises(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = bench.Options("tiny", tmp_path / "out", repeats=4, seed=3, docs=tmp_path / "docs")
    assert bench.run(options) == 0
    told = capsys.readouterr().out
    assert "MISSED  sum at least 1e+09 x as fast as loop" in told
    read = json.loads((tmp_path / "out" / "tiny" / "report.json").read_text())
    assert read["seed"] == 3
    assert read["versions"]["numpy"] == np.__version__
    variants = read["works"]["w"]["variants"]
    assert {name: len(v["samples"]) for name, v in variants.items()} == {"sum": 4, "loop": 4}
    assert variants["sum"]["seconds"]["median"] == pytest.approx(np.median(variants["sum"]["samples"]))
    assert read["works"]["w"]["targets"][0]["met"] is False
    summary = json.loads((tmp_path / "out" / "report.json").read_text())
    assert summary["stages"]["tiny"]["targets"] == 1
    assert summary["stages"]["tiny"]["met"] == 0
    for folder in (tmp_path / "out" / "tiny", tmp_path / "docs"):
        text = (folder / "tiny.md").read_text()
        assert "rainstereo bench tiny --repeats 4 --seed 3" in text
        pictures = [line.split("(")[1].rstrip(")") for line in text.splitlines() if line.startswith("![")]
        assert pictures == ["tiny-w.svg"]
        assert (folder / pictures[0]).read_text().startswith("<?xml")
    assert (tmp_path / "out" / "tiny" / "report.html").stat().st_size > 10_000


@pytest.mark.usefixtures("tiny")
def test_quick_does_little(tmp_path: Path) -> None:
    bench.run(bench.Options("tiny", tmp_path, repeats=50, quick=True))
    read = json.loads((tmp_path / "tiny" / "report.json").read_text())
    assert len(read["works"]["w"]["variants"]["sum"]["samples"]) == 3


def test_works_may_be_picked_out(tmp_path: Path) -> None:
    def work(name: str) -> Work:
        return Work(name, name, "", (Variant("one", lambda: 1, lambda found: 0.0),), "one", "", "")

    def works() -> list[str]:
        return list(json.loads((tmp_path / "two" / "report.json").read_text())["works"])

    class Module:
        @staticmethod
        def build(seed: int, quick: bool) -> Stage:
            return Stage("two", "t", "", (work("a"), work("b")))

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(bench.STAGES, "two", "two")
        patch.setattr(bench, "importlib", SimpleNamespace(import_module=lambda name: Module))
        for name, value in bench.SINGLE_THREAD.items():
            patch.setenv(name, value)
        assert bench.run(bench.Options("two", tmp_path, repeats=1, only=("b",))) == 0
        assert works() == ["b"]
        assert "--only b" in (tmp_path / "two" / "two.md").read_text()
        with pytest.raises(ValueError, match="the works of two are a, b"):
            bench.run(bench.Options("two", tmp_path, repeats=1, only=("c",)))
        with pytest.raises(ValueError, match="all stages were asked for"):
            bench.run(bench.Options("all", tmp_path, only=("a",)))


def test_unknown_stage_is_bad_usage_with_a_list(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert cli.main(["bench", "refractoin", "--out", str(tmp_path / "x")]) == 2
    told = " ".join(capsys.readouterr().err.split())
    assert "refractoin" in told
    assert ", ".join(bench.STAGES) in told
    assert not (tmp_path / "x").exists()


def test_bad_repeats_is_bad_usage(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bench", "warp", "--repeats", "0"]) == 2
    assert "--repeats is 0" in capsys.readouterr().err


def test_without_thread_settings_the_work_goes_to_a_process_that_has_them(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    seen: dict[str, Any] = {}

    class Done:
        returncode = 1

    def run(arguments: list[str], env: dict[str, str], check: bool) -> Done:
        seen.update(arguments=arguments, env=env)
        return Done()

    monkeypatch.setattr(bench.subprocess, "run", run)
    options = bench.Options("warp", tmp_path / "a b", repeats=2, seed=5, quick=True, docs=tmp_path / "docs")
    assert bench.run(options) == 1
    assert SINGLE_THREAD.items() <= seen["env"].items()
    words = seen["arguments"][seen["arguments"].index("bench") :]
    import tyro

    assert tyro.cli(bench.Options, args=words[1:]) == options


# -- the references that stages measure against -----------------------------------------------------------------------


def snell_by_bisection(point: np.ndarray, chamber: Chamber) -> list[float]:
    """The pixel of a point beyond the chamber: 50 digits, sines instead of tangents, bisection instead of Newton."""
    with mpmath.workdps(50):
        P, n = ([mpmath.mpf(float(v)) for v in vector] for vector in (point, chamber.normal))
        norm = mpmath.sqrt(sum(c * c for c in n))
        n = [c / norm for c in n]
        z = sum(a * b for a, b in zip(P, n, strict=True))
        across = [a - z * b for a, b in zip(P, n, strict=True)]
        r = mpmath.sqrt(sum(c * c for c in across))
        thick = [(mpmath.mpf(p.thickness), mpmath.mpf(p.index)) for p in chamber.panels]
        air = z - sum(t for t, _ in thick)

        def reach(sine: Any) -> Any:
            return air * sine / mpmath.sqrt(1 - sine**2) + sum(t * sine / mpmath.sqrt(i**2 - sine**2) for t, i in thick)

        low, high = mpmath.mpf(0), mpmath.mpf(1)
        for _ in range(150):
            middle = (low + high) / 2
            low, high = (middle, high) if reach(middle) < r else (low, middle)
        tangent = low / mpmath.sqrt(1 - low**2)
        ray = [a + tangent * b / r for a, b in zip(n, across, strict=True)]
        f, cx, cy = bench_refraction.FOCAL, (bench_refraction.WIDTH - 1) / 2, (bench_refraction.HEIGHT - 1) / 2
        return [float(f * ray[0] / ray[2] + cx), float(f * ray[1] / ray[2] + cy)]


def test_refraction_reference_agrees_with_fifty_digits(rng: np.random.Generator) -> None:
    panel = Panel(0.004, 1.49)
    chamber = Chamber((math.sin(0.3), 0.1, math.cos(0.3)), 0.04, (panel, Panel(0.01, 1.33)), (0.02,))
    points = rng.uniform((-1, -1, 0.3), (1, 1, 5), (12, 3)) * (0.3, 0.3, 1)
    found = bench_refraction.reference(points, chamber)
    truth = [snell_by_bisection(point, chamber) for point in points]
    np.testing.assert_allclose(np.asarray(found, float), truth, rtol=0, atol=3e-13)


def test_exact_bilinear_of_a_bilinear_image() -> None:
    y, x = np.mgrid[:5, :7].astype(float)
    image = np.stack([2 * x - y + 0.5 * x * y, x + 3 * y], -1)
    at = np.array([[0, 0], [6, 4], [2.25, 3.5], [5.999, 0.125]])
    expected = np.stack([2 * at[:, 0] - at[:, 1] + 0.5 * at.prod(1), at[:, 0] + 3 * at[:, 1]], -1)
    np.testing.assert_allclose(bench_warp.bilinear(image, at), expected, atol=1e-12)


def test_exact_map_agrees_with_opencv() -> None:
    camera = Camera("LENSMODEL_OPENCV5", np.array([300, 310, 160, 120, -0.1, 0.05, 1e-3, -2e-3, 0.01]), 320, 240)
    view, turn = Camera.pinhole(290, 290, 150, 118, 300, 230), cv2.Rodrigues(np.array([0.02, -0.03, 0.01]))[0]
    found = bench_warp.exact_map(camera, view, turn)
    K, N = (np.array([[c[0], 0, c[2]], [0, c[1], c[3]], [0, 0, 1.0]]) for c in (camera.intrinsics, view.intrinsics))
    maps, _ = cv2.initUndistortRectifyMap(K, camera.intrinsics[4:], turn.T, N, (300, 230), cv2.CV_32FC2)
    assert np.abs(found - maps).max() < 5e-5


@pytest.mark.parametrize("stage", ["refraction", "warp"])
def test_stages_run_and_are_as_exact_as_they_claim(stage: str) -> None:
    built = {"refraction": bench_refraction, "warp": bench_warp}[stage].build(0, True)
    limits = {
        "project": 1e-12,
        "bare": 1e-12,
        "backproject": 1e-12,
        "few": 1e-12,
        "pair": 0.6,
        "threads": 0.6,
        "plan": 1e-9,
    }
    for each in built.works:
        champion = next(v for v in each.variants if v.name == each.champion)
        assert champion.ours
        assert champion.error(champion.run()) < limits[each.name], each.name


def test_infinity_error_is_that_of_directions_and_forgives_a_turn_of_the_whole_rig() -> None:
    from rainstereo import Rig
    from rainstereo.apps import rig_error

    def camera(focal: float = 600.0, shift: float = 0.0, pose: tuple[float, ...] = (0.0,) * 6) -> Camera:
        return Camera("LENSMODEL_PINHOLE", np.array([focal, focal, 320 + shift, 240]), 640, 480, np.array(pose))

    wet = (0.01, -0.02, 0.005, -0.03, 0.0, 0.0)
    truth = Rig(camera(), camera(pose=wet), None)
    assert rig_error.infinity_error(truth, truth) < 1e-9
    assert rig_error.matching_error(truth, truth) < 1e-9
    # a turn of one camera by a small angle is shared out between both, and every match is off by its whole
    turned = Rig(camera(), camera(pose=(0.01 + 1e-3, *wet[1:])), None)
    assert rig_error.infinity_error(turned, truth) == pytest.approx(600 * 1e-3 / 2, rel=0.2)
    assert rig_error.matching_error(turned, truth) == pytest.approx(600 * 1e-3, rel=0.2)
    # a wrong focal length in both matches well and points badly
    longer = Rig(camera(606), camera(606, pose=wet), None)
    assert rig_error.infinity_error(longer, truth) > 5 * rig_error.matching_error(longer, truth)


def test_calibration_stage_finds_the_rig_and_known_panels_help() -> None:
    from rainstereo.apps import bench_calibration

    (each,) = bench_calibration.build(1, True).works
    variants = {v.name: v for v in each.variants}
    assert each.champion == "solve, known panels"
    errors = {name: v.error(v.run()) for name, v in variants.items()}
    assert errors["solve, known panels"] < 0.4
    assert errors["solve, known panels"] < 0.7 * errors["solve, bare"]
    assert errors["mrcal"] == pytest.approx(errors["solve, bare"], rel=0.02)
    found = variants["solve, known panels"]
    assert abs(found.also(found.run())["baseline, mm"]) < 0.05


def test_without_optv_the_refraction_stage_still_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "optv.calibration", None)
    built = bench_refraction.build(0, True)
    assert "optv" not in [v.name for v in built.works[0].variants]


@pytest.mark.slow
def test_bench_of_refraction_in_a_process_of_its_own(tmp_path: Path) -> None:
    assert cli.main(["bench", "refraction", "--quick", "--out", str(tmp_path)]) == 0
    read = json.loads((tmp_path / "refraction" / "report.json").read_text())
    assert read["machine"]["threads"] == SINGLE_THREAD
    assert read["works"]["project"]["variants"]["project"]["error"] < 1e-12


def test_select_stage_runs_and_our_cover_is_nearer_than_a_plain_difference() -> None:
    from rainstereo.apps import bench_select

    cover, pair, choice = bench_select.build(0, True).works
    errors = {v.name: v.error(v.run()) for v in cover.variants}
    assert errors["drop_cover"] < 0.06
    assert errors["drop_cover"] < errors["plain difference"]
    assert pair.variants[0].error(pair.variants[0].run()) == pytest.approx(errors["drop_cover"])
    ours, theirs = (v.error(v.run()) for v in choice.variants)
    assert ours < theirs
