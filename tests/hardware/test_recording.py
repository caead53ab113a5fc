"""Recordings: what is written comes back bit for bit; what a crash or a disk did is found, located and mended."""

import json
import shutil
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo.hardware import segment_log
from rainstereo.hardware.codec import available, decode, encode
from rainstereo.hardware.pair_frame import CameraFrame, PairFrame
from rainstereo.hardware.pixel_format import BAYER, demosaic, mosaic
from rainstereo.hardware.recording import is_recording, open_recording
from rainstereo.hardware.recording_repair import CUT, repair, verify
from rainstereo.hardware.recording_toml import toml
from rainstereo.hardware.recording_writer import RecordingWriter
from rainstereo.hardware.segment_index import NAME as INDEX
from rainstereo.hardware.segment_log import HEADER, Kind, LogError, segment_path
from rainstereo.hardware.segment_scan import flipped_bit
from tests.hardware.stamped import number_in, pair, stamped


def record(folder: Path, count: int = 12, **options: object) -> Path:
    with RecordingWriter(folder, {"rig": {"name": "bench"}}, **options) as writer:  # type: ignore[arg-type]
        for i in range(count):
            writer.write(pair(i))
            if i == 3:
                writer.event("regime", name="mist", duty=1000)
    return folder


def same(a: PairFrame, b: PairFrame) -> bool:
    kept = [
        (p.id, p.status, p.sync_us, p.regime, p.device_ts_ns, p.host_ts_ns, p.wet_frame.device_ts_ns) for p in (a, b)
    ]
    return kept[0] == kept[1] and np.array_equal(a.dry, b.dry) and np.array_equal(a.wet, b.wet)


@pytest.mark.parametrize("codec", available())
def test_pairs_come_back_bit_for_bit(tmp_path: Path, codec: str) -> None:
    found = open_recording(record(tmp_path / "rec", codec=codec))
    assert len(found) == 12
    assert all(same(found.read(i), pair(i)) for i in range(12))
    assert same(found[-1], pair(11))
    assert found.meta(5)["id"] == 5
    assert [event.name for event in found.events()] == ["regime", "closed"]
    assert found.events()[0].details == {"name": "mist", "duty": 1000}
    assert found.about["rig"] == {"name": "bench"}
    assert found.about["state"] == "closed"
    assert verify(tmp_path / "rec").sound
    with pytest.raises(IndexError, match="holds 12"):
        found.read(12)


