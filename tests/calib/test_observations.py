"""From files to a table: pairing by name, refusals by name, one order for both cameras."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rainstereo.calib import board_search, corners
from rainstereo.calib.board import Board
from rainstereo.calib.detection import Detection
from rainstereo.calib.observations import Observations
from rainstereo.calib.rejection import NotEnoughData, Rejection
from rainstereo.types import Array, Image

BOARD = Board.parse("chessboard:9x6:25mm")
SYMMETRIC = Board.parse("chessboard:8x6:25mm")
SIZE = {"dry": (400, 300), "wet": (360, 270)}


def view(board: Board, role: str, frame: int) -> tuple[Image, Array]:
    """Image of a board in one of many places, the wet camera's aside of the dry one's, and its true corners."""
    rng = np.random.default_rng(frame)
    width, height = SIZE[role]
    n = 24
    texture, origin = board.texture(n)
    scale = rng.uniform(0.75, 0.95) * width / texture.shape[1]
    angle = np.deg2rad(rng.uniform(-12, 12))
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    x, y = width / 2 + rng.uniform(-12, 12) - (5 if role == "wet" else 0), height / 2 + rng.uniform(-10, 10)
    H = np.array([[c, -s, x], [s, c, y], [rng.uniform(-2e-4, 2e-4), rng.uniform(-2e-4, 2e-4), 1]])
    H = H @ np.array([[1, 0, -texture.shape[1] / 2], [0, 1, -texture.shape[0] / 2], [0, 0, 1]])
    image = cv2.warpPerspective(texture, H, (width, height), flags=cv2.INTER_AREA, borderValue=120)
    lattice = origin + n * np.stack(np.meshgrid(np.arange(board.columns), np.arange(board.rows)), axis=-1)
    truth = cv2.perspectiveTransform(lattice.reshape(-1, 1, 2), H).reshape(board.rows, board.columns, 2)
    return cv2.GaussianBlur(image, (0, 0), 0.8), truth


def write(folder: Path, board: Board, frames: int, pattern: str = "{role}/{frame:02d}.png") -> None:
    for frame in range(frames):
        for role in ("dry", "wet"):
            path = folder / pattern.format(role=role, frame=frame, side={"dry": "left", "wet": "right"}[role])
            path.parent.mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(path), view(board, role, frame)[0])


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recording")
    write(folder, BOARD, 5)
    return folder


@pytest.fixture
def folders(recording: Path, tmp_path: Path) -> Path:
    """A copy that a test may spoil."""
    shutil.copytree(recording, tmp_path / "copy")
    return tmp_path / "copy"


def reasons(rejected: tuple[Rejection, ...]) -> dict[tuple[str, str], str]:
    return {(rejection.role, rejection.name): rejection.reason for rejection in rejected}


def test_all_pairs_are_found_where_they_are(recording: Path) -> None:
    done: list[tuple[int, int]] = []
    seen = Observations.from_folders(
        recording / "dry", recording / "wet", BOARD, progress=lambda i, n: done.append((i, n))
    )
    assert done == [(i, 10) for i in range(1, 11)]
    assert seen.names == ("00", "01", "02", "03", "04")
    assert seen.imagersize == SIZE
    assert seen.rejected == ()
    assert seen.paired.all()
    for role in ("dry", "wet"):
        assert seen.counts(role).tolist() == [54] * 5
        for frame in range(5):
            assert np.abs(seen.xy(role)[frame] - view(BOARD, role, frame)[1]).max() < 0.15
    assert [Path(dry).name for dry, _ in seen.files] == ["00.png", "01.png", "02.png", "03.png", "04.png"]


def test_one_worker_and_several_give_the_same(recording: Path) -> None:
    threads = cv2.getNumThreads()
    several = Observations.from_folders(recording / "dry", recording / "wet", BOARD, workers=3)
    one = Observations.from_folders(recording / "dry", recording / "wet", BOARD, workers=1)
    np.testing.assert_array_equal(several.dry, one.dry)
    np.testing.assert_array_equal(several.wet, one.wet)
    assert cv2.getNumThreads() == threads


def test_bad_files_are_named_and_the_rest_is_used(folders: Path) -> None:
    (folders / "dry" / "00.png").write_bytes(b"")
    whole = (folders / "wet" / "01.png").read_bytes()
    (folders / "wet" / "01.png").write_bytes(whole[: len(whole) // 2])
    (folders / "dry" / "05.png").write_bytes(whole)
    (folders / "dry" / "notes.txt").write_text("not an image, not looked at")
    seen = Observations.from_folders(folders / "dry", folders / "wet", BOARD)
    why = reasons(seen.rejected)
    assert why["dry", "00.png"] == "zero bytes"
    assert why["wet", "01.png"].startswith("truncated")
    assert why["dry", "05.png"] == "has no partner among the 5 wet images"
    assert len(why) == 3
    assert seen.names == ("00", "01", "02", "03", "04")
    assert seen.paired.tolist() == [False, False, True, True, True]
    assert np.isnan(seen.dry[0]).all()
    assert seen.counts("wet").tolist() == [54, 0, 54, 54, 54]


def test_the_odd_size_is_refused(folders: Path) -> None:
    small = cv2.resize(view(BOARD, "wet", 2)[0], (320, 240), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(folders / "wet" / "02.png"), small)
    seen = Observations.from_folders(folders / "dry", folders / "wet", BOARD)
    assert reasons(seen.rejected) == {("wet", "02.png"): "is 320x240 where most wet images are 360x270"}
    assert seen.imagersize == SIZE
    assert seen.paired.tolist() == [True, True, False, True, True]


def test_too_few_pairs_are_refused_file_by_file(folders: Path) -> None:
    for frame in range(3):
        (folders / "dry" / f"{frame:02d}.png").write_bytes(b"GIF89a")
    with pytest.raises(NotEnoughData, match=r"only 2 of 5 pairs") as refused:
        Observations.from_folders(folders / "dry", folders / "wet", BOARD)
    message = str(refused.value)
    for frame in range(3):
        assert f"dry {frame:02d}.png: not an image, or a damaged one" in message
    assert "Remedy: check" in message
    assert len(refused.value.rejected) == 3


def test_no_board_in_one_camera_says_which(folders: Path) -> None:
    for frame in range(5):
        cv2.imwrite(str(folders / "wet" / f"{frame:02d}.png"), np.full(SIZE["wet"][::-1], 90, np.uint8))
    with pytest.raises(NotEnoughData, match="no wet image shows the board chessboard:9x6:25mm"):
        Observations.from_folders(folders / "dry", folders / "wet", BOARD)


@pytest.mark.parametrize("frames", [4, 6])
@pytest.mark.parametrize(("asked", "printed"), [("6x5", "9x6"), ("9x6", "5x3")])
def test_the_wrong_shape_is_refused_with_the_right_one(tmp_path: Path, asked: str, printed: str, frames: int) -> None:
    write(tmp_path, Board.parse(f"chessboard:{printed}:25mm"), frames)
    with pytest.raises(NotEnoughData, match=f"images show a chessboard of {printed} inner corners; if that is your"):
        Observations.from_folders(tmp_path / "dry", tmp_path / "wet", Board.parse(f"chessboard:{asked}:25mm"))


def test_empty_and_missing_folders(tmp_path: Path, recording: Path) -> None:
    with pytest.raises(FileNotFoundError, match="there is no wet image"):
        Observations.from_folders(recording / "dry", tmp_path, BOARD)
    with pytest.raises(FileNotFoundError, match="does not exist"):
        Observations.from_folders(tmp_path / "nowhere", recording / "wet", BOARD)
    with pytest.raises(FileNotFoundError, match="there is no dry image"):
        Observations.from_folders(f"{tmp_path}/*.png", recording / "wet", BOARD)
    with pytest.raises(ValueError, match="the same images were given"):
        Observations.from_folders(recording / "dry", recording / "dry", BOARD)


@pytest.mark.parametrize(
    ("dry", "wet"), [("run/wet", "run/dry"), ("a/wet*.png", "a/dry*.png"), ("x_wet_y", "x_dry_y"), ("WET", "Dry")]
)
def test_swapped_cameras_are_noticed(tmp_path: Path, dry: str, wet: str) -> None:
    with pytest.raises(ValueError, match="swapped"):
        Observations.from_folders(tmp_path / dry, tmp_path / wet, BOARD)


@pytest.mark.parametrize(
    ("dry", "wet"),
    [
        ("wet_rig/dry", "wet_rig/wet"),
        ("laundry", "wetland"),
        ("wet/left", "wet/right"),
        ("wet_dry/left", "dry_wet/right"),
    ],
)
def test_unsuspicious_names_are_not_taken_for_swapped(tmp_path: Path, dry: str, wet: str) -> None:
    with pytest.raises(FileNotFoundError, match="does not exist"):
        Observations.from_folders(tmp_path / dry, tmp_path / wet, BOARD)


def test_one_folder_with_two_globs(tmp_path: Path) -> None:
    write(tmp_path, BOARD, 3, "{side}{frame:02d}.png")
    seen = Observations.from_folders(f"{tmp_path}/left*.png", f"{tmp_path}/right*.png", BOARD)
    assert seen.names == ("00", "01", "02")
    assert seen.paired.all()
    with pytest.raises(NotEnoughData, match="no dry image has a wet partner"):
        Observations.from_folders(f"{tmp_path}/left01.png", f"{tmp_path}/right02.png", BOARD)


@given(
    st.integers(-60, 60), st.integers(-60, 60), st.sampled_from([0, 1, 2, 3]), st.sampled_from(["8x6", "7x7", "6x6"])
)
def test_both_cameras_number_a_symmetric_board_alike(dry_deg: int, relative_deg: int, turn: int, spec: str) -> None:
    board = Board.parse(f"chessboard:{spec}:25mm")
    plane = board.points[..., :2] * 1000

    def seen(degrees: float) -> Array:
        a = np.deg2rad(degrees)
        return plane @ np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]]) + 300

    roll = relative_deg / 2  # of the cameras to each other: below 45 degrees
    dry, wet = seen(dry_deg), seen(dry_deg + roll)
    choices = corners.indistinguishable(wet, board)
    chosen = board_search._order_alike(dry, choices[turn % len(choices)], board)[1]
    np.testing.assert_allclose(chosen, wet, atol=1e-9)


def test_flips_are_put_right_on_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path, SYMMETRIC, 3)
    honest = corners.detect

    def flipping(image: Image, board: Board, **options: bool) -> Detection:
        """As a search that starts at either end, by chance: the wet camera's images are the smaller ones."""
        found = honest(image, board, **options)
        turned = found.xy[::-1, ::-1] if image.shape[1] == SIZE["wet"][0] else found.xy
        return Detection(turned, found.reason)

    monkeypatch.setattr(corners, "detect", flipping)
    seen = Observations.from_folders(tmp_path / "dry", tmp_path / "wet", SYMMETRIC)
    for frame in range(3):
        truth = {role: view(SYMMETRIC, role, frame)[1] for role in ("dry", "wet")}
        assert np.abs(seen.dry[frame] - truth["dry"]).max() < 0.2
        assert np.abs(seen.wet[frame] - truth["wet"]).max() < 0.2


