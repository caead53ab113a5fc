"""From measured pairs to a data set of an exact size: rejection, key frames, splits, strata, and the most different."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from rainstereo.types import Array, Indices, Mask

from . import strata
from .candidate import Candidate, Measures
from .farthest_point import farthest_points
from .keyframes import keyframes
from .perceptual_hash import NEAR_DUPLICATE, Hashes, from_text, nearest
from .rejection import REASONS, Limits, duplicated, refused
from .splits import SPLITS, Units, assigned, guarded, units_of

WAYS = ("auto", "drive", "block")
TRIES = 12
MORE = 1.3
"""By how much more of the candidates a split is given when it came out short."""


class NotEnoughError(RuntimeError):
    """Fewer pairs survive than were asked for; `rejected` says why, pair by pair."""

    def __init__(self, words: str, rejected: dict[int, tuple[str, str]]) -> None:
        super().__init__(words)
        self.rejected = rejected


@dataclass(frozen=True)
class Settings:
    """How to choose.

    count: of pairs, exactly; None: all that survive. seed: of every choice. limits: of what is usable.
    step, still: of key frames, shares of the image's width (`keyframes`). balance: of strata (`strata.shared_out`).
    val, test: shares of the count. reserve: test pairs set aside for labels; test has at least as many.
    split_by: "drive", "block", or "auto": by drive where three or more of them suit the shares.
    block, guard: seconds. near: bits of hash up to which two images are one.
    """

    count: int | None = None
    seed: int = 0
    limits: Limits = field(default_factory=Limits)
    step: float = 0.05
    still: float = 0.001
    balance: float = 0.5
    val: float = 0.1
    test: float = 0.15
    reserve: int = 0
    split_by: str = "auto"
    block: float = 30.0
    guard: float = 10.0
    near: int = NEAR_DUPLICATE

    def __post_init__(self) -> None:
        if self.count is not None and self.count < 1:
            raise ValueError(f"{self.count} pairs were asked for; expected 1 or more")
        if not (0 <= self.val < 1 and 0 <= self.test < 1 and self.val + self.test < 1):
            raise ValueError(f"shares of {self.val} (val) and {self.test} (test) were given; expected 0 or more, "
                             "below 1 in all")  # fmt: skip
        if self.reserve < 0 or (self.count is not None and self.reserve > self.count):
            raise ValueError(f"{self.reserve} pairs to reserve were asked for, of {self.count}")
        if self.split_by not in WAYS:
            raise ValueError(f"a split by {self.split_by!r} is unknown; expected one of {', '.join(WAYS)}")


@dataclass(frozen=True, eq=False)
class Selection:
    """What was chosen, as rows of the candidates.

    rows: (N,), in the candidates' order. split, stratum: of each. gap: bits to the nearest chosen before it in its
    split, inf for the first. reserved: (N,) test pairs set aside for labels. split_by: "drive" or "block".
    nearest_across: bits between the nearest two images of different splits. rejected: reason and detail by row.
    """

    rows: Indices
    split: list[str]
    stratum: list[str]
    gap: Array
    reserved: Mask
    split_by: str
    nearest_across: float
    rejected: dict[int, tuple[str, str]]


def choose(candidates: Sequence[Candidate], measures: Sequence[Measures], settings: Settings) -> Selection:
    """The data set. candidates and measures: of all pairs, drives one after another, each in order of time.

    NotEnoughError where the number cannot be reached. The same pairs, settings and seed give the same selection.
    """
    if len(candidates) != len(measures):
        raise ValueError(f"{len(candidates)} pairs and measures of {len(measures)} were given; expected as many")
    rejected = _rejected(candidates, measures, settings)
    rows = [i for i in range(len(candidates)) if i not in rejected]
    pool = _Pool.of(candidates, measures, rows)
    if not rows or (settings.count is not None and len(rows) < settings.count):
        raise _short(len(rows), settings.count, len(candidates), rejected)
    ways = [settings.split_by] if settings.split_by != "auto" else (["drive"] if len(set(pool.drives)) >= 3 else [])
    ways += ["block"] if settings.split_by == "auto" else []
    best = 0
    for way in ways:
        wanted = {"val": settings.val * len(rows), "test": max(settings.test * len(rows), 1.2 * settings.reserve)}
        if settings.count is not None:
            quota = _quota(settings.count, settings)
            wanted = {split: max(wanted[split], 1.2 * quota[split]) for split in wanted}
        for attempt in range(TRIES):
            found, short = _attempt(pool, settings, way, wanted, attempt)
            if found is not None:
                return _finished(found, pool, rejected, settings, way)
            best = max(best, sum(short.values()))
            for split in ("val", "test"):
                wanted[split] *= MORE if short.get(split, math.inf) < _least(settings, split) else 1.0
    raise _short(best, settings.count, len(candidates), rejected, usable=len(rows), units=settings.split_by)


# -- what cannot be used -----------------------------------------------------------------------------------------------


def _rejected(
    candidates: Sequence[Candidate], measures: Sequence[Measures], settings: Settings
) -> dict[int, tuple[str, str]]:
    rejected = {}
    for i, (pair, found, twice) in enumerate(zip(candidates, measures, duplicated(candidates), strict=True)):
        why = refused(pair, found, settings.limits)
        if twice and (why is None or why[0] != "incomplete"):
            why = "duplicate", f"timestamp {pair.timestamp_us}"
        if why is not None:
            rejected[i] = why
    for drive in dict.fromkeys(each.drive for each in candidates):
        mine = [i for i, each in enumerate(candidates) if each.drive == drive and i not in rejected]
        moved = _since(mine, [each.moved for each in measures])
        frames = keyframes(moved, settings.step, settings.still)
        for i, key, still in zip(mine, frames.key, frames.still, strict=True):
            if not key:
                rejected[i] = ("still" if still else "between", f"moved {measures[i].moved:.2%} of the width")
    return rejected


def _since(rows: list[int], moved: list[float]) -> Array:
    """Movement since the usable pair before: that of rejected pairs in between is added."""
    found, at = np.full(len(rows), np.nan), 0
    for k, row in enumerate(rows):
        steps = np.array(moved[at : row + 1], dtype=np.float64)
        found[k] = np.nansum(steps) if k and np.isfinite(steps).any() else np.nan
        at = row + 1
    return found


def _short(
    found: int, count: int | None, total: int, rejected: dict[int, tuple[str, str]], usable: int = 0, units: str = ""
) -> NotEnoughError:
    counts = Counter(reason for reason, _ in rejected.values())
    lines = [f"  {counts[reason]:7d} {reason}: {words}" for reason, words in REASONS.items() if counts[reason]]
    asked = f"{count} pairs were asked for" if count is not None else "pairs of every split were asked for"
    more = ""
    if usable:
        more = (
            f" {usable} are usable, but splitting by {units} with guard gaps leaves no way to fill training, "
            "validation and test: record more drives, ask for fewer, or lower --val, --test, --reserve, --block-s "
            "or --guard-s."
        )
    words = f"{asked} and {found} of {total} can be had.{more} Rejected:\n" + ("\n".join(lines) or "  nothing")
    return NotEnoughError(words, rejected)


# -- splits ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Pool:
    """Usable key frames: row in the candidates, drive, seconds, hash and stratum of each."""

    rows: Indices
    drives: list[str]
    times: Array
    hashes: Hashes
    strata: list[str]

    @classmethod
    def of(cls, candidates: Sequence[Candidate], measures: Sequence[Measures], rows: list[int]) -> _Pool:
        hashes = [from_text(measures[i].hash) for i in rows]
        return cls(
            np.array(rows, dtype=np.intp),
            [candidates[i].drive for i in rows],
            np.array([candidates[i].time for i in rows], dtype=np.float64),
            np.array(hashes, dtype=np.uint8).reshape(len(rows), -1),
            [_stratum(candidates[i], measures[i]) for i in rows],
        )


@dataclass(frozen=True, eq=False)
class _Parts:
    """Chosen members of the pool by split with their gaps; the guards, and the leaks with what they look like."""

    chosen: dict[str, tuple[Indices, Array]]
    guards: Indices
    leaks: dict[int, str]


def _stratum(pair: Candidate, found: Measures) -> str:
    cover = strata.bin_of(found.cover, strata.COVERS)
    bright = strata.bin_of(found.brightness, strata.BRIGHTNESSES)
    return f"{pair.drive} / {pair.regime or '?'} / cover {cover} / brightness {bright}"


def _quota(count: int, settings: Settings) -> dict[str, int]:
    test = min(max(round(settings.test * count), settings.reserve), count)
    val = min(round(settings.val * count), count - test)
    return {"test": test, "val": val, "train": count - test - val}


def _least(settings: Settings, split: str) -> int:
    """How many a split must have."""
    if settings.count is not None:
        return _quota(settings.count, settings)[split]
    return max(settings.reserve, int(settings.test > 0)) if split == "test" else int(settings.val > 0)


def _attempt(
    pool: _Pool, settings: Settings, way: str, wanted: dict[str, float], attempt: int
) -> tuple[_Parts | None, dict[str, int]]:
    """A selection, or None and how many each split could have had."""
    units: Units = units_of(pool.drives, pool.times, math.inf if way == "drive" else settings.block)
    sizes = np.bincount(units.unit, minlength=len(units.drive)).tolist()
    splits = np.asarray(assigned(sizes, wanted, np.random.default_rng([settings.seed, 1, attempt])), dtype=object)
    guards = guarded(units, list(splits), pool.times, settings.guard)
    whose = np.where(guards, "", splits[units.unit])
    chosen: dict[str, tuple[Indices, Array]] = {}
    leaks: dict[int, str] = {}
    taken: Indices = np.zeros(0, np.intp)
    have: dict[str, int] = {}
    for split in SPLITS:
        mine = np.flatnonzero(whose == split)
        which, bits = nearest(pool.hashes[mine], pool.hashes[taken])
        near = bits <= settings.near
        leaks |= {int(i): f"{int(b)} bits from {int(taken[w])}" for i, w, b in
                  zip(mine[near], which[near], bits[near], strict=True)}  # fmt: skip
        mine = mine[~near]
        have[split] = len(mine)
        count = len(mine) if settings.count is None else _quota(settings.count, settings)[split]
        if len(mine) < max(count, _least(settings, split) if split != "train" else 1 if settings.count is None else 0):
            whole = whose == split
            have |= {later: int((whose == later).sum()) for later in SPLITS if later not in have}
            have[split] = min(have[split], int(whole.sum()))
            return None, have
        chosen[split] = _most_different(pool, mine, count, settings)
        taken = np.concatenate([taken, chosen[split][0]])
    return _Parts(chosen, np.flatnonzero(guards), leaks), have


def _most_different(pool: _Pool, members: Indices, count: int, settings: Settings) -> tuple[Indices, Array]:
    """`count` of the members: each stratum's share of it, and there the most different from all chosen so far."""
    sizes = Counter(pool.strata[i] for i in members)
    shares = strata.shared_out({name: sizes[name] for name in sorted(sizes)}, count, settings.balance)
    labels = np.array([pool.strata[i] for i in members], dtype=object)
    found: Indices = np.zeros(0, np.intp)
    gaps: Array = np.zeros(0)
    for k, (name, share) in enumerate(shares.items()):
        some = members[labels == name]
        rng = np.random.default_rng([settings.seed, 2, k])
        picks, bits = farthest_points(pool.hashes[some], share, rng, pool.hashes[found])
        found, gaps = np.concatenate([found, some[picks]]), np.concatenate([gaps, bits])
    return found, gaps


