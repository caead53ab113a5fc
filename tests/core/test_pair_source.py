"""Sources of pairs: layouts of folders, times that are not what they should be, videos."""

import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo import timestamps
from rainstereo.hardware.recording_writer import RecordingWriter
from rainstereo.pair_source import BadPairError, FilePairs, open_source
from rainstereo.recording_pairs import RecordingPairs
from rainstereo.video_pairs import VideoPairs
from tests.hardware.stamped import number_in, pair

START = 1_535_202_904_410_922


def images(folder: Path, names: list[str]) -> Path:
    folder.mkdir(parents=True)
    for i, name in enumerate(names):
        cv2.imwrite(str(folder / f"{name}.png"), np.full((6, 8), i, np.uint8))
    return folder


def names(source: object) -> list[str]:
    assert isinstance(source, FilePairs)
    return [moment.name for moment in source.moments]


def test_robotcar_folders_pair_by_time_within_a_tolerance(tmp_path: Path) -> None:
    dry = images(tmp_path / "run1" / "stereo_right", [str(START + t) for t in (0, 62_500, 125_000, 187_500)])
    wet = images(tmp_path / "run1" / "stereo_left", [str(START + t) for t in (300, 62_400, 140_000, 187_500, 250_000)])
    source = open_source(str(dry), str(wet), sync_us=5000)
    assert names(source) == [str(START + t) for t in (0, 62_500, 187_500)]
    first = source.moment(0)
    assert (first.timestamp_us, first.drive, first.sync_us) == (START, "run1", 300.0)
    assert source.moment(1).sync_us == -100
    reasons = {Path(file).stem: reason for file, reason in source.leftovers}
    assert reasons == {
        str(START + 125_000): "has no wet image within 5 ms",
        str(START + 140_000): "has no dry image within 5 ms",
        str(START + 250_000): "has no dry image within 5 ms",
    }
    assert len(open_source(str(dry), str(wet), sync_us=20_000)) == 4
    _, a, b = source.read(2)
    assert (a[0, 0], b[0, 0]) == (3, 3)


def test_a_robotcar_list_is_held_against_the_images(tmp_path: Path) -> None:
    dry = images(tmp_path / "dry", [str(START + t) for t in (0, 100_000, 200_000)])
    wet = images(tmp_path / "wet", [str(START + t) for t in (0, 100_000, 200_000)])
    lines = [START, START + 100_000, START + 100_000, START + 50_000, START + 300_000]
    (tmp_path / "dry.timestamps").write_text("".join(f"{t} 1\n" for t in lines) + "oops 1\n")
    source = open_source(str(dry), str(wet))
    assert len(source) == 3
    found = {(Path(file).name, reason) for file, reason in source.leftovers}
    assert ("dry.timestamps:3", f"repeats the time {START + 100_000}") in found
    assert ("dry.timestamps:4", "goes back in time by 50000 us") in found
    assert ("dry.timestamps:5", f"there is no image {START + 300_000}") in found
    assert ("dry.timestamps:6", "'oops' is no timestamp in microseconds") in found
    assert (f"{START + 200_000}.png", "is not in dry.timestamps") in found


