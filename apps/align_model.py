"""How a recording is aligned: estimated once from a few of its pairs, kept as numbers, the same for all shards."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from rainstereo import Rig
from rainstereo.align import Alignment, plan
from rainstereo.apps.align_options import Options, plane_of
from rainstereo.occlusion import Occlusion
from rainstereo.pair_source import BadPairError, PairSource
from rainstereo.photometric import Photometric
from rainstereo.photometric import fit as fit_photometric
from rainstereo.plane_fit import describe, fit_plane
from rainstereo.pose import invert
from rainstereo.recipe import Recipe
from rainstereo.rectify import INFINITY, Plane
from rainstereo.refine import refine, turned, without_turn
from rainstereo.tile_votes import TileVotes
from rainstereo.types import Image
from rainstereo.uncalibrated import PairModel, UnalignableError, estimate

SAMPLE = 8
"""Pairs of a recording from which it is estimated how to align it."""
NEAREST = 2.5
"""Depth in metres up to which near things are looked for, for validity masks."""
ImagePair = tuple[Image, Image]


@dataclass(frozen=True, eq=False)
class Plan:
    """What the numbers of a model mean. alignment, rig (refined): None without a calibration; pair: None with one."""

    recipe: Recipe
    rig: Rig | None
    alignment: Alignment | None
    pair: PairModel | None


def make_model(options: Options, rig: Rig | None, source: PairSource) -> dict[str, Any]:
    """Everything that is estimated from the recording, as plain numbers, with the words that a report gives it."""
    sample = read_sample(source, SAMPLE, None if rig is None else (rig.dry.size, rig.wet.size))
    model = _from_images(options, sample) if rig is None else _from_rig(options, rig, sample)
    if options.photometric:
        recipe = realise(options, rig, model).recipe
        aligned = [recipe.make(dry, wet) for dry, wet in sample]
        try:
            found = fit_photometric([(eight_bits(a["dry"]), eight_bits(a["wet"])) for a in aligned])
            model["photometric"] = {**asdict(found), "words": _photometric_words(found)}
        except ValueError as error:
            model["photometric"] = {"words": f"gray levels are left as they are: {error}"}
    return model


def realise(options: Options, rig: Rig | None, model: dict[str, Any]) -> Plan:
    """The warps and maps that the model's numbers mean; the same numbers give the same bytes."""
    found = model.get("photometric") or {}
    photometric = None
    if "gain" in found:
        photometric = Photometric(
            tuple(found["gain"]), tuple(found["offset"]), (found["vignetting"][0], found["vignetting"][1])
        )
    if rig is None:
        pair = _pair_of(model["pair"])
        dry, wet = pair.warps()
        occlusion = _occlusion_of_pair(options, pair)
        recipe = Recipe(dry, wet, options.interpolation, photometric, occlusion, calibrated=False)
        return Plan(recipe, None, None, pair)
    if model["refine"]["applied"]:
        rig = turned(rig, np.array(model["refine"]["rotation"]))
    distance = model["plane"]["distance"]
    normal = model["plane"]["normal"]
    plane = Plane((normal[0], normal[1], normal[2]), math.inf if distance is None else distance)
    alignment = plan(rig, plane)
    recipe = Recipe(alignment.dry, alignment.wet, options.interpolation, photometric,
                    _occlusion_of_rig(options, rig, alignment))  # fmt: skip
    return Plan(recipe, rig, alignment, None)


def read_sample(
    source: PairSource, count: int, sizes: tuple[tuple[int, int], tuple[int, int]] | None
) -> list[ImagePair]:
    """Pairs evenly over the recording; those that cannot be read, or have other sizes, are passed over.

    sizes: of the dry and the wet image; None: the size that most of them have.
    """
    found = []
    for i in spread(len(source), count):
        try:
            _, dry, wet = source.read(i)
        except BadPairError:
            continue
        found.append((dry, wet))
    if sizes is None and found:
        seen = [image.shape[1::-1] for pair in found for image in pair]
        common = max(sorted(set(seen)), key=seen.count)
        sizes = (common[0], common[1]), (common[0], common[1])
    return [p for p in found if sizes is not None and (p[0].shape[1::-1], p[1].shape[1::-1]) == sizes]


def spread(length: int, count: int) -> list[int]:
    """`count` indices evenly over a length."""
    return [int(i) for i in np.unique(np.linspace(0, length - 1, min(count, length)).round())] if length else []


def eight_bits(image: Image) -> Image:
    """The image in 8 bits."""
    return image if image.dtype == np.uint8 else (image >> 8).astype(np.uint8)


# -- with a calibration ----------------------------------------------------------------------------------------


