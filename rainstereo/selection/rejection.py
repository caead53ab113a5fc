"""Why a pair cannot be used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from .candidate import Candidate, Measures

REASONS = {
    "incomplete": "a file is missing, unreadable or of another size than its partner",
    "duplicate": "another pair of the drive has the same timestamp",
    "out of sync": "the two exposures are too far apart",
    "dark": "the dry image is too dark",
    "clipped": "too much of the dry image is white",
    "blurred": "the dry image's edges are too wide",
    "dirty": "something on the dry side stays in place while the scene moves",
    "still": "the scene did not move",
    "between": "the scene moved too little since the last key frame",
    "guard": "too near in time to a pair of another split",
    "leak": "looks like a pair of another split",
    "surplus": "usable, and not needed: others differ more",
}
"""Why a pair is not in the data set, in the order in which it is asked."""


@dataclass(frozen=True)
class Limits:
    """What is still usable. Values that are not known (NaN) reject nothing.

    sync_us: microseconds. brightness: gray levels. dark, clipped, dirt: shares of the dry image. blur_px: pixels.
    """

    sync_us: float = 1000.0
    brightness: float = 20.0
    dark: float = 0.6
    clipped: float = 0.35
    blur_px: float = 2.5
    dirt: float = 0.003

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value >= 0:
                raise ValueError(f"a limit of {value} was given for {name}; expected a number, 0 or more")


def refused(candidate: Candidate, measures: Measures, limits: Limits) -> tuple[str, str] | None:
    """A reason of `REASONS` and the figure behind it, or None where the pair is usable by itself."""
    if measures.problem:
        return "incomplete", measures.problem
    if abs(candidate.sync_us) > limits.sync_us:
        return "out of sync", f"{candidate.sync_us:.0f} us"
    if measures.brightness < limits.brightness:
        return "dark", f"mean {measures.brightness:.0f}"
    if measures.dark > limits.dark:
        return "dark", f"{measures.dark:.0%} black"
    if measures.clipped > limits.clipped:
        return "clipped", f"{measures.clipped:.0%} white"
    if measures.blur_px > limits.blur_px:
        return "blurred", f"{measures.blur_px:.1f} px"
    if measures.dirt > limits.dirt:
        return "dirty", f"{measures.dirt:.1%} covered"
    return None


def duplicated(candidates: Sequence[Candidate]) -> list[bool]:
    """Of each whether an earlier one of its drive has the same timestamp."""
    seen: set[tuple[str, int]] = set()
    found = []
    for each in candidates:
        key = (each.drive, each.timestamp_us if each.timestamp_us is not None else -1)
        found.append(each.timestamp_us is not None and key in seen)
        seen.add(key)
    return found
