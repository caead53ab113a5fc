"""Images that gave no corners: which, why, and when too few are left."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

_NAMED = 12


@dataclass(frozen=True)
class Rejection:
    """An image file that gave no corners, the role it was meant for, and why."""

    name: str
    role: str
    reason: str


class NotEnoughData(ValueError):  # noqa: N818 - the name says what is wrong
    """Too few usable images to calibrate; the message names them one by one and the remedy."""

    def __init__(self, message: str, rejected: Sequence[Rejection] = ()) -> None:
        super().__init__(message)
        self.rejected = tuple(rejected)


def listing(rejected: Sequence[Rejection]) -> str:
    """A line for each rejection, the first dozen of them."""
    lines = [f"  {rejection.role} {rejection.name}: {rejection.reason}" for rejection in rejected[:_NAMED]]
    if len(rejected) > _NAMED:
        lines.append(f"  and {len(rejected) - _NAMED} more")
    return "\n".join(lines)
