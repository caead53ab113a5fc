"""The serial port below the pump: opened for one program alone, and one kind of error for every way it can vanish.

What pyserial leaves to know: a pseudo-terminal whose other end died raises SerialException on read and write but a
plain OSError on `in_waiting`; setting DTR on one raises ENOTTY, so it is not set here (an Arduino restarts when its
port is opened, which the handshake waits for). pyserial is imported when a port is opened.
"""

from __future__ import annotations

import os
from typing import Any, Protocol
from urllib.parse import quote

BAUD = 115_200


class PumpError(RuntimeError):
    """The pump cannot do what was asked. After any of these it is off, or goes off by its own watchdog."""


class PortError(PumpError):
    """The serial port cannot be opened, belongs to another program, takes no more data, or has vanished."""


class Line(Protocol):
    """Bytes to and from a device. Each method raises PortError when the device is gone."""

    def write(self, data: bytes) -> None:
        """Send all of it."""

    def read(self, timeout: float) -> bytes:
        """What has come, waiting at most `timeout` seconds for the first byte; b"" if nothing came."""

    def clear(self) -> None:
        """Throw away what has come and was not read."""

    def close(self) -> None:
        """Give the port back; never raises."""


class SerialLine:
    """A port by name (`/dev/ttyACM0`, or a URL of pyserial's such as `socket://host:port`), held exclusively.

    spy: a new file in which pyserial writes every byte that passes, with times.
    """

    def __init__(self, port: str, baud: int = BAUD, spy: str | os.PathLike[str] | None = None) -> None:
        try:
            import serial
        except ImportError as error:  # pragma: no cover
            raise PumpError("the pump needs pyserial, which is not installed. Get it: pip install pyserial") from error
        self.port = port
        self._too_late: type[OSError] = serial.SerialTimeoutException
        self._log: Any = None
        url = port
        if spy is not None:
            if "://" in port:
                raise ValueError(f"spy works for ports with a name; {port!r} is a URL")
            with open(spy, "x"):  # noqa: PTH123  what somebody recorded stays
                url = f"spy://{port}?file={quote(os.fspath(spy), safe='/')}&all"
        try:
            self._serial: Any = serial.serial_for_url(
                url, baudrate=baud, timeout=0, write_timeout=1.0, exclusive=True, do_not_open=True
            )
            self._log = getattr(getattr(self._serial, "formatter", None), "output", None)
            self._serial.open()
        except (OSError, ValueError) as error:  # SerialException is an OSError
            self.close()
            raise PortError(_why(port, error)) from error

    def write(self, data: bytes) -> None:
        """Send all of it, within a second."""
        try:
            self._serial.write(data)
        except self._too_late as error:
            words = "took no data for a second: the device hangs, or this program was stopped"
            raise PortError(f"{self.port}: the pump's port {words} ({error})") from error
        except (OSError, TypeError, AttributeError) as error:  # the latter two: closed meanwhile
            raise PortError(f"{self.port}: the pump's port vanished while writing ({error})") from error

    def read(self, timeout: float) -> bytes:
        """What has come, waiting at most `timeout` seconds for the first byte."""
        try:
            waiting = self._serial.in_waiting
            if waiting:
                return bytes(self._serial.read(min(waiting, 4096)))
            self._serial.timeout = max(timeout, 0.0)
            first = bytes(self._serial.read(1))
            self._serial.timeout = 0
            return first
        except (OSError, TypeError, AttributeError) as error:
            raise PortError(f"{self.port}: the pump's port vanished while reading ({error})") from error

    def clear(self) -> None:
        """Throw away what has come and was not read."""
        try:
            self._serial.reset_input_buffer()
        except Exception as error:  # termios.error is neither an OSError nor a SerialException
            raise PortError(f"{self.port}: the pump's port vanished ({error})") from error

    def close(self) -> None:
        """Give the port back."""
        for each in (getattr(self, "_serial", None), self._log):
            try:
                if each is not None:
                    each.close()
            except Exception:  # noqa: S110  a port that vanished is closed all the same
                pass


def send_stop_byte(port: str, stop: bytes) -> None:
    """Write the emergency stop to a port that another program may hold, in that program's settings."""
    try:
        handle = os.open(port, os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            os.write(handle, stop)
        finally:
            os.close(handle)
    except OSError as error:
        raise PortError(_why(port, error)) from error


def _why(port: str, error: Exception) -> str:
    words = str(error)
    if "exclusively lock" in words:
        return f"{port}: another program holds the pump's port; `rainstereo pump stop` works all the same"
    if isinstance(error, FileNotFoundError) or "No such file" in words:
        return f"{port}: there is no such port. Is the pump plugged in? `ls /dev/ttyACM* /dev/ttyUSB*` lists candidates"
    if isinstance(error, PermissionError) or "Permission denied" in words:
        return f"{port}: no permission. sudo usermod -aG dialout $USER, then log in again"
    return f"{port}: cannot be opened ({words})"
