"""Benchmark stage `rain`: rendering rain on a frame beside one interpolation of that frame, and on batches in torch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import cv2
import kornia
import numpy as np
import torch

from rainstereo import Camera, Chamber, Panel
from rainstereo.aperture import aperture
from rainstereo.apps.bench_harness import Stage, Target, Variant, Work
from rainstereo.apps.photographs import photograph
from rainstereo.model.augment import RandomAdherentRain
from rainstereo.patch import folded
from rainstereo.rain.drops import Drops
from rainstereo.rain.metaballs import field, grown
from rainstereo.rain.pane import Pane
from rainstereo.rain.population import Population
from rainstereo.rain.render import Plan, Renderer
from rainstereo.thin_lens import ThinLens
from rainstereo.trace import Fate, clear_transmittance, trace
from rainstereo.types import Array, Image, Indices

DROPS = 200
FRAMES = 20
SIDE, SAMPLED, FEW = 32, 3000, 200
"""Rays along each side of a pixel in the reference of sharp drops, and pixels that are compared; few if `quick`."""
OTHERS = ("astronaut", "coffee", "chelsea", "gravel", "rocket")
MANY = 100_000  # small drops, on a frame of full size
APERTURE_SAMPLES = 1024
CROP = 96
"""Side, pixels, of the window in which blurred drops are compared with samples of the aperture."""
COARSE = 10.0
"""Gray levels that the coarse setting allows; its one or few looks a pixel alias."""
BATCH, IMAGE_SIDE, IMAGE_DROPS = 8, 512, 50


def build(seed: int, quick: bool) -> Stage:
    """The stage at 1280x960, or 320x240 if `quick`."""
    width, height = (320, 240) if quick else (1280, 960)
    f = 1200 * width / 1280
    camera = Camera.pinhole(f, f, (width - 1) / 2, (height - 1) / 2, width, height)
    pane = Chamber((0.0, 0.0, 1.0), 0.057, (Panel(0.003, 1.49),))
    image: Image = cv2.resize(photograph("motorcycle"), (width, height), interpolation=cv2.INTER_AREA)
    return Stage(
        "rain",
        "rain on a frame",
        f"Adherent drops of 0.5 to 3 mm on a pane 60 mm away, on {width}x{height} colour frames, beside one "
        "`cv2.remap` of the whole frame. Drops that stand still are traced once and then cost what they cover.",
        (
            _dry_work(camera, pane, image, not quick),
            _still_work(camera, pane, image, seed, not quick),
            _moving_work(camera, pane, image, seed, not quick),
            _blurred_work(camera, pane, image, seed, quick),
            _merged_work(camera, pane, image, seed, not quick),
            batch_work(seed, quick),
        ),
        {
            "camera": f"pinhole {width}x{height}, f {f:.0f} px; with a lens: 4.5 mm at F/1.4, focused at infinity",
            "pane": "3 mm, index 1.49, its far face at 60 mm, square to the camera",
            "drops": "preset `drops`, the density scaled to the cover; contact angles around 68 degrees",
            "image": "8-bit BGR, a photograph from scikit-image",
            "seed": seed,
        },
        (
            f"The default aims at 1 gray level RMS inside drops, against {SIDE**2} rays a pixel. These drops shrink "
            "the scene some 30 to 50 times, so that 64 rays a pixel are themselves off by 0.7 to 1.5 gray levels.",
            f"`coarse` allows {COARSE:g} gray levels: about five texels a pixel.",
            "A cover is the share of the frame's pixels that drops hide, as rendered.",
            "Memory-bound work: on a busy machine trust the ratios within a round, not the milliseconds.",
        ),
    )


# -- drops that stand still ----------------------------------------------------------------------------------------


def _dry_work(camera: Camera, pane: Chamber, image: Image, promised: bool) -> Work:
    plan = Renderer(camera, pane).plan([])

    def many(work: Callable[[], Image]) -> Image:
        for _ in range(FRAMES - 1):
            work()
        return work()

    def error(found: Image) -> float:
        return float(np.abs(found.astype(np.int16) - image).max())

    copy, ours = "copies of the frame", "frames without drops"
    return Work(
        "dry",
        "No drops",
        f"{FRAMES} frames in a row, since one is too quick to time.",
        (
            Variant(copy, lambda: many(image.copy), error),
            Variant(ours, lambda: many(partial(plan.apply, image)), error, True),
        ),
        ours,
        "gray levels",
        "largest difference to the clear frame",
        FRAMES,
        "frames",
        (Target(ours, copy, 1.2),) if promised else (),
    )


def _still_work(camera: Camera, pane: Chamber, image: Image, seed: int, promised: bool) -> Work:
    lasting, default = Renderer(camera, pane, lasting=True), Renderer(camera, pane)
    coarse = Renderer(camera, pane, tolerance=COARSE)
    images = [*_others(camera.size), image]
    frame = "cv2.remap of the frame"
    variants = [Variant(frame, partial(_of_each, images, _remap(image, seed)), _nothing, note="R")]
    targets = []
    cases = [
        (f"{100 * share:.0f} %", _rain(camera, pane, share, seed), limit, ways)
        for share, limit, ways in (
            (0.02, 0.2, 3), (0.1, 0.6, 3), (0.34, 1.2, 1), (0.4, 1.2, 3), (0.8, 1.2, 2), (0.95, 1.2, 1),
        )
    ]  # fmt: skip
    many = MANY if promised else MANY // 16
    for case, drops, limit, ways in (*cases, (f"{many:,} small drops", _small(camera, pane, many, seed), 1.2, 1)):
        truth: Truth | None = None
        for renderer, name in ((default, ""), (lasting, ", lasting"), (coarse, ", coarse"))[:ways]:
            plan = renderer.plan(drops)
            label = case + name
            truth = truth or Truth.of(plan, seed, SAMPLED if promised else FEW)
            variants.append(
                Variant(
                    label, partial(_of_each, images, plan.apply), truth.error(image), True,
                    f"{len(drops)} drops hide {100 * float((plan.opacity > 0).mean()):.3g} %; {truth.elsewhere(plan)}",
                )
            )  # fmt: skip
            targets.append(Target(label, frame, limit))
    return Work(
        "still",
        "Drops that stand still",
        f"{len(images)} frames in a row, of as many photographs. Planned before, by default, with "
        "`Renderer(lasting=True)`, and coarsely; the time is that of drawing the frames.",
        tuple(variants),
        "10 %",
        "gray levels",
        f"RMS at some pixels inside drops against {SIDE} x {SIDE} exact rays a pixel",
        len(images),
        "frames",
        targets=tuple(targets) if promised else (),
    )


def _others(size: tuple[int, int]) -> list[Image]:
    """Other photographs."""
    return [np.ascontiguousarray(cv2.resize(photograph(n), size, interpolation=cv2.INTER_AREA)) for n in OTHERS]


def _of_each(images: Sequence[Image], draw: Callable[[Image], Image]) -> Image:
    """Draws one after the other; returns the last."""
    for image in images[:-1]:
        draw(image)
    return draw(images[-1])


def _moving_work(camera: Camera, pane: Chamber, image: Image, seed: int, promised: bool) -> Work:
    drops = _rain(camera, pane, 0.1, seed)
    truth = Truth.of(Renderer(camera, pane).plan(drops), seed, SAMPLED if promised else FEW)
    frame = "cv2.remap of the frame"
    variants = [Variant(frame, partial(_remap(image, seed), image), _nothing, note="R")]
    for moving, tolerance, name in (
        (True, 1.0, "10 %, all moving"), (True, COARSE, "10 %, all moving, coarse"), (False, 1.0, "10 %, as if still"),
    ):  # fmt: skip
        renderer = Renderer(camera, pane, tolerance=tolerance, moving=moving)
        work = partial(_anew, renderer, drops, image)
        work()  # finds once where rays meet the pane
        note = "traced, planned and drawn; " + truth.elsewhere(renderer.plan(drops))
        variants.append(Variant(name, work, truth.error(image), moving, note, every=1 if moving else 5))
    return Work(
        "moving",
        "Drops that all move",
        "Every drop is traced anew for the frame: by `Renderer(moving=True)`, and by the plan that serves many frames.",
        tuple(variants),
        "10 %, all moving",
        "gray levels",
        f"RMS at some pixels inside drops against {SIDE} x {SIDE} exact rays a pixel",
        targets=tuple(Target(v.name, frame, 1.5) for v in variants[1:3]) if promised else (),
    )


def _anew(renderer: Renderer, drops: Drops, image: Image) -> Image:
    return renderer.plan(drops).apply(image)


# -- out of focus --------------------------------------------------------------------------------------------------


def _blurred_work(camera: Camera, pane: Chamber, image: Image, seed: int, quick: bool) -> Work:
    lens, frame = ThinLens(0.0045, 1.4), "cv2.remap of the frame"
    drops = _rain(camera, pane, 0.1, seed)
    plan = Renderer(camera, pane, lens=lens).plan(drops)
    plan.apply(image)
    middle = [slice((n - CROP) // 2, (n + CROP) // 2) for n in (camera.height, camera.width)]
    samples = 64 if quick else APERTURE_SAMPLES
    near = [drop for drop in drops.shapes() if np.hypot(*drop.centre) < 0.06 * CROP / float(camera.intrinsics[0]) * 2]
    layer = aperture(near, camera, pane, lens, np.inf, image, samples, window=(middle[0], middle[1]))
    truth = layer.over(image.astype(np.float32))[middle[0], middle[1]]

    def error(found: Image) -> float:
        return float(np.sqrt(np.mean(np.square(found[middle[0], middle[1]] - truth))))

    name = "10 % at F/1.4"
    return Work(
        "defocus",
        "Drops out of focus, standing still",
        "Behind 4.5 mm at F/1.4 focused at infinity: a disc of 65 px.",
        (
            Variant(frame, partial(_remap(image, seed), image), _nothing, note="R"),
            Variant("nothing drawn", image.copy, error),
            Variant(name, partial(plan.apply, image), error, True, "traced before"),
        ),
        name,
        "gray levels",
        f"RMS in {CROP} x {CROP} pixels of the middle against {samples} samples of the aperture",
        targets=() if quick else (Target(name, frame, 5.0),),
    )


# -- merging -------------------------------------------------------------------------------------------------------


def _merged_work(camera: Camera, pane: Chamber, image: Image, seed: int, promised: bool) -> Work:
    drops = _rain(camera, pane, 0.1, seed)
    drops = grown(drops.take(slice(0, DROPS)))
    x, y = Pane.seen(camera, pane).grid(camera.width)
    frame, name = "cv2.remap of the frame", f"heights of {len(drops)} drops"

    def dense() -> Array:
        """All drops at all places, largest support first: the metaballs' sum written out."""
        order = np.argsort(-(0.5 * drops.top), kind="stable")
        depth = 0.5 * drops.top[order]
        height = np.full((len(y), len(x)), -np.inf)
        for i, s in zip(order, depth, strict=True):
            cap = _cap_height(drops, int(i), x, y)
            felt, both = cap > -s, (cap > -s) & (height > -s)
            total = np.cbrt(np.maximum(height + s, 0) ** 3 + np.maximum(cap + s, 0) ** 3) - s
            height = np.where(both, total, np.where(felt, np.maximum(cap, height), height))
        return np.maximum(height, 0)

    def error(found: Array) -> float:
        return 1e6 * float(np.abs(np.maximum(found, 0) - dense()).max())

    return Work(
        "metaballs",
        "Drops that merge",
        "The height of the water at every pixel of the pane, drops that touch being one body.",
        (
            Variant(frame, partial(_remap(image, seed), image), _nothing, note="R"),
            Variant(name, lambda: field(drops, x, y), error, True),
            Variant("every drop at every pixel", dense, error, note="the same sum, written out", every=5),
        ),
        name,
        "micrometres",
        "largest, against the sum over all drops at all pixels in float64",
        targets=(Target(name, frame, 2.0),) if promised else (),
    )


