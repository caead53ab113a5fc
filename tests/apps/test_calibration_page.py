"""The page of a calibration answers in order: good enough, what limits it, what to capture next."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mrcal")

from rainstereo.apps import trust_figures
from rainstereo.apps.calibrate import Clock, results
from rainstereo.apps.calibration_findings import ALONE, PIXELS, Findings, limits
from rainstereo.apps.calibration_page import page
from rainstereo.apps.run_record import Record, jsonable
from rainstereo.calib import checks, consistency, uncertainty
from rainstereo.calib.solve import solve
from rainstereo.chamber import ChamberUncertainty
from tests.calib import synthetic


@pytest.fixture(scope="module")
def findings() -> Findings:
    known = ChamberUncertainty((2e-5, 2e-5), np.deg2rad(2.0), (0.002, 0.002))
    inside = replace(synthetic.chamber(25), uncertainty=known)
    seen = synthetic.observe(synthetic.rig(inside), synthetic.poses(14, 1), noise=0.1, seed=0)
    solution = solve(seen, "LENSMODEL_OPENCV4", inside)
    cov = uncertainty.covariance(solution)
    verdict = checks.judge(seen, solution, cov=cov)
    compared = consistency.compare(solution, grid=(6, 5))
    return Findings(seen, solution, cov, None, verdict, inside, compared)


def test_order_of_the_answers(findings: Findings) -> None:
    html = page(findings, Record("calibrate", {})).html()
    headings = re.findall(r"<h2[^>]*>([^<]*)</h2>", html)
    wanted = ["Where it can be trusted", "What limits it", "Does it agree with itself", "What to capture next"]
    places = [headings.index(each) for each in wanted]
    assert places == sorted(places)
    assert headings.index("Residuals") > places[-1]
    assert html.index("verdict") < html.index("Where it can be trusted")
    assert "limited by the tilt of the panels" in html  # two degrees are a bad measurement
    assert "The pose that would help most" in html or "No single pose" in html
    assert "http://" not in html.replace("http://www.w3.org", "")


def test_the_record_tells_the_same(findings: Findings) -> None:
    told = json.loads(json.dumps(jsonable(results(findings, Clock()))))
    parts = told["variance_by_cause"][ALONE]
    assert max(parts, key=parts.get) == "tilt"
    assert limits(parts).startswith("the tilt of the panels")
    depth = told["variance_by_cause"]["depth at 2 m"]
    assert set(depth) == {PIXELS, "corner noise", "tilt", "thickness", "index"}
    assert told["typical_sigma_px"]["wet against dry"]["infinity"] > 0
    assert set(told["typical_sigma_px"]["dry"]) == {"infinity", "2 m", "0.5 m"}
    halves = told["cross_validation"][0]
    assert halves["frames"] == "two halves"
    assert 0.2 < halves["differences"]["infinity"]["ratio"] < 2
    assert told["panels_sd_assumed"] is False
    assert told["baseline_sigma_m"] > uncertainty.baseline_sigma(findings.solution, findings.covariance)  # type: ignore[arg-type]


def test_figures_refuse_what_does_not_fit() -> None:
    flat = np.ones((3, 4))
    with pytest.raises(ValueError, match="the first row"):
        trust_figures.map_rows([{"a": flat, "b": flat}, {"c": flat}], (40, 30), "px")
    with pytest.raises(ValueError, match="totals"):
        trust_figures.shares(["one"], {"x": [1.0]}, [])
    figure = trust_figures.map_rows([{"a": np.full((3, 4), np.nan)}], (40, 30), "px")  # no answer anywhere
    assert "no answer" in figure.axes[0].get_title(loc="left")
    nothing = trust_figures.shares(["one"], {"x": [0.0], "y": [0.0]}, ["0 px"])
    assert len(nothing.axes) == 1
