"""Reads segments back, record by record, and says where they are damaged: to the bit, if only one is flipped."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from .segment_log import HEADER, MAGIC, Entry, parse_header, segment_path


@dataclass(frozen=True)
class Damage:
    """Bytes of a segment that do not say what was written: where, and what is wrong.

    what: torn (the file ends within a record, as after a crash), header, payload, or lost (a segment that is missing).
    sequence: of the record, where it is known. bit: the one flipped bit, counted from the segment's start, where a
    single flipped bit explains the checksum.
    """

    segment: int
    offset: int
    end: int
    what: str
    sequence: int | None = None
    bit: int | None = None

    @property
    def words(self) -> str:
        """One line that locates it."""
        name = segment_path(Path(), self.segment).name
        record = "" if self.sequence is None else f", record {self.sequence}"
        where = f"{name}, bytes {self.offset} to {self.end}{record}"
        if self.bit is not None:
            return f"{where}: {self.what}, bit {self.bit % 8} of byte {self.bit // 8} is flipped"
        return f"{where}: {self.what}"


def scan(folder: Path, number: int, start: int = 0) -> Iterator[Entry | Damage]:
    """The records of a segment from the byte `start` on, and what is damaged between them. Payloads are not read."""
    with segment_path(folder, number).open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        offset = start
        while offset < size:
            file.seek(offset)
            head = file.read(HEADER.size)
            entry = parse_header(head, number, offset)
            if entry is not None and entry.end <= size:
                yield entry
                offset = entry.end
                continue
            following = _find_record(file, number, offset + 1, size)
            if following is None:
                yield Damage(number, offset, size, "torn", entry.sequence if entry else None)
                return
            what, bit = "header", None
            if entry is None and (mended := mend_header(head)) is not None:
                bit = 8 * offset + mended[1]
            yield Damage(number, offset, following, what, entry.sequence if entry else None, bit)
            offset = following


def header_at(folder: Path, number: int, offset: int) -> Entry | None:
    """The entry whose header lies there; None where none does."""
    with segment_path(folder, number).open("rb") as file:
        file.seek(offset)
        return parse_header(file.read(HEADER.size), number, offset)


def _find_record(file: BinaryIO, number: int, start: int, size: int) -> int | None:
    """Offset of the first whole record at or after `start`."""
    step = 1 << 20
    for base in range(start, size, step):
        file.seek(base)
        block = file.read(step + HEADER.size)
        at = block.find(MAGIC)
        while 0 <= at < step:
            entry = parse_header(block[at : at + HEADER.size], number, base + at)
            if entry is not None and entry.end <= size:
                return base + at
            at = block.find(MAGIC, at + 1)
    return None


def mend_header(head: bytes) -> tuple[bytes, int] | None:
    """A header with its one flipped bit put right, and which bit that was; None where no single bit explains it."""
    for bit in range(8 * len(head)):
        flipped = bytearray(head)
        flipped[bit // 8] ^= 1 << bit % 8
        if parse_header(flipped, 0, 0) is not None:
            return bytes(flipped), bit
    return None


def flipped_bit(length: int, expected: int, found: int) -> int | None:
    """Which bit of `length` bytes was flipped, if that alone turned the CRC-32 `expected` into `found`.

    A CRC is linear: the exclusive or of both checksums is that of the error alone. It is run backwards, byte by byte,
    until it is what a single bit leaves. Of other errors, one in 2^32 / (8 length) looks like a single bit too.
    """
    state = expected ^ found
    if not state:
        return None
    single = {_CRC[1 << bit]: bit for bit in range(8)}
    for byte in range(length - 1, -1, -1):
        if state in single:
            return 8 * byte + single[state]
        low = _CRC_TOP[state >> 24]
        state = ((state ^ _CRC[low]) << 8 | low) & 0xFFFFFFFF
    return None


def _crc_table() -> list[int]:
    table = []
    for byte in range(256):
        state = byte
        for _ in range(8):
            state = state >> 1 ^ (0xEDB88320 if state & 1 else 0)
        table.append(state)
    return table


_CRC = _crc_table()
_CRC_TOP = {value >> 24: byte for byte, value in enumerate(_CRC)}


def read_payload(folder: Path, entry: Entry) -> tuple[bytes, bytes]:
    """Meta and data of a record. ValueError, which names the place, where their checksum is wrong."""
    with segment_path(folder, entry.segment).open("rb") as file:
        file.seek(entry.payload)
        payload = file.read(entry.meta_bytes + entry.data_bytes)
    if len(payload) != entry.meta_bytes + entry.data_bytes or zlib.crc32(payload) != entry.crc:
        raise ValueError(f"{folder}: {check_payload(payload, entry).words}; see rainstereo record verify")
    return payload[: entry.meta_bytes], payload[entry.meta_bytes :]


def check_payload(payload: bytes, entry: Entry) -> Damage:
    """What is wrong with a payload whose checksum is not the header's."""
    bit = flipped_bit(len(payload), entry.crc, zlib.crc32(payload))
    at = None if bit is None else 8 * entry.payload + bit
    return Damage(entry.segment, entry.offset, entry.end, "payload", entry.sequence, at)
