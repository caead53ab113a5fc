"""A process of ours that serves another one for as long as that lives."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from types import TracebackType
from typing import Self

READY = "ready"
"""What the process prints when it serves; it ends when its standard input does."""


class Companion:
    """A module of this package run by an interpreter of its own, as a context; it serves when this is made.

    what: its name in messages. RuntimeError where it ends, or says anything else, before it is ready.
    """

    def __init__(self, what: str, module: str, arguments: Sequence[str]) -> None:
        words = [sys.executable, "-m", module, *arguments]
        self.process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        answer = self.process.stdout.readline().strip() if self.process.stdout else ""
        if answer != READY:
            self.close()
            raise RuntimeError(f"{what} did not start: {' '.join(words)}")

    def close(self) -> None:
        """End it."""
        self.process.kill()
        self.process.wait()
        for stream in (self.process.stdin, self.process.stdout):
            if stream is not None:
                stream.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
