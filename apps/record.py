"""`rainstereo record`: cameras and pump into a recording that survives a crash; and verify, repair, export."""

from __future__ import annotations

import dataclasses
import os
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

from rainstereo.apps.record_export import Layout, export
from rainstereo.apps.recording_session import Outcome, Preview, StopWhen, results, session
from rainstereo.apps.report import Report, Tile
from rainstereo.apps.run_record import Record
from rainstereo.hardware.capture import CameraPair
from rainstereo.hardware.codec import CODECS
from rainstereo.hardware.codec_choice import choose, disk_rate, measure
from rainstereo.hardware.pair_frame import PairFrame
from rainstereo.hardware.player import Player
from rainstereo.hardware.pump import WATCHDOG_MS, Pump
from rainstereo.hardware.pump_log import SegmentLog
from rainstereo.hardware.recording import Recording, open_recording
from rainstereo.hardware.recording_repair import Verdict, repair, total_bytes, verify
from rainstereo.hardware.recording_writer import RecordingWriter
from rainstereo.hardware.schedule import Schedule

DEFAULT_RATE = 16.0


@dataclasses.dataclass(frozen=True)
class Options:
    """Record pairs of two cameras while the pump follows its schedule; or look after a recording that is there.

    rainstereo record --dry aravis:A --wet aravis:B --pump /dev/ttyACM0 --schedule rain.toml --out DIR
    rainstereo record verify DIR      reads every byte, says what is damaged, to the bit if one is flipped
    rainstereo record repair DIR      cuts off what a crash left, mends flipped bits, makes the index from the log
    rainstereo record export DIR --out FOLDER --layout robotcar
    """

    action: Annotated[
        tyro.conf.Positional[Literal["take", "verify", "repair", "export"]], tyro.conf.arg(metavar="ACTION")
    ] = "take"
    """take (the default), verify, repair or export."""
    recording: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="RECORDING")] = None
    """Folder of the recording to verify, repair or export."""
    out: Path | None = None
    """Folder for the new recording; or, to export, for the images."""
    dry: str | None = None
    """The dry camera: aravis:ADDRESS, pylon:SERIAL, folder:PATH or video:FILE."""
    wet: str | None = None
    """The wet camera, of the same kind."""
    rate_hz: float | None = None
    """Frames a second, if the cameras time themselves; otherwise they are left as they are set."""
    pixel_format: str | None = None
    """Pixel format to ask for, such as BayerRG8; of folders: what gray files are mosaics of."""
    shared_clock: bool = False
    """The cameras' clocks are synchronised (PTP)."""
    pump: str | None = None
    """Serial port of the pump."""
    schedule: Path | None = None
    """The pump's schedule (TOML); see rainstereo pump."""
    watchdog_ms: int = WATCHDOG_MS
    """Silence of this program after which the pump turns itself off, 200 to 2000."""
    codec: str = "auto"
    """raw, zstd, blosc, jxl (JPEG XL), png, or auto: the smallest that keeps up on this machine, as measured."""
    workers: int = 2
    """Threads that compress."""
    sync_s: float = 0.5
    """Seconds between syncs to the disk: so much may be lost with the power. 0: every pair is synced."""
    pairs: int | None = None
    """Stop after so many pairs."""
    seconds: float | None = None
    """Stop after so many seconds."""
    least_free_gb: float = 1.0
    """Stop when less room than this is left on the disk."""
    silence_s: float = 30.0
    """Give up when no pair came for so long; cameras that were unplugged are looked for meanwhile."""
    preview_s: float = 2.0
    """Seconds between two preview sheets (preview.jpg in the recording); 0: none."""
    layout: Layout = "robotcar"
    """Of an export."""
    raw: bool = False
    """Export mosaics as they are, gray, instead of colours."""


class EventLog(SegmentLog):
    """The pump's log, in its own file and in the recording's log."""

    def __init__(self, path: Path, writer: RecordingWriter) -> None:
        super().__init__(path)
        self._writer = writer

    def _store(self, event: str, values: dict[str, Any], line: bytes) -> None:
        super()._store(event, values, line)
        self._writer.event(f"pump {event}", **values)


def run(options: Options) -> int:
    """Do what is asked; 0 when done, 1 when a recording ended otherwise than asked, or a log is damaged."""
    if options.action == "take":
        return _take(options)
    if options.recording is None:
        raise ValueError(f"rainstereo record {options.action} needs the folder of a recording")
    actions = {"verify": _verify, "repair": _repair, "export": _export}
    return actions[options.action](options, options.recording)


