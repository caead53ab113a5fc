"""The pump, driven over its serial line: nothing runs unless the device has confirmed it, nor longer than it was told.

    with Pump.open("/dev/ttyACM0") as pump:
        pump.arm()
        pump.run(Segment(duty=550, duration_ms=20_000, on_ms=120, off_ms=880))
        while pump.status().running:
            pump.renew()          # the caller's sign of life: without it the heartbeat ends, and the pump with it
            time.sleep(0.1)

Three things turn the pump off without us: the duration of its segment, its watchdog when the heartbeat ends, and the
emergency stop. A thread sends the heartbeat, but only while the lease lasts that `renew` extends; a program that hangs
or is stopped or killed therefore stops the pump. Nothing resumes by itself. Methods may be called from any thread.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType

from .frame import ERRORS, STOP_BYTE, Event, LineReader, Reply, command, numbers
from .regime import Segment
from .serial_line import Line, PortError, PumpError, SerialLine

STATES = ("idle", "armed", "run", "fault")
FAULTS = {
    0: "none",
    1: "the host was silent",
    2: "emergency stop",
    3: "the device had to restart itself",
    4: "the reservoir is low",
}
HEARTBEAT_S = 0.25
"""Between two signs of life; less where the watchdog is shorter than four of them."""
LEASE_S = 2.0
WATCHDOG_MS = 1000


class NoAnswerError(PumpError):
    """The port is there, but no answer came however often the command was repeated."""


class RefusedError(PumpError):
    """The device answered with an error; `code` is one of `frame.ERRORS`."""

    def __init__(self, body: str, code: str) -> None:
        super().__init__(f"the pump refused {body!r}: it {ERRORS[code]} ({code})")
        self.code = code


class LeaseExpiredError(PumpError):
    """The caller did not renew its lease in time, so the pump was stopped."""


@dataclass(frozen=True)
class Status:
    """What the device says about itself, and when.

    state: one of `STATES`. duty: per mille, now. fault: key of `FAULTS`. watchdog_ms, age_ms (of the present run),
    device_ms (its clock, modulo 2^32), bad_frames and executed: counted by the device. host_ns: Unix time at the
    middle of the exchange, round_trip_s its length; device_ms belongs to that moment within half of it.
    """

    state: str
    duty: int
    fault: int
    watchdog_ms: int
    age_ms: int
    device_ms: int
    bad_frames: int
    executed: int
    host_ns: int
    round_trip_s: float

    @property
    def running(self) -> bool:
        """A segment is under way."""
        return self.state == "run"

    @property
    def fault_words(self) -> str:
        """The fault for people."""
        return FAULTS.get(self.fault, f"fault {self.fault}")


@dataclass(frozen=True)
class Identity:
    """What the handshake told: firmware version, and the largest duty the device accepts, per mille."""

    firmware: str
    max_duty: int


class Pump:
    """A pump on a `Line`. Make one with `Pump.open`; it is shaken hands with, stopped, and not armed.

    reply_s: wait for an answer before the command is repeated. patience_s: how long it is repeated before
    NoAnswerError. lease_s: how long one `renew` keeps the heartbeat going. heartbeat=False: the caller sends it.
    """

    def __init__(
        self,
        line: Line,
        *,
        reply_s: float = 0.1,
        patience_s: float = 3.0,
        lease_s: float = LEASE_S,
        heartbeat: bool = True,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if not 0 < reply_s <= patience_s or not lease_s > 0:
            raise ValueError(
                f"reply_s {reply_s}, patience_s {patience_s}, lease_s {lease_s}; expected positive seconds"
            )
        self.reply_s, self.patience_s, self.lease_s = reply_s, patience_s, lease_s
        self.events: deque[tuple[int, Event]] = deque(maxlen=10_000)
        """What the device said unasked, each with the host's Unix time in ns at which it was read."""
        self.retries = 0
        self.on_event: Callable[[int, Event], None] | None = None
        self._reopen: Callable[[], Line] | None = None
        self._line: Line | None = line
        self._clock = clock
        self._lock = threading.RLock()
        self._reader = LineReader()
        self._seq = 0
        self._lease_until = -1.0
        self._armed = False
        self._pause_s = HEARTBEAT_S
        self._broken: PumpError | None = None
        self._wake = threading.Event()
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._beats = heartbeat
        try:
            self.identity = self._handshake()
        except BaseException:
            line.close()
            raise

    @classmethod
    def open(
        cls, port: str, *, spy: str | os.PathLike[str] | None = None, reply_s: float = 0.1, patience_s: float = 3.0,
        lease_s: float = LEASE_S,
    ) -> Pump:  # fmt: skip
        """The pump at a serial port, exclusively. PortError if there is none, or another program holds it.

        spy: a new file for a log of every byte. An Arduino restarts when its port is opened: `patience_s` covers that.
        """
        pump = cls(SerialLine(port, spy=spy), reply_s=reply_s, patience_s=patience_s, lease_s=lease_s)
        pump._reopen = lambda: SerialLine(port)
        return pump

    # -- commands ------------------------------------------------------------------------------------------------------

    def arm(self, watchdog_ms: int = WATCHDOG_MS) -> None:
        """Allow runs, and begin the lease. The watchdog, 200 to 2000 ms, cannot be turned off."""
        if not 200 <= watchdog_ms <= 2000:
            raise ValueError(f"a watchdog of {watchdog_ms} ms; expected 200 to 2000")
        with self._lock:
            self._broken = None
            self._expect(f"AR w={watchdog_ms}", f"w={watchdog_ms}")
            self._armed = True
            self._pause_s = min(HEARTBEAT_S, watchdog_ms / 4000)
            self.renew()
            if self._beats and self._thread is None:
                self._thread = threading.Thread(target=self._beat, name="pump-heartbeat", daemon=True)
                self._thread.start()
            self._wake.set()

    def run(self, segment: Segment) -> None:
        """Begin a segment, in place of the one under way. Returns when the device has confirmed every value.

        An answer that differs from what was sent raises PumpError, after an emergency stop.
        """
        if segment.duty > self.identity.max_duty:
            raise ValueError(f"a duty of {segment.duty} per mille; this pump accepts at most {self.identity.max_duty}")
        self.renew()
        self._expect(segment.body, segment.body[3:])

    def stop(self) -> None:
        """Turn the pump off and disarm it."""
        with self._lock:
            self._disarm()
            self._state("ST")

    def clear(self) -> None:
        """Clear a fault; the pump is off and not armed. RefusedError FLT while its cause lasts (an empty reservoir)."""
        with self._lock:
            self._disarm()
            self._broken = None
            self._state("CL")

    def emergency_stop(self) -> None:
        """Stop at once, without waiting for an answer; the device stays stopped until `clear`. Needs no lock."""
        self._disarm()
        if self._line is not None:
            self._line.write(STOP_BYTE)

    def status(self) -> Status:
        """Ask the device. This does not feed its watchdog, nor renew the lease."""
        with self._lock:
            asked_ns, asked = time.time_ns(), self._clock()
            found = numbers(self._ask("QS"), "sdfwaubx")
            took = self._clock() - asked
            if found is None or found["s"] >= len(STATES):
                raise self._stopped_for("QS", "an answer that makes no sense")
            return Status(
                STATES[found["s"]], found["d"], found["f"], found["w"], found["a"], found["u"], found["b"], found["x"],
                asked_ns + int(took * 5e8), took,
            )  # fmt: skip

    def renew(self) -> None:
        """The caller's sign of life: the heartbeat goes on for `lease_s`. Raises what the heartbeat met meanwhile."""
        broken = self._broken
        if broken is not None:
            raise broken
        self._lease_until = self._clock() + self.lease_s

    def heartbeat(self) -> None:
        """Feed the watchdog once. The heartbeat's thread does this; without one it is the caller's to do."""
        self._state("KA")

    # -- the port ------------------------------------------------------------------------------------------------------

    def reconnect(self, patience_s: float = 30.0) -> Identity:
        """Open the port again, with growing pauses, and shake hands. The pump is off and not armed afterwards."""
        if self._reopen is None:
            raise ValueError("only a pump that Pump.open made can be reconnected")
        until, pause = self._clock() + patience_s, 0.1
        with self._lock:
            self._disarm()
            while True:
                try:
                    if self._line is not None:
                        self._line.close()
                    self._line = None
                    self._line = self._reopen()
                    self.identity = self._handshake()
                    self._broken = None
                    return self.identity
                except PumpError:
                    if self._clock() + pause > until:
                        raise
                time.sleep(pause)
                pause = min(2 * pause, 2.0)

    def close(self) -> None:
        """Turn the pump off and give the port back. Never raises; where the port is gone the watchdog does it."""
        if self._closing.is_set():
            return
        self._closing.set()
        self._disarm()
        self._wake.set()
        with self._lock:
            patience, self.patience_s = self.patience_s, min(self.patience_s, 1.0)
            with contextlib.suppress(PumpError):
                self._ask("ST")
            self.patience_s = patience
            if self._line is not None:
                self._line.close()
            self._line = None
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(2.0)

    def __enter__(self) -> Pump:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # -- below ---------------------------------------------------------------------------------------------------------

    def _disarm(self) -> None:
        self._armed = False
        self._lease_until = -1.0

    def _handshake(self) -> Identity:
        with self._lock:
            self._reader = LineReader()
            if self._line is not None:
                self._line.clear()
            nonce = secrets.randbelow(1 << 16)
            self._seq = secrets.randbelow(256)
            body = f"HI v=1 n={nonce:04X}"
            words = self._ask(body).split(" ")
            max_duty = numbers(words[-1], "m")
            if (
                len(words) != 5 or words[:2] != ["v=1", f"n={nonce:04X}"] or words[2][:3] != "fw="
                or words[3] != "id=RSPUMP" or max_duty is None
            ):  # fmt: skip
                raise PumpError(f"the device on this port is no pump of ours: it answered {' '.join(words)!r}")
            return Identity(words[2][3:], max_duty["m"])

    def _expect(self, body: str, fields: str) -> None:
        with self._lock:
            answer = self._ask(body)
            if answer != fields:
                raise self._stopped_for(body, repr(answer))

    def _state(self, body: str) -> None:
        with self._lock:
            found = numbers(self._ask(body), "sdf")
            if found is None:
                raise self._stopped_for(body, "an answer that makes no sense")
            if body == "KA" and found["s"] not in (1, 2) and self._armed:
                self._disarm()
                raise PumpError(f"the pump is off: {FAULTS.get(found['f'], found['f']) if found['f'] else 'disarmed'}")

    def _stopped_for(self, body: str, what: str) -> PumpError:
        with contextlib.suppress(PumpError):
            self.emergency_stop()
        return PumpError(f"the pump answered {what} to {body!r}; it was sent an emergency stop")

    def _ask(self, body: str) -> str:
        """Send a command until it is answered, byte by byte the same each time; the fields behind OK."""
        with self._lock:
            if self._line is None:
                raise PortError("the pump's port is closed; reconnect or open it again")
            self._seq = (self._seq + 1) & 0xFF
            line = command(self._seq, body)
            until = self._clock() + self.patience_s
            while True:
                self._line.write(line)
                answer = self._answer(min(self._clock() + self.reply_s, until))
                if answer is not None:
                    break
                if self._clock() >= until:
                    raise NoAnswerError(f"the pump did not answer {body!r} within {self.patience_s:g} s")
                self.retries += 1
            if answer.error:
                raise RefusedError(body, answer.error)
            return answer.fields

    def _answer(self, until: float) -> Reply | None:
        if self._line is None:
            raise PortError("the pump's port was closed")
        while True:
            found = None
            for said in self._reader.feed(self._line.read(max(until - self._clock(), 0.0))):
                if isinstance(said, Event):
                    self._note(said)
                elif said.seq == self._seq:
                    found = said
            if found is not None or self._clock() >= until:
                return found

    def _note(self, event: Event) -> None:
        when = time.time_ns()
        self.events.append((when, event))
        if self.on_event is not None:
            self.on_event(when, event)

    def _beat(self) -> None:
        """The heartbeat's thread: feeds the watchdog while the lease lasts, stops the pump when it has run out."""
        while not self._closing.is_set():
            if not self._armed:
                self._wake.wait()
                self._wake.clear()
                continue
            try:
                with self._lock:
                    if self._armed and self._clock() < self._lease_until:
                        self._state("KA")
                    elif self._armed:
                        self._disarm()
                        self._broken = LeaseExpiredError(
                            f"nobody renewed the pump's lease of {self.lease_s:g} s, so it was stopped"
                        )
                        self._ask("ST")
            except PumpError as error:
                self._disarm()
                self._broken = self._broken or error
            self._closing.wait(self._pause_s)
