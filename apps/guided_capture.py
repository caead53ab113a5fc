"""A capture without cameras or hands: boards held before a digital rig, where the guidance says or anywhere.

Held as by a person, some centimetres and degrees off; corners are exact but for noise, so that the truth is known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rainstereo import Rig
from rainstereo.apps.digital_rig import exact_observations
from rainstereo.calib import board_candidates, guidance
from rainstereo.calib.board import Board
from rainstereo.calib.incremental import Incremental, View
from rainstereo.pose import compose, rotation_matrix, rotation_vector
from rainstereo.types import Array

UNSTEADY_DEG, UNSTEADY = 4.0, 0.03
"""Standard deviations of how far off a person holds the board: angle about each axis, and place as a share of the
distance."""
FIRST = 5
TRIES = 2000


@dataclass(frozen=True, eq=False)
class Captured:
    """How many pairs were taken, and the worst sigma at infinity after each, pixels (inf before the first solution)."""

    running: Incremental
    worst: tuple[float, ...]

    @property
    def pairs(self) -> int:
        """Number of pairs taken."""
        return len(self.worst)


def capture(truth: Rig, board: Board, lensmodel: str, *, target: float, guided: bool, seed: int, noise: float = 0.1,
            limit: int = 100) -> Captured:  # fmt: skip
    """Take pairs until the worst sigma at infinity is at most `target` pixels, or `limit` pairs are taken.

    The first few are anywhere; after that guided ones follow each proposal as a person would, the others are anywhere.
    """
    rng = np.random.default_rng([seed, 0x6D])
    running = Incremental(board, (truth.dry.size, truth.wet.size), lensmodel, truth.chamber)
    worst: list[float] = []
    while len(worst) < limit:
        pose = anywhere(truth, board, rng)
        if guided and len(worst) >= FIRST and running.solution is not None:
            proposal = guidance.propose(running.solution, board, known=running.known)
            pose = pose if proposal is None else unsteady(truth, board, proposal.pose, rng)
        dry, wet = (corners[0] for corners in exact_observations(truth, board, pose))
        corners = np.stack([dry, wet]) + rng.normal(0, noise, (2, *dry.shape))
        running.add(View(f"{len(worst):03d}", corners))
        worst.append(math.inf if running.known is None else running.known.worst)
        if worst[-1] <= target:
            break
    return Captured(running, tuple(worst))


def anywhere(truth: Rig, board: Board, rng: np.random.Generator, tilt_deg: float = 45.0) -> Array:
    """A random pose, (6,): both cameras see the whole board, 1 to 3 times as far as where it fills the frame."""
    width, height = board.size
    fills = max(width * truth.dry.intrinsics[0] / truth.dry.width, height * truth.dry.intrinsics[1] / truth.dry.height)
    middle = (board.points[0, 0] + board.points[-1, -1]) / 2
    for _ in range(TRIES):
        depth = fills * math.exp(rng.uniform(0, math.log(3)))
        ray = truth.dry.unproject(rng.uniform(0, np.array(truth.dry.size) - 1.0))
        direction, lean = rng.uniform(-math.pi, math.pi), math.radians(tilt_deg) * rng.uniform()
        r = np.array([lean * math.cos(direction), lean * math.sin(direction), rng.uniform(-0.35, 0.35)])
        pose: Array = np.concatenate([r, ray / ray[2] * depth - rotation_matrix(r) @ middle])
        if _held(truth, board, pose):
            return pose
    raise ValueError(f"{board.spec} does not fit into the view of both cameras; give a smaller board")


def unsteady(truth: Rig, board: Board, pose: Array, rng: np.random.Generator) -> Array:
    """The pose as a person holds it who corrects until both images show the whole board, (6,)."""
    middle = (board.points[0, 0] + board.points[-1, -1]) / 2
    for shrinking in np.linspace(1, 0, 20):
        turn = rng.normal(0, math.radians(UNSTEADY_DEG), 3) * shrinking
        about = np.concatenate([turn, middle - rotation_matrix(turn) @ middle])  # about the board's middle
        held = compose(pose, about)
        held[3:] += rng.normal(0, UNSTEADY * float(np.linalg.norm(pose[3:])), 3) * shrinking
        held[:3] = rotation_vector(rotation_matrix(held[:3]))
        if _held(truth, board, held):
            return held
    return pose


def _held(truth: Rig, board: Board, pose: Array) -> bool:
    _, whole = board_candidates.views(truth, board, pose[None])
    return bool(whole.all() and board_candidates.clear(truth, board, pose[None])[0])
