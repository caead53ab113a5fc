"""From a seed to an adjusted calibration: the stages that mrcal is led through, and the watch over single frames.

Order: poses; lens core; pose flips and hopeless frames; all distortions; board warp with rejection of outliers (which
`outliers` does).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from rainstereo import pose
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib import seed as seeding
from rainstereo.calib.mrcal_versions import Free, Problem
from rainstereo.types import Array, Mask

UNREGULARIZED_PX = 0.5
QUIET_PX = 0.02
PLENTY = 2500
HOPELESS = 12.0
"""A frame this many times worse than the median frame is dropped before distortions are solved."""
HOPELESS_PX = 4.0
SPLINED = "LENSMODEL_SPLINED_STEREOGRAPHIC"
TOO_LITTLE = "no camera shows enough of the board in it"
CONTRADICTS = "its two views contradict how the cameras stand to each other in the other pairs"
POSES = Free()
CORE = Free(core=True)


@dataclass(frozen=True)
class Dropped:
    """A frame that the calibration does without, and why."""

    name: str
    reason: str


@dataclass
class Adjustment:
    """A problem being adjusted and which of the given frames its own frames are.

    corners: (cameras, N, rows, columns, 2) of all frames given, in the order in which they are used.
    frames: (F,), indices into the N given. reordered: names of frames in which one camera's corners came reversed.
    """

    problem: Problem
    corners: Array
    names: tuple[str, ...]
    frames: np.ndarray[tuple[int], np.dtype[np.int_]]
    dropped: list[Dropped] = field(default_factory=list)
    reordered: tuple[str, ...] = ()

    def seen(self) -> Array:
        """Corners as detected, in the order of the problem's observations, (M, rows, columns, 2); 0 where unseen."""
        frame, camera = self.problem.indices[:, 0], self.problem.indices[:, 1]
        return np.asarray(np.nan_to_num(self.corners[camera, self.frames[frame]]))

    def drop(self, which: Mask, reasons: list[str]) -> None:
        """Take frames, (F,) true, out of the problem; `reasons` has one entry per frame taken out."""
        for index, reason in zip(np.flatnonzero(which), reasons, strict=True):
            self.dropped.append(Dropped(self.names[self.frames[index]], reason))
        self.frames = self.frames[~which]
        self.problem = without(self.problem, which)


Solver = Callable[[Adjustment], None]
"""Solves an adjustment's problem in place for its corners as seen."""


def without(problem: Problem, which: Mask) -> Problem:
    """The problem without some of its frames, (F,) true; an independent copy."""
    kept = ~which[problem.indices[:, 0]]
    renumbered = np.cumsum(~which) - 1
    indices = problem.indices[kept].copy()
    indices[:, 0] = renumbered[indices[:, 0]]
    return problem.copy(
        rt_ref_board=problem.rt_ref_board[~which].copy(),
        observations=problem.observations[kept].copy(),
        indices=indices,
    )


def begin(points: Array, corners: Array, names: tuple[str, ...], sizes: list[tuple[int, int]],
          spacing: float, *, reversible: bool) -> Adjustment:  # fmt: skip
    """Seed, solve poses and lens core from each seed, and keep the best. Frames without a usable view are dropped."""
    corners = np.array(corners, dtype=np.float64)
    for view in corners.reshape(-1, *corners.shape[2:]):
        if not seeding.usable(view):
            view[...] = np.nan
    attempts: list[tuple[float, Adjustment]] = []
    failure: Exception | None = None
    for guess in seeding.seed(points, corners, sizes, reversible=reversible):
        try:
            attempt = _from_seed(guess, corners, names, sizes, spacing, lattice_of(points, spacing))
            for free in (POSES, CORE):
                attempt.problem.free = free
                if not approach(attempt.problem):
                    versions.optimize(attempt.problem)
        except versions.SolveError as error:
            failure = error
            continue
        attempts.append((float(np.median(frame_rms(attempt.problem))), attempt))
    if not attempts:
        raise versions.SolveError(f"no first guess led anywhere; {failure}") from failure
    return min(attempts, key=lambda attempt: attempt[0])[1]


