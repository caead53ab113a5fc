"""Images that are wider than the frame, so that drops show what lies beside it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Surround:
    """A border of real content: images are given wider than the frame, by so many pixels on each side."""

    left: int = 0
    top: int = 0
    right: int = 0
    bottom: int = 0

    def __post_init__(self) -> None:
        for side in (self.left, self.top, self.right, self.bottom):
            if not (isinstance(side, int) and 0 <= side <= 32766):
                raise ValueError(f"a border of {side} pixels was given; expected a whole number, 0 or more")
