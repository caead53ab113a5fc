"""What docs/rain.md tells to type works: its commands are understood, its Python runs, its pictures and pages exist."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import tyro

from rainstereo import Camera, Chamber, Panel, Rig
from rainstereo.apps.rain_options import Options
from rainstereo.apps.rain_presets import PRESETS

DOCS = Path(__file__).resolve().parents[2] / "docs"
TEXT = (DOCS / "rain.md").read_text(encoding="utf-8")
PYTHON = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)


def test_commands_are_understood() -> None:
    lines = [shlex.split(line, comments=True) for line in re.findall(r"^rainstereo rain .*", TEXT, re.MULTILINE)]
    assert len(lines) >= 6
    for line in lines:
        options = tyro.cli(Options, args=line[2:])
        assert options.images
    for flag in set(re.findall(r"`--([a-z-]+)", TEXT)) - {"no-ssim"}:
        assert hasattr(Options, flag.replace("-", "_")) or flag in ("out", "images"), flag
    assert Options.ssim


def test_every_preset_is_described() -> None:
    table = TEXT[TEXT.index("## Which rain") : TEXT.index("## What it writes")]
    assert [name for name in PRESETS if f"`{name}`" not in table] == []


def test_links_lead_somewhere() -> None:
    found = re.findall(r"\]\((?!http)([^)#]+)\)", TEXT)
    assert found
    assert [name for name in found if not (DOCS / name).exists()] == []


def test_python_runs() -> None:
    camera = Camera.pinhole(96, 96, 47.5, 35.5, 96, 72)
    rig = Rig(camera, camera, Chamber((0, 0, 1), 0.04, (Panel(0.004, 1.49), Panel(0.004, 1.49)), (0.02,)))
    image = np.random.default_rng(0).integers(0, 256, (72, 96, 3), dtype=np.uint8)
    given = {"rig": rig, "image": image}
    exec(compile(PYTHON[0], "docs/rain.md", "exec"), given)  # noqa: S102 - our own page
    rainy = np.asarray(given["rainy"])
    assert rainy.shape == image.shape
    assert (rainy != image).any()


def test_the_augmentation_runs() -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed")
    pytest.importorskip("kornia", reason="kornia is not installed")
    given = {"images": torch.rand(2, 3, 24, 32), "masks": torch.ones(2, 1, 24, 32)}
    exec(compile(PYTHON[1], "docs/rain.md", "exec"), given)  # noqa: S102 - our own page
    assert torch.equal(given["again"], given["rainy"])