def _from_rig(options: Options, rig: Rig, sample: Sequence[ImagePair]) -> dict[str, Any]:
    asked = plane_of(options)
    plane = asked or INFINITY
    refinement: dict[str, Any] = {"applied": False, "words": "the rig is used as it is: --refine off"}
    fitted: dict[str, Any] | None = None
    if options.refine != "off" or asked is None:
        far = plan(rig)
        votes = TileVotes.measure((eight_bits(a), eight_bits(b)) for a, b in (far.apply(*pair) for pair in sample))
        if options.refine != "off":
            found = refine(votes, rig, far.view)
            if options.refine == "on" and not math.isfinite(found.sigma_px):
                raise ValueError(f"--refine on: {found.words}; use auto, or a recording with fewer drops")
            refinement = {
                "applied": found.applied, "words": found.words, "rotation": found.rotation, "sigma": found.sigma,
                "moved_px": found.moved_px, "sigma_px": found.sigma_px, "tiles": found.tiles,
                "across_px": dict(zip(("before", "after"), found.across_px, strict=True)),
            }  # fmt: skip
            if found.applied:
                votes, rig = without_turn(votes, far.view, found.rotation), turned(rig, found.rotation)
        if asked is None:
            fit = fit_plane(votes, rig, far.view)
            if fit.plane is not INFINITY:
                there = plan(rig, fit.plane)
                again = TileVotes.measure((eight_bits(a), eight_bits(b)) for a, b in (there.apply(*p) for p in sample))
                fit = fit_plane(again, rig, there.view, fit.plane)
            plane = fit.plane
            fitted = {"words": fit.words, "tiles": fit.tiles, "mean_px": {"at_infinity": fit.before[0],
                      "at_plane": fit.after[0]}, "median_px": {"at_infinity": fit.before[1],
                      "at_plane": fit.after[1]}}  # fmt: skip
    return {
        "kind": "rig",
        "refine": refinement,
        "plane": {"normal": plane.normal, "distance": plane.distance if plane.distance < math.inf else None,
                  "words": describe(plane), "fit": fitted},
    }  # fmt: skip


def _occlusion_of_rig(options: Options, rig: Rig, alignment: Alignment) -> Occlusion | None:
    if not options.valid:
        return None
    centre = invert(rig.rt_wet_dry)[3:]
    if abs(centre[0]) < 3 * abs(centre[1]):
        raise ValueError(
            "--valid needs cameras side by side; this rig's baseline runs at "
            f"{math.degrees(math.atan2(abs(centre[1]), abs(centre[0]))):.0f} degrees to the rows"
        )
    reach = rig.baseline * float(alignment.view.intrinsics[0])
    low = -reach / alignment.plane.distance - 4
    return Occlusion(1 if centre[0] < 0 else -1, max(low, -64), min(reach / NEAREST, 200), options.valid_px)


# -- without ---------------------------------------------------------------------------------------------------


def _from_images(options: Options, sample: Sequence[ImagePair]) -> dict[str, Any]:
    if not sample:
        raise UnalignableError("none of the pairs can be read, so there is nothing to estimate an alignment from")
    near = {"auto": None, "left": 1, "right": -1}[options.wet_side]
    found = estimate(
        [(eight_bits(a), eight_bits(b)) for a, b in sample], options.model, plane_of(options) is not None, near
    )
    return {
        "kind": "images",
        "pair": {
            "kind": found.kind, "H": found.H, "size": found.size, "shift": found.shift, "sigma": found.sigma,
            "matches": found.matches, "spread": found.spread, "words": found.words,
        },
        "pairs_used": len(sample),
    }  # fmt: skip


def _pair_of(found: dict[str, Any]) -> PairModel:
    return PairModel(
        found["kind"], np.array(found["H"], dtype=np.float64), (found["size"][0], found["size"][1]),
        np.array(found["shift"]), np.array(found["sigma"]), (found["matches"][0], found["matches"][1]),
        (found["spread"][0], found["spread"][1]), found["words"],
    )  # fmt: skip


def _occlusion_of_pair(options: Options, pair: PairModel) -> Occlusion | None:
    if not options.valid:
        return None
    low, high = pair.spread
    towards = {"left": 1, "right": -1, "auto": 1 if high > -low else -1}[options.wet_side]
    near, far = (high, -low) if towards > 0 else (-low, high)
    return Occlusion(towards, -far - 4, 2 * near + 8, options.valid_px)


def _photometric_words(found: Photometric) -> str:
    gains = ", ".join(f"{g:.3f} +- {s:.3f}" for g, s in zip(found.gain, found.sigma, strict=True))
    offsets = ", ".join(f"{o:+.1f}" for o in found.offset)
    names = "blue, green, red" if len(found.gain) == 3 else "gray"
    k2, k4 = found.vignetting
    return (
        f"the wet images' gray levels are mapped: gain ({names}) {gains}, offset {offsets}, vignetting "
        f"1 {k2:+.3f} r^2 {k4:+.3f} r^4; {found.blocks} drop-free blocks differ by {found.after:.1f} gray levels RMS "
        f"afterwards, {found.before:.1f} before"
    )