def _cap_height(drops: Drops, i: int, x: Array, y: Array) -> Array:
    """Height of one cap's sphere over a grid, below the face too; -inf beyond the sphere."""
    a, angle = float(drops.radius[i]), float(drops.contact_angle[i])
    inside = (a / np.sin(angle)) ** 2 - (x - drops.x[i]) ** 2 - (y[:, None] - drops.y[i]) ** 2
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(inside > 0, np.sqrt(inside) - a / np.tan(angle), -np.inf))


# -- batches -------------------------------------------------------------------------------------------------------


def batch_work(seed: int, quick: bool) -> Work:
    """The augmentation beside kornia's own rain and a bare grid_sample."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    side, count = (128, 2) if quick else (IMAGE_SIDE, 512 if device == "cuda" else BATCH)
    plain = cv2.resize(photograph("astronaut"), (side, side), interpolation=cv2.INTER_AREA)
    one = torch.from_numpy(np.ascontiguousarray(plain[..., ::-1].transpose(2, 0, 1))).float() / 255
    images = one.expand(count, -1, -1, -1).contiguous().to(device)
    grid = torch.nn.functional.affine_grid(
        torch.eye(2, 3, device=device).expand(count, -1, -1), list(images.shape), False
    )
    camera = Camera.pinhole(side, side, (side - 1) / 2, (side - 1) / 2, side, side)
    pane = Pane.seen(camera, Chamber((0, 0, 1), 0.04, (Panel(0.004, 1.49),)))
    law = Population.preset("drops")
    cover = IMAGE_DROPS / (law.density() * pane.area) * law.cover
    ours = RandomAdherentRain(law, cover=(cover, cover), p=1.0)
    streaks = kornia.augmentation.RandomRain(
        p=1.0, drop_height=(10, 20), drop_width=(-5, 5), number_of_drops=(500, 1000)
    )

    def timed(work: Callable[[], Any]) -> Callable[[], Any]:
        def run() -> Any:
            torch.manual_seed(seed)
            with torch.no_grad():
                found = work()
            if device == "cuda":
                torch.cuda.synchronize()
            return found

        return run

    def bare() -> torch.Tensor:
        return torch.nn.functional.grid_sample(images, grid, padding_mode="reflection", align_corners=False)

    name = "RandomAdherentRain"
    return Work(
        "batch",
        f"Batches in torch, on {device}",
        f"{count} images of {side}x{side}, about {IMAGE_DROPS} sharp drops each, drawn anew, traced exactly.",
        (
            Variant(name, timed(lambda: ours(images)), _nothing, True, "drops drawn, traced and rendered"),
            Variant(
                "kornia RandomRain", timed(lambda: streaks(images)), _nothing, note="streaks in the air, no optics"
            ),
            Variant("grid_sample", timed(bare), _nothing, note="one interpolation of the batch"),
        ),
        name,
        "",
        "not compared: they draw different things; the augmentation's is tested against the renderer",
        count,
        "images",
    )


# -- what all share ------------------------------------------------------------------------------------------------


def _rain(camera: Camera, pane: Chamber, share: float, seed: int) -> Drops:
    """Drops that hide this share of the frame, to a drop: the first so many of a rain that hides more."""
    drops = Population.preset("drops").with_cover(min(1.3 * share + 0.01, 0.95)).sample(seed, Pane.seen(camera, pane))
    renderer, few, many = Renderer(camera, pane, moving=True), 1, len(drops)
    while few < many:
        some = (few + many) // 2
        hidden = float((renderer.plan(drops.take(slice(some))).opacity > 0).mean())
        few, many = (some + 1, many) if hidden < share else (few, some)
    return drops.take(slice(few))


def _small(camera: Camera, pane: Chamber, count: int, seed: int) -> Drops:
    """So many drops of 0.1 to 0.8 mm, anywhere on the pane: they cover all of it several times over."""
    rng, seen = np.random.default_rng(seed), Pane.seen(camera, pane)
    x, y = rng.uniform(seen.low, seen.high, (count, 2)).T
    return Drops(x, y, rng.uniform(5e-5, 4e-4, count), rng.uniform(0.3, 1.2, count))


def _remap(image: Image, seed: int) -> Callable[[Image], Image]:
    """One interpolation of a whole frame of this size, maps at hand: the yardstick."""
    rng = np.random.default_rng(seed)
    maps = np.stack(np.meshgrid(*(np.arange(n, dtype=np.float32) for n in image.shape[1::-1])), -1)
    maps += rng.uniform(-3, 3, maps.shape).astype(np.float32)
    return lambda some: cv2.remap(some, maps, None, cv2.INTER_LINEAR)  # type: ignore[call-overload]


def _nothing(_: object) -> float:
    return float("nan")


@dataclass(frozen=True, eq=False)
class Truth:
    """Pixels in drops, (N,) rows and columns; their rays' sources (N, K, 2) and gains (N, K); hidden: (N,) share."""

    rows: Indices
    columns: Indices
    source: Array
    gain: Any
    hidden: Array

    @classmethod
    def of(cls, plan: Plan, seed: int, count: int) -> Truth:
        """Some of the pixels that the drops of a plan cover."""
        camera, pane = plan.renderer.camera, plan.renderer.chamber
        rows, columns = np.nonzero(plan.opacity > 0)
        chosen = np.sort(np.random.default_rng(seed).permutation(len(rows))[:count])
        rows, columns = rows[chosen], columns[chosen]
        own: Image = np.stack([columns, rows], -1).astype(np.float32)
        along = ((np.arange(SIDE) + 0.5) / SIDE - 0.5).astype(np.float32)
        seen = trace(own[:, None] + np.stack(np.meshgrid(along, along), -1).reshape(-1, 2), plan.drops, camera, pane)
        lit = seen.status == Fate.THROUGH
        clear = clear_transmittance(own, camera, pane)[:, None]
        gain = np.where(lit, seen.transmittance / clear, 0).astype(np.float32)
        source = folded(np.where(lit[..., None], seen.source, 0), camera.size)
        return cls(rows, columns, source, gain, (seen.status != Fate.NO_DROP).mean(-1))

    def values(self, image: Image) -> Array:
        """What the pixels show of an image, (N, C)."""
        plain, found = image.astype(np.float32), []
        for first in range(0, len(self.rows), 256):
            part = slice(first, first + 256)
            looked = cv2.remap(
                plain, self.source[part], cast("Any", None), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
            found.append((looked * self.gain[part, :, None]).mean(1))
        own = image[self.rows, self.columns] * (1 - self.hidden)[:, None]
        shown: Array = np.minimum(np.concatenate(found) + own, 255)  # a drop may be brighter than the bare pane
        return shown

    def error(self, image: Image) -> Callable[[Image], float]:
        """RMS error of a frame made of an image."""
        expected = self.values(image)
        return lambda found: float(np.sqrt(np.mean(np.square(found[self.rows, self.columns] - expected))))

    def elsewhere(self, plan: Plan) -> str:
        """The errors on other photographs."""
        errors = [self.error(image)(plan.apply(image)) for image in _others(plan.renderer.camera.size)]
        return f"{min(errors):.2g} to {max(errors):.2g} gray levels on {len(errors)} other photographs"
