"""Corners found against corners known: boards are drawn through a homography, so the truth is exact."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from rainstereo import imagefile
from rainstereo.calib import charuco, chessboard, corners, saddles
from rainstereo.calib.board import Board
from rainstereo.types import Array, Image

CHESSBOARD = Board.parse("chessboard:9x6:25mm")
CHARUCO = Board.parse("charuco:10x7:25mm:18mm:DICT_4X4_50")
SIZE = (640, 480)
SUPERSAMPLING = 4


def homography(board: Board, angle_deg: float = 0.0, tilt: float = 0.15, fill: float = 0.62) -> Array:
    """Board metres to image pixels: centred, turned in the image by an angle, tilted so that parallels meet."""
    centre = board.points.reshape(-1, 3)[:, :2].mean(axis=0)
    scale = fill * SIZE[0] / (board.square * (board.columns + 1))
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    tilted = np.array([[1, 0.03, 0], [0.02, 1, 0], [tilt / 300, 0.6 * tilt / 300, 1]])
    move = np.array([[1, 0, SIZE[0] / 2 - 0.3], [0, 1, SIZE[1] / 2 + 0.2], [0, 0, 1]])
    return (
        move
        @ tilted
        @ turn
        @ np.diag([scale, scale, 1])
        @ np.array([[1, 0, -centre[0]], [0, 1, -centre[1]], [0, 0, 1]])
    )


def through(H: Array, points: Array) -> Array:
    """Points (..., 2 or 3) of the board plane in the image, (..., 2)."""
    plane = np.concatenate([points[..., :2], np.ones((*points.shape[:-1], 1))], axis=-1) @ H.T
    return plane[..., :2] / plane[..., 2:]


def render(board: Board, H: Array, *, blur: float = 0.5, noise: float = 0.0, legacy: bool = False) -> Image:
    """Image of the board on gray, each pixel the mean over its area, then blurred by the lens and noisy."""
    n, s = 80, SUPERSAMPLING
    texture, origin = board.texture(n, legacy=legacy)
    to_board = np.array([[1, 0, -origin[0]], [0, 1, -origin[1]], [0, 0, n / board.square]])
    enlarge = np.array([[s, 0, (s - 1) / 2], [0, s, (s - 1) / 2], [0, 0, 1]])
    fine = cv2.warpPerspective(
        texture.astype(np.float32), enlarge @ H @ to_board, (SIZE[0] * s, SIZE[1] * s), borderValue=110.0
    )
    image = cv2.resize(fine, SIZE, interpolation=cv2.INTER_AREA)
    image = cv2.GaussianBlur(image, (0, 0), blur) * 0.75 + 25
    image += np.random.default_rng(7).normal(0, noise, image.shape) if noise else 0.0
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def rms(found: Array, truth: Array) -> float:
    seen = np.isfinite(found[..., 0])
    return float(np.sqrt(np.mean((found[seen] - truth[seen]) ** 2)))


@pytest.mark.parametrize("angle", [0, 20, -35, 90, 155])
def test_chessboard_corners_are_where_they_were_drawn(angle: float) -> None:
    H = homography(CHESSBOARD, angle)
    truth = through(H, CHESSBOARD.points)
    detection = corners.detect(render(CHESSBOARD, H), CHESSBOARD)
    assert detection, detection.reason
    assert np.isfinite(detection.xy).all()
    assert rms(detection.xy, truth) < 0.02  # and in this very order: nine by six tells its ends apart


@pytest.mark.parametrize("angle", [0, 20, -35, 90, 155])
def test_charuco_corners_are_where_they_were_drawn(angle: float) -> None:
    H = homography(CHARUCO, angle)
    detection = corners.detect(render(CHARUCO, H), CHARUCO)
    assert detection, detection.reason
    assert np.isfinite(detection.xy[..., 0]).sum() >= 53
    assert rms(detection.xy, through(H, CHARUCO.points)) < 0.035  # the white rim leaves a smaller window


@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO], ids=["chessboard", "charuco"])
def test_an_ordinary_lens_leaves_less(board: Board) -> None:
    H = homography(board, 0)
    assert rms(corners.detect(render(board, H, blur=0.8), board).xy, through(H, board.points)) < 0.025


@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO], ids=["chessboard", "charuco"])
@pytest.mark.parametrize(("blur", "noise", "limit"), [(0.5, 2.0, 0.05), (1.5, 2.0, 0.08), (2.0, 4.0, 0.15)])
def test_blur_and_noise(board: Board, blur: float, noise: float, limit: float) -> None:
    H = homography(board, 12)
    detection = corners.detect(render(board, H, blur=blur, noise=noise), board)
    assert detection, detection.reason
    assert np.isfinite(detection.xy[..., 0]).mean() > 0.95
    assert rms(detection.xy, through(H, board.points)) < limit


@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO], ids=["chessboard", "charuco"])
def test_other_pixel_types_give_the_same_corners(board: Board) -> None:
    image = render(board, homography(board, 5))
    reference = corners.detect(image, board).xy
    colour = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    np.testing.assert_array_equal(corners.detect(colour, board).xy, reference)
    np.testing.assert_array_equal(corners.detect(cv2.cvtColor(image, cv2.COLOR_GRAY2BGRA), board).xy, reference)
    deep = image.astype(np.uint16) * 16  # twelve bits in sixteen
    np.testing.assert_allclose(corners.detect(deep, board).xy, reference, atol=0.01)


def test_detection_changes_neither_its_input_nor_its_answer() -> None:
    image = render(CHESSBOARD, homography(CHESSBOARD, 5))
    before = image.copy()
    first = corners.detect(image, CHESSBOARD).xy
    cv2.setRNGSeed(12345)
    np.testing.assert_array_equal(corners.detect(image[:, :], CHESSBOARD).xy, first)
    np.testing.assert_array_equal(image, before)


def test_a_large_image_is_searched_small_but_measured_whole() -> None:
    H = homography(CHESSBOARD, 8)
    large = cv2.resize(render(CHESSBOARD, H), None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    detection = corners.detect(large, CHESSBOARD)
    assert detection, detection.reason
    truth = 4 * (through(H, CHESSBOARD.points) + 0.5) - 0.5  # integer pixel = centre, in both sizes
    assert rms(detection.xy, truth) < 0.12


@pytest.mark.parametrize(
    ("asked", "printed"),
    [("6x5", "9x6"), ("8x6", "9x6"), ("9x5", "9x6"), ("9x6", "5x3"), ("9x6", "10x7"), ("9x6", "8x6")],
)
def test_the_wrong_shape_is_refused_and_the_right_one_named(asked: str, printed: str) -> None:
    shown = Board.parse(f"chessboard:{printed}:25mm")
    image = render(shown, homography(shown, 10))
    detection = corners.detect(image, Board.parse(f"chessboard:{asked}:25mm"), diagnose=True)
    assert not detection
    assert np.isnan(detection.xy).all()
    assert f"a chessboard of {printed} inner corners" in detection.reason
    assert detection.seen == f"a chessboard of {printed} inner corners"


@pytest.mark.parametrize("side", [1, -1], ids=["first columns", "last columns"])
def test_a_part_that_a_search_found_is_seen_to_go_on(side: int) -> None:
    H = homography(CHESSBOARD, 7)
    fine = render(CHESSBOARD, H).astype(np.float32)
    part = through(H, CHESSBOARD.points)[1:5, ::side][:, :5]
    assert chessboard.extent(fine, part) == (9, 6)
    assert chessboard.extent(fine, through(H, CHESSBOARD.points)) == (9, 6)


def test_a_search_that_steps_over_rows_is_not_believed() -> None:
    H = homography(CHESSBOARD, 7)
    fine = render(CHESSBOARD, H).astype(np.float32)
    truth = through(H, CHESSBOARD.points)
    assert chessboard.checkered(fine, truth)
    assert not chessboard.checkered(fine, truth[::2])
    askew = np.stack([truth[2 * row, row : row + 6] for row in range(3)])  # down two and right one alternates too
    assert not chessboard.checkered(fine, askew)


def test_a_transposed_description_is_the_same_board() -> None:
    H = homography(CHESSBOARD, 0)
    detection = corners.detect(render(CHESSBOARD, H), Board.parse("chessboard:6x9:25mm"))
    assert detection, detection.reason
    assert detection.xy.shape == (9, 6, 2)
    du, dv = detection.xy[0, 1] - detection.xy[0, 0], detection.xy[1, 0] - detection.xy[0, 0]
    assert du[0] * dv[1] - du[1] * dv[0] > 0


@pytest.mark.parametrize(("angle", "spec"), [(0, "8x6"), (100, "8x6"), (180, "8x6"), (-60, "7x7"), (0, "6x6")])
def test_a_board_that_looks_the_same_turned_around_starts_upright(angle: float, spec: str) -> None:
    board = Board.parse(f"chessboard:{spec}:25mm")
    H = homography(board, angle, fill=0.5)
    truth = through(H, board.points)
    detection = corners.detect(render(board, H), board)
    assert detection, detection.reason
    errors = [rms(detection.xy, order) for order in corners.indistinguishable(truth, board)]
    assert min(errors) < 0.03
    assert detection.xy[0, -1, 0] > detection.xy[0, 0, 0]  # the columns run to the right
    assert len(errors) == {"8x6": 2, "7x7": 2, "6x6": 4}[spec]
    assert not corners.decided_by_colour(board)


def test_a_hidden_corner_never_gives_a_plausible_answer() -> None:
    H = homography(CHESSBOARD, 7)
    image = render(CHESSBOARD, H)
    truth = through(H, CHESSBOARD.points)
    for row, column in ((0, 0), (3, 4)):
        hidden = image.copy()
        x, y = truth[row, column].astype(int)
        cv2.circle(hidden, (int(x), int(y)), 22, 128, -1)
        detection = corners.detect(hidden, CHESSBOARD)
        assert not detection or np.isnan(detection.xy[row, column]).all()
        assert not detection or rms(detection.xy, truth) < 0.1


def test_a_part_of_a_charuco_board_is_enough() -> None:
    H = np.array([[1, 0, 260], [0, 1, -120], [0, 0, 1]]) @ homography(CHARUCO, 15, fill=1.1)
    truth = through(H, CHARUCO.points)
    image = render(CHARUCO, H)
    cv2.rectangle(image, (250, 150), (420, 280), 200, -1)
    detection = corners.detect(image, CHARUCO)
    assert detection, detection.reason
    seen = np.isfinite(detection.xy[..., 0])
    hidden = ((truth > (250, 150)) & (truth < (420, 280))).all(axis=-1)
    assert hidden.sum() >= 3
    assert not (seen & hidden).any()
    assert 10 <= seen.sum() < 54
    assert rms(detection.xy, truth) < 0.05


@pytest.mark.parametrize("legacy", [False, True])
def test_both_layouts_of_a_charuco_board_are_recognised(legacy: bool) -> None:
    board = Board.parse("charuco:9x6:25mm:18mm:DICT_4X4_50")
    H = homography(board, 10)
    image = render(board, H, legacy=legacy)
    detection = corners.detect(image, board)
    assert detection, detection.reason
    assert detection.legacy is legacy
    assert rms(detection.xy, through(H, board.points)) < 0.035
    np.testing.assert_array_equal(corners.detect(image, board, legacy=legacy).xy, detection.xy)
    assert detection.other is not None  # numbered the other way: a column less, each corner one column aside
    left, right = (detection, detection.other) if legacy else (detection.other, detection)
    assert np.nanmax(np.abs(left.xy[:, :-1] - right.xy[:, 1:])) < 0.05
    np.testing.assert_array_equal(corners.detect(image, board, legacy=not legacy).xy, detection.other.xy)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ("charuco:10x7:25mm:18mm:DICT_5X5_50", "markers of DICT_4X4_1000"),
        ("charuco:12x9:25mm:18mm:DICT_4X4_100", "another board|corners are seen"),
        ("charuco:5x4:25mm:18mm:DICT_4X4_50", "another board|corners are seen"),
        ("chessboard:7x5:25mm", "markers of DICT_4X4_1000"),
    ],
)
def test_another_charuco_board_is_refused_and_named(asked: str, words: str) -> None:
    image = render(CHARUCO, homography(CHARUCO, 10))
    detection = corners.detect(image, Board.parse(asked), diagnose=True)
    assert not detection
    assert any(word in detection.reason for word in words.split("|")), detection.reason


def test_markers_in_the_wrong_place_are_outvoted() -> None:
    H = homography(CHARUCO, 10)
    truth = through(H, CHARUCO.points)
    identities, quads = charuco.find_markers(render(CHARUCO, H), CHARUCO)
    identities[[3, 17]] = identities[[17, 3]]
    on_board = np.array(CHARUCO.charuco().getObjPoints())[identities][..., :2] / CHARUCO.square - 1
    agree = charuco.consistent(on_board, quads, np.ones(len(quads), dtype=bool))
    np.testing.assert_array_equal(np.flatnonzero(~agree), [3, 17])
    guess = charuco.from_markers(CHARUCO, on_board[agree], quads[agree])
    assert np.nanmax(np.abs(guess - truth)) < 2.5


def test_an_image_without_a_board() -> None:
    flat = np.full((480, 640), 128, np.uint8)
    clutter = np.random.default_rng(1).integers(0, 255, (480, 640)).astype(np.uint8)
    for board in (CHESSBOARD, CHARUCO):
        for image in (flat, cv2.GaussianBlur(clutter, (0, 0), 3)):
            detection = corners.detect(image, board, diagnose=True)
            assert not detection
            assert detection.seen == ""
            assert "no other board" in detection.reason


@pytest.mark.parametrize(
    "image", [np.zeros((4, 5)), np.zeros((4, 5, 2), np.uint8), np.zeros(7, np.uint8), np.zeros((0, 5), np.uint8)]
)
def test_what_is_not_an_image_is_refused(image: Image) -> None:
    with pytest.raises(ValueError, match=r"shape|channels"):
        corners.detect(image, CHESSBOARD)


def test_gray_between_pixels_is_bilinear(rng: np.random.Generator) -> None:
    plane = (2.0 * np.arange(7) + 3.0 * np.arange(5)[:, None]).astype(np.float32)
    xy = rng.uniform((0, 0), (6, 4), (20, 2))
    np.testing.assert_allclose(saddles.sample(plane, xy), 2 * xy[:, 0] + 3 * xy[:, 1], rtol=1e-12)
    edges = np.array([[0.0, 0], [6, 4], [6.01, 1], [-0.01, 1], [1, 4.01], [np.nan, 1]])
    np.testing.assert_allclose(saddles.sample(plane, edges), [0, 24, *[np.nan] * 4], rtol=1e-12)


@pytest.mark.parametrize(
    ("folder", "spec", "images", "least"),
    [
        ("opencv_chess_640x480", "chessboard:9x6:25mm", ["left04.jpg", "left05.jpg", "right01.jpg", "left13.jpg"], 54),
        ("stereopi_wide_640x480", "chessboard:9x6:25mm", ["left_01.png", "right_09.png", "right_23.png"], 54),
        (
            "charuco_wide_1280x800",
            "charuco:31x16:49.33mm:38.46mm:DICT_4X4_1000",
            ["left_p2_7.png", "right_p5_15.png"],
            290,
        ),
    ],
)
def test_real_boards(shared_data: Path, folder: str, spec: str, images: list[str], least: int) -> None:
    board = Board.parse(spec)
    for name in images:
        image = imagefile.read(shared_data / "calib" / folder / name, gray=True)
        detection = corners.detect(image, board)
        assert detection, f"{name}: {detection.reason}"
        assert np.isfinite(detection.xy[..., 0]).sum() >= least
        smooth = np.diff(detection.xy, n=3, axis=1)
        assert np.nanmedian(np.abs(smooth)) < 0.4  # equal steps through a lens: third differences are noise


def test_real_boards_of_another_shape(shared_data: Path) -> None:
    folder = shared_data / "calib" / "opencv_chess_640x480"
    for name in ("left01.jpg", "left13.jpg"):
        image = imagefile.read(folder / name, gray=True)
        for asked in ("6x5", "8x6", "10x7"):
            assert not corners.detect(image, Board.parse(f"chessboard:{asked}:1m")), f"{name} {asked}"