def test_one_layout_for_all_charuco_images() -> None:
    board = Board.parse("charuco:5x4:25mm:18mm:DICT_4X4_50")
    narrow, wide = np.full((3, 4, 2), np.nan), np.ones((3, 4, 2))
    narrow[:, :2] = 1.0
    torn = Detection(narrow, legacy=False, other=Detection(narrow + 1, legacy=True))
    plain = Detection(wide, legacy=True, other=Detection(narrow, legacy=False))
    only_modern = Detection(np.where(np.arange(4)[:, None] < 1, narrow, np.nan), legacy=False)
    blind = Detection(np.full((3, 4, 2), np.nan), "zero bytes")
    found = {Path(str(i)): board_search.Found((9, 9), d) for i, d in enumerate((torn, plain, only_modern, blind))}
    agreed = [one.detection for one in board_search._one_layout(found).values()]
    assert board.squares[1] % 2 == 0
    assert [detection.legacy for detection in agreed[:2]] == [True, True]
    np.testing.assert_array_equal(agreed[0].xy, narrow + 1)
    assert "another release" in agreed[2].reason
    assert agreed[3].reason == "zero bytes"


def table(dry: Array, wet: Array) -> Observations:
    names = tuple(f"{i:02d}" for i in range(len(dry)))
    rejected = (Rejection("é.png", "dry", "zero bytes"),)
    return Observations(BOARD, names, dry, wet, {"dry": (400, 300), "wet": (360, 270)}, rejected)


