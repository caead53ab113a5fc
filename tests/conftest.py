"""Fixtures that every folder of tests shares."""

import signal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # started in a shell's background, where commands that tests interrupt would inherit that nobody can
    signal.signal(signal.SIGINT, signal.default_int_handler)


settings.register_profile("same", derandomize=True, deadline=None)  # a test that fails was broken by the change at hand
settings.register_profile("search", derandomize=False, deadline=None)  # --hypothesis-profile=search: other examples
settings.load_profile("same")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real images beside the project; the test is skipped where it is absent."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("real images are not beside this checkout")
    return folder


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20190520)
