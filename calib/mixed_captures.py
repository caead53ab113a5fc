"""Are the images of one folder all of one rig in one state? Another focus, a camera that was moved, another rig.

Each frame has its own estimate of focal lengths and relative pose (`own_rig`). If all frames share one state these
scatter about one value, by the corners' noise and by what the models do not describe; if there are two states they form
two groups. For each way in which frames may differ the best division into two groups is sought (Lloyd's algorithm
with the frames' own covariances; S. P. Lloyd, "Least squares quantization in PCM", 1982) and tested by the F ratio of
what the division explains to the scatter that is left within the groups, so that a lens model or a board that does not
quite fit raises no alarm. The division was chosen among all, so the probability is multiplied by their number,
3^(n - 1) for n frames in one of two groups or in none (Bonferroni): the bound holds whatever the choice.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from rainstereo import pose
from rainstereo.calib import adjust, mismatch
from rainstereo.calib.checks import Finding
from rainstereo.calib.mrcal_versions import SolveError
from rainstereo.calib.observations import Observations
from rainstereo.calib.own_rig import NAMES, Own, own_rigs
from rainstereo.calib.solve import Solution, solve
from rainstereo.calib.sought import Sought
from rainstereo.chamber import Chamber
from rainstereo.rig import ROLES, Role
from rainstereo.types import Array, Mask

WAYS: dict[str, tuple[int, ...]] = {
    "dry focus": (0,),
    "wet focus": (1,),
    "both foci": (0, 1),
    "cameras": tuple(range(2, 8)),
    "rig": tuple(range(8)),
}
"""How frames may differ, and which of `own_rig.NAMES` then do."""
SURE = 1e-6
"""A probability below which two groups are believed."""
FEWEST = 2
"""Frames that make a group; a single frame may err for many reasons."""
SHOWS_PX, SHOWS_NOISE = 0.1, 0.5
"""A difference that moves the corners by less, in pixels and in units of their noise, is not worth a word."""
ZOOMED, ZOOMED_SIGMAS = 0.01, 8.0
"""A single frame is named where its focal length is off by this share and by so many sigmas: no mishap does that."""
WILD = 25.0
"""A frame this many times farther from its group than usual belongs to none."""
SLIGHT = 0.1
"""A simpler difference is told where what it leaves unexplained moves corners by less than this share of all."""
PLAIN = 25.0
"""Squared sigmas by which the other group has to suit a frame better for it to change sides."""
STARTS, ROUNDS = 8, 12


@dataclass(frozen=True)
class Mixture:
    """Two states of the rig in one set of images.

    way: one of `WAYS`. frames: the smaller group; others: how many the larger has. p: an upper bound of the
    probability of such a division by chance. shows: by how many pixels RMS the difference moves corners.
    focal: by which share each camera's focal length is longer in `frames`, focal_sd: one standard deviation.
    baseline, baseline_sd: how much longer, metres. turn, turn_sd: rotation between both relative poses, radians;
    move: of the wet camera's place, metres.
    """

    way: str
    frames: tuple[str, ...]
    others: int
    p: float
    shows: float
    focal: tuple[float, float]
    focal_sd: tuple[float, float]
    baseline: float
    baseline_sd: float
    turn: float
    turn_sd: float
    move: float


def examine(observations: Observations, solution: Solution, through: Mask | None = None) -> Mixture | None:
    """Whether frames, used or dropped, tell of two states; None where nothing does.

    through: which of the frames given were seen through the solution's chamber, (N,); None: all. A calibration from
    frames of both states is wrong for both; so once two groups are found, what differs is read off a calibration of the
    larger one alone.
    """
    if len(solution.problem.intrinsics) < len(ROLES):
        return None
    own = of_frames(observations, solution, through)
    divisions = [found for columns in WAYS.values() if (found := _divided(own, list(columns))) is not None]
    if not divisions:
        return _single(own, solution)
    candidates: dict[tuple[str, ...], _Division] = {}
    for division in sorted(divisions, key=lambda each: each.p):
        candidates.setdefault(tuple(sorted(division.frames)), division)
    told = [_described(observations, solution, through, division) for division in candidates.values()]
    apart = [each for each in told if each is not None]
    if not apart:
        first = next(iter(candidates.values()))
        return _read_off(solution, own, first)[1]
    return min(apart, key=lambda each: each[0])[1]


def _described(
    observations: Observations, solution: Solution, through: Mask | None, division: _Division
) -> tuple[float, Mixture] | None:
    """A division as a calibration of its larger group shows it, and square pixels that it leaves; None: that failed."""
    try:
        clean, own = _larger_alone(observations, solution, through, division)
    except (SolveError, ValueError):
        return None
    return _read_off(clean, own, division)


def _read_off(solution: Solution, own: Own, division: _Division) -> tuple[float, Mixture]:
    """In which way the groups differ, and square pixels that stay unexplained."""
    mine, theirs = (np.isin(np.array(own.names), names) for names in (division.frames, division.others))
    compared = {way: _compared(own, list(columns), mine, theirs) for way, columns in WAYS.items()}
    best = min(compared, key=lambda each: compared[each].left)
    slight = (SLIGHT * _shows(own, list(WAYS[best]), compared[best].step, mine) / own.noise) ** 2
    enough = compared[best].left + slight * 2 * float(own.corners[mine].sum())
    way = min(
        (each for each in WAYS if compared[each].left <= enough),
        key=lambda each: (len(WAYS[each]), compared[each].left),
    )
    mine, theirs = _sorted(own, list(WAYS[way]), mine, theirs)
    found = _compared(own, list(WAYS[way]), mine, theirs)
    return compared[way].left * own.noise**2, _mixture(solution, own, way, replace(found, p=division.p), mine)


def _larger_alone(
    observations: Observations, solution: Solution, through: Mask | None, division: _Division
) -> tuple[Solution, Own]:
    """A calibration of the larger group alone, and what each frame of both has to say about it."""
    chamber, place = solution.rig.chamber, {name: i for i, name in enumerate(observations.names)}
    behind = np.ones(len(observations), dtype=np.bool_) if through is None else through
    others = np.array(sorted(place[name] for name in division.others), dtype=np.intp)
    panels = None if chamber is None else Sought(chamber, through=behind[others])
    clean = solve(observations.select(others), solution.lensmodel, panels, warp=bool(solution.calobject_warp.any()))
    strange = [place[name] for name in division.frames]
    return clean, own_rigs(clean.problem, clean.names, _strangers(observations, strange, chamber, behind))


def of_frames(observations: Observations, solution: Solution, through: Mask | None = None) -> Own:
    """Each frame's own rig, of those used and of those dropped for what they show."""
    place = {name: i for i, name in enumerate(observations.names)}
    mute = (adjust.TOO_LITTLE, mismatch.EXCHANGED)  # the latter are of this rig, and it is said what they are
    strange = [place[drop.name] for drop in solution.dropped if not drop.reason.startswith(mute)]
    behind = np.ones(len(observations), dtype=np.bool_) if through is None else through
    return own_rigs(solution.problem, solution.names, _strangers(observations, strange, solution.rig.chamber, behind))


