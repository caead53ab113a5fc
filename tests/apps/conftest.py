"""A small recording by the digital rig, made once a test process."""

from pathlib import Path

import pytest

from rainstereo.apps import simulate
from rainstereo.apps.digital_rig import RigOptions


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """640 x 480: twelve pairs of a chessboard behind the chamber, three of the street, and their truth."""
    folder = tmp_path_factory.mktemp("recording") / "rec"
    options = simulate.Options(
        folder, boards=("chessboard:9x6:25mm",), frames=12, bare_frames=0, drive_frames=3, workers=1,
        rig=RigOptions(width=640, height=480), seed=3,
    )  # fmt: skip
    assert simulate.run(options) == 0
    return folder
