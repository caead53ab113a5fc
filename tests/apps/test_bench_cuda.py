"""Benchmark stage `cuda`: refused where there is no such device, and left out of `all`; it runs where there is one."""

from pathlib import Path

import pytest
import torch

from rainstereo.apps import bench, bench_cuda, cli
from rainstereo.apps.bench_harness import measure


def test_without_a_device_it_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(bench_cuda, "is_there", lambda: False)
    with pytest.raises(ValueError, match="needs a CUDA device"):
        bench_cuda.build(0, True)
    ran: list[str] = []
    monkeypatch.setattr(bench, "_run_stage", lambda name, options: ran.append(name) or {})
    for name, value in bench.SINGLE_THREAD.items():
        monkeypatch.setenv(name, value)
    assert cli.main(["bench", "all", "--out", str(tmp_path)]) == 0
    assert set(ran) == set(bench.STAGES) - {"cuda", "cavity"}
    capsys.readouterr()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="this machine has no CUDA device")
def test_on_a_device_every_work_runs() -> None:
    stage = bench_cuda.build(0, True)
    assert stage.setting["device"] == torch.cuda.get_device_name()
    for work in stage.works:
        outcome = measure(work, 1)
        assert all(m.seconds.median > 0 for m in outcome.measurements)