def _strangers(
    observations: Observations, which: list[int], chamber: Chamber | None, behind: Mask
) -> list[tuple[list[str], Array, Chamber | None]]:
    """Frames that a calibration did not use: those seen through its chamber, and those that were not."""
    corners, parts = np.stack([observations.xy(role) for role in ROLES]), []
    for before in (True, False):
        mine = [i for i in which if bool(behind[i]) == before]
        parts.append(([observations.names[i] for i in mine], corners[:, mine], chamber if before else None))
    return parts


@dataclass(frozen=True, eq=False)
class _Division:
    """Two groups of frames, in one way to differ. left: squared sigmas that stay in all eight, and what the way's
    number of parameters costs. step, covariance: of the smaller group less the larger, in the way's columns."""

    frames: tuple[str, ...]
    others: tuple[str, ...]
    p: float
    left: float
    step: Array
    covariance: Array


def _divided(own: Own, columns: list[int]) -> _Division | None:
    """The division into two that explains most, in these of the eight; None if it is not one to believe in."""
    H = own.weight[:, columns][:, :, columns] / own.noise**2
    telling = np.array([np.linalg.matrix_rank(h, hermitian=True) == len(columns) if h.any() else False for h in H])
    if telling.sum() < 2 * FEWEST + 1:
        return None
    H, best = H[telling], _estimates(own, columns)[telling]
    state = _two(H, best)
    if state is None:
        return None
    second, kept = state
    n, k = int(kept.sum()), len(columns)
    mine, theirs = (kept & (second == which) for which in (True, False))
    if mine.sum() > theirs.sum():
        mine, theirs = theirs, mine
    if mine.sum() < FEWEST or n < 2 * FEWEST + 1:
        return None
    within = sum(float(_costs(H, best, _mean(H, best, group))[group].sum()) for group in (mine, theirs))
    total = float(_costs(H, best, _mean(H, best, kept))[kept].sum())
    spread = max(within / (k * (n - 2)), 1.0)
    log_p = float(scipy.stats.f.logsf((total - within) / k / spread, k, k * (n - 2)))
    log_p += (len(kept) - 1) * float(np.log(3))
    where = np.flatnonzero(telling)
    groups = [np.isin(np.arange(len(own.names)), where[group]) for group in (mine, theirs)]
    found = _compared(own, columns, *groups)
    if log_p > np.log(SURE) or _shows(own, columns, found.step, groups[0]) < max(SHOWS_PX, SHOWS_NOISE * own.noise):
        return None
    return replace(found, p=float(np.exp(log_p)))


