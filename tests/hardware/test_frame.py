"""Lines of RSP/1 taken apart: exactly those that are whole, whatever surrounds them."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo.hardware import frame
from rainstereo.hardware.frame import Event, LineReader, Reply, command, crc, number, numbers, parse, reply

FIELDS = st.lists(
    st.tuples(st.sampled_from("abdfnstuwx"), st.integers(0, 2**32 - 1)).map(lambda kv: f"{kv[0]}={kv[1]}"), max_size=4
).map(" ".join)
REPLIES = st.tuples(st.integers(0, 255), FIELDS).filter(lambda r: len(r[1]) < 60)


def crc_by_division(data: bytes) -> int:
    """The CRC's definition: remainder of the message's polynomial, the register preset with ones."""
    value = int.from_bytes(data, "big") << 16
    length = 8 * len(data) + 16
    value ^= 0xFFFF << (length - 16)
    for bit in range(length - 1, 15, -1):
        if value >> bit & 1:
            value ^= 0x11021 << (bit - 16)
    return value


def device_line(text: str, first: bytes = b"#") -> bytes:
    return first + text.encode() + b"*%04X" % crc(text.encode())


def test_crc_of_the_check_string() -> None:
    assert crc(b"123456789") == 0x29B1


@given(st.binary(min_size=2, max_size=90))
def test_crc_is_a_polynomial_division(data: bytes) -> None:
    assert crc(data) == crc_by_division(data)


def test_the_line_of_the_manual() -> None:
    assert command(0x0A, "KA") == b"@0A KA*%04X\n" % crc_by_division(b"0A KA")


@pytest.mark.parametrize("body", ["", "KA*", "K@", "KA\n", "Kä", "x" * 80])
def test_what_is_no_command(body: str) -> None:
    with pytest.raises(ValueError, match="expected"):
        command(1, body)


@pytest.mark.parametrize("seq", [-1, 256])
def test_what_is_no_sequence_number(seq: int) -> None:
    with pytest.raises(ValueError, match="expected 0 to 255"):
        command(seq, "KA")


@given(REPLIES, st.binary(max_size=40), st.binary(max_size=40), st.data())
def test_a_reply_is_found_in_any_garbage_however_it_is_cut(
    said: tuple[int, str], before: bytes, after: bytes, data: st.DataObject
) -> None:
    seq, fields = said
    stream = before + reply(seq, f"OK {fields}".rstrip()) + after
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=4)))
    reader, found = LineReader(), []
    for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        found += reader.feed(stream[start:end])
    assert Reply(seq, fields) in found
    assert all(isinstance(each, (Reply, Event)) for each in found)


@settings(max_examples=300)
@given(st.binary(max_size=300))
def test_no_bytes_do_harm(data: bytes) -> None:
    reader = LineReader()
    whole = reader.feed(data)
    assert reader._line is None or len(reader._line) < frame.LINE_MAX
    for said in whole:  # improbable, but then it must be a line that makes itself again
        assert isinstance(said, (Reply, Event))
    again = LineReader()
    assert [said for byte in data for said in again.feed(bytes([byte]))] == whole
    assert again.bad == reader.bad
    assert reader.feed(b"\n" + reply(7, "OK"))[-1] == Reply(7)


@settings(derandomize=True)  # one in 65,536 would slip through
@given(REPLIES, st.data())
def test_a_changed_lost_or_added_byte_is_no_reply(said: tuple[int, str], data: st.DataObject) -> None:
    line = reply(said[0], f"OK {said[1]}".rstrip())[:-1]
    at, byte = data.draw(st.integers(0, len(line) - 1)), data.draw(st.integers(0, 255))
    kind = data.draw(st.sampled_from(("change", "lose", "add")))
    spoilt = line[:at] + (b"" if kind == "lose" else bytes([byte])) + line[at + (kind != "add") :]
    if spoilt != line:
        assert parse(spoilt) is None


@given(st.text(st.sampled_from("#!@*0123456789ABCDEF OKER=dfnstuw\n")))
def test_text_like_the_protocol_is_no_reply_without_its_crc(text: str) -> None:
    line = text.encode()
    said = parse(line)
    if said is not None:
        assert crc_by_division(line[1:-5]) == int(line[-4:], 16)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("07 OK", Reply(7)), ("FF OK d=1 t=2", Reply(255, "d=1 t=2")), ("01 ER FLT", Reply(1, error="FLT")),
        ("0a OK", None), ("7 OK", None), ("07  OK", None), ("07 OK ", None), ("07 OK  d=1", None), ("07 ER", None),
        ("07 ER XXX", None), ("07 ER FLT x", None), ("07 KO", None), ("07 OKd=1", None), ("07", None), ("", None),
    ],
)  # fmt: skip
def test_strictness(text: str, expected: Reply | None) -> None:
    assert parse(device_line(text)) == expected


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("WD u=12 f=1", Event("WD", 12, 1)), ("WD u=012 f=1", None), ("WD u=4294967296 f=1", None),
        ("WD f=1 u=1", None), ("wd u=1 f=1", None), ("WD u=1 f=1 ", None), ("WD u= f=1", None),
    ],
)  # fmt: skip
def test_events(text: str, expected: Event | None) -> None:
    assert parse(device_line(text, b"!")) == expected


def test_a_line_too_long_is_dropped_before_it_ends() -> None:
    reader = LineReader()
    assert reader.feed(b"#" + b"A" * 1_000_000) == []
    assert reader.bad == 1
    assert reader.feed(b"\n" + reply(1, "OK")) == [Reply(1)]


def test_numbers() -> None:
    assert numbers("d=0 r=12", "dr") == {"d": 0, "r": 12}
    for fields in ("d=0", "r=12 d=0", "d=00 r=1", "d=+1 r=1", "d=1 r=", "d=1  r=1", "d=1 r=1 s=1", ""):
        assert numbers(fields, "dr") is None
    assert [number(text) for text in ("4294967295", "4294967296", "-1", "1.0", "", " 1", "١")] == [2**32 - 1] + [
        None
    ] * 6
    assert Event("WD", 1, 1).words == "stopped, since the host was silent"