# -- take --------------------------------------------------------------------------------------------------------------


def _take(options: Options) -> int:
    if options.dry is None or options.wet is None or options.out is None:
        raise ValueError("a recording needs --dry, --wet and --out; see rainstereo record --help")
    if (options.pump is None) != (options.schedule is None):
        raise ValueError("a pump needs a schedule, and a schedule a pump: give both --pump and --schedule, or neither")
    plan = None if options.schedule is None else Schedule.load(options.schedule).expand()
    camera_options: dict[str, Any] = {"rate_hz": options.rate_hz, "pixel_format": options.pixel_format}
    if options.shared_clock:
        camera_options["shared_clock"] = True
    with ExitStack() as stack:
        cameras = stack.enter_context(CameraPair.open(options.dry, options.wet, **camera_options))
        pump = None if options.pump is None else stack.enter_context(Pump.open(options.pump))
        about = {"cameras": {"dry": options.dry, "wet": options.wet}, "schedule": _text(options.schedule)}
        return take(options, options.out, cameras, pump, plan, about)


def take(options: Options, out: Path, cameras: CameraPair, pump: Pump | None, plan: Any, about: dict[str, Any]) -> int:
    """Record from cameras that are open, with a pump or without; writes the recording, report.json and report.html."""
    record = Record("record", options)
    console = Console(stderr=True)
    out.mkdir(parents=True, exist_ok=True)
    cameras.start()
    first = _first_pairs(cameras, options.silence_s)
    codec = options.codec if options.codec in CODECS else _choose(options, out, first, record, console)
    if any(camera.free_running for camera in cameras.cameras.values()):
        cameras.begin_anew()  # what came while codecs were tried is old
    with RecordingWriter(
        out, about, codec=codec, workers=options.workers, sync_s=options.sync_s
    ) as writer, EventLog(out / "pump.jsonl", writer) as pump_log:  # fmt: skip
        cameras.event = writer.event
        if not any(camera.free_running for camera in cameras.cameras.values()):
            for pair in first:  # of files, nothing may be missing
                writer.write(pair)
        player = None if pump is None else Player(pump, plan, pump_log, options.watchdog_ms)
        left = None if options.pairs is None else max(0, options.pairs - writer.pairs - writer.waiting)
        until = StopWhen(left, options.seconds, round(1e9 * options.least_free_gb), options.silence_s)
        preview = Preview(out / "preview.jpg", options.preview_s)
        with Live(Text("recording"), console=console, transient=True, refresh_per_second=4) as live:
            outcome = session(cameras, writer, until, player, preview, lambda line: live.update(Text(line)))
        try:
            pump_log.close()
        except OSError as error:
            outcome.failed, outcome.reason = True, f"{outcome.reason}; the pump's log could not be written ({error})"
        found = results(outcome, writer)
        writer.close(**{key: value for key, value in found.items() if key not in ("dry", "wet", "sync")})
        if writer.error is not None and not outcome.failed:
            outcome.failed, outcome.reason = True, str(writer.error)
    return _report(options, out, record, writer, outcome, console)


def _first_pairs(cameras: CameraPair, patience_s: float) -> list[PairFrame]:
    """One pair, or two: what the codec is chosen by. RuntimeError where none comes."""
    first = cameras.read(max(patience_s, 1.0))
    if first is None:
        health = cameras.health
        raise RuntimeError(
            f"no pair came within {patience_s:g} s (frames received: dry {health.dry.received}, wet "
            f"{health.wet.received}); are the cameras triggered?"
        )
    return [first]


def _choose(options: Options, out: Path, pairs: list[PairFrame], record: Record, console: Console) -> str:
    if options.codec != "auto":
        raise ValueError(f"the codec {options.codec!r} is unknown; expected auto, {', '.join(CODECS)}")
    frames = [(pair.frame(role).image, pair.frame(role).pixel_format) for pair in pairs for role in ("dry", "wet")]
    rate = options.rate_hz or DEFAULT_RATE
    workers = min(options.workers, os.cpu_count() or 1)
    choice = choose(measure(frames), disk_rate(out), frames[0][0].nbytes, 2 * rate, workers)
    record["codec_choice"] = choice
    if not choice.enough:
        console.print(f"no codec keeps up twice with {2 * rate:g} frames a second here; {choice.codec} comes nearest")
    return choice.codec


