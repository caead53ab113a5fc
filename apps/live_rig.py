"""`rainstereo simulate --live`: the digital rig at work, with cameras on the network and the pump's own firmware.

OUT/live/boards    a recording of the board behind the chamber, pump off: for calibrate
OUT/live/drive     a recording of the street while the pump follows its schedule: for align, select, train
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

from rainstereo import Rig
from rainstereo.apps import record
from rainstereo.apps.live_scene import PIXEL_FORMAT, LiveScene
from rainstereo.hardware import own_network
from rainstereo.hardware.aravis_camera import AravisCamera, load_aravis
from rainstereo.hardware.camera_source import CameraSource
from rainstereo.hardware.capture import CameraPair
from rainstereo.hardware.fake_cameras import FakeCameras
from rainstereo.hardware.firmware import SimulatedPump, build_program
from rainstereo.hardware.frame_board import FrameBoard
from rainstereo.hardware.own_network import ADDRESSES
from rainstereo.hardware.pump import Pump
from rainstereo.hardware.recording import open_recording
from rainstereo.hardware.regime import REGIMES
from rainstereo.hardware.schedule import Schedule, Step
from rainstereo.rig import ROLES, Role


def default_schedule(seconds: float) -> Schedule:
    """Every built-in regime in turn, in so many seconds."""
    each = seconds / len(REGIMES)
    return Schedule(tuple(Step(regime, each) for regime in REGIMES.values()))


def check() -> None:
    """RuntimeError, with the remedy, where something that the live rig needs is missing."""
    load_aravis()
    build_program()
    why_not = own_network.available()
    if why_not:
        raise RuntimeError(why_not)


def run_live(out: Path, boards: str | None, rate_hz: float, seconds: float, schedule: Path | None, codec: str) -> int:
    """Take both recordings into OUT/live, in a network of their own; finished ones stay. boards: folder of board
    images below OUT, or None. The exit status."""
    check()
    words = [sys.executable, "-m", "rainstereo.apps.live_rig", str(out), boards or "", repr(rate_hz), repr(seconds)]
    words += [str(schedule) if schedule is not None else "", codec]
    try:
        return own_network.run_inside(words)
    except subprocess.SubprocessError as error:
        raise RuntimeError(f"the live rig could not be started ({error})") from error


def _record(
    out: Path, name: str, images: Path, rate_hz: float, plan: Schedule | None, pairs: int | None, codec: str
) -> int:
    target = out / "live" / name
    if _finished(target):
        return 0
    if target.exists():
        shutil.rmtree(target)  # ours: a recording of the live rig that did not come to its end
    size = Rig.load(out / "truth").dry.size
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None  # noqa: S108 - a folder of its own within it
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rainstereo-live-", dir=memory)))
        board = stack.enter_context(FrameBoard(folder / "frames", *size, create=True))
        device = None if plan is None else stack.enter_context(SimulatedPump())
        trace = None if device is None else device.trace
        stack.enter_context(LiveScene(out / "truth", images, board, rate_hz, trace))
        stack.enter_context(FakeCameras(board, rate_hz))
        sources: dict[Role, CameraSource] = {
            role: AravisCamera(address, rate_hz=rate_hz, pixel_format=PIXEL_FORMAT, size=size, shared_clock=True)
            for role, address in zip(ROLES, ADDRESSES, strict=True)
        }
        cameras = stack.enter_context(CameraPair(sources, grid_s=1 / rate_hz))
        pump = None if device is None else stack.enter_context(Pump.open(device.port))
        options = record.Options(
            out=target, rate_hz=rate_hz, pairs=pairs, codec=codec, least_free_gb=0.2, watchdog_ms=2000
        )
        about = {"cameras": {role: sources[role].name for role in ROLES}, "simulated": True}
        return record.take(options, target, cameras, pump, None if plan is None else plan.expand(), about)


def _finished(folder: Path) -> bool:
    try:
        return open_recording(folder).about.get("state") == "closed" and (folder / "report.json").exists()
    except (FileNotFoundError, ValueError):
        return False


def main() -> int:
    """Inside the network: take the recordings."""
    folder, boards, rate, seconds, schedule, codec = sys.argv[1:]
    out = Path(folder)
    own_network.set_up()
    if boards:
        images = out / boards
        count = len(list((images / "dry").glob("*.png")))
        status = _record(out, "boards", images, float(rate), None, count, codec)
        if status:
            return status
    plan = Schedule.load(schedule) if schedule else default_schedule(float(seconds))
    return _record(out, "drive", out / "drive", float(rate), plan, None, codec)


if __name__ == "__main__":
    sys.exit(main())
