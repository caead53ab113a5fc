"""Solutions that several files look at."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from rainstereo.calib.solve import Solution


@pytest.fixture(scope="session")
def bare() -> Solution:
    """Twelve boards seen by the synthetic rig without panels, 0.1 px of noise."""
    from rainstereo.calib.solve import solve

    from . import synthetic

    return solve(synthetic.observe(synthetic.rig(), synthetic.poses(12, 1), noise=0.1, seed=0), "LENSMODEL_OPENCV5")


@pytest.fixture(scope="session")
def through() -> Solution:
    """The same through two panels pitched by 15 degrees, which are known."""
    from rainstereo.calib.solve import solve

    from . import synthetic

    inside = synthetic.chamber(15)
    seen = synthetic.observe(synthetic.rig(inside), synthetic.poses(12, 1), noise=0.1, seed=0)
    return solve(seen, "LENSMODEL_OPENCV5", inside)
