"""The pump's firmware without the pump: the sketch's protocol core, built here and run on a pseudo-terminal.

    with SimulatedPump() as device, Pump.open(device.port) as pump:
        ...
        device.applied()          # what a real pump would have got, and when

It needs a C++ compiler and the `firmware` folder of a checkout (an installed package does not carry it).
"""

from __future__ import annotations

import hashlib
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

_CORE = ("rspump/rsp_core.h", "rspump/rsp_core.cpp")
_PROGRAM = ("native/main.cpp", "native/line_noise.h", "native/pseudo_terminal.h")
_LIBRARY = ("native/rsp_c.cpp",)
_FLAGS = ("-std=c++11", "-O2", "-Wall", "-Wextra")


@dataclass(frozen=True)
class Applied:
    """The duty, per mille, from `monotonic_ns` (CLOCK_MONOTONIC) and `device_ms` on; state and fault as numbers."""

    monotonic_ns: int
    device_ms: int
    duty: int
    state: int
    fault: int


def sources() -> Path:
    """The folder of the firmware: `RAINSTEREO_FIRMWARE` if that is set, else beside the package in a checkout."""
    named = os.environ.get("RAINSTEREO_FIRMWARE")
    folder = Path(named) if named else Path(__file__).resolve().parents[2] / "firmware"
    if not (folder / _CORE[0]).is_file():
        raise RuntimeError(
            f"the pump's firmware is not in {folder}. It comes with a checkout of rainstereo, not with the installed "
            "package: run from one, or set RAINSTEREO_FIRMWARE to its firmware folder"
        )
    return folder


def compiler() -> str:
    """The C++ compiler: `CXX` if that is set, else c++, g++ or clang++."""
    for name in (os.environ.get("CXX", ""), "c++", "g++", "clang++"):
        if name and shutil.which(name):
            return name
    raise RuntimeError("the simulated pump needs a C++ compiler. Get one: sudo apt-get install g++")


def build_program() -> Path:
    """The firmware as a program; built once for each version of its sources."""
    return _build("rspump_native", ("native/main.cpp", "rspump/rsp_core.cpp"), _CORE + _PROGRAM)


def build_library() -> Path:
    """The firmware's core behind plain C functions, as a shared library."""
    flags = ("-fPIC", "-shared")
    return _build("librsp.so", ("native/rsp_c.cpp", "rspump/rsp_core.cpp"), _CORE + _LIBRARY, flags)


def _build(name: str, units: Sequence[str], depends: Sequence[str], flags: Sequence[str] = ()) -> Path:
    folder, tool = sources(), compiler()
    content = b"\0".join(
        [*((folder / each).read_bytes() for each in depends), " ".join((tool, *_FLAGS, *flags)).encode()]
    )
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rainstereo" / "firmware"
    built = cache / hashlib.sha256(content).hexdigest()[:16] / name
    if built.is_file():
        return built
    built.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=built.parent) as place:
        made = Path(place) / name
        done = subprocess.run(
            [tool, *_FLAGS, *flags, "-o", str(made), *(str(folder / each) for each in units)],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        if done.returncode != 0:
            raise RuntimeError(f"{tool} could not build the firmware:\n{done.stderr[-2000:]}")
        made.replace(built)
    return built


class SimulatedPump:
    """The firmware, running. port: to be opened like any serial port.

    corrupt, drop, insert: bytes in a million that the line changes, loses, makes up, both ways, by `seed`.
    program: another build of the firmware with the same options (the simulated AVR).
    """

    def __init__(
        self, *, corrupt: int = 0, drop: int = 0, insert: int = 0, seed: int = 1, max_duty: int = 1000,
        program: Sequence[str] | None = None,
    ) -> None:  # fmt: skip
        self._folder = tempfile.TemporaryDirectory(prefix="rainstereo-pump-")
        self.trace = Path(self._folder.name) / "applied"
        words = [*(program or [str(build_program())]), "--trace", str(self.trace)]
        for name, value in (("corrupt", corrupt), ("drop", drop), ("insert", insert)):
            words += [f"--{name}", str(value)] if value else []
        words += ["--seed", str(seed)] if corrupt or drop or insert else []
        words += ["--max-duty", str(max_duty)] if max_duty != 1000 else []
        self.process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.port = self.process.stdout.readline().strip() if self.process.stdout else ""
        if not self.port:
            self.close()
            raise RuntimeError(f"the simulated pump did not start: {' '.join(words)}")

    def applied(self) -> list[Applied]:
        """Every change of duty, state or fault so far."""
        lines = self.trace.read_text().split("\n")[:-1] if self.trace.exists() else []
        return [Applied(*map(int, line.split())) for line in lines]

    def wait(self, duty: int, timeout: float = 5.0) -> Applied:
        """The present entry of `applied` once it has this duty; TimeoutError if it does not come to that."""
        until = time.monotonic() + timeout
        while True:
            applied = self.applied()
            if applied and applied[-1].duty == duty:
                return applied[-1]
            if time.monotonic() > until:
                raise TimeoutError(f"the duty is not {duty} after {timeout} s but {applied[-1:]}")
            time.sleep(0.005)

    def reservoir(self, *, low: bool) -> None:
        """Let the reservoir run low, or fill it."""
        self.process.send_signal(signal.SIGUSR1 if low else signal.SIGUSR2)

    def close(self) -> None:
        """Unplug it."""
        self.process.kill()
        self.process.wait()
        for stream in (self.process.stdin, self.process.stdout):
            if stream is not None:
                stream.close()
        self._folder.cleanup()

    def __enter__(self) -> SimulatedPump:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
