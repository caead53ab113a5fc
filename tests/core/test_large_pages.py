"""Memory on large pages is memory like any other."""

import os
import subprocess
import sys

import numpy as np
import pytest

from rainstereo.rain.large_pages import zeros


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.uint32])
@pytest.mark.parametrize("size", [0, 1, 1000, (1 << 21) + 1])
def test_numbers_are_0_and_can_be_written(kind, size):
    found = zeros(kind, size)
    assert (found.shape, found.dtype) == ((size,), kind)
    assert not found.any()
    found += kind(7)
    assert (found == 7).all()


FORKED = """
import os
import numpy as np
from rainstereo.rain.large_pages import zeros
found = zeros(np.uint32, 1000)
child = os.fork()
if child == 0:
    found[:] = 1
    os._exit(0)
os.waitpid(child, 0)
print(found.any())
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked here")
def test_a_forked_process_has_its_own():
    done = subprocess.run([sys.executable, "-c", FORKED], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout == "False\n"
