"""`rainstereo simulate`: a digital rig takes a recording, and the truth is written beside it."""

from __future__ import annotations

import re
import shutil
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from rainstereo import Rig
from rainstereo.apps.board_poses import board_poses
from rainstereo.apps.digital_rig import RigOptions, digital_rig
from rainstereo.apps.report import Report, Tile, quantity
from rainstereo.apps.run_record import Record
from rainstereo.apps.simulation import Capture, Simulation, fingerprint_in
from rainstereo.apps.simulation_images import MOST_WORKERS, jobs, write_images
from rainstereo.apps.street import drive
from rainstereo.calib.board import Board
from rainstereo.rig import ROLES
from rainstereo.sensor import Sensor
from rainstereo.types import Image

FOLDERS = r"truth|drive|live|(chessboard|charuco|aprilgrid)(-[0-9]+)?"


@dataclass(frozen=True)
class Options:
    """Take a recording with a digital rig: boards without and with the chamber, a drive along a street, the truth.

    The same options and seed give the same bytes. A run that was interrupted goes on where it stopped when it is
    repeated; finished images stay.
    """

    out: Path
    """Folder to write; made if missing."""
    boards: tuple[str, ...] = ("chessboard:9x6:25mm", "charuco:11x8:25mm:19mm:DICT_4X4_250")
    """Boards to capture: chessboard:WxH:SQUARE (inner corners), charuco:WxH:SQUARE:MARKER:DICTIONARY (squares),
    aprilgrid:WxH:TAG:SPACING (tags, gaps in sides of a tag), or a description as rainstereo board writes it,
    FILE.toml."""
    frames: int = 20
    """Poses of each board behind the chamber."""
    bare_frames: int = 20
    """Poses of each board without the chamber; 0: no such capture."""
    still: bool = False
    """Rig and board stand still while the chamber is put in: the capture without it shows the same poses."""
    near_m: float | None = None
    """Nearest board, metres; by default 0.3, or where a larger board fills the frame."""
    far_m: float | None = None
    """Farthest board, metres; by default 1, or three times as far as where the board fills the frame."""
    board_tilt_deg: float = 45.0
    """Steepest lean of a board."""
    drive_frames: int = 6
    """Pairs of the drive along the street; 0: no drive."""
    drive_step_m: float = 0.8
    """Way between two pairs of the drive."""
    blur_px: float = 0.7
    """Standard deviation of the lens's point-spread function, pixels."""
    noise: float = 1.0
    """Standard deviation of the noise, gray levels."""
    vignetting: float = 2.0
    """Exponent of the cosine of the angle off the axis by which images darken; 0: none, 4: cosine-fourth law."""
    supersampling: int = 4
    """Samples along each side of a pixel of a board."""
    rig: tyro.conf.OmitArgPrefixes[RigOptions] = field(default_factory=RigOptions)
    """The rig."""
    seed: int = 0
    """Decides everything that is drawn at random."""
    workers: int = 0
    """Threads that render; 0: one a processor. Their number changes no byte."""
    overwrite: bool = False
    """Replace a recording that other options made."""
    live: bool = False
    """Then let the rig work live: fake cameras, the pump's firmware, and rainstereo record, into OUT/live."""
    live_seconds: float = 60.0
    """Seconds of the live drive, through all regimes of the pump."""
    live_rate_hz: float = 16.0
    """Pairs a second of the live cameras."""
    live_schedule: Path | None = None
    """Schedule of the pump (TOML) in place of all regimes in turn."""
    live_codec: str = "auto"
    """Codec of the live recordings; see rainstereo record."""


def simulation(options: Options) -> Simulation:
    """What the options describe, with all poses drawn; nothing is written. ValueError where an option is wrong."""
    if options.seed < 0:
        raise ValueError(f"seed {options.seed} was given; expected a whole number, 0 or more")
    if not options.boards and not options.drive_frames:
        raise ValueError("neither boards nor drive frames were asked for; there would be nothing to see")
    if not 0 <= options.workers <= MOST_WORKERS:
        raise ValueError(f"--workers {options.workers} was given; expected 0 (one a processor) to {MOST_WORKERS}")
    if options.live and (options.drive_frames < 2 or not options.rig.panels):
        raise ValueError("--live needs --drive-frames 2 or more, and a chamber (--panels 1 or more)")
    if not (1 <= options.live_rate_hz <= 100 and 1 <= options.live_seconds <= 86400):
        raise ValueError(
            f"--live-rate-hz {options.live_rate_hz:g} and --live-seconds {options.live_seconds:g} were given; expected "
            "1 to 100 pairs a second and 1 to 86400 seconds"
        )
    if not 1 <= options.supersampling <= 16:
        raise ValueError(f"--supersampling {options.supersampling} was given; expected 1 to 16")
    rig = digital_rig(options.rig, options.seed)
    sensor = Sensor(options.blur_px, options.vignetting, options.noise)
    way = drive(options.drive_frames, options.seed, options.drive_step_m)
    captures = [
        capture
        for i, (name, board) in enumerate(_named(options.boards).items())
        for capture in _captures(options, rig, name, board, (options.seed, i))
    ]
    return Simulation(rig, sensor, captures, way, options.seed, options.supersampling)


