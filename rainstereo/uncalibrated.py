"""Pairs without a calibration: where the wet image lies on the dry one, from the images themselves.

Features (SIFT: Lowe, IJCV 60, 2004) that match both ways vote for one shift. Drops break most of them and agree on
nothing, so whatever many agree on is the scene. If the votes need more than a shift (a turned or rolled camera), a
homography is fitted to them by MAGSAC++ (Barath et al., CVPR 2020). Whatever disagrees by parallax, no homography can
align: such pairs are refused.

As a calibrated rig does by default, a shift aligns what is far away: near things lie to one side of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np

from .align import largest_rectangle
from .types import Array, Image, Mask
from .warp import Warp

FEATURES = 4000
RATIO = 0.8
FEWEST = 40
"""Matches below which pairs are refused."""
AGREEING = 0.5
"""Share of the matches that must agree on one shift or homography."""
DRIFT = 0.01
"""How far from the commonest shift a match may lie to agree with it, as a share of the image's width."""
PARALLAX = 0.008
"""Parallax that is put up with among the matches that agree, 10th to 90th percentile, as a share of the width."""
ACROSS = 3.0
"""Pixels by which a match of row-aligned images may leave its row."""
BETTER = 1.3
"""Times as many matches as a shift that a homography must explain to be preferred."""
Model = Literal["auto", "shift", "homography"]


class UnalignableError(ValueError):
    """These images cannot be aligned without a calibration; the message says why."""


@dataclass(frozen=True, eq=False)
class PairModel:
    """H: takes pixels of the dry image to those of the wet one, (3, 3). kind: shift or homography.

    shift: of the image's centre, (2,) pixels; sigma: its standard deviations. matches: all, and those that agree.
    spread: of the agreeing matches along the rows, 10th to 90th percentile about H, pixels: parallax that remains.
    """

    kind: str
    H: Array
    size: tuple[int, int]
    shift: Array
    sigma: Array
    matches: tuple[int, int]
    spread: tuple[float, float]
    words: str

    def warps(self) -> tuple[Warp, Warp]:
        """Warps of the dry and the wet image to the part that both see. The dry one is copied, not interpolated."""
        width, height = self.size
        there = Warp.from_function(lambda p: _through(self.H, p), self.size, self.size)
        x, y, w, h = largest_rectangle(there.valid)
        if w * h < 0.1 * width * height:
            raise UnalignableError(f"the images share {w} x {h} of {width} x {height} pixels; too little for pairs")
        return Warp.identity(self.size).crop(x, y, w, h), there.crop(x, y, w, h)


def match_features(dry: Image, wet: Image) -> tuple[Array, Array]:
    """Pixels of the same features in both images, (N, 2) each."""
    finder = cv2.SIFT.create(nfeatures=FEATURES, contrastThreshold=0.02)
    points, descriptors = zip(*(_features(finder, image) for image in (dry, wet)), strict=True)
    if min(map(len, points)) < 2:
        return np.empty((0, 2)), np.empty((0, 2))
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    forth = matcher.knnMatch(descriptors[0], descriptors[1], k=2)
    back = {m[0].queryIdx: m[0].trainIdx for m in matcher.knnMatch(descriptors[1], descriptors[0], k=1) if m}
    good = [m[0] for m in forth if len(m) == 2 and m[0].distance < RATIO * m[1].distance
            and back.get(m[0].trainIdx) == m[0].queryIdx]  # fmt: skip
    return points[0][[m.queryIdx for m in good]], points[1][[m.trainIdx for m in good]]


def _features(finder: cv2.SIFT, image: Image) -> tuple[Array, Image]:
    gray: Any = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    nowhere: Any = None
    found, descriptors = finder.detectAndCompute(gray, nowhere)
    if not found:
        return np.empty((0, 2)), np.empty((0, 128), np.float32)
    return np.array([point.pt for point in found], dtype=np.float64).reshape(-1, 2), np.asarray(descriptors)