# -- the result --------------------------------------------------------------------------------------------------------


def _finished(
    parts: _Parts, pool: _Pool, rejected: dict[int, tuple[str, str]], settings: Settings, way: str
) -> Selection:
    members = np.concatenate([parts.chosen[split][0] for split in SPLITS])
    gaps = np.concatenate([parts.chosen[split][1] for split in SPLITS])
    names = np.repeat(np.array(SPLITS, dtype=object), [len(parts.chosen[split][0]) for split in SPLITS])
    reserved = np.zeros(len(members), np.bool_)
    reserved[: min(settings.reserve, int((names == "test").sum()))] = True
    order = np.argsort(members)
    across = [
        nearest(pool.hashes[parts.chosen[a][0]], pool.hashes[parts.chosen[b][0]])[1]
        for a, b in (("test", "val"), ("test", "train"), ("val", "train"))
    ]
    both = np.concatenate(across)
    rejected = dict(rejected)
    chosen = set(members.tolist())
    for i, row in enumerate(pool.rows.tolist()):
        if i in chosen:
            continue
        if i in parts.leaks:
            bits, _, other = parts.leaks[i].rpartition(" ")
            rejected[row] = ("leak", f"{bits} row {int(pool.rows[int(other)])}")
        else:
            rejected[row] = ("surplus", "")
    rejected |= {int(pool.rows[i]): ("guard", "") for i in parts.guards}
    return Selection(
        pool.rows[members[order]], [str(names[k]) for k in order], [pool.strata[i] for i in members[order]],
        gaps[order], reserved[order], way, float(both.min()) if len(both) else math.inf, rejected,
    )  # fmt: skip
