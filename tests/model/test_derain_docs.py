"""The example of docs/derain.md runs."""

import re
from pathlib import Path

import cv2
import pytest

from rainstereo.model import restore
from tests.model.small_restorer import RedDetector, network, picture, with_drop

DOCS = Path(__file__).resolve().parents[2] / "docs" / "derain.md"


@pytest.mark.parametrize("drop", [True, False])
def test_the_example_in_front_of_a_detector_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], drop: bool
) -> None:
    code = re.findall(r"```python\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.DOTALL)
    assert len(code) == 1
    assert 15 <= len([line for line in code[0].splitlines() if line.strip()]) <= 22
    cv2.imwrite(str(tmp_path / "photo.png"), with_drop(picture(), 50, 50) if drop else picture())
    monkeypatch.chdir(tmp_path)
    own = restore.Restorer(network=network(), detector=RedDetector())
    monkeypatch.setattr(restore, "Restorer", lambda: own)
    exec(compile(code[0], "docs/derain.md", "exec"), {})  # noqa: S102 - our own page
    told = capsys.readouterr().out
    assert told.startswith("0 % of the frame") == (not drop)
    assert "edges:" in told
