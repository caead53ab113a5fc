"""RSP/1, the pump's line protocol, as bytes: commands made, replies and events taken apart, nothing guessed.

    host   @SS BODY*CCCC\\n        SS a hex sequence number, CCCC the CRC of everything between @ and *
    device #SS OK ...*CCCC\\n  or  #SS ER CODE*CCCC\\n, and of its own accord  !NAME u=MS f=FAULT*CCCC\\n

docs/pump.md describes every command. A line that is not exactly as it should be is no line: it is counted and dropped.
"""

from __future__ import annotations

import binascii
import re
from dataclasses import dataclass

LINE_MAX = 80
"""Bytes of a line, its first character and the line feed among them."""
STOP_BYTE = b"\x18"
"""By itself, anywhere: the pump stops at once and stays stopped."""
ERRORS = {
    "VER": "speaks another version of the protocol",
    "SEQ": "knows nothing of this session: it was restarted, or another program spoke to it",
    "ARG": "does not accept these values",
    "ARM": "is not in a state for this",
    "FLT": "has a fault, which must be cleared first",
    "CMD": "does not know this command",
}
"""What a device that answers so says about itself."""
EVENTS = {
    "UP": "the device started",
    "DN": "a run ended as it should",
    "DA": "disarmed, since the host was silent",
    "WD": "stopped, since the host was silent",
    "ES": "emergency stop",
    "RS": "the device had to restart itself",
    "LV": "the reservoir is low",
}
"""What each event means."""
_NUMBER = re.compile(r"0|[1-9][0-9]{0,9}")
_LINE = re.compile(
    rb"(?:#([0-9A-F]{2}) (?:OK((?: [!-)+-~]+)*)|ER ([A-Z]{3}))|!([A-Z]{2}) u=([0-9]+) f=([0-9]+))\*([0-9A-F]{4})"
)


@dataclass(frozen=True)
class Reply:
    """An answer to the command `seq`. fields: what stands behind OK. error: one of `ERRORS`, else ""."""

    seq: int
    fields: str = ""
    error: str = ""


@dataclass(frozen=True)
class Event:
    """What a device says unasked. device_ms: its clock, modulo 2^32. fault: the number of the fault that is latched."""

    name: str
    device_ms: int
    fault: int

    @property
    def words(self) -> str:
        """What happened, for people."""
        return EVENTS.get(self.name, f"event {self.name}")


def crc(data: bytes) -> int:
    """CRC-16/IBM-3740 (polynomial 0x1021, begins with 0xFFFF, not reflected); 0x29B1 of b"123456789"."""
    return binascii.crc_hqx(data, 0xFFFF)


def command(seq: int, body: str) -> bytes:
    """The line that carries `body` (printable ASCII without `@` and `*`) as command number `seq`, 0 to 255."""
    if not 0 <= seq <= 0xFF:
        raise ValueError(f"sequence number {seq}; expected 0 to 255")
    if not body or not re.fullmatch(r"[ -)+-?A-~]+", body):
        raise ValueError(f"a command {body!r}; expected printable ASCII without @ and *")
    return _framed(b"@", f"{seq:02X} {body}")


def reply(seq: int, words: str) -> bytes:
    """The line by which a device answers: `words` is `OK k=1 ...` or `ER CODE`."""
    return _framed(b"#", f"{seq:02X} {words}")


def parse(line: bytes) -> Reply | Event | None:
    """What a device said in `line` (without its line feed), or None if it is not exactly one line of RSP/1."""
    found = _LINE.fullmatch(line) if len(line) < LINE_MAX else None
    if found is None or crc(line[1:-5]) != int(found[7], 16):
        return None
    seq, fields, error, event, device_ms, fault = (
        None if part is None else part.decode() for part in found.groups()[:6]
    )
    if event is not None:
        when, what = number(str(device_ms)), number(str(fault))
        return None if when is None or what is None else Event(event, when, what)
    if error is not None:
        return Reply(int(str(seq), 16), error=error) if error in ERRORS else None
    return Reply(int(str(seq), 16), str(fields)[1:])


def number(text: str) -> int | None:
    """A whole number below 2^32 without sign or leading zeros; None for anything else."""
    value = int(text) if _NUMBER.fullmatch(text) else None
    return value if value is not None and value < 1 << 32 else None


def numbers(fields: str, keys: str) -> dict[str, int] | None:
    """`k=1 l=2` as {"k": 1, "l": 2}; None unless `keys` ("kl") are exactly the keys, in that order."""
    words = fields.split(" ")
    if len(words) != len(keys):
        return None
    found = {}
    for word, key in zip(words, keys, strict=True):
        value = number(word[2:]) if word[:2] == f"{key}=" else None
        if value is None:
            return None
        found[key] = value
    return found


class LineReader:
    """Finds a device's lines in a stream of bytes, however it is cut. `#` and `!` always begin a line.

    bad: lines dropped so far. Memory is bounded: a line too long is dropped before it ends.
    """

    def __init__(self) -> None:
        self.bad = 0
        self._line: bytearray | None = None

    def feed(self, data: bytes) -> list[Reply | Event]:
        """Everything that ends in `data`, in order."""
        found: list[Reply | Event] = []
        for byte in data:
            if byte in b"#!":
                self.bad += self._line is not None
                self._line = bytearray((byte,))
            elif self._line is None:
                continue
            elif byte == 0x0A:
                said = parse(bytes(self._line))
                self._line = None
                if said is None:
                    self.bad += 1
                else:
                    found.append(said)
            elif len(self._line) >= LINE_MAX - 1 or not 0x20 <= byte <= 0x7E:
                self._line = None
                self.bad += 1
            else:
                self._line.append(byte)
        return found


def _framed(first: bytes, text: str) -> bytes:
    payload = text.encode("ascii")
    line = first + payload + b"*%04X\n" % crc(payload)
    if len(line) > LINE_MAX:
        raise ValueError(f"a line of {len(line)} bytes, {text!r}; expected at most {LINE_MAX}")
    return line