def _from_seed(guess: seeding.Seed, corners: Array, names: tuple[str, ...], sizes: list[tuple[int, int]],
               spacing: float, lattice: tuple[Array, Array] | None) -> Adjustment:  # fmt: skip
    corners = corners.copy()
    if len(corners) > 1:
        corners[1, guess.flipped] = corners[1, guess.flipped][:, ::-1, ::-1]
    seen = np.isfinite(guess.rt_ref_board[:, 0])
    placed = seen & (guess.apart < seeding.AGREE)
    problem = assemble(corners[:, placed], sizes, spacing, lattice)
    problem.lensmodel = guess.lens
    centres = (np.asarray(sizes) - 1) / 2
    problem.intrinsics = np.column_stack([guess.focals, guess.focals, centres])
    if guess.rt_wet_dry is not None:
        problem.rt_cam_ref = guess.rt_wet_dry[None].copy()
    problem.rt_ref_board = guess.rt_ref_board[placed].copy()
    problem.free, problem.regularization = POSES, False
    return Adjustment(
        problem,
        corners,
        names,
        np.flatnonzero(placed),
        [Dropped(names[i], CONTRADICTS if seen[i] else TOO_LITTLE) for i in np.flatnonzero(~placed)],
        tuple(names[i] for i in np.flatnonzero(guess.flipped)),
    )


def lattice_of(points: Array, spacing: float) -> tuple[Array, Array] | None:
    """Where columns and rows of a board's corners stand, if that is not at steps of `spacing`."""
    x, y = points[0, :, 0], points[:, 0, 1]
    if all(np.allclose(np.diff(along), spacing, rtol=1e-9) for along in (x, y)):
        return None
    return np.array(x), np.array(y)


def assemble(
    corners: Array, sizes: list[tuple[int, int]], spacing: float, lattice: tuple[Array, Array] | None = None
) -> Problem:
    """A problem from corners, (cameras, F, rows, columns, 2), NaN where unseen; its state is still zero."""
    cameras, frames = corners.shape[:2]
    seen = np.isfinite(corners[..., 0])
    frame, camera = np.nonzero(seen.any((2, 3)).T)
    observations = np.empty((len(frame), *corners.shape[2:4], 3))
    observations[..., :2] = np.where(seen[camera, frame][..., None], corners[camera, frame], 0)
    observations[..., 2] = np.where(seen[camera, frame], 1.0, 0.0)
    return Problem(
        lensmodel=seeding.LENSES[0],
        intrinsics=np.zeros((cameras, 4)),
        rt_cam_ref=np.zeros((cameras - 1, 6)),
        rt_ref_board=np.zeros((frames, 6)),
        observations=observations,
        indices=np.column_stack([frame, camera, camera - 1]).astype(np.int32),
        sizes=np.array(sizes, dtype=np.int32),
        spacing=spacing,
        lattice=lattice,
    )


def fit(problem: Problem) -> float:
    """RMS per coordinate of all inliers, pixels."""
    return float(np.sqrt(np.nanmean(np.square(versions.residuals(problem)))))


def frame_rms(problem: Problem) -> Array:
    """RMS per coordinate of each frame's inliers, (F,) pixels."""
    square = versions.residuals(problem) ** 2
    total = np.zeros((len(problem.rt_ref_board), 2))
    np.add.at(total, problem.indices[:, 0],
              np.column_stack([np.nansum(square, (1, 2, 3)), np.isfinite(square).sum((1, 2, 3))]))  # fmt: skip
    return np.asarray(np.sqrt(total[:, 0] / np.maximum(total[:, 1], 1)))


