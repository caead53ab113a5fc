"""`rainstereo pump`: what the pump is doing, one regime, a schedule, a stop; every segment logged on both clocks."""

from __future__ import annotations

import contextlib
import dataclasses
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Annotated

import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from rainstereo.apps.run_record import Record
from rainstereo.hardware.firmware import SimulatedPump
from rainstereo.hardware.frame import STOP_BYTE, Event
from rainstereo.hardware.player import Player
from rainstereo.hardware.pump import WATCHDOG_MS, Pump, Status
from rainstereo.hardware.pump_log import SegmentLog
from rainstereo.hardware.regime import DURATION_MAX_MS, REGIMES, Regime, Segment
from rainstereo.hardware.schedule import Planned, Schedule, Step
from rainstereo.hardware.serial_line import PortError, PumpError, send_stop_byte

ACTIONS = ("status", "run", "schedule", "stop", "monitor")
POLL_S = 0.05


@dataclasses.dataclass(frozen=True)
class Options:
    """Drive the rig's pump over its serial line. It is off whenever nobody says otherwise.

    `status` says what it is and does. `run REGIME` (mist, drops, large, streaks, settle) or `run --duty N` runs once.
    `schedule FILE` plays a TOML schedule. `stop` stops it at once, whoever else uses it. `monitor` watches and
    reconnects. OUT/segments.jsonl holds every segment with host and device time, OUT/report.json the rest.
    """

    action: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ACTION")]
    """status, run, schedule, stop or monitor."""
    what: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="WHAT")] = ""
    """For run the regime's name, for schedule the TOML file."""
    port: Annotated[str, tyro.conf.arg(metavar="PORT")] = ""
    """Serial port, such as /dev/ttyACM0."""
    simulate: bool = False
    """Without a pump: build the firmware's core (needs a C++ compiler) and run it on a pseudo-terminal."""
    duration_s: float | None = None
    """run: how long (default: the regime's own time, 10 s with --duty). monitor: when to end."""
    duty: int | None = None
    """run: per mille, in place of a regime."""
    on_ms: int = 0
    """run with --duty: pulses, milliseconds on; 0 for none."""
    off_ms: int = 0
    """run with --duty: pulses, milliseconds off."""
    ramp_ms: int = 0
    """run with --duty: milliseconds to get there."""
    seed: int | None = None
    """schedule: draw the jitter by this seed in place of the file's."""
    dry_run: bool = False
    """run, schedule: print the plan and leave the pump alone."""
    clear: bool = False
    """status, run, schedule: clear a fault first (after its cause is mended)."""
    watchdog_ms: int = WATCHDOG_MS
    """Silence after which the device stops by itself, 200 to 2000."""
    spy: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """New file for a log of every byte on the line."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("out/pump")
    """Folder for report.json and segments.jsonl (which is continued)."""


def run(options: Options) -> int:
    """Do what is asked. Returns 0, or 1 if the pump has a fault at the end."""
    if options.action not in ACTIONS:
        raise ValueError(f"there is no action {options.action!r}; expected one of {', '.join(ACTIONS)}")
    record = Record("pump", options)
    plan = _plan(options)
    if plan and options.dry_run:
        _print_plan(plan)
        record["plan"] = plan
        record.write(options.out / "report.json")
        return 0
    if options.simulate == bool(options.port):
        raise ValueError("give either --port (ls /dev/ttyACM* /dev/ttyUSB* lists candidates) or --simulate")
    with _terminated_like_interrupted(), contextlib.ExitStack() as stack:
        port = stack.enter_context(SimulatedPump()).port if options.simulate else options.port
        try:
            status = _stop(port, record) if options.action == "stop" else _drive(port, options, plan, record)
        except BaseException as error:
            record.status = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
            record["error"] = str(error)
            raise
        finally:
            record.write(options.out / "report.json")
    if status is not None:
        print(_line(status))
    return 1 if status is not None and status.fault else 0


def _drive(port: str, options: Options, plan: tuple[Planned, ...], record: Record) -> Status:
    with Pump.open(port, spy=options.spy) as pump:
        record["port"], record["identity"] = port, pump.identity
        print(f"{port}: firmware {pump.identity.firmware}, duty up to {pump.identity.max_duty} per mille")
        if options.clear:
            pump.clear()
        if options.action == "monitor":
            status = _monitor(pump, options)
        else:
            if plan:
                _play(pump, plan, options, record)
            status = pump.status()
        record["pump"] = status
        record["events"] = [
            {"host_ns": host_ns, "words": event.words, **dataclasses.asdict(event)} for host_ns, event in pump.events
        ]
        record["retries"] = pump.retries
        return status


def _plan(options: Options) -> tuple[Planned, ...]:
    if options.action == "schedule":
        if not options.what:
            raise ValueError("which schedule? rainstereo pump schedule FILE.toml --port PORT")
        return Schedule.load(options.what).expand(options.seed)
    if options.action != "run":
        if options.what:
            raise ValueError(f"{options.action} was given {options.what!r}; it takes nothing more")
        return ()
    if (options.duty is None) == (not options.what):
        raise ValueError(f"run either a regime ({', '.join(REGIMES)}) or --duty N")
    if options.duty is not None:
        duration = round(1000 * (10.0 if options.duration_s is None else options.duration_s))
        first = min(duration, DURATION_MAX_MS)
        segment = Segment(options.duty, first, options.on_ms, options.off_ms, options.ramp_ms)
        return Schedule((Step(Regime("by hand", (segment,)), duration / 1000),)).expand()
    if options.what not in REGIMES:
        raise ValueError(f"there is no regime {options.what!r}; expected one of {', '.join(REGIMES)}, or a schedule")
    return Schedule((Step(REGIMES[options.what], options.duration_s),)).expand()


def _play(pump: Pump, plan: tuple[Planned, ...], options: Options, record: Record) -> None:
    total = (plan[-1].start_ms + plan[-1].segment.duration_ms) / 1000
    if not all(each.calibrated for each in plan):
        print("not calibrated: nobody has yet checked what these values make on this rig's pane")
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with (
        SegmentLog(options.out / "segments.jsonl") as log,
        Progress(*columns, console=Console(stderr=True), transient=True) as progress,
    ):
        task = progress.add_task("", total=total)
        begun = time.monotonic()
        player = Player(pump, plan, log, options.watchdog_ms)
        try:
            while not player.done:
                player.poll()
                progress.update(task, completed=time.monotonic() - begun, description=player.regime)
                time.sleep(POLL_S)
        except BaseException as error:
            with contextlib.suppress(PumpError):
                player.stop(str(error) or type(error).__name__)
            raise
        finally:
            record["segments_planned"], record["segments_played"] = len(plan), len(player.played)
            record["log"] = log.path


def _monitor(pump: Pump, options: Options) -> Status:
    until = float("inf") if options.duration_s is None else time.monotonic() + options.duration_s

    def show(_: int, event: Event) -> None:
        print(f"{event.device_ms / 1000:10.3f} s  {event.words}", flush=True)

    pump.on_event = show
    while True:
        try:
            status = pump.status()
        except PumpError as error:
            print(f"{error}; reconnecting", flush=True)
            pump.reconnect(max(0.0, min(600.0, until - time.monotonic())))
            print("connected again; the pump is off", flush=True)
            continue
        if time.monotonic() >= until:
            return status
        print(_line(status), flush=True)
        time.sleep(min(1.0, max(0.0, until - time.monotonic())))


def _stop(port: str, record: Record) -> Status | None:
    """By the protocol where the port is free, else by the emergency byte beside whoever holds it."""
    try:
        with Pump.open(port) as pump:
            pump.stop()
            status = pump.status()
            record["pump"], record["stopped"] = status, "by command"
            return status
    except PortError as error:
        if "another program" not in str(error):
            raise
    send_stop_byte(port, STOP_BYTE)
    record["stopped"] = "by an emergency stop, while another program holds the port"
    print("emergency stop sent; another program holds the port. Clear the fault before the next run (--clear)")
    return None


def _print_plan(plan: tuple[Planned, ...]) -> None:
    print("   start s  regime        duty  on/off ms   ramp ms  duration s")
    for each in plan:
        s = each.segment
        print(
            f"{each.start_ms / 1000:10.3f}  {each.regime:<12}{s.duty:6d}  {s.on_ms:5d}/{s.off_ms:<5d}{s.ramp_ms:8d}"
            f"{s.duration_ms / 1000:12.3f}"
        )


def _line(status: Status) -> str:
    fault = f"  FAULT: {status.fault_words}" if status.fault else ""
    return (
        f"{status.device_ms / 1000:10.3f} s  {status.state:<5}  duty {status.duty:4d} per mille  "
        f"bad frames {status.bad_frames}{fault}"
    )


@contextlib.contextmanager
def _terminated_like_interrupted() -> Iterator[None]:
    """SIGTERM leaves by the same door as Ctrl-C: the pump is turned off rather than left to its watchdog."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    try:
        before = signal.signal(signal.SIGTERM, interrupt)
    except ValueError:  # not the main thread
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
