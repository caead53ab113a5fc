"""The firmware's core in this process, on a clock of its own: ten thousand commands take seconds."""

import ctypes
import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from rainstereo.hardware import firmware
from rainstereo.hardware.pump import Pump


@functools.cache
def library() -> Any:
    loaded = ctypes.CDLL(str(firmware.build_library()))
    loaded.rsp_new.restype = ctypes.c_void_p
    for name in ("rsp_duty", "rsp_state", "rsp_fault", "rsp_bad_frames", "rsp_executed", "rsp_take", "rsp_applied"):
        getattr(loaded, name).restype = ctypes.c_uint32
    return loaded


class Noise:
    """Changes, drops and inserts bytes, each with its probability."""

    def __init__(self, seed: int, corrupt: float, drop: float, insert: float) -> None:
        self.rng = np.random.default_rng(seed)
        self.corrupt, self.drop, self.insert = corrupt, drop, insert

    def __call__(self, data: bytes) -> bytes:
        draws = self.rng.random((len(data), 3))
        if draws.min(initial=1.0) > max(self.corrupt, self.drop, self.insert):
            return data
        out = bytearray()
        for byte, (corrupt, drop, insert) in zip(data, draws, strict=True):
            if insert < self.insert:
                out.append(int(self.rng.integers(256)))
            if drop >= self.drop:
                out.append(byte ^ int(self.rng.integers(1, 256)) if corrupt < self.corrupt else byte)
        return bytes(out)


class VirtualPump:
    """A `Line` with the core behind it. Time goes on only while somebody waits."""

    def __init__(self, noise: Callable[[bytes], bytes] = bytes, max_duty: int = 1000) -> None:
        self.library, self.noise, self.now, self.level_low = library(), noise, 0.0, False
        self.core = ctypes.c_void_p(self.library.rsp_new(ctypes.c_uint16(max_duty), 0, 0))
        self.on_write: Callable[[bytes], bytes] = bytes
        self._waiting = b""

    def pump(self, **options: Any) -> Pump:
        options = {"reply_s": 0.02, "patience_s": 20.0, "lease_s": 1e9, **options}
        return Pump(self, heartbeat=False, clock=lambda: self.now, **options)

    @property
    def duty(self) -> int:
        return int(self.library.rsp_duty(self.core))

    @property
    def state(self) -> int:
        return int(self.library.rsp_state(self.core))

    @property
    def fault(self) -> int:
        return int(self.library.rsp_fault(self.core))

    @property
    def executed(self) -> int:
        return int(self.library.rsp_executed(self.core))

    @property
    def bad_frames(self) -> int:
        return int(self.library.rsp_bad_frames(self.core))

    def receive(self, data: bytes) -> None:
        """Bytes that reach the device as they are."""
        self.library.rsp_receive(self.core, data, len(data), self._ms())

    def applied(self) -> list[int]:
        """Every duty, byte by byte, since the last call."""
        duties = (ctypes.c_uint16 * 100_000)()
        return list(duties[: self.library.rsp_applied(self.core, duties, len(duties))])

    def sent(self) -> bytes:
        """What the device sent and nobody read."""
        room = ctypes.create_string_buffer(1 << 16)
        count = self.library.rsp_take(self.core, room, len(room))
        return room.raw[:count]

    def wait(self, seconds: float) -> None:
        self.now += seconds
        self.library.rsp_poll(self.core, self._ms(), int(self.level_low))

    def write(self, data: bytes) -> None:
        self.receive(self.noise(self.on_write(data)))

    def read(self, timeout: float) -> bytes:
        self._waiting += self.noise(self.sent())
        if not self._waiting:
            self.wait(timeout)
            self._waiting = self.noise(self.sent())
        data, self._waiting = self._waiting, b""
        return data

    def clear(self) -> None:
        self.sent()

    def close(self) -> None:
        pass

    def _ms(self) -> ctypes.c_uint32:
        return ctypes.c_uint32(int(self.now * 1000))
