"""Frames of a stream through a network, whole and in batches; a CUDA device is kept busy while frames come and go.

    for clear in WholeFrames(network, batch=4)(frames): ...

On a CUDA device a batch is copied into page-locked memory, converted there and back on the device, and not waited for
until the next one is on its way: copies, conversions and the launching of kernels cost no time of their own.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from rainstereo.model.networks import Network
from rainstereo.model.pixels import RAW, check, from_batch, packed, to_batch, turned, unpacked
from rainstereo.types import Image

AHEAD = 2
"""Batches that are on their way at once on a CUDA device."""


class WholeFrames:
    """Restores frames, uint8 or uint16, gray or BGR, to the same type and shape, in order; nothing is skipped.

    batch: frames of one size that are computed together; where the size changes, a smaller batch is. ValueError for
    less than 1, and for what is no frame.
    """

    def __init__(self, network: Network, batch: int = 1) -> None:
        if batch < 1:
            raise ValueError(f"a batch of {batch} frames was given; expected 1 or more")
        self.network, self.batch = network, batch
        self._lanes: deque[_Lane] = deque()

    def __call__(self, frames: Iterable[Image]) -> Iterator[Image]:
        """The frames, restored."""
        if self.network.device.type != "cuda":
            for alike in self._batches(frames):
                given = np.stack(alike)
                yield from from_batch(self.network(to_batch(given, self.network.device)), given)
            return
        sent: deque[_Lane] = deque()
        for alike in self._batches(frames):
            if len(sent) == AHEAD:
                yield from self._back(sent)
            sent.append(self._sent(alike))
        while sent:
            yield from self._back(sent)

    def _batches(self, frames: Iterable[Image]) -> Iterator[list[Image]]:
        alike: list[Image] = []
        for frame in frames:
            check(frame)
            if alike and (len(alike) == self.batch or _kind(alike[0]) != _kind(frame)):
                yield alike
                alike = []
            alike.append(frame)
        if alike:
            yield alike

    def _sent(self, alike: Sequence[Image]) -> _Lane:
        lane = self._lanes.popleft() if self._lanes else None
        if lane is None or not lane.fits(alike):
            lane = _Lane(len(alike), alike[0], self.network.device)
        lane.send(alike, self.network)
        return lane

    def _back(self, sent: deque[_Lane]) -> list[Image]:
        lane = sent.popleft()
        found = lane.receive()
        self._lanes.append(lane)
        return found


class _Lane:
    """Page-locked memory for a batch of frames on its way to a CUDA device and back."""

    def __init__(self, count: int, like: Image, device: torch.device) -> None:
        raw = RAW[like.dtype.name]
        self.up = torch.empty((count, *like.shape), dtype=raw, pin_memory=True)
        self.down = torch.empty((count, *like.shape), dtype=raw, pin_memory=True)
        self.device, self.kind = device, _kind(like)
        self.done: Any = None

    def fits(self, frames: Sequence[Image]) -> bool:
        return len(frames) == len(self.up) and _kind(frames[0]) == self.kind

    def send(self, frames: Sequence[Image], network: Network) -> None:
        """Queue everything on the device's stream; nothing is waited for."""
        most = int(np.iinfo(frames[0].dtype).max)
        staged = self.up.numpy()
        for place, frame in zip(staged, frames, strict=True):
            np.copyto(place, turned(frame) if frame.ndim == 3 else frame)
        with torch.cuda.device(self.device), torch.inference_mode():
            restored: Tensor = network(unpacked(self.up.to(self.device, non_blocking=True), most))
            self.down.copy_(packed(restored, most, frames[0].ndim == 2, self.down.dtype), non_blocking=True)
            self.done = cast(Any, torch.cuda).Event()  # which has no types
            self.done.record()

    def receive(self) -> list[Image]:
        """Wait for the batch; frames of their own memory."""
        self.done.synchronize()
        found = self.down.numpy().astype(self.kind[1], copy=False)
        return [turned(frame) if frame.ndim == 3 else frame.copy() for frame in found]


def _kind(frame: Image) -> tuple[tuple[int, ...], str]:
    return frame.shape, frame.dtype.name
