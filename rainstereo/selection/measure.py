"""Measures of a run of consecutive pairs: each image is read once, and nothing of it is kept but numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from rainstereo import imagefile
from rainstereo.types import Image, Mask

from .candidate import Candidate, Measures
from .dirt import DryDirt
from .drop_cover import hidden
from .edge_blur import edge_blur
from .keyframes import movement, small_copy
from .perceptual_hash import perceptual_hash, to_text

WHITE, BLACK = 250, 8
MOVING = 0.004
"""Share of the width that the scene must have moved for a frame to count in the search for dirt."""
VERSION = 1
"""Of what is measured and how: other numbers make what was measured before worthless."""


def measure_pair(wet: Image, dry: Image) -> tuple[Measures, Mask, Image]:
    """What one pair shows by itself, where drops hide the wet image, and the dry one's small copy.

    wet, dry: aligned, uint8, gray or BGR, of one size.
    """
    gray = dry if dry.ndim == 2 else cv2.cvtColor(dry, cv2.COLOR_BGR2GRAY)
    counts = np.bincount(gray.ravel(), minlength=256) / gray.size
    where = hidden(wet, dry)
    found = Measures(
        "", float(counts @ np.arange(256)), float(counts[WHITE:].sum()), float(counts[: BLACK + 1].sum()),
        edge_blur(gray), float(where.mean()), hash=to_text(perceptual_hash(gray)),
    )  # fmt: skip
    return found, where, small_copy(gray)


def measure_run(pairs: Sequence[Candidate], before: Candidate | None = None) -> list[Measures]:
    """Measures of consecutive pairs of one drive, in order. before: the pair that precedes them, if there is one."""
    found: list[Measures] = []
    dirt, size, last = DryDirt(), None, _small(before)
    for pair in pairs:
        try:
            wet, dry = _read(pair)
        except ValueError as error:
            found.append(Measures(problem=str(error)))
            continue
        measures, where, small = measure_pair(wet, dry)
        moved = math.nan if last is None else movement(last, small)
        last = small
        found.append(replace(measures, moved=moved))
        if moved > MOVING and size in (None, where.shape):
            size = where.shape
            dirt.add(wet, dry, where)
    share = dirt.share
    return [each if each.problem else replace(each, dirt=share) for each in found]


def _small(pair: Candidate | None) -> Image | None:
    if pair is None or pair.dry is None or pair.wet is None:
        return None
    try:
        return small_copy(_eight_bits(imagefile.read(pair.dry, gray=True)))
    except imagefile.UnreadableImageError:
        return None


def _read(pair: Candidate) -> tuple[Image, Image]:
    """Wet and dry; ValueError says what is wrong with which file."""
    images = []
    for role, path in (("wet", pair.wet), ("dry", pair.dry)):
        if path is None:
            raise ValueError(f"the {role} image is missing")
        try:
            images.append(_eight_bits(imagefile.read(path)))
        except imagefile.UnreadableImageError as error:
            raise ValueError(f"the {role} image {path.name}: {error}") from error
    wet, dry = images
    if wet.shape[:2] != dry.shape[:2]:
        sizes = " and ".join(f"{i.shape[1]} x {i.shape[0]}" for i in (dry, wet))
        raise ValueError(f"the dry and the wet image have {sizes} pixels; an aligned pair has one size")
    if min(dry.shape[:2]) < 16:
        raise ValueError(f"images of {dry.shape[1]} x {dry.shape[0]} pixels are too small to be measured")
    return wet, dry


def _eight_bits(image: Image) -> Image:
    return image if image.dtype == np.uint8 else (image >> 8).astype(np.uint8)
