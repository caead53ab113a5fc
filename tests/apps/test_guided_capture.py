"""Captures without hands, guided or not, and the benchmark stage made of them."""

from __future__ import annotations

import pytest

pytest.importorskip("mrcal")

from rainstereo.apps.bench_calibration import BOARD, MODEL
from rainstereo.apps.digital_rig import digital_rig
from rainstereo.apps.guided_capture import FIRST, capture


@pytest.mark.slow
def test_a_guided_capture_needs_fewer_pairs() -> None:
    truth = digital_rig(seed=0)
    guided, anywhere = (
        capture(truth, BOARD, MODEL, target=0.6, guided=guided, seed=0, limit=40) for guided in (True, False)
    )
    assert guided.worst[-1] <= 0.6
    assert FIRST < guided.pairs <= 0.7 * anywhere.pairs, (guided.pairs, anywhere.pairs)
    assert guided.worst[:FIRST] == anywhere.worst[:FIRST]  # both begin alike
