"""What to capture next: the board pose that makes the least certain direction at infinity most certain.

Candidates (`board_candidates`) are judged before anybody holds a board there: the Jacobian of the corners that both
cameras would see, the board's own pose eliminated (`information`), is added to what the frames at hand say, and the
uncertainty of far directions (`far_directions`) follows from the sum. Greedy choice of the most informative experiment
(Fedorov, "Theory of optimal experiments", 1972); the aim is the largest sigma (G-optimality), softened to a power mean,
since one board can hardly improve two opposite corners of an image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rainstereo.calib import board_candidates, information
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib.board import Board
from rainstereo.calib.board_candidates import Candidates
from rainstereo.calib.far_directions import FarDirections, far_directions
from rainstereo.calib.information import Information
from rainstereo.calib.mrcal_versions import Problem
from rainstereo.calib.problem_rig import rig_of
from rainstereo.calib.solve import Solution
from rainstereo.camera import Camera
from rainstereo.chamber import Chamber
from rainstereo.pose import rotation_matrix
from rainstereo.rig import ROLES, Rig, Role
from rainstereo.types import Array

POWER = 8.0
"""Of the mean over places that stands in for the largest sigma."""
COUNTS = 0.4
"""Places below this share of the largest sigma do not count: a share of 0.4 ** 8, less than a thousandth."""
LEAST_POINTS, REACH = 12, 0.9
SIDES = {(0, 0): "centre", (-1, 0): "left edge", (1, 0): "right edge", (0, -1): "top edge", (0, 1): "bottom edge",
         (-1, -1): "top left corner", (1, -1): "top right corner", (-1, 1): "bottom left corner",
         (1, 1): "bottom right corner"}  # fmt: skip
LEANS = {(0, 0): "facing the cameras", (-1, 0): "left side", (1, 0): "right side", (0, -1): "top", (0, 1): "bottom",
         (-1, -1): "top left corner", (1, -1): "top right corner", (-1, 1): "bottom left corner",
         (1, 1): "bottom right corner"}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Certainty:
    """How well a calibration knows far directions, at present.

    noise: standard deviation of a corner's coordinate, pixels. sigmas: (P,) pixels, of each place of `far`, worst
    direction. covariance: (G, G) of the shared state at a noise of one pixel, packed.
    """

    information: Information
    far: FarDirections
    noise: float
    covariance: Array
    sigmas: Array

    @property
    def maps(self) -> Array:
        """Standard deviation in the worst direction, (maps, rows, columns) pixels; see `far_directions.MAPS`."""
        return self.far.maps(self.sigmas)

    @property
    def worst(self) -> float:
        """Of the least certain place of all maps, pixels; inf where the lens does not reach all of the image."""
        return float(self.maps.max())

    @property
    def worst_place(self) -> tuple[int, Array]:
        """Which map (0 dry, 1 wet, 2 wet against dry) and which pixel, (2,), is least certain."""
        number, row, column = np.unravel_index(int(self.maps.argmax()), self.maps.shape)
        return int(number), self.far.pixels[number, row, column]

    def with_frames(self, frames: Array) -> Array:
        """Sigmas, (..., P) pixels, were information, (..., G, G), added."""
        return self.noise * self.far.sigmas(information.inverse(self.information.total + frames))

    def gain(self, frames: Array) -> Array:
        """By which share, (...), information, (..., G, G), would lessen the sigma of the place that it helps most."""
        after = self.far.sigmas(information.inverse(self.information.total + frames))
        return np.asarray((1 - after / self.far.sigmas(self.covariance)).max(-1))


@dataclass(frozen=True, eq=False)
class Proposal:
    """Where to hold the board next.

    pose: (6,) rt_ref_board. outlines: per role (N, 2) pixels, the edge of the printed squares, a closed line. mesh: per
    role, a few lines (N, 2) between squares, which show how the board leans.
    where, how_far, lean: in words; `words` joins them. distance: of its middle from the dry camera, metres.
    now, predicted: the largest sigma of far directions at present and with that frame, pixels; NaN before there is a
    calibration. considered: how many poses there were to choose from.
    """

    pose: Array
    outlines: dict[Role, Array]
    mesh: dict[Role, tuple[Array, ...]]
    where: str
    how_far: str
    lean: str
    distance: float
    now: float
    predicted: float
    considered: int

    @property
    def words(self) -> str:
        """Where to hold the board, as one would say it."""
        return f"{self.where}, {self.how_far}, {self.lean}"


def certainty(problem: Problem, chamber: Chamber | None) -> Certainty:
    """Of a calibration at its solution. chamber: what its corners were seen through, None if that is already taken off.

    A `Solution`'s problem has the chamber taken off its corners; give `Solution.rig.chamber` nevertheless, since how
    the corners depend on the state is what counts here.
    """
    known = information.information(problem, chamber)
    far = far_directions(problem, known.layout, known.scale)
    covariance = information.inverse(known.total)
    noise = _noise(problem, known, covariance)
    return Certainty(known, far, noise, covariance, noise * far.sigmas(covariance))


def _noise(problem: Problem, known: Information, covariance: Array) -> float:
    """Of a corner's coordinate, from residuals and degrees of freedom; inf where there are none left."""
    off = versions.residuals(problem)
    used = int(np.isfinite(off).sum())
    spent = float(np.sum(covariance * known.frames.sum(0))) + 6 * len(problem.rt_ref_board)
    return float(np.sqrt(np.nansum(off**2) / (used - spent))) if used > spent else np.inf


