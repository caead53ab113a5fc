"""The board's words, corners and picture."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rainstereo.calib.board import Board, aruco_dictionary

CHARUCO = "charuco:31x16:49.33mm:38.46mm:DICT_4X4_1000"


@pytest.mark.parametrize(
    "spec", ["chessboard:9x6:25mm", CHARUCO, "chessboard:9x6:1m", "charuco:8x5:40mm:30mm:DICT_5X5_100"]
)
def test_spec_round_trips(spec: str) -> None:
    assert Board.parse(spec).spec == spec


@given(st.integers(3, 60), st.integers(3, 60), st.floats(1e-6, 1e3))
def test_any_chessboard_round_trips_exactly(columns: int, rows: int, square: float) -> None:
    board = Board("chessboard", columns, rows, square)
    assert Board.parse(board.spec) == board


@given(st.integers(4, 12), st.integers(3, 12), st.floats(1e-4, 10), st.floats(0.1, 0.95))
def test_any_charuco_board_round_trips_exactly(width: int, height: int, square: float, share: float) -> None:
    board = Board("charuco", width - 1, height - 1, square, square * share, "DICT_6X6_250")
    assert Board.parse(board.spec) == board


@pytest.mark.parametrize(
    ("text", "metres"), [("25mm", 0.025), ("2.5cm", 0.025), ("0.025m", 0.025), ("2.5e1mm", 0.025), (".5 m", 0.5)]
)
def test_units(text: str, metres: float) -> None:
    assert Board.parse(f"chessboard:9x6:{text}").square == metres


def test_a_charuco_board_counts_squares_and_a_chessboard_counts_corners() -> None:
    charuco, chessboard = Board.parse(CHARUCO), Board.parse("chessboard:9x6:25mm")
    assert (charuco.columns, charuco.rows, charuco.squares) == (30, 15, (31, 16))
    assert (chessboard.columns, chessboard.rows, chessboard.squares) == (9, 6, (10, 7))
    assert charuco.size == pytest.approx((31 * 0.04933, 16 * 0.04933), rel=1e-15)


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("chessboard:9x6:25", "no unit"),
        ("chessboard:9x6:25in", "'in'"),
        ("chessboard:9x6:wide", "not a number"),
        ("chessboard:9-6:25mm", "'9-6'"),
        ("chessboard:2x6:25mm", "inner corners"),
        ("chessboard:9x6:0mm", "positive"),
        ("chessboard:9x6:1e999m", "positive"),
        ("chessboard:9x6", "1 fields"),
        ("circles:9x6:25mm", "'circles'"),
        ("", "''"),
        ("charuco:31x16:49mm:38mm", "3 fields"),
        ("charuco:31x16:49mm:38mm:DICT_4X4_50", "has only 50"),
        ("charuco:31x16:49mm:38mm:DICT_5X5_100", "DICT_5X5_1000"),
        ("charuco:31x16:38mm:49mm:DICT_4X4_1000", "square's side first"),
        ("charuco:8x5:38mm:29mm:DICT_9X9_10", "DICT_4X4_1000"),
        ("charuco:3x3:38mm:29mm:DICT_4X4_50", "at least 4x3"),
        ("charuco:9999x9999:38mm:29mm:DICT_4X4_50", "at most"),
    ],
)
def test_a_bad_description_is_refused_in_words(spec: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Board.parse(spec)


def test_points_follow_the_definition() -> None:
    board = Board.parse("chessboard:5x4:20mm")
    for row in range(4):
        for column in range(5):
            assert board.points[row, column] == pytest.approx((0.02 * column, 0.02 * row, 0.0), abs=1e-16)
    with pytest.raises(ValueError, match="read-only"):
        board.points[0, 0] = 1.0


def test_points_agree_with_opencv_identities() -> None:
    board = Board.parse("charuco:7x5:30mm:20mm:DICT_4X4_50")
    theirs = board.charuco().getChessboardCorners()  # by identity, from the outer corner of the board
    np.testing.assert_allclose(board.points.reshape(-1, 3) + (0.03, 0.03, 0), theirs, atol=1e-8)


@pytest.mark.parametrize("spec", ["chessboard:9x6:25mm", "charuco:8x6:40mm:30mm:DICT_4X4_50"])
@pytest.mark.parametrize("pixels", [8, 24])
def test_four_squares_meet_exactly_at_each_corner_of_the_texture(spec: str, pixels: int) -> None:
    board = Board.parse(spec)
    image, origin = board.texture(pixels)
    assert image.shape == ((board.rows + 3) * pixels, (board.columns + 3) * pixels)
    for row in range(board.rows):
        for column in range(board.columns):
            x, y = origin + pixels * np.array([column, row])
            assert x % 1 == 0.5
            assert y % 1 == 0.5
            left, top = int(x - 0.5), int(y - 0.5)
            around = image[top : top + 2, left : left + 2]
            up_left = 0 if (row + column) % 2 == 0 else 255
            np.testing.assert_array_equal(around, [[up_left, 255 - up_left], [255 - up_left, up_left]])
    assert (image[: pixels - 1] == 255).all()
    assert (image[:, -pixels + 1 :] == 255).all()


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("shape", ["8x6", "7x5"])
def test_texture_agrees_with_opencv_where_modules_are_whole_texels(shape: str, legacy: bool) -> None:
    board = Board.parse(f"charuco:{shape}:40mm:30mm:DICT_4X4_50")
    width, height = board.squares
    ours, _ = board.texture(24, border=0, legacy=legacy)
    theirs = board.charuco(legacy).generateImage((24 * width, 24 * height), marginSize=0)
    np.testing.assert_array_equal(ours, theirs)


def test_texture_keeps_the_share_of_black_at_any_scale() -> None:
    board = Board.parse("charuco:4x3:49.33mm:38.46mm:DICT_4X4_50")
    bits = [cv2.aruco.generateImageMarker(aruco_dictionary("DICT_4X4_50"), i, 6) == 0 for i in range(6)]
    black = 6 + sum(marker.mean() for marker in bits) * (38.46 / 49.33) ** 2
    for pixels in (9, 37, 100):
        image, _ = board.texture(pixels, border=0)
        assert 1 - image.mean() / 255 == pytest.approx(black / 12, abs=1e-3)


@pytest.mark.parametrize(
    ("pixels", "border", "words"), [(3, 1, "at least 4"), (4.5, 1, "whole"), (8, -1, "border"), (10**6, 1, "fewer")]
)
def test_a_bad_texture_is_refused(pixels: int, border: float, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Board.parse("chessboard:9x6:25mm").texture(pixels, border)


def test_a_chessboard_has_no_markers() -> None:
    with pytest.raises(ValueError, match="no markers"):
        Board.parse("chessboard:9x6:25mm").charuco()
    with pytest.raises(ValueError, match="charuco"):
        Board("chessboard", 9, 6, 0.025, 0.01, "DICT_4X4_50")
    with pytest.raises(ValueError, match="marker side"):
        Board("charuco", 9, 6, 0.025)