@pytest.mark.parametrize("codec", available())
@pytest.mark.parametrize("shape", [(48, 64), (31, 17), (1, 1), (24, 20, 3)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_codecs_lose_nothing(codec: str, shape: tuple[int, ...], dtype: type, rng: np.random.Generator) -> None:
    image = rng.integers(0, np.iinfo(dtype).max, shape, dtype=dtype, endpoint=True)
    bayer = len(shape) == 2
    data = encode(image, codec, bayer)
    assert np.array_equal(decode(data, codec, bayer, shape, np.dtype(dtype)), image)
    with pytest.raises(ValueError):  # noqa: PT011 - each decoder in its own words
        decode(data, codec, bayer, (shape[0] + 2, *shape[1:]), np.dtype(dtype))
    with pytest.raises(ValueError):  # noqa: PT011
        decode(data[: len(data) // 2], codec, bayer, shape, np.dtype(dtype))


@pytest.mark.parametrize("name", BAYER)
def test_a_mosaic_of_a_plain_colour_gives_that_colour(name: str) -> None:
    colour = np.full((8, 10, 3), (30, 120, 210), np.uint8)
    assert np.array_equal(demosaic(mosaic(colour, f"{name}8"), f"{name}8"), colour)


def test_mosaics_are_stored_raw_and_read_in_colour(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "rec", codec="png") as writer:
        writer.write(pair(7, (40, 60), "BayerRG8"))
    found = open_recording(tmp_path / "rec").read(0)
    assert np.array_equal(found.dry_frame.image, stamped(7, (40, 60), 1))
    assert found.dry.shape == (40, 60, 3)


def test_segments_rotate_and_index_is_made_from_the_log_alone(tmp_path: Path) -> None:
    folder = record(tmp_path / "rec", 60, segment_bytes=4096)
    assert len(segment_log.segments(folder)) > 5
    whole = (folder / INDEX).read_bytes()
    (folder / INDEX).unlink()
    assert all(same(a, pair(i)) for i, a in enumerate(open_recording(folder)))
    assert not verify(folder).sound
    (folder / "recording.toml").unlink()
    with pytest.raises(ValueError, match="rainstereo record repair"):
        open_recording(folder)
    repair(folder)
    assert (folder / INDEX).read_bytes() == whole
    assert verify(folder).sound
    assert is_recording(folder)
    assert open_recording(folder).about["rig"] == {"name": "bench"}
    assert len((folder / "events.jsonl").read_text().splitlines()) == 2


def test_a_damaged_index_is_not_believed(tmp_path: Path) -> None:
    folder = record(tmp_path / "rec")
    data = bytearray((folder / INDEX).read_bytes())
    data[40] ^= 1
    (folder / INDEX).write_bytes(data)
    assert all(same(a, pair(i)) for i, a in enumerate(open_recording(folder)))
    other = record(tmp_path / "other", 5)
    shutil.copy(other / INDEX, folder / INDEX)
    assert len(open_recording(folder)) == 12


@given(length=st.integers(1, 3000), data=st.data())
@settings(max_examples=60, deadline=None)
def test_a_flipped_bit_is_found_from_the_checksums_alone(length: int, data: st.DataObject) -> None:
    bit = data.draw(st.integers(0, 8 * length - 1))
    original = np.random.default_rng(length).bytes(length)
    flipped = bytearray(original)
    flipped[bit // 8] ^= 1 << bit % 8
    assert flipped_bit(length, zlib.crc32(original), zlib.crc32(flipped)) == bit
    assert flipped_bit(length, zlib.crc32(original), zlib.crc32(original)) is None


def test_every_flipped_bit_is_detected_located_and_mended(tmp_path: Path, rng: np.random.Generator) -> None:
    """Anywhere in the file: in headers, in descriptions, in pixels."""
    folder = record(tmp_path / "rec", 6)
    path = segment_path(folder, 0)
    original = path.read_bytes()
    header_bits = rng.integers(0, 8 * HEADER.size, 6)
    for bit in (*header_bits, *rng.integers(0, 8 * len(original), 30), 8 * len(original) - 1):
        damaged = bytearray(original)
        damaged[bit // 8] ^= 1 << int(bit) % 8
        path.write_bytes(damaged)
        verdict = verify(folder)
        assert [each.bit for each in verdict.damage] in ([bit], [None]), verdict
        if verdict.damage[0].bit is None:  # the last header in the file, with nothing after it to go on from
            assert verdict.damage[0].what == "torn"
            continue
        assert f"bit {bit % 8} of byte {bit // 8}" in verdict.damage[0].words
        repair(folder)
        assert path.read_bytes() == original
        assert verify(folder).sound


def test_more_damage_is_located_and_the_rest_is_read(tmp_path: Path) -> None:
    folder = record(tmp_path / "rec", 8)
    hit = open_recording(folder).entry(4)
    with segment_path(folder, 0).open("rb+") as file:
        file.seek(hit.payload + hit.meta_bytes + 20)
        file.write(b"\0" * 64)
    found = open_recording(folder)
    with pytest.raises(ValueError, match=f"bytes {hit.offset} to {hit.end}, record {hit.sequence}"):
        found.read(4)
    assert all(same(found.read(i), pair(i)) for i in (0, 1, 2, 3, 5, 6, 7))
    repair(folder)
    assert verify(folder).damage == verify(folder).damage != []
    with segment_path(folder, 0).open("rb+") as file:  # a header gone: the log goes on at the next record
        file.seek(hit.offset)
        file.write(b"\0" * HEADER.size)
    (folder / INDEX).unlink()
    found = open_recording(folder)
    assert [p.id for p in found] == [0, 1, 2, 3, 5, 6, 7]
    assert [(d.what, d.offset, d.end) for d in found.damage] == [("header", hit.offset, hit.end)]


@pytest.mark.parametrize("rest", ["nothing", "zeros", "half"])
def test_after_a_power_cut_everything_synced_is_there(tmp_path: Path, rest: str) -> None:
    """What was not synced may be missing, zeros, or cut off in the middle of a record."""
    folder = tmp_path / "rec"
    writer = RecordingWriter(folder, sync_s=100)
    for i in range(5):
        writer.write(pair(i))
    while writer.pairs < 5:
        pass
    writer.sync()
    _, synced = writer._log.synced
    for i in range(5, 9):
        writer.write(pair(i))
    writer.close()
    path = segment_path(folder, 0)
    data = path.read_bytes()
    tail = {"nothing": b"", "zeros": bytes(len(data) - synced), "half": data[synced : synced + 100]}[rest]
    path.write_bytes(data[:synced] + tail)
    assert [p.id for p in open_recording(folder)] == list(range(5))
    done = repair(folder)
    assert len(done.before.damage) == (rest != "nothing")
    assert verify(folder).sound
    assert all(same(a, pair(i)) for i, a in enumerate(open_recording(folder)))
    if tail:
        assert (folder / CUT / f"segment-000000-{synced}.bin").read_bytes() == tail


def test_two_writers_and_a_repair_during_a_recording_are_refused(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "rec") as writer:
        writer.write(pair(0))
        with pytest.raises(FileExistsError, match="holds a recording"):
            RecordingWriter(tmp_path / "rec")
        with pytest.raises(LogError, match="is being written"):
            repair(tmp_path / "rec")
    with pytest.raises(LogError, match="closed"):
        writer.write(pair(1))


def test_a_full_disk_keeps_what_is_there(tmp_path: Path) -> None:
    """The system's own limit on the size of files stands in for the disk."""
    script = f"""
        import resource, signal, sys
        from pathlib import Path
        from rainstereo.hardware.recording_writer import RecordingWriter
        from tests.hardware.stamped import pair
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))
        writer = RecordingWriter(Path({str(tmp_path / "rec")!r}))
        try:
            for i in range(200):
                writer.write(pair(i, (40, 60)))
        except OSError as error:
            print(error.errno)
        writer.close()
    """
    root = Path(__file__).resolve().parents[2]
    lines = "\n".join(line[8:] for line in script.splitlines())
    done = subprocess.run([sys.executable, "-c", lines], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "27"
    found = open_recording(tmp_path / "rec")
    assert len(found) >= 3
    assert not found.damage
    assert all(same(a, pair(i, (40, 60))) for i, a in enumerate(found))
    repair(tmp_path / "rec")
    assert verify(tmp_path / "rec").sound


def test_a_backlog_that_is_full_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = RecordingWriter(tmp_path / "rec", backlog=2)
    with writer._log._lock:  # the disk stands still
        taken = [writer.submit(pair(i)) for i in range(2)]
        monkeypatch.setattr(writer, "event", lambda *_, **__: None)
        taken += [writer.submit(pair(i)) for i in range(2, 5)]
    writer.close()
    assert taken == [True, True, False, False, False]
    assert writer.lost == 3
    assert open_recording(tmp_path / "rec").about["lost_by_recorder"] == 3


def test_others_files_are_data(tmp_path: Path) -> None:
    """A record that describes an absurd frame, or none at all, is refused before anything is allocated."""
    folder = record(tmp_path / "rec", 1)
    good = open_recording(folder).meta(0)
    for change in (
        {"dry": {**good["dry"], "shape": [1 << 40, 2]}},
        {"dry": {**good["dry"], "shape": [16384, 16384, 3]}},
        {"dry": {**good["dry"], "bytes": 1 << 50}},
        {"dry": {**good["dry"], "codec": "pickle"}},
        {"wet": None},
        {"id": "7"},
        {"status": "sure"},
    ):
        target = tmp_path / "other"
        shutil.rmtree(target, ignore_errors=True)
        shutil.copytree(folder, target)
        segment_path(target, 0).unlink()
        with segment_log.LogWriter(target, {}) as log:
            log.append(Kind.PAIR, {**good, **change}, b"x" * 100)
        with pytest.raises(ValueError, match=r"pair 0 \(record 1\)"):
            open_recording(target).read(0)
    with pytest.raises(FileNotFoundError, match="no recording"):
        open_recording(tmp_path / "nowhere")
    (folder / "recording.toml").write_text("format = 99\n")
    with pytest.raises(ValueError, match="reads 1"):
        open_recording(folder)


def test_frames_must_be_what_their_format_says(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "rec")
    wrong = CameraFrame(np.zeros((4, 4), np.uint16), 1, pixel_format="Mono8")
    writer.write(PairFrame(1, wrong, wrong))
    while writer.error is None:
        pass
    with pytest.raises(ValueError, match="Mono8 frame is uint16"):
        writer.write(pair(2))
    writer.close()
    assert not open_recording(tmp_path / "rec").damage


def test_toml_says_what_it_was_given() -> None:
    import tomllib

    table = {"a": 1, "b": [0.5, 1e30], "c": {"d": 'quo"te\n', "e f": True, "g": {"h": [], "i": -3}}, "j": None}
    expected = {"a": 1, "b": [0.5, 1e30], "c": {"d": 'quo"te\n', "e f": True, "g": {"h": [], "i": -3}}}
    assert tomllib.loads(toml(table)) == expected


WRITER = """
import os, sys
from pathlib import Path
from rainstereo.hardware.recording_writer import RecordingWriter
from tests.hardware.stamped import pair
folder, number = Path(sys.argv[1]), int(sys.argv[2])
pairs = [pair(i, (60, 80)) for i in range(40)]
os.read(0, 1)
while True:
    writer = RecordingWriter(folder / str(number), sync_s=0.05, segment_bytes=100_000)
    os.write(1, b"r")
    for p in pairs * 50:
        writer.write(p)
    writer.close()
    number += 1
"""


@pytest.mark.slow
def test_killed_at_50_random_moments(tmp_path: Path, rng: np.random.Generator) -> None:
    """Everything is there after `repair`, byte for byte, up to the moment: SIGKILL loses no page that was written."""
    root = Path(__file__).resolve().parents[2]
    waiting: list[tuple[Path, subprocess.Popen[bytes]]] = []
    counts = []

    def start(i: int) -> None:
        folder = tmp_path / str(i)
        folder.mkdir()
        process = subprocess.Popen(
            [sys.executable, "-c", WRITER, str(folder), "0"], cwd=root, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        waiting.append((folder, process))

    start(0)
    for i in range(50):
        if i + 1 < 50:
            start(i + 1)  # loads while the other is killed
        folder, process = waiting.pop(0)
        assert process.stdin is not None
        assert process.stdout is not None
        with process:
            process.stdin.write(b"g")
            process.stdin.flush()
            assert process.stdout.read(1) == b"r"
            try:
                process.wait(float(rng.uniform(0, 0.25)))
            except subprocess.TimeoutExpired:
                process.kill()
            assert process.wait() == -9
        for each in folder.iterdir():
            if not segment_log.segments(each):
                continue
            repair(each)
            verdict = verify(each)
            assert verdict.sound, verdict
            found = open_recording(each)
            ids = [found.read(k).id for k in range(len(found))]
            assert ids == [k % 40 for k in range(len(found))]  # nothing missing in the middle
            assert all(same(found.read(k), pair(ids[k], (60, 80))) for k in range(0, len(found), 7))
            counts.append(len(found))
    assert max(counts) > 20, counts


def test_events_as_text_say_what_the_log_says(tmp_path: Path) -> None:
    folder = record(tmp_path / "rec")
    lines = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    assert [(line["event"], line["host_ns"]) for line in lines] == [
        (event.name, event.host_ns) for event in open_recording(folder).events()
    ]
    assert number_in(open_recording(folder).read(3).wet) == 3
    assert segment_path(folder, 0).stat().st_size > 12 * 400
