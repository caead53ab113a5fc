"""A pair of cameras that take the same moments.

    with CameraPair.open("aravis:192.168.1.11", "aravis:192.168.1.12") as cameras:
        cameras.start()
        pair = cameras.read()          # a PairFrame, or None if none came in time

Each camera is read by a thread of its own; frames are paired by `Pairer`. A camera that goes away is looked for until
it is back; then both are started anew, and numbers go on.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

from rainstereo.rig import ROLES, Role

from .camera_source import CameraGoneError, CameraSource, EndOfFramesError
from .clock_comparison import SyncSummary
from .pair_frame import CameraFrame, PairFrame
from .pairing import Pairer

KINDS = ("folder", "video", "aravis", "pylon")
QUEUE = 64
RETRY_S = (0.25, 4.0)
"""First and longest pause between two tries to find a camera that is gone."""


@dataclass(frozen=True)
class CameraHealth:
    """One camera's frames so far. received: whole frames. lost: numbers that never came, and damaged: that came with
    holes; both are the camera's or the network's. overrun: ours, no buffer was free. unpaired: whole, but without a
    partner. missed: triggers it did not count. restarts: how often both were started anew because of it."""

    received: int
    lost: int
    damaged: int
    overrun: int
    unpaired: int
    repeated: int
    missed: int
    restarts: int


@dataclass(frozen=True)
class CaptureHealth:
    """The pair's. waiting: frames between the cameras and `read`."""

    pairs: int
    dry: CameraHealth
    wet: CameraHealth
    sync: SyncSummary
    waiting: int


Item = tuple[Role, CameraFrame | Exception]


class CameraPair:
    """Two cameras; see the module. cameras: by role. period_s, grid_s: what `Pairer` is told about triggers. event: is
    told of restarts, by name and details."""

    def __init__(
        self,
        cameras: Mapping[Role, CameraSource],
        *,
        period_s: float | None = None,
        grid_s: float | None = None,
        event: Callable[..., None] = lambda *_, **__: None,
    ) -> None:
        self.cameras = dict(cameras)
        self.event = event
        shared = all(camera.shared_clock for camera in self.cameras.values())
        self._pairing: dict[str, Any] = {
            "shared_clock": shared,
            "period_ns": None if period_s is None else 1e9 * period_s,
            "grid_ns": None if grid_s is None else round(1e9 * grid_s),
        }
        self.pairer = Pairer(**self._pairing)
        self._queue: queue.Queue[Item] = queue.Queue(QUEUE)
        self._ready: list[PairFrame] = []
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []
        self._ended: set[Role] = set()
        self._open: set[Role] = set()
        self._restarts: dict[Role, int] = dict.fromkeys(ROLES, 0)
        self._retry_at, self._pause = 0.0, RETRY_S[0]
        self._running = False
        self._was_started = False

    @classmethod
    def open(cls, dry: str, wet: str, **options: Any) -> CameraPair:
        """Connect to two cameras: folder:PATH, video:FILE, aravis:ADDRESS or pylon:SERIAL.

        options: rate_hz, pixel_format, exposure_us, shared_clock, as the adapters have them. ValueError for another
        kind; CameraGoneError where a camera does not answer.
        """
        pair = cls(_sources(dry, wet, options), period_s=1 / options["rate_hz"] if options.get("rate_hz") else None)
        try:
            pair._connect()
        except BaseException:
            pair.close()
            raise
        return pair

    def _connect(self) -> None:
        for role in ROLES:
            if role not in self._open:
                self.cameras[role].open()
                self._open.add(role)

    def start(self) -> None:
        """Start both: first the wet camera, which waits for triggers, then the dry one, which may give them."""
        self._connect()
        self._was_started = True
        self.pairer.count_from({role: self.cameras[role].id_wrap for role in ROLES})
        self._stop = threading.Event()
        self._queue = queue.Queue(QUEUE)
        self._ended.clear()
        self.pairer.restart()
        for role in ROLES[::-1]:
            self.cameras[role].start()
        self._threads = [
            threading.Thread(
                target=_pump,
                args=(role, self.cameras[role], self._queue, self._stop),
                name=f"{role} camera",
                daemon=True,
            )
            for role in ROLES
        ]
        for thread in self._threads:
            thread.start()
        self._running = True

    def read(self, timeout_s: float = 1.0) -> PairFrame | None:
        """The next pair; None: none came in time. EndOfFramesError when files have no more."""
        until = time.monotonic() + timeout_s
        while True:
            if self._ready:
                return self._ready.pop(0)
            left = until - time.monotonic()
            if not self._running:
                if not self._was_started:
                    raise RuntimeError("the cameras were not started; call start() first")
                if self._ended:
                    raise EndOfFramesError("there are no more frames")
                self._try_again(left)
                if not self._running and left <= 0:
                    return None
                continue
            try:
                role, item = self._queue.get(timeout=max(0.0, left))
            except queue.Empty:
                return None
            self._take(role, item)

    def _take(self, role: Role, item: CameraFrame | Exception) -> None:
        if isinstance(item, CameraFrame):
            self._ready += self.pairer.offer(role, item)
            if self.pairer.broken:
                self._suspend(role, self.pairer.broken, gone=False)
        elif isinstance(item, EndOfFramesError):
            self._ended.add(role)
            if len(self._ended) == len(ROLES):
                self._halt()
        elif isinstance(item, CameraGoneError):
            self._suspend(role, str(item), gone=True)
        else:
            self._halt()
            raise item

    def _suspend(self, role: Role, why: str, gone: bool) -> None:
        self._halt()
        self._restarts[role] += 1
        if gone:
            self.cameras[role].close()
            self._open.discard(role)
        self._pause = RETRY_S[0]
        self._retry_at = time.monotonic() + (self._pause if gone else 0.0)
        self.event("camera gone" if gone else "out of step", camera=role, why=why)

    def _try_again(self, left: float) -> None:
        """Wait, at most `left` seconds, for the next try; start both anew if it is time and all answer."""
        pause = self._retry_at - time.monotonic()
        if pause > 0:
            time.sleep(max(0.0, min(pause, left)))
            return
        try:
            self.start()
        except CameraGoneError:
            self._halt()
            for role in ROLES:  # whatever state it is in, the next try begins from nothing
                self.cameras[role].close()
            self._open.clear()
            self._pause = min(2 * self._pause, RETRY_S[1])
            self._retry_at = time.monotonic() + self._pause
        else:
            self.event("started anew", next_id=self.pairer.next_id)

    def _halt(self) -> None:
        self._stop.set()
        for thread in self._threads:
            while thread.is_alive():
                try:
                    self._queue.get(timeout=0.02)  # it may wait for room
                except queue.Empty:
                    thread.join(0.02)
        self._threads = []
        for camera in self.cameras.values():
            camera.stop()
        self._running = False

    def __iter__(self) -> Iterator[PairFrame]:
        """Pairs until files end; of real cameras, for ever."""
        while True:
            try:
                pair = self.read()
            except EndOfFramesError:
                return
            if pair is not None:
                yield pair

    @property
    def health(self) -> CaptureHealth:
        """How it goes."""
        each = {}
        for role in ROLES:
            counted, trouble = self.pairer.counters[role], self.cameras[role].trouble
            lost = max(0, counted.lost - trouble.damaged - trouble.overrun)  # those left gaps in the numbers too
            each[role] = CameraHealth(
                counted.received, lost, trouble.damaged, trouble.overrun, counted.unpaired, counted.repeated,
                counted.missed, self._restarts[role],
            )  # fmt: skip
        waiting = self._queue.qsize() + len(self._ready)
        return CaptureHealth(self.pairer.pairs, each["dry"], each["wet"], self.pairer.sync.summary(), waiting)

    def stop(self) -> None:
        """End acquiring; `start` begins anew."""
        self._halt()
        self._was_started = False

    def begin_anew(self) -> None:
        """Stop, forget everything that was counted, and start."""
        self.stop()
        self.pairer = Pairer(**self._pairing)
        for camera in self.cameras.values():
            camera.trouble.damaged = camera.trouble.overrun = 0
        self._ready.clear()
        self._restarts = dict.fromkeys(ROLES, 0)
        self.start()

    def close(self) -> None:
        """Stop and let go of both cameras."""
        self.stop()
        for camera in self.cameras.values():
            camera.close()
        self._open.clear()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _pump(role: Role, camera: CameraSource, frames: queue.Queue[Item], stop: threading.Event) -> None:
    """A camera's thread: its frames into the queue, until told to stop or until it is gone."""
    item: CameraFrame | Exception | None
    while not stop.is_set():
        try:
            item = camera.read(0.1)
        except Exception as error:  # for the thread that reads pairs
            item = error
        while item is not None and not stop.is_set():
            try:
                frames.put((role, item), timeout=0.1)
            except queue.Full:
                continue
            break
        if isinstance(item, Exception):
            return