def run(options: Options) -> int:
    """Write the recording, `report.json` and `report.html`; 0 when done."""
    record = Record("simulate", options)
    plan = simulation(options)
    _claim(options.out, plan, options.overwrite)
    plan.write_truth(options.out)
    planned = record.elapsed
    total = sum(len(jobs(plan, role, through)) for through in (True, False) for role in ROLES)
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("rendering", total=total)
        made, kept = write_images(plan, options.out, workers=options.workers, progress=lambda n: bar.advance(task, n))
    record["images_made"], record["images_kept"] = made, kept
    record["planning_s"], record["rendering_s"] = round(planned, 3), round(record.elapsed - planned, 3)
    record["fingerprint"] = plan.fingerprint
    record["baseline_m"] = plan.rig.baseline
    record["folders"] = {c.folder: {"board": c.board.spec, "pairs": len(c.poses)} for c in plan.captures}
    _report(options, plan, record)
    record.write(options.out / "report.json")
    console.print(f"{made} images made, {kept} kept, in {record.elapsed:.1f} s: {options.out}")
    return _live(options, plan) if options.live else 0


def _live(options: Options, plan: Simulation) -> int:
    from rainstereo.apps.live_rig import run_live

    boards = next((capture.folder for capture in plan.captures if capture.through), None)
    return run_live(
        options.out, boards, options.live_rate_hz, options.live_seconds, options.live_schedule, options.live_codec
    )


def _named(specs: tuple[str, ...]) -> dict[str, Board]:
    """The boards by their folder: chessboard, charuco, and with a number from the second of a kind on."""
    boards: dict[str, Board] = {}
    for spec in specs:
        board = Board.parse(spec)
        if board in boards.values():
            raise ValueError(f"the board {spec} was asked for twice; name each once")
        count = 1 + sum(other.kind == board.kind for other in boards.values())
        boards[board.kind if count == 1 else f"{board.kind}-{count}"] = board
    return boards


def _captures(options: Options, rig: Rig, name: str, board: Board, seed: tuple[int, ...]) -> list[Capture]:
    captures = []
    for through, frames in ((False, options.bare_frames), (True, options.frames)):
        if frames:
            poses = board_poses(
                rig, board, frames, (*seed, int(through or options.still)), through=through or options.still,
                near=options.near_m, far=options.far_m, tilt_deg=options.board_tilt_deg,
            )  # fmt: skip
            captures.append(Capture(name, board, through, poses))
    return captures


def _claim(folder: Path, plan: Simulation, overwrite: bool) -> None:
    """Make the folder ours: new, or with the same recording to go on with, or with another of ours that may go.

    What `simulate` has not written is never removed.
    """
    found = fingerprint_in(folder)
    ours = {"truth", "drive", *(capture.name for capture in plan.captures)}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if found == plan.fingerprint:
            return
        old = {path.name for path in folder.iterdir() if re.fullmatch(FOLDERS, path.name)} if found else set()
        taken = sorted(name for name in ours | old if (folder / name).exists())
        if taken and found is None:
            raise ValueError(f"{folder} holds {', '.join(taken)}, not written by simulate; name another --out")
        if taken and not overwrite:
            raise ValueError(
                f"{folder} holds a recording that other options or versions made; name another --out, or replace it "
                "with --overwrite"
            )
        for name in taken:
            shutil.rmtree(folder / name)
    except OSError as error:
        raise ValueError(f"{folder} cannot be written ({error.strerror}); name another folder as --out") from error


def _report(options: Options, plan: Simulation, record: Record) -> None:
    """`report.html`: what the recording looks like."""
    rig = plan.rig
    chamber = "no chamber" if rig.chamber is None else f"chamber tilted by {np.degrees(rig.chamber.tilt):.1f} degrees"
    page = Report("Simulated recording", f"digital rig, {quantity(1000 * rig.baseline, 'mm')} baseline, {chamber}")
    page.tiles(
        Tile("images", int(record["images_made"]) + int(record["images_kept"])),  # type: ignore[call-overload]
        Tile("size", f"{rig.dry.width} x {rig.dry.height}", "px"),
        Tile("noise", plan.sensor.noise, "levels"),
        Tile("blur", plan.sensor.blur, "px", "standard deviation"),
    )
    if len(plan.drive):
        page.section("Drive", "The wet and the dry camera in turn: what is near jumps, as 29 mm apart it must.")
        pair = [_thumbnail(options.out / f"drive/{role}/000.png", 900) for role in ("wet", "dry")]
        page.blink(pair[0], pair[1], ("wet", "dry"), "First pair of the drive, as recorded.")
        depth = _depth_picture(options.out / "drive/depth/000.npz")
        page.image(depth, "Depth of the dry image on a logarithmic scale: 3 m light, 300 m dark, sky white.")
    for capture in plan.captures:
        where = "behind the chamber" if capture.through else "without the chamber"
        page.section(f"{capture.board.spec} {where}", f"{len(capture.poses)} pairs; the dry camera's first twelve.")
        names = [f"{i:03d}" for i in range(min(12, len(capture.poses)))]
        folder = options.out / capture.folder / "dry"
        page.images([_thumbnail(folder / f"{name}.png", 320) for name in names], names)
    page.record(record)
    page.write(options.out / "report.html")


def _thumbnail(path: Path, width: int) -> Image:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise RuntimeError(f"{path} cannot be read back; was it removed?")
    return cv2.resize(image, (width, round(width * image.shape[0] / image.shape[1])), interpolation=cv2.INTER_AREA)


def _depth_picture(path: Path) -> Image:
    with np.load(path) as file:
        depth = file["depth"]
    share = np.log(np.clip(np.nan_to_num(depth, nan=3.0), 3, 300) / 3) / np.log(100)
    picture: Image = cv2.applyColorMap(np.rint(255 * (1 - share)).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    picture[np.isnan(depth)] = 255
    return cv2.resize(picture, (900, round(900 * depth.shape[0] / depth.shape[1])), interpolation=cv2.INTER_AREA)