def _compared(own: Own, columns: list[int], mine: Mask, theirs: Mask) -> _Division:
    """What differs between two groups of frames if only these of the eight do."""
    H, best = own.weight[:, columns][:, :, columns] / own.noise**2, _estimates(own, columns)
    left, covariance, means = 0.0, np.zeros((len(columns), len(columns))), []
    for group in (theirs, mine):
        full, mean = np.zeros(len(NAMES)), _mean(H, best, group)
        full[columns] = mean
        left += float(_costs(own.weight[group], own.values[group], full).sum()) / own.noise**2
        spread = float(_costs(H, best, mean)[group].sum()) / max(len(columns) * (int(group.sum()) - 1), 1)
        covariance += np.linalg.pinv(H[group].sum(0), hermitian=True) * max(spread, 1.0)
        means.append(mean)
    count = int(mine.sum() + theirs.sum())
    scatter = max(left / max(len(NAMES) * (count - 2), 1), 1.0)
    names = [tuple(name for name, there in zip(own.names, group, strict=True) if there) for group in (mine, theirs)]
    return _Division(
        names[0],
        names[1],
        0.0,
        left + 2 * len(columns) * float(np.log(count)) * scatter,
        means[1] - means[0],
        covariance,
    )


def _estimates(own: Own, columns: list[int]) -> Array:
    """Each frame's best values if only these of the eight differ, (F, k)."""
    H = own.weight[:, columns][:, :, columns]
    return np.asarray(
        np.einsum("fij,fj->fi", np.linalg.pinv(H, hermitian=True),
                  np.einsum("fij,fj->fi", own.weight[:, columns], own.values))
    )  # fmt: skip


def _sorted(own: Own, columns: list[int], mine: Mask, theirs: Mask) -> tuple[Mask, Mask]:
    """The groups once each frame has gone where it plainly fits better: they were divided before either was known."""
    H, best = own.weight[:, columns][:, :, columns] / own.noise**2, _estimates(own, columns)
    centres = [np.median(best[group], axis=0) for group in (mine, theirs)]
    for _ in range(ROUNDS):
        prefers_mine = _costs(H, best, centres[1]) - _costs(H, best, centres[0])
        fresh = (mine & (prefers_mine > -PLAIN)) | (theirs & (prefers_mine > PLAIN))
        rest = (mine | theirs) & ~fresh
        if (fresh == mine).all() or min(fresh.sum(), rest.sum()) < FEWEST:
            break
        mine, theirs = fresh, rest
        centres = [_mean(H, best, group) for group in (mine, theirs)]
    return mine, theirs


def _shows(own: Own, columns: list[int], step: Array, group: Mask) -> float:
    """By how many pixels RMS, per coordinate, a difference moves the corners of some frames."""
    H = own.weight[group][:, columns][:, :, columns]
    return float(np.sqrt(np.einsum("i,fij,j->", step, H, step) / max(2 * own.corners[group].sum(), 1)))


def _two(H: Array, best: Array) -> tuple[Mask, Mask] | None:
    """Which frames are in the second group, and which in either, (n,) each; None where that finds no two."""
    middle = np.median(best, axis=0)
    found: tuple[float, Mask, Mask] | None = None
    for start in np.argsort(-_costs(H, best, middle))[:STARTS]:
        centres, second = [middle, best[start]], np.zeros(len(H), dtype=np.bool_)
        for _ in range(ROUNDS):
            costs, before = np.stack([_costs(H, best, centre) for centre in centres]), second
            second, nearer = costs[1] < costs[0], costs.min(0)
            limit = WILD * max(float(np.median(nearer)), 1.0)
            kept = nearer <= limit
            if not (kept & second).any() or not (kept & ~second).any() or (second == before).all():
                break
            centres = [_mean(H, best, kept & ~second), _mean(H, best, kept & second)]
        total = float(np.minimum(nearer, limit).sum())
        if min((kept & second).sum(), (kept & ~second).sum()) >= FEWEST and (found is None or total < found[0]):
            found = total, second, kept
    return None if found is None else found[1:]


def _costs(H: Array, best: Array, at: Array) -> Array:
    """Squared distance of each frame's estimate from a value, in its own sigmas, (n,)."""
    off = best - at
    return np.asarray(((H @ off[:, :, None])[:, :, 0] * off).sum(-1))


def _mean(H: Array, best: Array, which: Mask) -> Array:
    """Weighted mean of the estimates of some frames."""
    return np.asarray(np.linalg.pinv(H[which].sum(0), hermitian=True) @ np.einsum("fij,fj->i", H[which], best[which]))


