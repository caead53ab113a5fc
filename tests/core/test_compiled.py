"""Where compiled loops come from, and where they are kept."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

numba = pytest.importorskip("numba", reason="numba is not installed (extra fast)")

from rainstereo.compiled import compile as compiling  # noqa: E402


def double(values: np.ndarray) -> np.ndarray:
    return 2 * values


def test_a_loop_gives_what_python_gives_and_settings_are_put_back() -> None:
    before = numba.config.CACHE_DIR
    np.testing.assert_array_equal(compiling.compiled(double)(np.arange(5.0)), double(np.arange(5.0)))
    assert numba.config.CACHE_DIR == before


def test_any_change_to_any_source_is_compiled_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiling, "__file__", str(tmp_path / "compile.py"))
    (tmp_path / "loop.py").write_text("a = 1")
    (tmp_path / "part.py").write_text("b = 1")
    first = compiling._kept()
    assert compiling._kept() == first
    (tmp_path / "part.py").write_text("b = 2")
    assert compiling._kept() != first


def test_without_a_place_for_the_cache_loops_are_compiled_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def njit(cache: bool = False, **settings: object) -> object:
        calls.append(cache)
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return lambda loop: loop

    monkeypatch.setattr(compiling.numba, "njit", njit)
    assert compiling.compiled(double) is double
    assert calls == [True, False]


def test_without_numba_nothing_is_available_and_rain_is_drawn_all_the_same() -> None:
    code = """
import sys
sys.modules["numba"] = None
import numpy as np
from rainstereo import Camera, Chamber, Panel, compiled
from rainstereo.droplet import SphericalCap
from rainstereo.rain.render import Renderer
assert not compiled.available()
camera, pane = Camera.pinhole(60, 60, 31.5, 23.5, 64, 48), Chamber((0, 0, 1), 0.057, (Panel(0.003, 1.49),))
image = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
for moving in (False, True):
    shown = Renderer(camera, pane, moving=moving).plan(SphericalCap((0, 0), 5e-3, 1.0)).render(image)
    assert (shown.image != image).any() and shown.drop_mask.any()
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