@pytest.fixture
def random_table(rng: np.random.Generator) -> Observations:
    dry, wet = rng.uniform(0, 300, (2, 6, 6, 9, 2))
    dry[2], wet[4, 0, 0, 1] = np.nan, np.inf
    return table(dry, wet)


def test_a_half_known_corner_counts_as_unseen_and_nothing_can_be_written(random_table: Observations) -> None:
    assert random_table.counts("wet").tolist() == [54, 54, 54, 54, 53, 54]
    assert np.isnan(random_table.wet[4, 0, 0]).all()
    with pytest.raises(ValueError, match="read-only"):
        random_table.dry[0] = 0


def test_select_takes_indices_and_masks(random_table: Observations) -> None:
    some = random_table.select([5, 2])
    assert some.names == ("05", "02")
    np.testing.assert_array_equal(some.wet, random_table.wet[[5, 2]])
    assert random_table.select(random_table.paired).names == ("00", "01", "03", "04", "05")
    assert len(random_table.select([])) == 0


def test_save_and_load_round_trip(random_table: Observations, tmp_path: Path) -> None:
    path = tmp_path / "deep" / "corners.npz"
    random_table.save(path)
    again = Observations.load(path)
    np.testing.assert_array_equal(again.dry, random_table.dry)
    np.testing.assert_array_equal(again.wet, random_table.wet)
    assert again.summary() == random_table.summary()
    assert again.board == BOARD
    assert again.rejected == random_table.rejected
    assert json.loads(json.dumps(again.summary()))["rejected"][0]["name"] == "é.png"
    assert [entry.name for entry in path.parent.iterdir()] == ["corners.npz"]