def _single(own: Own, solution: Solution) -> Mixture | None:
    """Dropped frames of which each alone says that its focal length was another."""
    named = np.zeros(len(own.names), dtype=np.bool_)
    for i in np.flatnonzero(~own.used & own.weight.any((1, 2))):
        sd = own.noise * np.sqrt(np.diag(np.linalg.pinv(own.weight[i], hermitian=True)))[:2]
        off = np.abs(own.values[i, :2])
        named[i] = bool(((off > ZOOMED) & (off > ZOOMED_SIGMAS * sd)).any())
    if not named.any():
        return None
    columns = list(range(len(NAMES)))
    found = _compared(own, columns, named, own.used)
    p = min(1.0, 4 * len(own.names) * float(scipy.stats.norm.sf(ZOOMED_SIGMAS)))
    return _mixture(solution, own, "rig", replace(found, p=p), named)


def _mixture(solution: Solution, own: Own, way: str, found: _Division, mine: Mask) -> Mixture:
    """In the terms of a user: focal lengths, baseline, rotation and place of the smaller group against the larger's."""
    columns = list(WAYS[way])
    full, matrix = np.zeros(len(NAMES)), np.zeros((len(NAMES), len(NAMES)))
    full[columns], matrix[np.ix_(columns, columns)] = found.step, found.covariance
    sd = np.sqrt(np.diag(matrix))
    now = solution.rig.rt_wet_dry
    then, t = now + full[2:], now[3:] / np.linalg.norm(now[3:])
    axis = full[2:5] / max(float(np.linalg.norm(full[2:5])), 1e-300)
    return Mixture(
        way=way,
        frames=found.frames,
        others=len(found.others),
        p=found.p,
        shows=_shows(own, columns, found.step, mine),
        focal=(float(np.expm1(full[0])), float(np.expm1(full[1]))),
        focal_sd=(float(sd[0]), float(sd[1])),
        baseline=float(np.linalg.norm(then[3:]) - np.linalg.norm(now[3:])),
        baseline_sd=float(np.sqrt(t @ matrix[5:, 5:] @ t)),
        turn=float(np.linalg.norm(pose.compose(then, pose.invert(now))[:3])),
        turn_sd=float(np.sqrt(axis @ matrix[2:5, 2:5] @ axis)),
        move=float(np.linalg.norm(pose.invert(then)[3:] - pose.invert(now)[3:])),
    )


def doubts(mixture: Mixture | None) -> list[Finding]:
    """What a user should know about two states in one folder."""
    if mixture is None:
        return []
    many = len(mixture.frames) > 1
    these = f"the {len(mixture.frames)} frames named" if many else "the frame named"
    sure = f"p < {10.0 ** math.ceil(math.log10(max(mixture.p, 1e-300))):.0e}"
    shows = f"{mixture.shows:.2f} px RMS of their corners, {sure}" if many else f"{mixture.shows:.1f} px RMS"
    if mixture.way == "cameras":
        text = f"in {these} the cameras stand differently to each other than in the other {mixture.others}: "
        text += _stand(mixture)
        remedy = "tighten what holds the cameras, and calibrate from frames taken before or after it moved, not both"
    elif mixture.way == "rig":
        text = f"{these} {'were' if many else 'was'} taken by another rig than the other {mixture.others}, or after "
        text += f"a change of it: {_foci(mixture, ROLES)}, {_stand(mixture)}"
        remedy = "put the images of each rig, or state of it, into a folder of its own"
    else:
        changed = ROLES if mixture.way == "both foci" else tuple(role for role in ROLES if role in mixture.way)
        text = f"{these} {'were' if many else 'was'} taken with another focus than the other {mixture.others}: "
        text += _foci(mixture, changed)
        remedy = (
            "lock focus and zoom, and calibrate from frames of one focus: put the others into a folder of their own"
        )
    return [Finding("doubtful", f"{text} ({shows})", remedy, mixture.frames)]


def _foci(mixture: Mixture, roles: tuple[Role, ...]) -> str:
    told = []
    for role in roles:
        share, sd = mixture.focal[ROLES.index(role)], mixture.focal_sd[ROLES.index(role)]
        told.append(f"the {role} camera's focal length {100 * share:+.3f} +- {100 * sd:.3f} %")
    return ", ".join(told)


def _stand(mixture: Mixture) -> str:
    return (
        f"the wet camera turned by {math.degrees(mixture.turn):.2f} +- {math.degrees(mixture.turn_sd):.2f} degrees, "
        f"{1000 * mixture.move:.1f} mm away, the baseline {1000 * mixture.baseline:+.2f} +- "
        f"{1000 * mixture.baseline_sd:.2f} mm"
    )
