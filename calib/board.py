"""Calibration boards: their description in words, their corners in metres, their picture."""

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from rainstereo.types import Array

Kind = Literal["chessboard", "charuco", "aprilgrid"]

_METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_LENGTH = re.compile(r"(?P<value>[0-9]*\.?[0-9]+(?:[eE][+-]?[0-9]+)?)\s*(?P<unit>[a-zA-Zµ\"']*)")
_SHAPE = re.compile(r"(?P<columns>[0-9]{1,4})[xX×](?P<rows>[0-9]{1,4})")
_LARGEST_SIDE = 500
_LARGEST_TEXTURE = 400_000_000
_EXAMPLES = (
    "chessboard:9x6:25mm (9 x 6 inner corners), charuco:31x16:49.33mm:38.46mm:DICT_4X4_1000 (31 x 16 squares) or "
    "aprilgrid:6x6:88mm:0.3 (6 x 6 tags, the gaps 0.3 of a tag)"
)
TAGS = "DICT_APRILTAG_36H11"
"""Dictionary of an AprilGrid's tags. OpenCV draws them turned by half a turn against AprilTag's and Kalibr's."""
TAG_BORDER = 2
"""Width in modules of an AprilGrid tag's black frame; a tag has 6 + 2 x 2 modules a side."""