def estimate(
    pairs: Sequence[tuple[Image, Image]], model: Model = "auto", far: bool = True, near: int | None = None
) -> PairModel:
    """Where the wet images lie on the dry ones, all pairs voting together; uint8 images of one size.

    far: a shift aligns the far scene, else what most of the matches show. near: to which side near things are shifted
    in the wet image: 1 right (the wet camera stands on the left), -1 left, None: to be told from the ground.
    UnalignableError says why pairs are refused.
    """
    if not pairs:
        raise UnalignableError("no pair was given")
    sizes = sorted({image.shape[1::-1] for pair in pairs for image in pair})
    if len(sizes) > 1:
        raise UnalignableError(f"images of {len(sizes)} sizes were given, {sizes[:4]}; expected one")
    size = sizes[0][0], sizes[0][1]
    found = [match_features(dry, wet) for dry, wet in pairs]
    here, there = (np.concatenate(part) for part in zip(*found, strict=True))
    if len(here) < FEWEST:
        raise UnalignableError(
            f"{len(here)} features match between the images of {len(pairs)} pairs; {FEWEST} are needed. Are they of "
            "the same moment? Use more pairs, or ones with fewer drops, or a calibration"
        )
    moved = there - here
    agree = _vote(moved, size)
    H, inliers = (None, np.zeros(len(here), bool))
    if model != "shift":
        H, inliers = _homography(here, there)
    if model == "homography" or (model == "auto" and inliers.sum() > BETTER * agree.sum()):
        if H is None or inliers.mean() < AGREEING:
            raise UnalignableError(_refusal(moved, inliers, size))
        return _turned(H, here, there, inliers, size)
    if agree.mean() < AGREEING:
        raise UnalignableError(_refusal(moved, agree, size))
    return _shifted(here, moved, agree, size, far, near)


def _vote(moved: Array, size: tuple[int, int]) -> Mask:
    """Matches near the shift that most agree on."""
    reach = np.array([max(DRIFT * size[0], 3.0), ACROSS])
    order = np.argsort(moved[:, 0], kind="stable")
    x, y = moved[order].T
    best, centre = 0, moved[0]
    for i in range(len(x)):  # each match in turn as the centre; its neighbours along x lie together
        low, high = np.searchsorted(x, (x[i] - reach[0], x[i] + reach[0]))
        count = int((np.abs(y[low:high] - y[i]) < reach[1]).sum())
        if count > best:
            best, centre = count, np.array([x[i], y[i]])
    for _ in range(3):
        agree = (np.abs(moved - centre) < reach).all(1)
        centre = np.median(moved[agree], axis=0)
    return np.asarray((np.abs(moved - centre) < reach).all(1))


def _shifted(here: Array, moved: Array, agree: Mask, size: tuple[int, int], far: bool, near: int | None) -> PairModel:
    votes = moved[agree]
    low, high = np.percentile(votes[:, 0], (10, 90))
    if high - low > max(PARALLAX * size[0], 3.0):
        raise UnalignableError(_refusal(moved, agree, size))
    near = _nearness(here[agree], votes, size) if near is None else near
    level = 0.5 if not far or near == 0 else (0.25 if near > 0 else 0.75)
    shift = np.array([np.quantile(votes[:, 0], level), np.median(votes[:, 1])])
    rng = np.random.default_rng(0)
    again = [votes[rng.integers(0, len(votes), len(votes))] for _ in range(100)]
    sigma = np.std([(np.quantile(v[:, 0], level), np.median(v[:, 1])) for v in again], axis=0)
    H = np.array([[1, 0, shift[0]], [0, 1, shift[1]], [0, 0, 1.0]])
    what = (
        "what most matches show"
        if level == 0.5
        else "the far scene (near things lie further to the " + ("right)" if near > 0 else "left)")
    )
    spread = float(low - shift[0]), float(high - shift[0])
    words = f"a shift of ({shift[0]:.2f}, {shift[1]:.2f}) px aligns {what}"
    return PairModel("shift", H, size, shift, sigma, (len(moved), len(votes)), spread, words)


