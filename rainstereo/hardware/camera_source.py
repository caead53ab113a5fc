"""What every camera, real or made of files, must do for a pair of them to be captured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from .pair_frame import CameraFrame


class CameraGoneError(OSError):
    """The camera does not answer any more: unplugged, powered off, or taken by another program."""


class EndOfFramesError(EOFError):
    """There are no more frames; only files end."""


@dataclass
class Trouble:
    """Frames that a camera's adapter had to give up. damaged: arrived incomplete, a loss on the camera's side or in
    the network. overrun: no buffer was free, our own fault."""

    damaged: int = 0
    overrun: int = 0


class CameraSource(Protocol):
    """One camera. All of it is called from one thread at a time.

    id_wrap: number after which its counter goes on with 1; None: it does not. shared_clock: its timestamps count the
    same time as the other camera's. free_running: it sends frames as time passes, whether or not they are fetched.
    """

    name: str
    id_wrap: int | None
    shared_clock: bool
    free_running: bool
    trouble: Trouble

    def open(self) -> None:
        """Connect. CameraGoneError if it is not there."""

    def start(self) -> None:
        """Begin to acquire; counting begins anew."""

    def read(self, timeout_s: float) -> CameraFrame | None:
        """The next frame; None: none came in time. CameraGoneError, EndOfFramesError."""

    def stop(self) -> None:
        """End acquiring. Never raises, whatever became of the camera."""

    def close(self) -> None:
        """Let go of it. Never raises."""


__all__ = ["CameraGoneError", "CameraSource", "EndOfFramesError", "Trouble"]
