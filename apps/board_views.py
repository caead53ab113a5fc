"""Pictures of a calibration board that a camera takes through the chamber, in a room with a brick wall."""

from __future__ import annotations

import math

import cv2
import numpy as np

from rainstereo.apps.photographs import photograph
from rainstereo.calib.board import Board
from rainstereo.drawing import Drawing, render_drawing
from rainstereo.mipmap import Mipmap
from rainstereo.scene import Plane, Scene, render
from rainstereo.sensor import Sensor
from rainstereo.types import Array, Image
from rainstereo.view import View

INK, PAPER = 28, 214  # gray levels of black and white print
LARGEST = 40e6  # texels of a board's picture


def board_drawing(board: Board, samples_per_metre: float) -> Drawing:
    """A print of the board with a white border of one square, at least as fine as the samples that are taken of it.

    samples_per_metre: of the nearest view, such as 4 samples a pixel x 1200 px / 0.3 m.
    """
    squares = (board.columns + 3) * (board.rows + 3)
    finest = math.floor(math.log2(math.sqrt(LARGEST / squares)))
    power = min(math.ceil(math.log2(samples_per_metre * board.square)), finest, 9)
    pixels_per_square = 2 ** max(power, 4)
    picture, origin_xy = board.texture(pixels_per_square)
    return Drawing.of(picture, origin_xy, board.square / pixels_per_square, INK, PAPER)


def room(view: View, distance: float, blur: float) -> Image:
    """What is behind the boards, (H, W) float32 gray levels: a wall `distance` metres ahead."""
    brick = Mipmap(cv2.rotate(photograph("brick"), cv2.ROTATE_90_CLOCKWISE), repeat=True)
    width, height = (4 * distance * n / view.camera.intrinsics[0] for n in view.camera.size)
    pose = np.array([0.0, 0.0, 0.0, -width / 2, -height / 2, distance])
    wall = Plane(brick, (width, height), pose, (0.8, 0.8), 0.62, "wall")
    gray: Image = render(view, Scene((wall,)), np.zeros(6), blur).image[..., 0]
    return np.ascontiguousarray(gray)


def render_board(
    view: View,
    drawing: Drawing,
    rt_cam_board: Array,
    sensor: Sensor,
    rng: np.random.Generator,
    background: Image | None = None,
    supersampling: int = 4,
) -> Image:
    """The camera's image of the board, (H, W) uint8. rt_cam_board: (6,). No background: mid gray."""
    behind = np.full(view.shape, 96, dtype=np.float32) if background is None else background
    light = render_drawing(view, drawing, rt_cam_board, behind, sensor.blur, supersampling)
    return sensor.expose(light, view.cosine, rng)
