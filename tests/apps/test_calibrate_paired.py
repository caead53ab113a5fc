"""`rainstereo calibrate` with the chamber's captures in folders: usage, and one paired run on rendered boards."""

import json
from pathlib import Path

import numpy as np
import pytest

from rainstereo import Rig
from rainstereo.apps.cli import main
from rainstereo.apps.digital_rig import RigOptions
from rainstereo.apps.simulate import Options as Simulate
from rainstereo.apps.simulate import run as simulate
from rainstereo.calib.slab import across

pytest.importorskip("mrcal")

BOARD = "chessboard:9x6:25mm"
ROUGH = """normal = [0.02, 0.30, 0.95]
distance_mm = 42.0
gaps_mm = [18.0]
[[panel]]
thickness_mm = 3.9
index = 1.49
[[panel]]
thickness_mm = 4.2
index = 1.49
"""


def calibrate(out: Path, *words: object) -> int:
    return main(["calibrate", "--board", BOARD, "--out", str(out), *map(str, words)])


@pytest.mark.slow
def test_paired_captures_of_rendered_boards(tmp_path: Path) -> None:
    """From images, not exact corners: within 1.5 times of what corners of known noise would give."""
    folder = tmp_path / "recording"
    simulate(Simulate(folder, (BOARD,), 10, 10, still=True, drive_frames=0, workers=1,
                      rig=RigOptions(width=640, height=480)))  # fmt: skip
    boards = folder / "chessboard"
    (boards / "chamber" / "chamber.toml").write_text(ROUGH)
    out = tmp_path / "rig"
    words = ("--bare", boards / "bare", "--chamber", boards / "chamber", "--lensmodel", "LENSMODEL_OPENCV5")
    assert calibrate(out, *words, "--no-cross-validate", "--workers", 1) == 0
    told = json.loads((out / "report.json").read_text())
    found, true = Rig.load(out).chamber, Rig.load(folder / "truth").chamber
    assert found is not None
    assert true is not None
    assert told["panels"]["mode"] == "paired captures"
    assert found.nominal == ("distance", "gaps", "index")
    assert found.distance == pytest.approx(0.042)
    off = across(true.normal).T @ np.array(found.normal)
    sigmas = told["panels"]["sigmas"]
    assert abs(off[0]) < 4 * 1.5 * sigmas["pitch"]
    assert abs(off[1]) < 4 * 1.5 * sigmas["yaw"]
    thickness = [sum(panel.thickness for panel in chamber.panels) for chamber in (found, true)]
    assert abs(thickness[0] - thickness[1]) < 4 * 1.5 * sigmas["thickness 0"]
    assert told["panels"]["hypotheses"][0]["name"] == "no slab"
    page = (out / "report.html").read_text()
    assert "sigma after / before" in page
    assert "panels not parallel" in page


def told(capsys: pytest.CaptureFixture[str]) -> str:
    return " ".join(capsys.readouterr().err.split())


def test_bad_usage_is_explained(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, bare, behind = tmp_path / "rig", tmp_path / "without", tmp_path / "with"
    for folder in (bare, behind):
        folder.mkdir()
    assert calibrate(out, "--bare", bare) == 2
    assert "--chamber is not given; paired captures are two folders" in told(capsys)
    assert calibrate(out, "--bare", bare, "--chamber", bare) == 2
    assert "name one folder" in told(capsys)
    assert calibrate(out, "--bare", bare, "--chamber", behind) == 2
    assert "chamber.toml does not exist; it describes the panels" in told(capsys)
    (behind / "chamber.toml").write_text(ROUGH)
    assert calibrate(out, "--bare", bare, "--chamber", behind) == 2
    assert "has no folder dry" in told(capsys)
    assert calibrate(out) == 2
    assert "give the board images of both cameras" in told(capsys)
    assert calibrate(out, "--dry", bare, "--wet", behind, "--slab", "estimated") == 2
    assert "needs the panels' description" in told(capsys)
    assert calibrate(out, "--dry", bare, "--wet", behind, "--panels", behind / "chamber.toml") == 2
    assert "--panels goes with a folder" in told(capsys)
    (behind / "chamber.toml").write_text(ROUGH.replace("thickness_mm = 3.9", "thickness_mm = 3900"))
    assert calibrate(out, "--bare", bare, "--chamber", behind) == 2
    assert "panel 3.9 m thick" in told(capsys)
    assert not out.exists()