def test_kitti_folders_carry_their_times(tmp_path: Path) -> None:
    for camera, late in (("image_02", 0), ("image_03", 1)):
        images(tmp_path / "drive_0005" / camera / "data", [f"{i:010d}" for i in range(4)])
        stamps = [f"2011-09-26 13:02:{25 + i}.96{4 + late}389445" for i in range(3)]
        if late:
            stamps[1] = "2011-09-26 13:02:26.999000000"  # 35 ms late
        (tmp_path / "drive_0005" / camera / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    folder = tmp_path / "drive_0005"
    source = open_source(str(folder / "image_02"), str(folder / "image_03"))
    assert names(source) == ["0000000000", "0000000002", "0000000003"]
    assert source.moment(0).timestamp_us == timestamps.clock_us("2011-09-26 13:02:25.964389445") == 1317042145964389
    assert source.moment(0).sync_us == 1000
    assert source.moment(2).timestamp_us is None
    assert source.moment(0).drive == "drive_0005"
    found = {Path(file).name: reason for file, reason in source.leftovers}
    assert found["0000000001.png"] == "the cameras are 34.6 ms apart; at most 5 were allowed"
    assert found["0000000003.png"] == "has no time in line 4 of timestamps.txt"


@settings(max_examples=80, deadline=None)
@given(st.lists(st.integers(0, 400), max_size=12), st.lists(st.integers(0, 400), max_size=12), st.integers(0, 60))
def test_nearest_pairs_are_mutual_close_and_unique(dry: list[int], wet: list[int], most: int) -> None:
    """Against brute force over all pairs."""
    pairs = timestamps.nearest(dry, wet, most)
    assert len({i for i, _ in pairs}) == len({j for _, j in pairs}) == len(pairs)
    for i, j in pairs:
        gap = abs(dry[i] - wet[j])
        assert gap <= most
        assert gap == min(abs(dry[i] - w) for w in wet) == min(abs(d - wet[j]) for d in dry)
    taken_d, taken_w = {dry[i] for i, _ in pairs}, {wet[j] for _, j in pairs}
    for d in set(dry) - taken_d:
        for w in set(wet) - taken_w:
            nearer = any(abs(d - v) <= abs(d - w) for v in set(wet) - {w}) or any(
                abs(e - w) <= abs(d - w) for e in set(dry) - {d}
            )
            assert abs(d - w) > most or nearer


def test_what_cannot_be_read_is_named(tmp_path: Path) -> None:
    dry, wet = images(tmp_path / "dry", ["a", "b"]), images(tmp_path / "wet", ["a", "b"])
    (wet / "b.png").write_bytes(b"")
    source = open_source(str(dry), str(wet))
    before = source.stamp(0)
    with pytest.raises(BadPairError, match="zero bytes") as caught:
        source.read(1)
    assert caught.value.file == str(wet / "b.png")
    cv2.imwrite(str(dry / "a.png"), np.zeros((60, 80), np.uint8))
    assert source.stamp(0) != before


def video(path: Path, frames: int, fps: float = 16.0) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), fps, (64, 48))
    for i in range(frames):
        writer.write(np.full((48, 64, 3), 20 * i, np.uint8))
    writer.release()
    return path


def test_videos_run_in_step_and_read_in_any_order(tmp_path: Path) -> None:
    dry, wet = video(tmp_path / "dry.avi", 9), video(tmp_path / "wet.avi", 7)
    source = open_source(str(dry), str(wet))
    assert isinstance(source, VideoPairs)
    assert len(source) == 7
    assert source.leftovers == ((str(dry), "has 9 frames, the other video 7"),)
    for i in (2, 3, 6, 0, 5):
        moment, a, b = pickle.loads(pickle.dumps(source)).read(i) if i == 6 else source.read(i)  # noqa: S301 - our own bytes
        assert (moment.name, moment.timestamp_us) == (f"{i:06d}", round(i * 1e6 / 16))
        assert abs(int(a.mean()) - 20 * i) < 4
        assert abs(int(b.mean()) - 20 * i) < 4
    source.close()
    with pytest.raises(ValueError, match="one is a video and the other is not"):
        open_source(str(dry), str(tmp_path))
    with pytest.raises(ValueError, match="frames are no pairs"):
        open_source(str(dry), str(video(tmp_path / "slow.avi", 7, 8.0)))


def test_a_recording_of_ours_is_a_source(tmp_path: Path) -> None:
    folder = tmp_path / "rec"
    with RecordingWriter(folder, {}) as writer:
        for i in range(5):
            writer.write(pair(i))
    source = pickle.loads(pickle.dumps(open_source(str(folder), str(folder), drive="monday")))  # noqa: S301 - our own bytes
    assert isinstance(source, RecordingPairs)
    assert (len(source), source.leftovers) == (5, ())
    for i in (3, 0):
        moment, dry, wet = source.read(i)
        assert number_in(dry) == number_in(wet) == i
        when = (1_000_000_000 + i * 62_500_000) // 1000
        assert moment == source.moment(i)
        assert (moment.name, moment.timestamp_us, moment.drive) == (f"{i:06d}", when, "monday")
        assert (moment.regime, moment.sync_us) == ("mist", 13.0)
    segment = max(folder.iterdir(), key=lambda path: path.stat().st_size)
    data = bytearray(segment.read_bytes())
    data[len(data) // 2] ^= 4
    segment.write_bytes(data)
    broken = open_source(str(folder), str(folder))
    bad = []
    for i in range(len(broken)):
        try:
            broken.read(i)
        except BadPairError as error:
            bad.append(error.file)
    assert 1 <= len(bad) + len(broken.leftovers) <= 2
    with pytest.raises(ValueError, match="a recording holds both cameras"):
        open_source(str(folder), str(tmp_path))
