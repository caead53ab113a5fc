"""Pairs of a recording of ours: the segment log that `rainstereo record` writes."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from .pair_source import RECORDING, BadPairError, Moment, stamp_of
from .types import Image


class RecordingPairs:
    """A recording as pairs; regime, time and synchronisation come with each. It is opened where it is first read."""

    def __init__(self, path: str, *, drive: str = "") -> None:
        self.path, self.drive = path, drive
        self._recording: Any = None
        recording = self._opened()
        self._count = len(recording)
        self.leftovers = tuple(
            (f"{path}, segment {d.segment}", f"{d.what}: bytes {d.offset} to {d.end} cannot be read")
            for d in recording.damage
        )

    def __len__(self) -> int:
        return self._count

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_recording": None}

    def name(self, index: int) -> str:
        """The pair's number in the recording."""
        return f"{index:06d}"

    def moment(self, index: int) -> Moment:
        """As `read` without the images; the recording keeps both together, so it costs as much."""
        return self.read(index)[0]

    def read(self, index: int) -> tuple[Moment, Image, Image]:
        """Pair `index`."""
        where = f"{self.path}#{index}"
        try:
            frame = self._opened().read(index)
        except (ValueError, EOFError) as error:
            raise BadPairError(where, str(error)) from error
        time = frame.device_ts_ns if frame.device_ts_ns is not None else frame.host_ts_ns
        when = None if time is None else int(time) // 1000
        sync = float(frame.sync_us) if frame.sync_us is not None else math.nan
        moment = Moment(self.name(index), where, where, when, self.drive, str(frame.regime or ""), sync)
        return moment, frame.dry, frame.wet

    def stamp(self, index: int) -> str:
        """That of the recording's description: what it holds is only ever appended to."""
        return f"{stamp_of(Path(self.path) / RECORDING)} {index}"

    def _opened(self) -> Any:
        if self._recording is None:
            from .hardware.recording import open_recording

            self._recording = open_recording(self.path)
        return self._recording