def mend(adjustment: Adjustment, points: Array) -> None:
    """Pose flips undone, hopeless frames dropped; ends with a problem whose frames agree with its lens core."""
    for _ in range(3):
        turned = unflip(adjustment.problem, points)
        if turned:
            versions.optimize(adjustment.problem)
        rms = frame_rms(adjustment.problem)
        bad = rms > max(HOPELESS * float(np.median(rms)), HOPELESS_PX)
        if bad.any() and (~bad).sum() >= 3:
            worst = bad & (rms >= rms.max() / 2)  # the others may only suffer from these
            reasons = [f"its corners are {value:.1f} px RMS away from where the other frames put them (those: "
                       f"{np.median(rms):.2f} px)" for value in rms[worst]]  # fmt: skip
            adjustment.drop(worst, reasons)
            versions.optimize(adjustment.problem)
        elif not turned:
            break


def unflip(problem: Problem, points: Array) -> int:
    """Give each frame the better of its pose and the closed-form poses under the present lenses; how many changed."""
    best = frame_rms(problem)
    turned = np.zeros(len(best), bool)
    for camera, rt_cam_ref in enumerate([np.zeros(6), *problem.rt_cam_ref]):
        found = closed_form(problem, camera, points)
        for rank in range(2):
            trial = problem.copy()
            placed = {frame: c[rank].rt_cam_board for frame, c in found.items() if len(c) > rank}
            if placed:
                trial.rt_ref_board[list(placed)] = pose.compose(
                    pose.invert(rt_cam_ref), np.array(list(placed.values()))
                )
            rms = frame_rms(trial)
            better = rms < 0.9 * best
            problem.rt_ref_board[better] = trial.rt_ref_board[better]
            best, turned = np.where(better, rms, best), turned | better
    return int(turned.sum())


def closed_form(problem: Problem, camera: int, points: Array) -> dict[int, list[seeding.Candidate]]:
    """For each frame that a camera saw the poses, one or two, that its inliers allow under the present lens."""
    focal = problem.intrinsics[camera, :2]
    found, rows = {}, np.flatnonzero(problem.indices[:, 1] == camera)
    everywhere = versions.unproject(problem.observations[rows][..., :2], problem.lensmodel, problem.intrinsics[camera])
    for row, view_rays in zip(rows, everywhere, strict=True):
        seen = problem.observations[row][..., 2] > 0
        rays = view_rays[seen]
        if seen.sum() >= seeding.MIN_CORNERS and (rays[:, 2] > 0).all():
            xy = rays[:, :2] / rays[:, 2:]
            found[int(problem.indices[row, 0])] = seeding.poses_from_rays(points[seen], xy, focal)
    return found


def enrich(problem: Problem, lensmodel: str) -> None:
    """Switch from the seed's lens to the one wanted, close to what the seed's lens did, and free what it offers."""
    count = versions.parameters(lensmodel)
    intrinsics = np.zeros((len(problem.intrinsics), count))
    intrinsics[:, :4] = problem.intrinsics[:, :4]
    if problem.lensmodel == seeding.LENSES[1] and not lensmodel.startswith(SPLINED):
        coefficients = like_stereographic(count - 4)
        intrinsics[:, 4 : 4 + len(coefficients)] = coefficients
    problem.lensmodel, problem.intrinsics = lensmodel, intrinsics
    problem.free = Free(core=not lensmodel.startswith(SPLINED), distortions=count > 4)
    problem.regularization = True


def approach(problem: Problem) -> bool:
    """Where there are plenty of corners, come near with every second one in each direction, four times as fast.

    False, and nothing done, where there are not.
    """
    sparse = np.ascontiguousarray(problem.observations[:, ::2, ::2])
    enough = np.zeros(len(problem.rt_ref_board))
    np.add.at(enough, problem.indices[:, 0], (sparse[..., 2] > 0).sum((1, 2)))
    if problem.lattice is not None and not _alternating(problem.lattice):
        return False
    if observed(problem).sum() < PLENTY or enough.min() < 2 * seeding.MIN_CORNERS:
        return False
    trial = problem.copy(observations=sparse, spacing=2 * problem.spacing)
    if problem.lattice is not None:  # every second corner of an AprilGrid: equal steps, which mrcal solves
        trial.spacing, trial.lattice = float(problem.lattice[0][2] - problem.lattice[0][0]), None
    versions.optimize(trial)
    problem.intrinsics, problem.rt_cam_ref = trial.intrinsics, trial.rt_cam_ref
    problem.rt_ref_board = trial.rt_ref_board
    return True