def propose(
    solution: Solution | Problem,
    board: Board,
    chamber: Chamber | None = None,
    *,
    known: Certainty | None = None,
    last: float | None = None,
) -> Proposal | None:
    """The pose that lessens the worst uncertainty at infinity most; None where no pose fits both images.

    chamber: what the cameras look through, by default a Solution's. known: the certainty, if at hand. last: at which
    distance, metres, the board was held last, to say "half the distance".
    """
    problem = solution if isinstance(solution, Problem) else solution.problem
    if chamber is None and isinstance(solution, Solution):
        chamber = solution.rig.chamber
    known = certainty(problem, chamber) if known is None else known
    rig = rig_of(problem, chamber)
    possible = board_candidates.candidates(rig, board)
    if not len(possible.poses):
        return None
    offered = offers(problem, chamber, board, possible)
    index = best(known, offered)
    seen = possible.seen[:, index, None].astype(np.float64)
    told = information.of_poses(problem, chamber, possible.poses[index, None], seen, problem.spacing)
    return _described(rig, board, possible, index, last, known.worst, float(known.with_frames(told).max()))


def best(known: Certainty, offered: Array) -> int:
    """Which of the frames offered, (K, G, G), leaves the least power mean of the sigmas."""
    high = known.sigmas > COUNTS * known.sigmas.max()  # the others do not count, and no frame makes them grow
    far = replace(known.far, derivative=known.far.derivative[high])
    sigmas = far.sigmas(information.inverse(known.information.total + offered)) / far.sigmas(known.covariance).max()
    return int(np.argmin(np.mean(sigmas**POWER, -1)))


def offers(problem: Problem, chamber: Chamber | None, board: Board, possible: Candidates) -> Array:
    """What each candidate would say, (K, G, G).

    A part of the corners stands in for all, each with the weight of those that it represents. Thinned boards are a
    little more telling than whole ones (more of their corners lie at the rim), all alike: good enough to choose by.
    """
    step = stride(board.rows, board.columns)
    seen = possible.seen[:, :, ::step, ::step]
    share = possible.seen.sum((2, 3)) / np.maximum(seen.sum((2, 3)), 1)
    return information.of_poses(
        problem, chamber, possible.poses, seen * np.sqrt(share)[..., None, None], step * problem.spacing
    )


def stride(rows: int, columns: int) -> int:
    """The coarsest step through a board's corners that still spans it and leaves a dozen."""

    def spans(step: int) -> bool:
        ends = [(step * ((n - 1) // step)) / (n - 1) for n in (rows, columns)]
        return min(ends) >= REACH and -(-rows // step) * -(-columns // step) >= LEAST_POINTS

    return max((step for step in range(1, max(rows, columns)) if spans(step)), default=1)


def first_proposal(board: Board, size: tuple[int, int], chamber: Chamber | None, count: int) -> Proposal | None:
    """Where to hold the board while there are too few frames to calibrate from: each time another way.

    size: of the images. count: of the frames there are. The lens is taken to see 65 degrees.
    """
    width, height = size
    focal = width / 1.27
    camera = Camera.pinhole(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
    rig = Rig(camera, camera.with_pose(np.zeros(6)), chamber)
    possible = board_candidates.candidates(rig, board)
    if not len(possible.poses):
        return None
    wanted = [((0, 0), (1, 0)), ((0, 0), (-1, 0)), ((-1, -1), (0, 1)), ((1, 1), (0, -1)), ((1, -1), (-1, 0)),
              ((-1, 1), (1, 0))][count % 6]  # fmt: skip
    off = np.abs(possible.place - wanted[0]).sum(-1) + np.abs(possible.away - wanted[1]).sum(-1)
    near = np.abs(np.log(possible.distance / np.median(possible.distance)))
    return _described(rig, board, possible, int(np.argmin(off + 0.5 * near)), None, np.nan, np.nan)


def _described(rig: Rig, board: Board, possible: Candidates, index: int, last: float | None, now: float,
               predicted: float) -> Proposal:  # fmt: skip
    pose = possible.poses[index]
    distance = float(possible.distance[index])
    edges = board_candidates.drawn(rig, pose[None], board_candidates.outline(board))[:, 0]
    lines = board_candidates.mesh(board)
    inner = board_candidates.drawn(rig, pose[None], lines.reshape(-1, 3))[:, 0].reshape(2, *lines.shape[:2], 2)
    return Proposal(
        pose,
        dict(zip(ROLES, edges, strict=True)),
        {role: tuple(view) for role, view in zip(ROLES, inner, strict=True)},
        SIDES[_key(possible.place[index])],
        _distance(distance, last),
        _lean(_key(possible.away[index])),
        distance,
        now,
        predicted,
        len(possible.poses),
    )


def _key(pair: Array) -> tuple[int, int]:
    return int(pair[0]), int(pair[1])


def _lean(away: tuple[int, int]) -> str:
    if away == (0, 0):
        return LEANS[away]
    return f"{LEANS[away]} tilted away by {np.degrees(board_candidates.TILT):.0f} degrees"


def _distance(distance: float, last: float | None) -> str:
    words = f"{100 * distance:.0f} cm away" if distance < 1 else f"{distance:.1f} m away"
    if last is None:
        return words
    ratio = distance / last
    for limit, comparison in ((0.4, "a third of the distance"), (0.6, "half the distance"), (0.85, "nearer"),
                              (1.2, "the same distance"), (1.7, "further away"), (2.5, "twice the distance"),
                              (np.inf, "three times the distance")):  # fmt: skip
        if ratio < limit:
            return f"{comparison}: {words}"
    return words


def distance_of(board: Board, rt_ref_board: Array) -> float:
    """How far the middle of a board is from the dry camera along its axis, metres."""
    middle = (board.points[0, 0] + board.points[-1, -1]) / 2
    return float((rotation_matrix(rt_ref_board[:3]) @ middle + rt_ref_board[3:])[2])