def test_other_files_are_refused(tmp_path: Path) -> None:
    text, pickled, other = tmp_path / "a.npz", tmp_path / "b.npz", tmp_path / "c.npz"
    text.write_text("no zip at all")
    np.savez(pickled, words=np.array([{"format": 1}], dtype=object))
    np.savez(other, x=np.zeros(3))
    for path in (text, pickled, other):
        with pytest.raises(ValueError, match="does not hold observations"):
            Observations.load(path)


def test_bad_tables_are_refused() -> None:
    good = np.zeros((1, 6, 9, 2))
    with pytest.raises(ValueError, match="shape"):
        table(good, np.zeros((2, 6, 9, 2)))
    with pytest.raises(ValueError, match="expected 'dry' and 'wet'"):
        Observations(BOARD, ("a",), good, good, {"dry": (1, 1)})
    with pytest.raises(ValueError, match="expected 'dry' or 'wet'"):
        table(good, good).xy("left")
    with pytest.raises(ValueError, match="pairs of files"):
        Observations(BOARD, ("a",), good, good, {"dry": (1, 1), "wet": (1, 1)}, (), (("a", "b"), ("c", "d")))


def test_near_identical_views_are_grouped(rng: np.random.Generator) -> None:
    places = rng.uniform(0, 300, (3, 6, 9, 2))
    order = [0, 1, 0, 2, 0, 1]
    dry = places[order] + rng.normal(0, 0.3, (6, 6, 9, 2))
    wet = places[order] + 5 + rng.normal(0, 0.3, (6, 6, 9, 2))
    assert table(dry, wet).near_identical() == ((0, 2, 4), (1, 5))
    assert table(dry, wet).near_identical(tolerance_px=1e-6) == ()
    wet[2] += 10  # the same for one camera, not for the other
    dry[4] = np.nan  # compared by the camera that sees both
    assert table(dry, wet).near_identical() == ((0, 4), (1, 5))