def _report(
    options: Options, out: Path, record: Record, writer: RecordingWriter, outcome: Outcome, console: Console
) -> int:
    found = results(outcome, writer)
    for key, value in found.items():
        record[key] = value
    record["pairs"], record["codec"], record["lost_by_recorder"] = writer.pairs, writer.codec, writer.lost
    if outcome.failed:
        record.status = "failed"
    _page(out, record, outcome, writer)
    record.write(out / "report.json")
    health = outcome.health
    if health is not None:
        console.print(health.sync.words)
    console.print(f"{writer.pairs} pairs in {outcome.seconds:.1f} s, {outcome.reason}: {out}")
    return 1 if outcome.failed else 0


def _page(out: Path, record: Record, outcome: Outcome, writer: RecordingWriter) -> None:
    recording = open_recording(out)
    page = Report("Recording", f"{len(recording)} pairs; it ended because {outcome.reason}")
    health = outcome.health
    rate = len(recording) / outcome.seconds if outcome.seconds else 0.0
    if health is not None:
        theirs = sum(each.lost + each.damaged for each in (health.dry, health.wet))
        page.tiles(
            Tile("pairs", len(recording), "", f"{rate:.1f} a second"),
            Tile("lost by us", writer.lost + health.dry.overrun + health.wet.overrun, "frames"),
            Tile("lost by the cameras", theirs, "frames"),
            Tile("codec", recording.about["codec"], "", f"{writer.nbytes / 1e6:.0f} MB"),
        )
        page.section("In step?", health.sync.words)
    _pictures(page, recording)
    page.record(record)
    page.write(out / "report.html")


def _pictures(page: Report, recording: Recording) -> None:
    chosen: dict[str, int] = {}
    for i in range(0, len(recording), max(1, len(recording) // 60)):
        chosen[recording.meta(i)["regime"]] = i  # the last one of each regime that is looked at
    if not chosen:
        return
    page.section("What it looks like", "The last pair of each regime, wet and dry in turn.")
    for regime, i in list(chosen.items())[:8]:
        pair = recording.read(i)
        page.blink(pair.wet, pair.dry, ("wet", "dry"), f"{regime or 'no pump'}, pair {pair.id}")


def _text(path: Path | None) -> str | None:
    return None if path is None else path.read_text(encoding="utf-8")


# -- look after --------------------------------------------------------------------------------------------------------


def _progress() -> Progress:
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    return Progress(*columns, console=Console(stderr=True), transient=True)


def _verify(options: Options, folder: Path) -> int:
    record = Record("record verify", options)
    with _progress() as bar:
        task = bar.add_task("reading", total=total_bytes(folder) if folder.is_dir() else 0)
        verdict = verify(folder, lambda n: bar.advance(task, n))
    _say(verdict)
    record["pairs"], record["events"], record["bytes_read"] = verdict.pairs, verdict.events, verdict.bytes_read
    record["damage"], record["notes"] = [each.words for each in verdict.damage], verdict.notes
    record.status = "ok" if verdict.sound else "damaged"
    record.write((options.out or folder) / "verify.json")
    return 0 if verdict.sound else 1


def _repair(options: Options, folder: Path) -> int:
    record = Record("record repair", options)
    done = repair(folder)
    for line in done.changes or ["nothing had to be mended"]:
        print(line)
    after = verify(folder)
    _say(after)
    record["changes"], record["damage_before"] = done.changes, [each.words for each in done.before.damage]
    record["damage"] = [each.words for each in after.damage]
    record.status = "ok" if after.sound else "damaged"
    record.write((options.out or folder) / "repair.json")
    return 0 if after.sound else 1


def _say(verdict: Verdict) -> None:
    for damage in verdict.damage:
        print(damage.words)
    for note in verdict.notes:
        print(note)
    state = "sound" if verdict.sound else "see above; rainstereo record repair mends what can be mended"
    print(f"{verdict.pairs} pairs and {verdict.events} events are whole: {state}")


def _export(options: Options, folder: Path) -> int:
    if options.out is None:
        raise ValueError("an export needs --out, the folder for the images")
    record = Record("record export", options)
    recording = open_recording(folder)
    with _progress() as bar:
        task = bar.add_task("exporting", total=len(recording))
        count, bad = export(recording, options.out, options.layout, raw=options.raw, progress=lambda: bar.advance(task))
    for line in bad:
        print(line)
    record["pairs"], record["unreadable"], record["layout"] = count, bad, options.layout
    record.status = "ok" if not bad else "damaged"
    record.write(options.out / "report.json")
    print(f"{count} pairs: {options.out}")
    return 0 if not bad else 1
