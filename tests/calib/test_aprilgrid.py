"""AprilGrids: their layout, their corners in images, whole and in part, and calibration on their unequal steps."""

import cv2
import numpy as np
import pytest

from rainstereo.calib import corners
from rainstereo.calib.board import Board
from rainstereo.types import Array, Image

from . import test_corners as rendering

GRID = Board.parse("aprilgrid:5x3:24mm:0.3")
# The first of the family 36h11, as AprilTag publishes them: bits row by row from the upper left, first bit highest.
CODES = [0xD5D628584, 0xD97F18B49, 0xDD280910E, 0xE479E9C98, 0xEBCBCA822, 0xF31DAB3AC, 0x056A5D085, 0x10652E1D4]


def kalibr(columns: int, rows: int, gap: int) -> Array:
    """Kalibr's target in modules, true where black: 10 a tag, tag 0 lower left, y up; built upside down."""
    pitch = 10 + gap
    black = np.zeros((rows * pitch + gap, columns * pitch + gap), bool)  # row 0 is the lowest
    for identity, code in enumerate(CODES[: columns * rows]):
        up, across = divmod(identity, columns)
        x, y = gap + across * pitch, gap + up * pitch
        black[y : y + 10, x : x + 10] = True
        for bit in range(36):
            down, right = divmod(bit, 6)
            black[y + 7 - down, x + 2 + right] = not (code >> (35 - bit)) & 1
    for up in range(rows + 1):
        for across in range(columns + 1):
            black[up * pitch : up * pitch + gap, across * pitch : across * pitch + gap] = True
    return black[::-1]


def test_layout_is_that_of_kalibr() -> None:
    board = Board.parse("aprilgrid:4x2:20mm:0.3")
    image, origin = board.texture(10, border=0)
    assert np.array_equal(image == 0, kalibr(4, 2, 3))
    assert set(np.unique(image)) == {0, 255}
    assert origin == pytest.approx([2.5, 2.5])
    lower_left = [board.points[-1, 0], board.points[-1, 1], board.points[-2, 1], board.points[-2, 0]]
    assert np.allclose(np.diff(lower_left, axis=0)[:, :2], [[0.02, 0], [0, -0.02], [-0.02, 0]])
    assert board.points[0, 2, 0] == pytest.approx(0.026)


def test_tags_are_at_the_corners_that_opencv_reads() -> None:
    """Independent: OpenCV's GridBoard of the same tags; it counts from the upper left, Kalibr from the lower left."""
    image, origin = GRID.texture(200)
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits, parameters.perspectiveRemovePixelPerCell = 2, 8
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36H11)
    detector = cv2.aruco.ArucoDetector(dictionary, parameters)
    quads, identities, _ = detector.detectMarkers(cv2.dilate(image, np.ones((9, 9), np.uint8)))
    assert sorted(np.ravel(identities)) == list(range(15))
    grid = cv2.aruco.GridBoard((5, 3), 1.0, 0.3, dictionary, np.arange(15))
    on_grid, seen = (np.reshape(each, (-1, 2)) for each in (
        grid.matchImagePoints(quads, identities)[0][..., :2], np.concatenate(quads)
    ))  # fmt: skip
    rows = np.round((seen[:, 1] - origin[1]) / 200, 1)
    lower_left = np.argmin(seen[:, 0] - seen[:, 1])
    # half a turn of OpenCV's numbering along y alone: x as it is within a row, rows from below
    assert np.ravel(identities)[lower_left // 4] == 0
    np.testing.assert_allclose(np.unique(on_grid[:, 1].round(3)), np.unique((rows.max() - rows).round(1)), atol=1e-5)
    points = GRID.points[..., :2].reshape(-1, 2) / GRID.square * 200 + origin
    assert np.linalg.norm(seen[:, None] - points, axis=-1).min(1).max() < 8  # the image was thinned by four texels


def test_words_and_bad_descriptions() -> None:
    assert GRID.spec == "aprilgrid:5x3:24mm:0.3"
    assert Board.parse(GRID.spec) == GRID
    assert (GRID.columns, GRID.rows, GRID.shape) == (10, 6, (5, 3))
    assert GRID.size == pytest.approx((0.024 * (5 * 1.3 + 0.3), 0.024 * (3 * 1.3 + 0.3)))
    for spec, words in (("aprilgrid:6x6:88mm", "2 fields"), ("aprilgrid:6x6:88mm:x", "not a number"),
                        ("aprilgrid:6x6:88mm:3", "0.1 to 1"), ("aprilgrid:30x30:8mm:0.3", "587"),
                        ("aprilgrid:1x1:8mm:0.3", "2 to 587")):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            Board.parse(spec)
    with pytest.raises(ValueError, match="an aprilgrid has one"):
        Board("chessboard", 9, 6, 0.02, spacing=0.3)


def view(angle: float) -> tuple[Image, Array]:
    H = rendering.homography(GRID, angle)
    return rendering.render(GRID, H, noise=1.0), rendering.through(H, GRID.points)


@pytest.mark.parametrize("angle", [0, 155])
def test_all_corners_are_found_where_they_were_drawn(angle: float) -> None:
    image, truth = view(angle)
    found = corners.detect(image, GRID)
    assert found, found.reason
    assert np.isfinite(found.xy).all()
    assert rendering.rms(found.xy, truth) < 0.05


def test_a_part_of_the_board_is_enough() -> None:
    image, truth = view(20)
    inside = truth.reshape(-1, 2).mean(0)
    cut = image[:, : int(inside[0])]
    found = corners.detect(cut, GRID)
    assert found, found.reason
    seen = np.isfinite(found.xy[..., 0])
    assert 0.25 < seen.mean() < 0.6
    assert not seen[truth[..., 0] > cut.shape[1]].any()
    assert rendering.rms(found.xy, truth) < 0.05
    image[int(inside[1]) - 40 :, : int(inside[0])] = 110  # a hand over a quarter
    hidden = corners.detect(image, GRID)
    covered = (truth[..., 1] > inside[1] - 36) & (truth[..., 0] < inside[0] - 4)
    assert hidden, hidden.reason
    assert not np.isfinite(hidden.xy[covered]).any()
    assert rendering.rms(hidden.xy, truth) < 0.05


def test_another_grid_and_an_empty_image_are_refused() -> None:
    image, _ = view(20)
    assert "tags" in corners.detect(image, Board.parse("aprilgrid:4x4:24mm:0.3")).reason
    assert "none of the board's 15 tags" in corners.detect(np.full((200, 300), 99, np.uint8), GRID).reason
