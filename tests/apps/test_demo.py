"""The demo, as a newcomer runs it."""

import json
from pathlib import Path

import pytest

from rainstereo.apps.cli import main

pytest.importorskip("mrcal")


@pytest.mark.slow
def test_the_demo_shows_a_calibrated_rig_and_aligned_pairs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--out", str(tmp_path / "demo"), "--pictures", str(tmp_path / "pictures")]) == 0
    told = json.loads((tmp_path / "demo" / "report.json").read_text())
    modelled, ignored = told["through_acrylic"], told["ignoring_acrylic"]
    assert modelled["status"] == "good"
    assert abs(modelled["baseline_error_m"]) < 2 * modelled["baseline_sigma_m"]
    for what, key in (("dry", "dry"), ("wet", "wet"), ("stereo", "wet against dry")):
        assert modelled["infinity_error_px"][what]["rms"] < 2 * modelled["infinity_predicted_rms_px"][key]
    assert ignored["infinity_error_px"]["dry"]["rms"] > 10 * modelled["infinity_error_px"]["dry"]["rms"]
    assert ignored["rms_px"] < 1.5 * modelled["rms_px"]  # which is why the reprojection error does not tell
    assert told["aligned_pairs"] == 4
    assert abs(told["remaining_shift_px"]["median_xy"][1]) < 0.05
    for frame in told["derained"]:
        assert frame["derained_psnr"] > frame["raw_psnr"] + 0.5
    page = (tmp_path / "demo" / "report.html").read_text()
    assert page.count("data:image") >= 12
    assert page.count("<svg") >= 3
    pictures = {path.relative_to(tmp_path / "pictures").as_posix() for path in (tmp_path / "pictures").rglob("*.*")}
    tutorial = (Path(__file__).parents[2] / "docs" / "tutorial.md").read_text()
    used = {
        line.split("images/")[1].split(")")[0]
        for line in tutorial.replace("![", "\n![").splitlines()
        if "images/" in line
    }
    assert used <= pictures  # every picture of the tutorial is one that the demo makes
    assert "Open" in capsys.readouterr().out
