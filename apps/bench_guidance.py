"""Benchmark stage `guidance`: what an update costs while capturing, and how many pairs a target takes."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from functools import cache

import numpy as np

from rainstereo import Rig
from rainstereo.apps.bench_calibration import BOARD, MODEL, NOISE_PX
from rainstereo.apps.bench_harness import Stage, Target, Variant, Work
from rainstereo.apps.board_poses import board_poses
from rainstereo.apps.digital_rig import digital_rig, exact_observations
from rainstereo.apps.guided_capture import Captured, anywhere, capture, unsteady
from rainstereo.apps.rig_error import infinity_error
from rainstereo.calib import guidance
from rainstereo.calib.guidance import Proposal
from rainstereo.calib.incremental import Incremental, View
from rainstereo.calib.observations import Observations
from rainstereo.calib.solve import Solution, solve

TARGET_PX, SEEDS, LIMIT = 0.4, 3, 60
QUICK_TARGET_PX = 0.6


def build(seed: int, quick: bool) -> Stage:
    """Updates at 15, 30 and 60 pairs, the proposal, and captures with three seeds; little of each if `quick`."""
    works = [_update(pairs, seed) for pairs in ((10,) if quick else (15, 30, 60))]
    works.append(_propose(10 if quick else 30, seed))
    works.append(_redundant(10 if quick else 60, seed))
    works.append(_frames(QUICK_TARGET_PX if quick else TARGET_PX, 1 if quick else SEEDS, seed))
    return Stage(
        "guidance",
        "calibrating while capturing",
        "A pair arrives: how long until the calibration knows it, how long until it is known where to hold the board "
        "next, and how many pairs a target takes if the board is held there rather than anywhere.",
        tuple(works),
        {
            "rig": "two OPENCV8 cameras of 1280x960, f about 1200 px, 29 mm apart, behind two 4 mm panels pitched "
            "by 15 degrees; the panels are known",
            "board": BOARD.spec,
            "noise": f"{NOISE_PX} px a coordinate",
            "seed": seed,
        },
        (
            "Corners are given: detection is not part of the time.",
            "Anywhere: poses at random in which both cameras see the whole board, up to three times as far as where it "
            "fills the frame, tilted by up to 45 degrees. Proposals are held 4 degrees and 3 % of the distance off.",
            "Both start with the same five pairs anywhere. The figure is the sigma of the least certain direction at "
            "infinity over both cameras and their match, in the worst direction.",
        ),
    )


def _running(pairs: int, seed: int) -> tuple[Rig, Incremental, View]:
    """A rig, a calibration of all pairs but one, and that one."""
    truth = digital_rig(seed=seed)
    poses = board_poses(truth, BOARD, pairs, seed)
    rng = np.random.default_rng([seed, pairs])
    dry, wet = (corners + rng.normal(0, NOISE_PX, corners.shape) for corners in exact_observations(truth, BOARD, poses))
    views = [View(f"{i:03d}", np.stack([dry[i], wet[i]])) for i in range(pairs)]
    running = Incremental(BOARD, (truth.dry.size, truth.wet.size), MODEL, truth.chamber, redundant=0.0)
    for view in views[:-1]:
        running.add(view, solve_now=False)
    running.solve_afresh()
    return truth, running, views[-1]


def _update(pairs: int, seed: int) -> Work:
    truth, running, last = _running(pairs, seed)

    def warm() -> Solution:
        now = copy.deepcopy(running)
        now.add(last)
        if now.solution is None:
            raise RuntimeError(f"no solution of {pairs} exact pairs: {now.trouble}")
        return now.solution

    everything = copy.deepcopy(running)
    everything.add(last)
    observations = everything.observations(everything.names("used"))

    def error(solution: Solution) -> float:
        return infinity_error(solution.rig, truth)

    return Work(
        f"update-{pairs}",
        f"one more pair: {pairs} in all",
        f"{pairs - 1} pairs are solved, one arrives. From the solution at hand: its pose, what it adds, the joint "
        "solution of all pairs through the panels with outliers looked for, and the uncertainty at infinity.",
        (
            Variant("update", warm, error, True, "from the solution at hand"),
            Variant("solve", lambda: solve(observations, MODEL, truth.chamber), error, True, "from nothing"),
        ),
        "update",
        "px",
        "of directions at infinity, RMS over both images",
        targets=(Target("update", None, 1.0),) if pairs == 60 else (),
    )


def _propose(pairs: int, seed: int) -> Work:
    truth, running, last = _running(pairs, seed)
    running.add(last)
    rng = np.random.default_rng([seed, 0xADD])

    def proposed() -> Proposal:
        if running.solution is None:
            raise RuntimeError(running.trouble)
        found = guidance.propose(
            running.solution, BOARD, known=guidance.certainty(running.solution.problem, truth.chamber)
        )
        if found is None:
            raise RuntimeError("no pose fits both images")
        return found

    @cache
    def taken() -> View:
        corners = exact_observations(truth, BOARD, proposed().pose)
        return View("proposed", np.stack([xy[0] + rng.normal(0, NOISE_PX, xy[0].shape) for xy in corners]))

    def added() -> float:
        now = copy.deepcopy(running)
        now.add(taken())
        return np.inf if now.known is None else now.known.worst

    return Work(
        "propose",
        f"where to hold the board next, after {pairs} pairs",
        "All candidate poses judged by the linearised problem; the best one's promise is compared with what comes of "
        "really taking that pair, with noise.",
        (
            Variant("propose", proposed, lambda found: 100 * abs(found.predicted / added() - 1), True,
                    f"{proposed().considered} poses judged"),
            Variant("take one and solve", added, lambda _: 0.0, True, "one pose only"),
        ),
        "propose",
        "%",
        "of the worst sigma that was promised",
        targets=(Target("propose", None, 0.3),),
    )  # fmt: skip


def _redundant(pairs: int, seed: int) -> Work:
    truth = digital_rig(seed=seed)
    rng = np.random.default_rng([seed, 0x2ED])
    poses = np.stack([anywhere(truth, BOARD, rng) for _ in range(pairs // 2)])
    again = np.stack([unsteady(truth, BOARD, pose, rng) for pose in poses])
    still = poses[:: max(pairs // 12, 1)]
    held = np.concatenate([poses, again, still])
    dry, wet = (corners + rng.normal(0, NOISE_PX, corners.shape) for corners in exact_observations(truth, BOARD, held))
    running = Incremental(BOARD, (truth.dry.size, truth.wet.size), MODEL, truth.chamber)
    for i in rng.permutation(len(held)):
        running.add(View(f"{i:03d}", np.stack([dry[i], wet[i]])), solve_now=False)
    running.catch_up()
    used, everything = running.observations(running.names("used")), running.observations(tuple(running.judged))

    def variant(name: str, observations: Observations) -> Variant:
        return Variant(
            name,
            lambda: solve(observations, MODEL, truth.chamber),
            lambda solution: infinity_error(solution.rig, truth),
            True,
            f"{len(observations)} pairs",
        )

    return Work(
        "redundant",
        f"{len(held)} pairs, many nearly alike",
        f"Boards held anywhere {pairs // 2} times, then once more nearly there, and {len(still)} times without having "
        f"moved; frames that together lessen no sigma by {running.redundant:.0%} are left out.",
        (variant("redundant left out", used), variant("all pairs", everything)),
        "redundant left out",
        "px",
        "of directions at infinity, RMS over both images",
    )


def _frames(target: float, seeds: int, seed: int) -> Work:
    @cache
    def captured(guided: bool, number: int) -> Captured:
        truth = digital_rig(seed=seed + number)
        return capture(
            truth, BOARD, MODEL, target=target, guided=guided, seed=seed + number, noise=NOISE_PX, limit=LIMIT
        )

    def needed(guided: bool) -> list[int]:
        return [captured(guided, number).pairs for number in range(seeds)]

    def variant(name: str, guided: bool, note: str, ours: bool) -> Variant:
        def run() -> Captured:
            captured.cache_clear()
            return captured(guided, 0)

        def also(_: Captured) -> Mapping[str, float]:
            return {f"pairs, seed {seed + number}": float(pairs) for number, pairs in enumerate(needed(guided))}

        error: Callable[[Captured], float] = lambda _: float(np.median(needed(guided)))  # noqa: E731
        return Variant(name, run, error, ours, note, 50, also)

    return Work(
        "pairs",
        f"how many pairs until the worst sigma is {target:g} px",
        "The time is that of all updates and proposals of the first seed's capture.",
        (
            variant("held where proposed", True, "as a person does, a little off", True),
            variant("held anywhere", False, f"at most {LIMIT} pairs", False),
        ),
        "held where proposed",
        "pairs",
        f"median over {seeds} rigs and captures",
    )
