"""Basler cameras by pypylon (pip install 'rainstereo[pypylon]'). `PYLON_CAMEMU=2` makes two emulated ones."""

from __future__ import annotations

import contextlib
import time
from typing import Any

import numpy as np

from .camera_source import CameraGoneError, Trouble
from .pair_frame import CameraFrame
from .pixel_format import PIXEL_FORMATS


def load_pylon() -> Any:
    """pypylon. RuntimeError, with the remedy, where it is not installed."""
    try:
        from pypylon import pylon
    except ImportError as error:
        raise RuntimeError("pypylon is not installed. Get it: pip install 'rainstereo[pypylon]'") from error
    return pylon


class PylonCamera:
    """One camera by its serial number; "" takes the first.

    Emulated cameras tell no time: their frames have no device timestamps. shared_clock: PTP.
    """

    free_running = True

    def __init__(
        self,
        serial: str = "",
        *,
        rate_hz: float | None = None,
        pixel_format: str | None = None,
        shared_clock: bool = False,
    ) -> None:
        self.name = f"pylon:{serial}"
        self.id_wrap: int | None = None
        self.shared_clock = shared_clock
        self.trouble = Trouble()
        self._serial, self._rate, self._format = serial, rate_hz, pixel_format
        self._camera: Any = None
        self._emulated = False
        self._first = 0

    def open(self) -> None:
        """Connect, and set what was asked for."""
        pylon = load_pylon()
        factory = pylon.TlFactory.GetInstance()
        found = [info for info in factory.EnumerateDevices() if self._serial in ("", info.GetSerialNumber())]
        if not found:
            raise CameraGoneError(f"no Basler camera with the serial number {self._serial or '(any)'} answers")
        try:
            self._camera = pylon.InstantCamera(factory.CreateDevice(found[0]))
            self._emulated = found[0].GetDeviceClass() == "BaslerCamEmu"
            self._camera.Open()
            self.id_wrap = 65535 if found[0].GetDeviceClass() == "BaslerGigE" else None
            if self._format is not None:
                self._camera.PixelFormat.SetValue(self._format)
            if self._rate is not None:
                self._camera.AcquisitionFrameRateEnable.SetValue(True)
                rate = "AcquisitionFrameRateAbs" if self._emulated else "AcquisitionFrameRate"
                getattr(self._camera, rate).SetValue(self._rate)
        except pylon.GenericException as error:
            raise CameraGoneError(f"{self.name}: {error}") from error

    def start(self) -> None:
        """Begin, keeping every frame in order."""
        if self._camera is None:
            raise CameraGoneError(f"{self.name} is not open")
        pylon = load_pylon()
        try:
            self._camera.MaxNumBuffer.SetValue(32)
            self._camera.StartGrabbing(pylon.GrabStrategy_OneByOne)
        except pylon.GenericException as error:
            raise CameraGoneError(f"{self.name}: {error}") from error

    def read(self, timeout_s: float) -> CameraFrame | None:
        """The next whole frame."""
        pylon = load_pylon()
        if self._camera is None or not self._camera.IsGrabbing():
            raise CameraGoneError(f"{self.name} does not acquire")
        try:
            result = self._camera.RetrieveResult(max(1, round(1e3 * timeout_s)), pylon.TimeoutHandling_Return)
            if not result.IsValid():
                if self._camera.IsCameraDeviceRemoved():
                    raise CameraGoneError(f"{self.name}: the camera no longer answers")
                return None
            host_ns = time.time_ns()
            try:
                if not result.GrabSucceeded():
                    self.trouble.damaged += 1
                    return None
                name = self._camera.PixelFormat.GetValue()
                if name not in PIXEL_FORMATS:
                    raise ValueError(f"{self.name} sends {name}; set one of {', '.join(PIXEL_FORMATS)}")
                device_ns = None if self._emulated else int(result.GetTimeStamp())
                image = np.array(result.GetArray())
                return CameraFrame(image, int(result.GetBlockID()), device_ns, host_ns, name)
            finally:
                result.Release()
        except pylon.GenericException as error:
            raise CameraGoneError(f"{self.name}: {error}") from error

    def stop(self) -> None:
        """End acquiring."""
        if self._camera is not None:
            with contextlib.suppress(load_pylon().GenericException):
                self._camera.StopGrabbing()

    def close(self) -> None:
        """Let go of the camera."""
        if self._camera is not None:
            with contextlib.suppress(load_pylon().GenericException):
                self._camera.Close()
            self._camera = None
