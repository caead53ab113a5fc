"""`rainstereo demo`: a digital rig recorded, calibrated through acrylic, aligned, rained on and derained; one page."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from rainstereo import Camera, Chamber, Rig, imagefile
from rainstereo.apps import align, calibrate, derain, droplets, figures, overlays, rain, simulate
from rainstereo.apps.calibrate import Clock
from rainstereo.apps.cli import DONE
from rainstereo.apps.report import Report, Tile
from rainstereo.apps.run_record import Record
from rainstereo.calib import uncertainty
from rainstereo.calib.uncertainty import InfinityError
from rainstereo.refraction import project
from rainstereo.types import Array, Image

BOARD = "chessboard:9x6:25mm"
F_NUMBER = 8.0
"""Of the wet camera's lens; the rig's own images show drops that are blurred by a few pixels only."""
GRID = (33, 25)
RESTORED_WIDTH = 640
"""Pixels. The weights that come along learnt on images of 480; see docs/model-card.md."""


@dataclass(frozen=True)
class Options:
    """The toolkit at work without hardware: simulate, calibrate, align, drops, rain, derain. Three minutes at most."""

    out: Path
    """Folder for everything: OUT/report.html is the page to open."""
    pictures: Path | None = None
    """Folder for each picture of all reports as a file of its own."""
    frames: int = 20
    """Pairs of board images."""
    seed: int = 0
    """Of the digital rig and its recording."""


def run(options: Options) -> int:
    """Run all stages; the exit status is that of the first that fails."""
    record, clock = Record("demo", options), Clock()
    for stage, work in _stages(options).items():
        print(f"\n== {stage}", flush=True)
        status = work()
        if status != DONE:
            record.status = "failed"
            record["failed_at"] = stage
            record.write(options.out / "report.json")
            return status
        clock(stage)
    _report(options, record, clock)
    return DONE


def _stages(options: Options) -> dict[str, Callable[[], int]]:
    """The commands that the demo runs, as a user would."""
    out, pictures = options.out, options.pictures
    recording = out / "recording"
    boards, drive = recording / "chessboard" / "chamber", recording / "drive"
    record = simulate.Options(
        recording,
        boards=(BOARD,),
        frames=options.frames,
        bare_frames=0,
        drive_frames=4,
        seed=options.seed,
        overwrite=True,
    )
    through = calibrate.Options(
        BOARD, out / "rig", str(boards / "dry"), str(boards / "wet"), chamber=recording / "truth" / "chamber.toml",
        expected_baseline_mm=29.0, cache=out / "corners", pictures=pictures and pictures / "calibrate",
    )  # fmt: skip
    ignoring = replace(through, out=out / "rig-ignoring-acrylic", chamber=None, pictures=None)
    aligned = align.Options(
        str(drive / "dry"), str(drive / "wet"), out / "aligned", out / "rig", pictures=pictures and pictures / "align"
    )
    drops = droplets.Options(
        out / "droplets",
        out / "rig",
        f_number=F_NUMBER,
        tolerance=4.0,
        quick=True,
        pictures=out / "droplets" / "pictures",
    )
    rained = rain.Options(
        (str(drive / "wet"),), out / "rain", rig=out / "rig", f_number=F_NUMBER, seed=options.seed, overwrite=True
    )
    restored = derain.Options(
        (str(out / "rain-small"),), out / "derained", overwrite=True, pictures=pictures and pictures / "derain"
    )
    return {
        "simulate": lambda: simulate.run(record),
        "calibrate through the acrylic": lambda: calibrate.run(through),
        "calibrate as if there were none": lambda: calibrate.run(ignoring),
        "align": lambda: align.run(aligned),
        "drops": lambda: droplets.run(drops),
        "rain": lambda: rain.run(rained),
        "derain": lambda: _shrink(out) or derain.run(restored),
    }


def _report(options: Options, record: Record, clock: Clock) -> None:
    out = options.out
    true = Rig.load(out / "recording" / "truth")
    modelled, ignored = _Outcome(out / "rig", true), _Outcome(out / "rig-ignoring-acrylic", true)
    aligned = json.loads((out / "aligned" / "report.json").read_text())
    record["seconds"] = clock.seconds
    record["through_acrylic"], record["ignoring_acrylic"] = modelled.told(), ignored.told()
    record["aligned_pairs"] = aligned["pairs"]
    record["remaining_shift_px"] = aligned["remaining_shift_px"]

    page = Report("rainstereo, from board to rain", _described(true))
    page.verdict(
        "good",
        f"Calibrated through its acrylic, the rig knows directions at infinity to {modelled.error.dry.rms:.3f} px RMS. "
        f"With the acrylic ignored they are {ignored.error.dry.rms:.2f} px wrong, and the reprojection error "
        f"({modelled.report['rms_px']:.3f} against {ignored.report['rms_px']:.3f} px) hardly tells.",
        "It works.",
    )
    sigma = 1000 * modelled.report["baseline_sigma_m"]
    page.tiles(
        Tile("reprojection RMS", f"{modelled.report['rms_px']:.3f}", "px", "per coordinate, inliers"),
        Tile("baseline", f"{1000 * modelled.rig.baseline:.3f}", "mm",
             f"+- {sigma:.3f}; truth {1000 * true.baseline:.3f}"),
        Tile("error at infinity", f"{modelled.error.dry.rms:.3f}", "px", f"predicted {modelled.predicted('dry'):.3f}"),
        Tile("pairs aligned", aligned["pairs"], "", "undistorted, cropped, laid on each other"),
        Tile("all of it took", f"{sum(clock.seconds.values()):.0f}", "s", "see the last table"),
    )  # fmt: skip
    _recording(page, out)
    _acrylic(page, true, modelled, ignored)
    _alignment(page, out)
    _drop(page, out)
    _rain(page, out)
    record["derained"] = _derained(page, out)
    _next(page, out, clock)
    page.record(record)
    page.write(out / "report.html")
    if options.pictures:
        page.save_pictures(options.pictures / "demo")
    record.write(out / "report.json")
    print(f"\nOpen {out / 'report.html'}")


def _described(rig: Rig) -> str:
    words = f"a digital rig: two cameras {1000 * rig.baseline:.0f} mm apart"
    if rig.chamber is None:
        return words
    return f"{words} behind {len(rig.chamber.panels)} panels tilted by {np.degrees(rig.chamber.tilt):.0f} degrees"


class _Outcome:
    """A calibration and how far it is from the truth."""

    def __init__(self, folder: Path, true: Rig) -> None:
        self.rig = Rig.load(folder)
        self.true = true
        self.error: InfinityError = uncertainty.infinity_error(self.rig, true)
        self.report: dict[str, Any] = json.loads((folder / "report.json").read_text())

    def predicted(self, what: str) -> float:
        """What the calibration itself expects its RMS error at infinity to be, pixels."""
        return float(self.report["infinity_expected_rms_px"][what])

    def field(self) -> Array:
        """Distance, pixels, between where this dry camera and the true one see a direction, on a grid; the turn that
        fits best is left out, since a camera's own axes are a convention.
        """
        pixels = _grid(self.true.dry)
        here, there = (camera.unproject(pixels).reshape(-1, 3) for camera in (self.rig.dry, self.true.dry))
        turn, _ = Rotation.align_vectors(here, there)
        seen = self.rig.dry.project(turn.apply(there)).reshape(pixels.shape)
        return np.asarray(np.linalg.norm(seen - pixels, axis=-1))

    def row(self, words: str) -> tuple[str, ...]:
        """Its line in the table of the page."""
        error = self.error
        pixels = self.report["rms_px"], error.dry.rms, self.predicted("dry"), error.wet.rms, error.stereo.rms
        off = 1000 * (self.rig.baseline - self.true.baseline)
        return (words, *(f"{px:.4f}" for px in pixels), f"{1000 * self.true.baseline:.3f} {off:+.4f}")

    def told(self) -> dict[str, object]:
        keys = ("status", "lensmodel", "rms_px", "baseline_m", "baseline_sigma_m", "frames_used", "outliers")
        return {key: self.report[key] for key in keys} | {
            "infinity_error_px": self.error,
            "infinity_predicted_rms_px": self.report["infinity_expected_rms_px"],
            "baseline_error_m": self.rig.baseline - self.true.baseline,
        }


def _grid(camera: Camera) -> Array:
    """Pixels, (rows, columns, 2), from edge to edge of a camera's image."""
    x, y = (np.linspace(0, length - 1, count) for length, count in zip(camera.size, GRID, strict=True))
    return np.stack(np.meshgrid(x, y), -1)