def _alternating(lattice: tuple[Array, Array]) -> bool:
    """Whether every second column and row stand at equal steps, the same along both."""
    steps = np.concatenate([np.diff(along[::2]) for along in lattice])
    return len(steps) > 0 and bool(np.allclose(steps, steps[0], rtol=1e-9))


def like_stereographic(count: int) -> list[float]:
    """OpenCV distortion coefficients, at most `count`, that turn a pinhole into a stereographic lens.

    The radial factor wanted is 2 / (1 + sqrt(1 + s)), s = tan^2. With 8 coefficients: its Pade approximant, from that
    of the square root; with fewer: a polynomial fit over s up to 1 (90 degrees across).
    """
    if count >= 8:
        return [3 / 4, 1 / 16, 0, 0, 0, 1, 3 / 16, 0]
    if count < 4:
        return []
    s = np.linspace(0, 1, 50)
    powers = [1, 2, 3] if count >= 5 else [1, 2]
    k = np.linalg.lstsq(np.stack([s**p for p in powers], -1), 2 / (1 + np.sqrt(1 + s)) - 1, rcond=None)[0]
    return [float(k[0]), float(k[1]), 0, 0, *map(float, k[2:])]


def splined(problem: Problem) -> str:
    """A splined model for the field of view at hand: 12 knots across, a tenth wider than the wider camera sees."""
    width, height = (int(n) for n in problem.sizes.max(0))
    half = np.arctan(problem.sizes[:, 0] / 2 / problem.intrinsics[:, 0] / 2).max() * 2
    if problem.lensmodel == seeding.LENSES[0]:
        half = np.arctan(problem.sizes[:, 0] / 2 / problem.intrinsics[:, 0]).max()
    degrees = min(float(np.degrees(2 * half)) * 1.1 + 2, 175.0)
    return f"{SPLINED}_order=3_Nx=12_Ny={max(round(12 * height / width), 4)}_fov_x_deg={degrees:.0f}"


def unregularize(adjustment: Adjustment, solver: Solver) -> None:
    """Take mrcal's regularization away where the data do without; it biases directions by some 1e-3 px.

    Ordinary noise hides that bias by far, so this is done for corners better than QUIET_PX only.
    It stays where taking it away moves the image by more than UNREGULARIZED_PX somewhere without halving the
    residuals: there it holds up what the data leave open. Splined models always need it.
    """
    problem = adjustment.problem
    if problem.lensmodel.startswith(SPLINED) or not problem.regularization or fit(problem) > QUIET_PX:
        return
    freed = replace(adjustment, problem=problem.copy(regularization=False))
    try:
        solver(freed)
    except versions.SolveError:
        return
    trial = freed.problem
    for before, after, (width, height) in zip(problem.intrinsics, trial.intrinsics, problem.sizes, strict=True):
        grid = np.stack(np.meshgrid(np.linspace(0, width - 1, 9), np.linspace(0, height - 1, 7)), -1)
        moved = versions.project(versions.unproject(grid, problem.lensmodel, before), problem.lensmodel, after) - grid
        moved -= moved.mean((0, 1))  # a shift of the image is mostly a rotation of the camera
        if not np.abs(moved).max() < UNREGULARIZED_PX and not fit(trial) < fit(problem) / 2:
            return
    adjustment.problem = trial


def bend(problem: Problem) -> None:
    """Let the board be bent from here on."""
    problem.warp = np.zeros(2)
    problem.free = replace(problem.free, warp=True)


def observed(problem: Problem) -> Mask:
    """Which corners were seen, (M, rows, columns), outliers included. Unseen ones have weight 0 all along."""
    return np.asarray(problem.observations[..., 2] != 0)
