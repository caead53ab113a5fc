"""The firmware's core under libFuzzer with address and undefined-behaviour sanitizers; FUZZ_SECONDS says how long."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from rainstereo.hardware import firmware


@pytest.mark.slow
def test_the_core_survives_fuzzing(tmp_path: Path) -> None:
    if shutil.which("clang++") is None or shutil.which("make") is None:
        pytest.skip("no clang++ or make: `make firmware-test` installs them")
    (tmp_path / "probe.cpp").write_text('#include <cstdint>\n#include <cstddef>\nextern "C" int LLVMFuzzerTestOneInput'
                                        "(const uint8_t*, size_t) { return 0; }\n")  # fmt: skip
    probe = ["clang++", "-fsanitize=fuzzer,address", "-o", str(tmp_path / "probe"), str(tmp_path / "probe.cpp")]
    if subprocess.run(probe, capture_output=True, check=False).returncode != 0:
        pytest.skip("this clang++ has no libFuzzer (Debian: libclang-rt-dev)")
    seconds = os.environ.get("FUZZ_SECONDS", "10")
    command = ["make", "-C", str(firmware.sources()), f"BUILD={tmp_path}", f"FUZZ_SECONDS={seconds}", "fuzz"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-4000:]
    executions = re.search(r"number_of_executed_units: *(\d+)", done.stderr)
    assert executions is not None
    assert int(executions[1]) > 1000