def _recording(page: Report, out: Path) -> None:
    page.section(
        "The recording", "Traced ray by ray through both panels, with lens distortion, blur, vignetting and noise."
    )
    boards = out / "recording" / "chessboard" / "chamber"
    names = sorted(path.stem for path in (boards / "dry").iterdir())
    chosen = [names[i] for i in (0, len(names) // 3, 2 * len(names) // 3, -1)]
    page.images(
        [_small(boards / role / f"{name}.png", 420) for name in chosen for role in ("wet", "dry")],
        [f"board {name}, {role} camera" for name in chosen for role in ("wet", "dry")],
    )


def _acrylic(page: Report, true: Rig, modelled: _Outcome, ignored: _Outcome) -> None:
    page.section(
        "What the acrylic does",
        "It shifts near things and leaves far ones alone. A solve that ignores it bends the lens to fit: the residuals "
        "stay small, and the directions become wrong.",
    )
    if true.chamber is not None:
        shift = _shift(true.dry, true.chamber, 0.5)
        page.figure(
            figures.heat_map(shift, true.dry.size, "px", title="shift by the panels at 0.5 m"),
            "How far the panels move a point 0.5 m in front of the dry camera; at 5 m it is a tenth of that.",
        )
    top = float(np.nanpercentile(ignored.field(), 98))
    for outcome, words in ((ignored, "acrylic ignored"), (modelled, "acrylic modelled")):
        page.figure(
            figures.heat_map(outcome.field(), true.dry.size, "px", title=f"error at infinity, {words}", top=top),
            f"How far the dry camera's directions are from the true ones; RMS {outcome.error.dry.rms:.3f} px.",
        )
    page.table(
        (
            "px RMS",
            "reprojection",
            "dry at infinity",
            "predicted",
            "wet at infinity",
            "wet against dry",
            "baseline, mm",
        ),
        [modelled.row("acrylic modelled"), ignored.row("acrylic ignored")],
        "The same images, solved twice. Both cameras look through the same panels and are misled alike, so the pair "
        "still aligns; what is lost is where in the world things are.",
        strong=[0],
    )


def _shift(camera: Camera, chamber: Chamber, depth: float) -> Array:
    """Length of the shift by the panels, pixels, on a grid over the image, of points at z = depth."""
    pixels = _grid(camera)
    rays = camera.unproject(pixels)
    points = rays * (depth / rays[..., 2:])
    return np.asarray(np.linalg.norm(project(points, camera, chamber)[0] - pixels, axis=-1))


def _alignment(page: Report, out: Path) -> None:
    page.section(
        "An aligned pair",
        "Undistorted, cropped to what both see, and laid on each other at infinity; each image interpolated once.",
    )
    raw, aligned = (
        [imagefile.read(folder / role / "000.png") for role in ("dry", "wet")]
        for folder in (out / "recording" / "drive", out / "aligned")
    )
    page.images(
        [_shrunk(overlays.anaglyph(*raw), 900), _shrunk(overlays.anaglyph(*aligned), 900)],
        ["As recorded: dry in red, wet in cyan.", "Aligned: far things are gray; near ones keep their parallax."],
    )
    page.blink(_shrunk(aligned[0], 1100), _shrunk(aligned[1], 1100), ("dry", "wet"), "What still jumps is near.")


def _drop(page: Report, out: Path) -> None:
    told = json.loads((out / "droplets" / "report.json").read_text())
    page.section("A drop, in six levels of truth", told["verdict"]["sentence"])
    for name, caption in (
        ("one-drop-every-tier-2", "One drop of 1 mm on this rig's last panel; beneath each tier its difference to the "
         "truth. The paper's texture places its pixels wrongly and knows no dark rim."),
        ("out-of-focus-1", "The same drop through lenses of different aperture."),
    ):  # fmt: skip
        page.image(imagefile.read(out / "droplets" / "pictures" / f"{name}.png"), caption)


def _rain(page: Report, out: Path) -> None:
    page.section(
        "Rain on the wet camera's view",
        f"Drops on the far face of this rig's last panel, traced exactly, at F/{F_NUMBER:g}. Where no drop is, every "
        "pixel is as it was.",
    )
    folders = out / "recording" / "drive" / "wet", out / "rain"
    clear, rainy = (_shrunk(imagefile.read(folder / "000.png"), 1100) for folder in folders)
    page.compare(clear, rainy, ("clear", "rain"), "The same frame, clear and in the rain.")


def _shrink(out: Path) -> int:
    """The frames in the rain, of the width that suits the restorer."""
    for path in (out / "rain").glob("*.png"):
        (out / "rain-small").mkdir(exist_ok=True)
        imagefile.write(out / "rain-small" / path.name, _small(path, RESTORED_WIDTH))
    return DONE


def _derained(page: Report, out: Path) -> list[dict[str, float]]:
    """PSNR of each frame in the rain and derained, dB."""
    names = sorted(path.name for path in (out / "derained").glob("*.png"))
    frames = [
        (_small(out / "recording" / "drive" / "wet" / name, RESTORED_WIDTH),
         *(imagefile.read(out / folder / name) for folder in ("rain-small", "derained")))
        for name in names
    ]  # fmt: skip
    scores = [
        {"raw_psnr": cv2.PSNR(clear, rainy), "derained_psnr": cv2.PSNR(clear, derained)}
        for clear, rainy, derained in frames
    ]
    page.section(
        "The rain removed",
        f"By the small generator that rainstereo ships, at {RESTORED_WIDTH} pixels of width: near those at which it "
        "learnt, on photographs of other streets. Where it found no drop, every pixel is as it was.",
    )
    page.compare(frames[0][1], frames[0][2], ("rain", "derained"), "The same frame in the rain, and derained.")
    page.table(
        ("frame", "PSNR in the rain, dB", "derained, dB"),
        [(name, *(f"{value:.2f}" for value in score.values())) for name, score in zip(names, scores, strict=True)],
        "Against the clear frame, all pixels and channels.",
    )
    return scores


def _next(page: Report, out: Path, clock: Clock) -> None:
    page.section("What to do with your own rig", "The same commands, your folders.")
    page.code(
        "rainstereo calibrate --dry boards/dry --wet boards/wet --board chessboard:9x6:25mm \\\n"
        "    --chamber chamber.toml --out rig\n"
        "rainstereo align --dry drive/dry --wet drive/wet --rig rig --out aligned\n"
        "rainstereo droplets --rig rig --out droplets\n"
        "rainstereo rain drive/wet --rig rig --out rain\n"
        "rainstereo derain rain --out derained"
    )
    page.text(
        f"The calibration's own page is `{out / 'rig' / 'report.html'}`, the alignment's "
        f"`{out / 'aligned' / 'report.html'}`, the recording's `{out / 'recording' / 'report.html'}`."
    )
    page.table(("stage", "seconds"), [(stage, round(seconds, 1)) for stage, seconds in clock.seconds.items()])


def _small(path: Path, width: int) -> Image:
    return _shrunk(imagefile.read(path), width)


def _shrunk(image: Image, width: int) -> Image:
    height = round(width * image.shape[0] / image.shape[1])
    return image if image.shape[1] <= width else cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
