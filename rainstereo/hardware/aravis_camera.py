"""GigE Vision and USB3 Vision cameras by Aravis (Debian: gir1.2-aravis-0.8, python3-gi)."""

from __future__ import annotations

import contextlib
import time
import warnings
from typing import Any

import numpy as np

from .camera_source import CameraGoneError, Trouble
from .pair_frame import CameraFrame

PFNC = {
    0x01080001: ("Mono8", np.uint8), 0x01100003: ("Mono10", np.uint16), 0x01100005: ("Mono12", np.uint16),
    0x01100007: ("Mono16", np.uint16), 0x01080008: ("BayerGR8", np.uint8), 0x01080009: ("BayerRG8", np.uint8),
    0x0108000A: ("BayerGB8", np.uint8), 0x0108000B: ("BayerBG8", np.uint8), 0x0110000C: ("BayerGR10", np.uint16),
    0x0110000D: ("BayerRG10", np.uint16), 0x0110000E: ("BayerGB10", np.uint16), 0x0110000F: ("BayerBG10", np.uint16),
    0x01100010: ("BayerGR12", np.uint16), 0x01100011: ("BayerRG12", np.uint16), 0x01100012: ("BayerGB12", np.uint16),
    0x01100013: ("BayerBG12", np.uint16), 0x0110002E: ("BayerGR16", np.uint16), 0x0110002F: ("BayerRG16", np.uint16),
    0x01100030: ("BayerGB16", np.uint16), 0x01100031: ("BayerBG16", np.uint16), 0x02180015: ("BGR8", np.uint8),
}  # fmt: skip
"""GenICam's numbers of pixel formats that are taken, unpacked ones."""
GVSP_WRAP = 65535
BUFFERS = 32


def load_aravis() -> Any:
    """Aravis by GObject introspection. RuntimeError, with the remedy, where it is not installed."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ImportWarning)  # about how gi loads, on newer Pythons
            import gi

            gi.require_version("Aravis", "0.8")
            from gi.repository import Aravis
    except (ImportError, ValueError) as error:
        raise RuntimeError(
            "Aravis is not installed. Get it: sudo apt-get install gir1.2-aravis-0.8 python3-gi aravis-tools, then run "
            "make again"
        ) from error
    return Aravis


class AravisCamera:
    """One camera, by its device id, serial number or address; "" takes the first that answers.

    rate_hz: frames a second if the camera times itself; None leaves that as the camera is set (a trigger line, say).
    pixel_format, size (width, height): to ask for; None leaves them. shared_clock: the camera's
    timestamps are PTP's, or those of fakes.
    """

    free_running = True

    def __init__(
        self,
        address: str = "",
        *,
        rate_hz: float | None = None,
        pixel_format: str | None = None,
        size: tuple[int, int] | None = None,
        exposure_us: float | None = None,
        shared_clock: bool = False,
        buffers: int = BUFFERS,
    ) -> None:
        self.name = f"aravis:{address}"
        self.id_wrap: int | None = GVSP_WRAP
        self.shared_clock = shared_clock
        self.trouble = Trouble()
        self._address, self._rate, self._format, self._exposure = address, rate_hz, pixel_format, exposure_us
        self._buffers, self._size = buffers, size
        self._camera: Any = None
        self._stream: Any = None
        self._lost = False
        self._silent_since: float | None = None
        self._overruns = 0

    def open(self) -> None:
        """Connect, and set what was asked for."""
        aravis = load_aravis()
        try:
            self._camera = aravis.Camera.new(self._address or None)
            if self._camera is None:
                raise CameraGoneError(f"no camera answers at {self._address or 'any address'}")
            self._lost = False
            if self._format is not None:
                self._camera.set_pixel_format_from_string(self._format)
            if self._size is not None:
                self._camera.set_region(0, 0, *self._size)
            if self._exposure is not None:
                self._camera.set_exposure_time(self._exposure)
            if self._rate is not None:
                self._camera.set_frame_rate(self._rate)
            self.id_wrap = GVSP_WRAP if self._camera.is_gv_device() else None
            self._camera.get_device().connect("control-lost", self._on_lost)
        except aravis_error() as error:
            self._camera = None
            raise CameraGoneError(f"{self.name}: {error.message}") from error

    def _on_lost(self, *_: object) -> None:
        self._lost = True

    def start(self) -> None:
        """Make buffers and begin."""
        if self._camera is None:
            raise CameraGoneError(f"{self.name} is not open")
        aravis = load_aravis()
        try:
            payload = self._camera.get_payload()
            if not 0 < payload <= 1 << 29:
                raise ValueError(f"{self.name} wants frames of {payload} bytes; expected at most {1 << 29}")
            self._stream = self._camera.create_stream(None, None)
            for _ in range(self._buffers):
                self._stream.push_buffer(aravis.Buffer.new_allocate(payload))
            self._camera.set_acquisition_mode(aravis.AcquisitionMode.CONTINUOUS)
            self._camera.start_acquisition()
            self._overruns = 0
            self._silent_since = None
        except aravis_error() as error:
            raise CameraGoneError(f"{self.name}: {error.message}") from error

    def read(self, timeout_s: float) -> CameraFrame | None:
        """The next whole frame."""
        if self._stream is None:
            raise CameraGoneError(f"{self.name} does not acquire")
        aravis = load_aravis()
        until = time.monotonic() + timeout_s
        while True:
            if self._lost:
                raise CameraGoneError(f"{self.name}: the camera no longer answers")
            left = until - time.monotonic()
            buffer = self._stream.timeout_pop_buffer(round(1e6 * min(max(left, 0), 0.1)))
            if buffer is not None:
                break
            if left <= 0:
                return None
        host_ns = time.time_ns()
        try:
            overruns = int(self._stream.get_info_uint64_by_name("n_underruns"))
            self.trouble.overrun += max(0, overruns - self._overruns)
            self._overruns = overruns
            if buffer.get_status() != aravis.BufferStatus.SUCCESS:
                self.trouble.damaged += 1
                return None
            return self._frame(buffer, host_ns)
        finally:
            self._stream.push_buffer(buffer)

    def _frame(self, buffer: Any, host_ns: int) -> CameraFrame:
        number = buffer.get_image_pixel_format()
        if number not in PFNC:
            taken = ", ".join(name for name, _ in PFNC.values())
            raise ValueError(f"{self.name} sends the pixel format {number:#010x}; set one of {taken}")
        name, dtype = PFNC[number]
        height, width = buffer.get_image_height(), buffer.get_image_width()
        shape = (height, width, 3) if name == "BGR8" else (height, width)
        data = np.frombuffer(buffer.get_data(), dtype)[: int(np.prod(shape))]  # get_data copies
        image = data.reshape(shape)
        return CameraFrame(image, int(buffer.get_frame_id()), int(buffer.get_timestamp()), host_ns, name)

    def stop(self) -> None:
        """End acquiring; a camera that is gone is left alone."""
        if self._camera is not None and not self._lost:
            with contextlib.suppress(aravis_error()):
                self._camera.stop_acquisition()
        self._stream = None

    def close(self) -> None:
        """Let go of the camera."""
        self._stream = None
        self._camera = None


def aravis_error() -> type[Exception]:
    """GLib's error, which Aravis raises."""
    from gi.repository import GLib

    error: type[Exception] = GLib.Error
    return error
