"""Two GigE Vision cameras that exist only as software, over real UDP, showing what another process draws.

    python -m rainstereo.hardware.fake_cameras BOARD WIDTH HEIGHT RATE

Aravis's fake cameras on the two addresses of a network of one's own (`own_network`). Both wait for multiples of the
same period of the host's clock, so what they show is of one moment. Their fill callback runs on threads of Aravis's,
hence the process of its own. It prints `ready`, and ends when its standard input does.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import math
import sys
import time
from pathlib import Path
from typing import Any

from rainstereo.rig import ROLES, Role

from .aravis_camera import load_aravis
from .companion import READY, Companion
from .frame_board import FrameBoard
from .own_network import ADDRESSES

FILL = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32
)  # fmt: skip


def moment_at(host_s: float, rate_hz: float) -> int:
    """Number of the moment that began last at a time of the host's clock."""
    return math.floor(host_s * rate_hz)


def serve(board: FrameBoard, rate_hz: float) -> list[Any]:
    """Start both cameras; they run as long as what is returned is kept."""
    aravis = load_aravis()
    library = ctypes.CDLL(ctypes.util.find_library("aravis-0.8") or "libaravis-0.8.so.0")
    library.arv_buffer_get_data.restype = ctypes.c_void_p
    library.arv_buffer_get_data.argtypes = [ctypes.c_void_p, ctypes.POINTER(ctypes.c_size_t)]
    library.arv_gv_fake_camera_get_fake_camera.restype = ctypes.c_void_p
    library.arv_gv_fake_camera_get_fake_camera.argtypes = [ctypes.c_void_p]
    library.arv_fake_camera_set_fill_pattern.argtypes = [ctypes.c_void_p, FILL, ctypes.c_void_p]
    library.arv_fake_camera_get_payload.restype = ctypes.c_size_t
    library.arv_fake_camera_get_payload.argtypes = [ctypes.c_void_p]
    kept: list[Any] = []
    for role, address in zip(ROLES, ADDRESSES, strict=True):
        camera = aravis.GvFakeCamera.new(address, f"rainstereo-{role}")
        if not camera.is_running():
            raise RuntimeError(f"no fake camera can run at {address}; is another one there, or no own network set up?")
        pointer = library.arv_gv_fake_camera_get_fake_camera(hash(camera))
        fill = FILL(_fill(library, pointer, board, role, rate_hz))
        library.arv_fake_camera_set_fill_pattern(pointer, fill, None)
        kept += [camera, fill]
    return kept


def _fill(library: Any, camera: int, board: FrameBoard, role: Role, rate_hz: float) -> Any:
    frame_bytes = board.width * board.height

    def fill(buffer: int, *_: object) -> None:
        target = library.arv_buffer_get_data(buffer, None)
        moment = board.newest(moment_at(time.time(), rate_hz))
        if target and moment:  # the buffer has room for what the camera's registers ask for, whatever the board holds
            room = library.arv_fake_camera_get_payload(camera)
            ctypes.memmove(target, board.address(role, moment), min(room, frame_bytes))

    return fill


class FakeCameras(Companion):
    """The process, as a context. Open its cameras as aravis:127.0.0.1 (dry) and aravis:127.0.0.2 (wet)."""

    def __init__(self, board: FrameBoard, rate_hz: float) -> None:
        arguments = [str(board.path), str(board.width), str(board.height), repr(rate_hz)]
        super().__init__("the fake cameras", "rainstereo.hardware.fake_cameras", arguments)


def main() -> int:
    """Serve until standard input ends."""
    path, width, height, rate = sys.argv[1:]
    with FrameBoard(Path(path), int(width), int(height)) as board:
        kept = serve(board, float(rate))
        print(READY, flush=True)
        sys.stdin.read()
        del kept
    return 0


if __name__ == "__main__":
    sys.exit(main())