def test_corners_are_remembered_by_content(folders: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = tmp_path / "cache"
    first = Observations.from_folders(folders / "dry", folders / "wet", BOARD, cache=cache)
    assert len(list(cache.iterdir())) == 10
    searched = []
    honest = corners.detect

    def counting(image: Image, board: Board, **options: bool) -> Detection:
        searched.append(image.shape)
        return honest(image, board, **options)

    monkeypatch.setattr(corners, "detect", counting)
    (folders / "dry" / "00.png").rename(folders / "dry" / "99.png")
    (folders / "wet" / "00.png").rename(folders / "wet" / "99.png")
    again = Observations.from_folders(folders / "dry", folders / "wet", BOARD, cache=cache)
    assert searched == []
    np.testing.assert_array_equal(np.roll(first.dry, -1, axis=0), again.dry)
    next(iter(sorted(cache.iterdir()))).write_bytes(b"damaged")
    Observations.from_folders(folders / "dry", folders / "wet", BOARD, cache=cache)
    assert len(searched) == 1
    monkeypatch.setattr(corners, "VERSION", corners.VERSION + 1)
    Observations.from_folders(folders / "dry", folders / "wet", BOARD, cache=cache)
    assert len(searched) == 11


@pytest.mark.parametrize(
    ("folder", "suffix", "spec", "pairs", "corners_seen"),
    [
        ("opencv_chess_640x480", "jpg", "chessboard:9x6:1m", 13, 2 * 13 * 54),
        ("stereopi_wide_640x480", "png", "chessboard:9x6:25mm", 25, 2 * 25 * 54),
        ("charuco_wide_1280x800", "png", "charuco:31x16:49.33mm:38.46mm:DICT_4X4_1000", 9, 5400),
    ],
)
def test_real_sets(shared_data: Path, folder: str, suffix: str, spec: str, pairs: int, corners_seen: int) -> None:
    source = shared_data / "calib" / folder
    seen = Observations.from_folders(f"{source}/left*.{suffix}", f"{source}/right*.{suffix}", Board.parse(spec))
    assert len(seen) == pairs
    assert seen.paired.all()
    assert seen.counts("dry").sum() + seen.counts("wet").sum() >= corners_seen
    unpaired = {"stereopi_wide_640x480": [("wet", "right_23.png")]}.get(folder, [])
    assert [(rejection.role, rejection.name) for rejection in seen.rejected] == unpaired
    for frame in range(pairs):
        for axis in (1, 2):  # the same way along columns and rows in both cameras, which are nearly parallel
            dry, wet = (np.nanmean(np.diff(seen.xy(role), axis=axis)[frame], axis=(0, 1)) for role in ("dry", "wet"))
            assert dry @ wet > 0.9 * np.linalg.norm(dry) * np.linalg.norm(wet)
        across, down = (np.nanmean(np.diff(seen.dry, axis=axis)[frame], axis=(0, 1)) for axis in (2, 1))
        assert across[0] * down[1] - across[1] * down[0] > 0
