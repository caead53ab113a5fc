"""Raw frames from one program to another: in from stdin, restored, out to stdout."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from rainstereo.apps.derain_files import Note

if TYPE_CHECKING:
    from rainstereo.model.frame_sequence import FrameSequence


def restore_raw(
    shape: tuple[int, ...], source: BinaryIO, sink: BinaryIO, sequence: FrameSequence,
    told: Callable[[str, int, int], None],
) -> Note:  # fmt: skip
    """Frames of that shape, uint8, until the stream ends; a piece of a frame at its end is reported, not restored."""
    size = int(np.prod(shape))
    count, rest = 0, 0
    while True:
        data = _exactly(source, size)
        if len(data) < size:
            rest = len(data)
            break
        frame = np.frombuffer(data, np.uint8).reshape(shape)
        sink.write(np.ascontiguousarray(sequence(frame).image).data)
        sink.flush()
        count += 1
        told("stdin", 1, 0)
    note: Note = {"name": "stdin", "path": "-", "status": "ok", "files": [], "frames": count}
    if rest:
        note |= {"status": "incomplete", "reason": f"the stream ended {rest} bytes into a frame of {size}"}
    elif not count:
        note |= {"status": "failed", "reason": "the stream held no frame"}
    return note


def _exactly(source: BinaryIO, size: int) -> bytes:
    """As many bytes, or fewer where the stream ends; a pipe gives them in pieces."""
    parts, missing = [], size
    while missing and (part := source.read(missing)):
        parts.append(part)
        missing -= len(part)
    return b"".join(parts)