def _nearness(here: Array, votes: Array, size: tuple[int, int]) -> int:
    """To which side near things are shifted in the wet image: 1 right, -1 left, 0 cannot be told.

    The ground is near at the bottom of the image and far at the horizon, wherever that is; so the lowest quarter is
    held against the two bands above it, which must not contradict one another.
    """
    low = here[:, 1] > 0.75 * size[1]
    bands = [votes[(here[:, 1] > a * size[1]) & (here[:, 1] <= (a + 0.15) * size[1]), 0] for a in (0.45, 0.6)]
    if low.sum() < 8 or all(len(band) < 8 for band in bands):
        return 0
    ground = float(np.median(votes[low, 0]))
    gaps = [ground - float(np.median(band)) for band in bands if len(band) >= 8]
    if max(map(abs, gaps)) < 0.5 or min(gaps) < 0 < max(gaps):
        return 0
    return int(np.sign(max(gaps, key=abs)))


def _homography(here: Array, there: Array) -> tuple[Array | None, Mask]:
    cv2.setRNGSeed(0)
    found: Any
    found, kept = cv2.findHomography(here, there, cv2.USAC_MAGSAC, 2.0, maxIters=5000, confidence=0.999)
    if found is None:
        return None, np.zeros(len(here), bool)
    return np.asarray(found), kept.ravel().astype(bool)


def _turned(H: Array, here: Array, there: Array, inliers: Mask, size: tuple[int, int]) -> PairModel:
    left = (there - _through(H, here))[inliers]
    centre = (np.array([size]) - 1) / 2
    shift = (_through(H, centre) - centre)[0]
    corners = np.array([[0, 0], [size[0] - 1, 0], [size[0] - 1, size[1] - 1], [0, size[1] - 1]], dtype=np.float64)
    image = _through(H, corners)
    area = 0.5 * abs(np.sum(image[:, 0] * np.roll(image[:, 1], -1) - np.roll(image[:, 0], -1) * image[:, 1]))
    if not 0.25 < area / (size[0] * size[1]) < 4 or not cv2.isContourConvex(image.astype(np.float32)):
        raise UnalignableError("the homography that most matches agree on folds or tears the image; these are no pairs")
    sigma = 1.4826 * np.median(np.abs(left), axis=0) / np.sqrt(len(left) / 8)
    low, high = np.percentile(left[:, 0], (10, 90))
    words = f"a homography that moves the image's centre by ({shift[0]:.2f}, {shift[1]:.2f}) px"
    return PairModel("homography", H / H[2, 2], size, shift, sigma, (len(here), int(inliers.sum())),
                     (float(low), float(high)), words)  # fmt: skip


def _refusal(moved: Array, agree: Mask, size: tuple[int, int]) -> str:
    in_row = np.abs(moved[:, 1] - np.median(moved[:, 1])) < ACROSS
    if in_row.mean() >= AGREEING:
        low, high = np.percentile(moved[in_row, 0], (10, 90))
        return (
            f"the images are row-aligned, but their features are shifted by {low:.0f} to {high:.0f} px: that is "
            f"parallax of a baseline too wide for this scene, and no warp without depths aligns it (at most "
            f"{PARALLAX * size[0]:.0f} px of it were accepted)"
        )
    return (
        f"{int(agree.sum())} of {len(moved)} matches agree on one shift or homography, {AGREEING:.0%} are needed: the "
        "scene is seen with too much parallax, or through too many drops, or these are no pairs. Calibrate the rig, "
        "and give --rig"
    )


def _through(H: Array, points: Array) -> Array:
    return np.asarray(cv2.perspectiveTransform(np.asarray(points, dtype=np.float64)[None], H)[0])