def _sources(dry: str, wet: str, options: Mapping[str, Any]) -> dict[Role, CameraSource]:
    kinds = [_kind(text) for text in (dry, wet)]
    if kinds[0][0] != kinds[1][0]:
        raise ValueError(f"the cameras are {dry} and {wet}; expected two of one kind ({', '.join(KINDS)})")
    kind, places = kinds[0][0], (kinds[0][1], kinds[1][1])
    if kind == "folder":
        from .file_cameras import folder_pair

        return dict(folder_pair(*places, options.get("pixel_format")))
    if kind == "video":
        from .file_cameras import VideoCamera

        return {role: VideoCamera(place) for role, place in zip(ROLES, places, strict=True)}
    known = ("rate_hz", "pixel_format", "shared_clock", *(("exposure_us",) if kind == "aravis" else ()))
    wanted = {key: value for key, value in options.items() if key in known and value is not None}
    if kind == "aravis":
        from .aravis_camera import AravisCamera

        return {role: AravisCamera(place, **wanted) for role, place in zip(ROLES, places, strict=True)}
    from .pylon_camera import PylonCamera

    return {role: PylonCamera(place, **wanted) for role, place in zip(ROLES, places, strict=True)}


def _kind(text: str) -> tuple[str, str]:
    kind, colon, place = text.partition(":")
    if not colon or kind not in KINDS:
        raise ValueError(
            f"the camera {text!r} was given; expected folder:PATH, video:FILE, aravis:ADDRESS or pylon:SERIAL"
        )
    return kind, place


__all__ = ["CameraHealth", "CameraPair", "CaptureHealth"]
