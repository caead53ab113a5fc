"""The firmware, for tests: skipped with the reason where it cannot be built."""

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from rainstereo.hardware import firmware
from rainstereo.hardware.firmware import SimulatedPump
from rainstereo.hardware.pump import Pump


@pytest.fixture(scope="session")
def compiled() -> None:
    """The firmware's core can be built here."""
    try:
        firmware.compiler()
    except RuntimeError as reason:
        pytest.skip(str(reason))


@pytest.fixture
def device(compiled: None) -> Iterator[SimulatedPump]:
    with SimulatedPump() as simulated:
        yield simulated


@pytest.fixture
def pump(device: SimulatedPump) -> Iterator[Pump]:
    with Pump.open(device.port) as opened:
        yield opened


@pytest.fixture(scope="session")
def avr_program(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The command that runs the sketch on a simulated ATmega328P."""
    missing = [tool for tool in ("make", "avr-gcc", "avr-g++") if shutil.which(tool) is None]
    missing += [] if Path("/usr/share/arduino/hardware/arduino/avr").is_dir() else ["arduino-core-avr"]
    missing += [] if Path("/usr/include/simavr").is_dir() else ["libsimavr-dev"]
    if missing:
        pytest.skip(f"no {', '.join(missing)}: `make firmware-test` installs what builds the sketch and simulates it")
    build = tmp_path_factory.mktemp("avr")
    command = ["make", "-s", "-C", str(firmware.sources()), f"BUILD={build}", "avr"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return [str(build / "rspump_avr"), str(build / "rspump.elf")]