@dataclass(frozen=True)
class Board:
    """A flat calibration board: a chessboard, a ChArUco board or an AprilGrid as Kalibr defines it.

    Attributes
    ----------
    kind
        ``"chessboard"``, ``"charuco"`` or ``"aprilgrid"``.
    columns, rows
        Number of inner corners along x (to the right) and along y (down). A ChArUco board of W x H squares has
        (W - 1) x (H - 1) of them; an AprilGrid of W x H tags has 2 W x 2 H, the corners of its tags.
    square
        Side of a square, or of an AprilGrid's tag, in metres.
    marker
        Side of a ChArUco marker in metres, else None.
    dictionary
        Name of OpenCV's ArUco dictionary, such as ``DICT_4X4_1000``, else None.
    spacing
        Width of the gaps of an AprilGrid in sides of a tag, else None.

    Notes
    -----
    Board frame: origin at corner [0, 0], x along the columns, y along the rows, z into the board (away from a
    viewer who sees the print). The square up and left of corner [0, 0] is black. An AprilGrid's tag 0 is the lower
    left one, its numbers grow to the right, then up.

    A wrong argument raises ValueError that names it.
    """

    kind: Kind
    columns: int
    rows: int
    square: float
    marker: float | None = None
    dictionary: str | None = None
    spacing: float | None = None

    def __post_init__(self) -> None:
        if self.kind not in {"chessboard", "charuco", "aprilgrid"}:
            raise ValueError(f"the board is a {self.kind!r}; expected a kind as in {_EXAMPLES}")
        if not (np.isfinite(self.square) and self.square > 0):
            raise ValueError(f"the squares measure {self.square} m; give a positive length")
        if (self.spacing is not None) != (self.kind == "aprilgrid"):
            raise ValueError(
                f"a spacing of {self.spacing} was given for a {self.kind}; an aprilgrid has one, as in {_EXAMPLES}"
            )
        if self.kind == "chessboard":
            self._check_chessboard()
        elif self.kind == "aprilgrid":
            self._check_aprilgrid()
        else:
            self._check_charuco()

    def _check_chessboard(self) -> None:
        if min(self.columns, self.rows) < 3 or max(self.columns, self.rows) > _LARGEST_SIDE:
            raise ValueError(
                f"a chessboard of {self.columns}x{self.rows} inner corners was asked for; 3 to {_LARGEST_SIDE} a side "
                "can be detected (count the inner corners, where four squares meet, not the squares)"
            )
        if self.marker is not None or self.dictionary is not None:
            raise ValueError("a chessboard has neither markers nor a dictionary; did you mean charuco?")

    def _check_charuco(self) -> None:
        width, height = self.squares
        if self.columns * self.rows < 6 or min(self.columns, self.rows) < 2 or max(width, height) > _LARGEST_SIDE:
            raise ValueError(
                f"a ChArUco board of {width}x{height} squares was asked for; at least 4x3 and at most "
                f"{_LARGEST_SIDE}x{_LARGEST_SIDE} squares are needed (for ChArUco count the squares, not the corners)"
            )
        if self.marker is None or self.dictionary is None:
            raise ValueError(f"a ChArUco board needs the marker side and the dictionary, as in {_EXAMPLES}")
        if not 0 < self.marker < self.square:
            raise ValueError(
                f"the markers measure {self.marker} m in squares of {self.square} m; "
                "give the square's side first, then the marker's, which is the smaller"
            )
        needed, available = width * height // 2, len(aruco_dictionary(self.dictionary).bytesList)
        if needed > available:
            raise ValueError(
                f"{width}x{height} squares hold {needed} markers but {self.dictionary} has only {available}; "
                f"name the larger dictionary that it is a part of, such as {_larger(self.dictionary)}"
            )

    def _check_aprilgrid(self) -> None:
        if self.marker is not None or self.dictionary is not None:
            raise ValueError("an AprilGrid has neither marker side nor dictionary: its tags are of the family 36h11")
        width, height = self.columns // 2, self.rows // 2
        available = len(aruco_dictionary(TAGS).bytesList)
        if self.columns % 2 or self.rows % 2 or min(width, height) < 1 or not 2 <= width * height <= available:
            raise ValueError(
                f"an AprilGrid of {self.columns}x{self.rows} corners was asked for; expected an even number a "
                f"side, two for each tag, and 2 to {available} tags"
            )
        if not 0.1 <= float(self.spacing or 0) <= 1:
            raise ValueError(
                f"the gaps of the AprilGrid are {self.spacing} of a tag's side; expected a share from 0.1 to 1, "
                "such as 0.3"
            )

    @classmethod
    def parse(cls, spec: str) -> "Board":
        """Read a board from words.

        ``chessboard:WxH:SQUARE``, ``charuco:WxH:SQUARE:MARKER:DICTIONARY`` or ``aprilgrid:WxH:TAG:SPACING``. A
        chessboard's WxH counts inner corners, a ChArUco board's squares (as OpenCV does), an AprilGrid's tags; its
        SPACING is the width of the gaps in sides of a tag (as Kalibr has it). Lengths carry a unit: mm, cm or m. If
        the square's size is unknown, say ``1m``: every length is then in squares.

        A name that ends in ``.toml`` is a file with a board's description, as `rainstereo board` writes it.
        """
        if spec.strip().lower().endswith(".toml"):
            from rainstereo.calib import board_file

            return board_file.read(Path(spec.strip()))
        kind, *fields = (field.strip() for field in spec.split(":"))
        expected = {"chessboard": 2, "charuco": 4, "aprilgrid": 3}
        if kind.lower() not in expected:
            raise ValueError(f"the board {spec!r} starts with {kind!r}; expected {_EXAMPLES}")
        if len(fields) != expected[kind.lower()]:
            raise ValueError(
                f"the board {spec!r} has {len(fields)} fields after {kind!r}, not {expected[kind.lower()]}; "
                f"expected {_EXAMPLES}"
            )
        width, height = _shape(fields[0], spec)
        square = _length(fields[1], spec)
        if kind.lower() == "chessboard":
            return cls("chessboard", width, height, square)
        if kind.lower() == "aprilgrid":
            return cls("aprilgrid", 2 * width, 2 * height, square, spacing=_ratio(fields[2], spec))
        return cls("charuco", width - 1, height - 1, square, _length(fields[2], spec), fields[3].upper())

    @property
    def spec(self) -> str:
        """The board in words; ``Board.parse(board.spec) == board``."""
        width, height = self.shape
        words = f"{self.kind}:{width}x{height}:{words_of_length(self.square)}"
        if self.spacing is not None:
            return f"{words}:{self.spacing!r}"
        if self.marker is None:
            return words
        return f"{words}:{words_of_length(self.marker)}:{self.dictionary}"

    @property
    def shape(self) -> tuple[int, int]:
        """What the board's description counts along x and y: inner corners, squares or tags."""
        if self.kind == "aprilgrid":
            return self.columns // 2, self.rows // 2
        return self.squares if self.kind == "charuco" else (self.columns, self.rows)

    @property
    def squares(self) -> tuple[int, int]:
        """Number of squares along x and y: one more than inner corners."""
        return self.columns + 1, self.rows + 1

    @property
    def size(self) -> tuple[float, float]:
        """Extent of all that is printed along x and y, in metres."""
        if self.spacing is not None:
            gap = self.spacing * self.square
            return self.columns // 2 * (self.square + gap) + gap, self.rows // 2 * (self.square + gap) + gap
        return self.square * (self.columns + 1), self.square * (self.rows + 1)

    @property
    def margin(self) -> float:
        """Extent of the print to the left of corner [0, 0] and above it, in metres."""
        return self.square if self.spacing is None else self.spacing * self.square

    @cached_property
    def points(self) -> Array:
        """Corners in the board frame, (rows, columns, 3) metres, z = 0; read-only."""
        points = np.zeros((self.rows, self.columns, 3))
        points[..., 0] = self._along(self.columns)
        points[..., 1] = self._along(self.rows)[:, None]
        points.flags.writeable = False
        return points

    def _along(self, count: int) -> Array:
        if self.spacing is None:
            return np.asarray(self.square * np.arange(count))
        tag, far = np.divmod(np.arange(count), 2)
        return np.asarray(self.square * (tag * (1 + self.spacing) + far))

    def charuco(self, legacy: bool = False) -> cv2.aruco.CharucoBoard:
        """OpenCV's own object for this ChArUco board; ``legacy`` as printed by OpenCV before 4.6 (even rows only)."""
        if self.marker is None or self.dictionary is None:
            raise ValueError(f"{self.spec} has no markers; expected a charuco board")
        board = cv2.aruco.CharucoBoard(self.squares, self.square, self.marker, aruco_dictionary(self.dictionary))
        board.setLegacyPattern(legacy)
        return board

    def texture(
        self, pixels_per_square: int, border: float = 1.0, legacy: bool = False
    ) -> tuple[npt.NDArray[np.uint8], Array]:
        """Picture of the board for printing and for simulation.

        Parameters
        ----------
        pixels_per_square
            Texels along a square's (or tag's) side, at least 4. Squares begin and end exactly between texels; so do
            marker modules if ``pixels_per_square * marker / square`` is divisible suitably, else their edge texels
            carry the exact share of black (area sampling).
        border
            Width of the white quiet border in squares, rounded to whole texels.
        legacy
            Draw a ChArUco board as OpenCV did before 4.6.

        Returns
        -------
        image
            (height, width) uint8.
        origin_xy
            (2,) texture pixel of corner [0, 0] (integer = texel centre); corner [r, c] is at
            ``origin_xy + pixels_per_square * points[r, c, :2] / square``.
        """
        if pixels_per_square < 4 or int(pixels_per_square) != pixels_per_square:
            raise ValueError(f"pixels_per_square is {pixels_per_square}; give a whole number of at least 4")
        if not border >= 0:
            raise ValueError(f"the border is {border} squares wide; give 0 or more")
        n = int(pixels_per_square)
        edge = round(border * n)
        if self.kind == "aprilgrid":
            from rainstereo.calib import board_pattern

            return board_pattern.picture(self, n, edge, _LARGEST_TEXTURE)
        width, height = self.squares
        if (width * n + 2 * edge) * (height * n + 2 * edge) > _LARGEST_TEXTURE:
            raise ValueError(f"{n} texels a square make a picture above {_LARGEST_TEXTURE} texels; give fewer")
        black = (np.add.outer(np.arange(height), np.arange(width)) % 2) == int(legacy and height % 2 == 0)
        inside: npt.NDArray[np.uint8] = np.where(black, 0, 255).astype(np.uint8).repeat(n, axis=0).repeat(n, axis=1)
        if self.marker is not None:
            self._draw_markers(inside, n, self.marker, legacy)
        image: npt.NDArray[np.uint8] = np.pad(inside, edge, constant_values=255)
        return image, np.full(2, edge + n - 0.5)

    def _draw_markers(self, squares: npt.NDArray[np.uint8], n: int, marker: float, legacy: bool) -> None:
        board = self.charuco(legacy)
        dictionary = board.getDictionary()
        modules = int(dictionary.markerSize) + 2  # with the marker's black frame of one module
        side = n * marker / self.square
        edges = (n - side) / 2 + side / modules * np.arange(modules + 1)
        # share[i, k]: how much of texel i module k covers
        texel = np.arange(n)[:, None]
        share = np.clip(np.minimum(texel + 1, edges[1:]) - np.maximum(texel, edges[:-1]), 0, None)
        for identity, corners in zip(np.ravel(board.getIds()), board.getObjPoints(), strict=True):
            bits = cv2.aruco.generateImageMarker(dictionary, int(identity), modules)
            column, row = (np.mean(corners, axis=0)[:2] // self.square).astype(int)
            cell = 255.0 * (1.0 - share @ (bits == 0) @ share.T)
            squares[row * n : (row + 1) * n, column * n : (column + 1) * n] = np.round(cell)


def aruco_dictionary(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's predefined ArUco dictionary of this name; ValueError with the known names if there is none."""
    names = [known for known in dir(cv2.aruco) if known.startswith("DICT_") and known.isupper()]
    if name not in names:
        raise ValueError(f"there is no ArUco dictionary {name!r}; expected one of {', '.join(sorted(names))}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def _larger(dictionary: str) -> str:
    family = re.match(r"DICT_[0-9]X[0-9]_", dictionary)
    return f"{family.group()}1000" if family else "DICT_4X4_1000"


def _shape(text: str, spec: str) -> tuple[int, int]:
    match = _SHAPE.fullmatch(text)
    if match is None:
        raise ValueError(f"the shape {text!r} in the board {spec!r} is not of the form 9x6; expected {_EXAMPLES}")
    return int(match["columns"]), int(match["rows"])


def _length(text: str, spec: str) -> float:
    match = _LENGTH.fullmatch(text)
    if match is None:
        raise ValueError(f"the length {text!r} in the board {spec!r} is not a number with a unit, such as 25mm")
    if match["unit"] not in _METRES:
        given = f"has the unit {match['unit']!r}" if match["unit"] else "has no unit"
        raise ValueError(f"the length {text!r} in the board {spec!r} {given}; expected mm, cm or m, such as 25mm")
    # divide: 25 / 1000 is the float64 nearest to 0.025, 25 * 1e-3 need not be
    return float(match["value"]) / round(1 / _METRES[match["unit"]])


def _ratio(text: str, spec: str) -> float:
    try:
        return float(text)
    except ValueError as error:
        raise ValueError(f"the spacing {text!r} in the board {spec!r} is not a number such as 0.3") from error


def words_of_length(metres: float) -> str:
    """Shortest decimal in mm that reads back as exactly this float64 (in m where whole, or where there is none)."""
    if metres == int(metres):
        return f"{int(metres)}m"
    for digits in range(1, 18):
        text = f"{metres * 1000:.{digits}g}"
        if float(text) / 1000 == metres:
            return f"{float(text)!r}".removesuffix(".0") + "mm"
    return f"{metres!r}m"
