"""A street to drive along: a road with its markings, houses, trees, signs and posters of photographs, and a sky.

Scene frame: x right, y down, z ahead, origin on the road below the start of the drive. Everything is drawn from
photographs and a seed; sizes and places are metres.
"""

from __future__ import annotations

import math
from functools import lru_cache

import cv2
import numpy as np

from rainstereo.apps.photographs import photograph
from rainstereo.mipmap import Mipmap
from rainstereo.pose import invert, rotation_vector
from rainstereo.scene import Plane, Scene, Sky
from rainstereo.types import Array, Image

CAMERA_HEIGHT = 1.5
LANES = 7.0  # width of the road, two lanes
LENGTH = 400.0  # of road and land
ROAD_TILE = (LANES, 12.0)  # what the road's picture covers: one dash of the centre line and the gap after it
ROAD_TEXELS = 160  # a metre
POSTERS = ("astronaut", "rocket", "coffee", "chelsea", "motorcycle", "camera")


@lru_cache(maxsize=1)
def street(seed: int) -> Scene:
    """The scene. The first plane is the road, y = 0; things stand upright on it at 5 to 60 m and beyond."""
    rng = np.random.default_rng([seed, 0x57])
    grass = _tinted("grass", (0.45, 0.95, 0.75), 0.75)
    planes = [
        _ground("road", _road(rng), LANES, 0.0, ROAD_TILE),
        _ground("kerb", _tinted("gravel", (0.96, 1.0, 1.0), 0.9), 14.0, 0.02, (3.0, 3.0)),
        _ground("land", grass, 2 * LENGTH, 0.04, (4.0, 4.0)),
        *_houses(rng),
        *_posters(rng),
        *_trees(rng),
        *_signs(rng),
        *(_post(3.85, z, 0.9, 0.14, "bollard") for z in (5.2, 7.0, 10.0)),
    ]
    return Scene(tuple(planes), _sky(rng))


def drive(frames: int, seed: int, step: float = 0.8) -> Array:
    """Poses of the rig along the street, (frames, 6) rt_ref_scene: `step` metres a frame on the right-hand lane,
    the rig nodding and swaying a little as a car does.
    """
    if not (frames >= 0 and 0 <= step * max(frames - 1, 0) <= 50):
        raise ValueError(f"a drive of {frames} frames every {step:g} m was asked for; expected at most 50 m of road")
    rng = np.random.default_rng([seed, 0xD21])
    poses = np.zeros((frames, 6))
    phase = rng.uniform(0, 2 * math.pi, 3)
    for i in range(frames):
        along = i * step
        sway = np.radians([0.3, 0.5, 0.2]) * np.sin(along / np.array([4.0, 9.0, 6.0]) + phase)
        place = [LANES / 4 + 0.1 * math.sin(along / 9 + phase[1]), -CAMERA_HEIGHT, along]
        poses[i] = invert(np.concatenate([sway, place]))
    return poses


def _upright(x: float, z: float, size: tuple[float, float], turn_deg: float, above: float = 0.0) -> Array:
    """Pose of a standing rectangle, (6,): its foot's middle at x, z, facing the start when turn_deg is 0."""
    turn = math.radians(turn_deg)
    right = np.array([math.cos(turn), 0.0, -math.sin(turn)])
    R = np.stack([right, [0.0, 1.0, 0.0], np.cross(right, [0.0, 1.0, 0.0])], 1)
    corner = np.array([x, -size[1] - above, z]) - size[0] / 2 * right
    return np.concatenate([rotation_vector(R), corner])


def _ground(name: str, picture: Image, width: float, drop: float, tile: tuple[float, float]) -> Plane:
    """A level rectangle around the road's middle, `drop` below it; its picture's top lies ahead."""
    R = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # x right, y backwards, z down
    corner = [-width / 2, drop, LENGTH - 20.0]
    pose = np.concatenate([rotation_vector(R), corner])
    return Plane(Mipmap(picture, repeat=True), (width, LENGTH), pose, tile, name=name)


def _tinted(name: str, bgr: tuple[float, float, float], gain: float) -> Image:
    light = photograph(name).astype(np.float32) * (np.array(bgr, dtype=np.float32) * np.float32(gain))
    picture: Image = np.clip(np.rint(light), 0, 255).astype(np.uint8)
    return picture


def _noise(rng: np.random.Generator, shape: tuple[int, int], coarsest: int, octaves: int) -> Image:
    """Smooth noise from 0 to 1, (H, W) float32, whose largest blobs are a `coarsest`-th of the picture; it tiles."""
    n = min((coarsest << octaves) * 2, 1024)  # four texels to the smallest blob; the rest is interpolated
    total = np.zeros((n, n), dtype=np.float32)
    for i in range(octaves):
        total += _enlarged(rng.random((coarsest << i,) * 2, dtype=np.float32), (n, n), cv2.INTER_CUBIC) * 0.5**i
    total -= total.min()
    return _enlarged(total / total.max(), shape, cv2.INTER_LINEAR)


def _enlarged(cells: Image, shape: tuple[int, int], interpolation: int) -> Image:
    """A picture that tiles, enlarged so that it still tiles."""
    margin, (rows, columns) = 2, cells.shape
    x = (np.arange(shape[1], dtype=np.float32) + 0.5) * columns / shape[1] - 0.5 + margin
    y = (np.arange(shape[0], dtype=np.float32) + 0.5) * rows / shape[0] - 0.5 + margin
    wrapped = np.pad(cells, margin, mode="wrap")
    at_x, at_y = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
    enlarged: Image = cv2.remap(wrapped, at_x, at_y, interpolation)
    return enlarged


def _road(rng: np.random.Generator) -> Image:
    """Asphalt made from gravel, with patches, wheel tracks and painted lines; repeats along the road."""
    width, height = (round(n * ROAD_TEXELS) for n in ROAD_TILE)
    gravel = cv2.resize(photograph("gravel")[..., 0], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    rows, columns = -(-height // gravel.shape[0]), -(-width // gravel.shape[1])
    stones = np.tile(gravel, (rows, columns))[:height, :width].astype(np.float32)
    light = 74 + 0.32 * (stones - stones.mean()) + 22 * (_noise(rng, (height, width), 4, 4) - 0.5)
    x = (np.arange(width) + 0.5) / ROAD_TEXELS - LANES / 2
    for track in (-2.55, -0.95, 0.95, 2.55):
        light -= 7 * np.exp(-(((x - track) / 0.28) ** 2))
    paint = np.zeros((height, width), dtype=np.float32)
    paint[: height // 3, np.abs(x) < 0.075] = 1
    paint[:, np.abs(np.abs(x) - (LANES / 2 - 0.25)) < 0.075] = 1
    worn = np.clip(1.25 - 0.7 * _noise(rng, (height, width), 8, 5) - 0.0016 * (stones - 90), 0.2, 1)
    light += paint * worn * (205 - light)
    picture: Image = np.clip(np.rint(light[..., None] * np.array([1.03, 1.0, 0.98])), 0, 255).astype(np.uint8)
    return picture


def _houses(rng: np.random.Generator) -> list[Plane]:
    """Rows of brick houses along both sides of the road, and the gable of each first house."""
    planes = []
    for side in (-1, 1):
        z = 9.0 if side < 0 else 13.0
        for k in range(4):
            width, height = float(rng.uniform(9, 13)), float(rng.uniform(5.5, 8.0))
            x = side * float(rng.uniform(7.6, 8.6))
            facade = Mipmap(_facade(rng, width, height))
            shade = 0.62 if side < 0 else 1.0
            turn = -90.0 * side  # seen from the road, left to right
            planes.append(
                Plane(
                    facade,
                    (width, height),
                    _upright(x, z + width / 2, (width, height), -turn),
                    None,
                    shade,
                    f"house {k}",
                )
            )
            gable = Mipmap(_facade(rng, 7.0, height, windows=False))
            place = _upright(x + side * 3.45, z, (7.0, height), 0.0)  # 5 cm over the facade's edge: no sky between
            planes.append(Plane(gable, (7.0, height), place, None, 0.85, f"gable {k}"))
            z += width + float(rng.uniform(1.5, 5.0))
    return planes


def _facade(rng: np.random.Generator, width: float, height: float, windows: bool = True) -> Image:
    texels = 90
    columns, rows = round(width * texels), round(height * texels)
    upright = cv2.rotate(photograph("brick"), cv2.ROTATE_90_CLOCKWISE)
    brick = cv2.resize(upright, None, fx=0.3, fy=0.3, interpolation=cv2.INTER_AREA)
    wall = np.tile(brick, (rows // brick.shape[0] + 1, columns // brick.shape[1] + 1, 1))[:rows, :columns]
    tint = np.array([0.62, 0.76, 1.12]) * rng.uniform(0.85, 1.1, 3)
    light = wall * tint * (0.9 + 0.2 * _noise(rng, (rows, columns), 2, 4)[..., None])
    picture: Image = np.clip(light, 0, 255).astype(np.uint8)
    cv2.rectangle(picture, (0, 0), (columns, texels // 4), (70, 72, 78), -1)  # eaves
    if windows:
        for storey in range(int(height // 2.7)):
            for bay in range(int(width // 2.4)):
                x, y = 0.75 + 2.4 * bay, height - 2.4 - 2.7 * storey
                _window(picture, rng, round(x * texels), round(y * texels), round(1.1 * texels), round(1.4 * texels))
    return picture


def _window(picture: Image, rng: np.random.Generator, x: int, y: int, width: int, height: int) -> None:
    frame, pane = max(3, width // 14), photograph("hubble")
    cv2.rectangle(picture, (x - frame, y - frame), (x + width + frame, y + height + 2 * frame), (205, 210, 214), -1)
    top, left = (int(rng.integers(0, n - 260)) for n in pane.shape[:2])
    dark = cv2.resize(pane[top : top + 250, left : left + 250], (width, height)) // 3
    sheen = np.linspace(70, 12, height)[:, None, None] * rng.uniform(0.6, 1.2)
    picture[y : y + height, x : x + width] = np.clip(dark + sheen, 0, 255)[: picture.shape[0] - y]
    cv2.line(picture, (x + width // 2, y), (x + width // 2, y + height), (205, 210, 214), frame // 2 + 1)
    cv2.line(picture, (x, y + height // 2), (x + width, y + height // 2), (205, 210, 214), frame // 2 + 1)


def _posters(rng: np.random.Generator) -> list[Plane]:
    """Photographs on boards at 5 to 60 m, each on two legs."""
    places = (
        (5.2, 8.5, 1.4), (-5.2, 14.5, 2.4), (-4.9, 20.5, 2.4), (5.6, 21.0, 3.0), (-5.6, 33.0, 3.6), (6.0, 56.0, 6.0),
    )  # fmt: skip
    planes = []
    for name, (x, z, width) in zip(POSTERS, places, strict=True):
        photo = photograph(name)
        size = width, width * photo.shape[0] / photo.shape[1]
        framed = cv2.copyMakeBorder(photo, 9, 9, 9, 9, cv2.BORDER_CONSTANT, value=(225, 225, 225))
        turn = float(rng.uniform(-18, 18)) - 8 * math.copysign(1, x)
        above = 0.35 + 0.1 * width
        planes.append(Plane(Mipmap(framed), size, _upright(x, z, size, turn, above), name=name))
        for leg in (-0.35, 0.35):
            foot = x + leg * width * math.cos(math.radians(turn)), z + 0.03 - leg * width * math.sin(math.radians(turn))
            planes.append(_post(*foot, above + 0.1, 0.05 + 0.02 * width, f"leg of {name}"))
    return planes


def _post(x: float, z: float, height: float, width: float, name: str) -> Plane:
    across = 95 + 70 * np.sin(np.linspace(0.25, math.pi - 0.1, 32))  # lit like a cylinder
    picture = np.repeat(np.rint(across).astype(np.uint8)[None, :, None], 64, 0).repeat(3, -1)
    return Plane(Mipmap(picture), (width, height), _upright(x, z, (width, height), 0.0), name=name)


def _trees(rng: np.random.Generator) -> list[Plane]:
    """Crowns of grass and trunks, cut out."""
    planes = []
    for x, z in ((-6.4, 24.0), (6.6, 29.0), (-6.6, 43.0), (6.8, 47.0), (-7.0, 75.0), (7.2, 82.0), (-7.4, 110.0)):
        size = (float(rng.uniform(3.2, 4.6)), float(rng.uniform(5.0, 6.8)))
        planes.append(Plane(Mipmap(_tree(rng)), size, _upright(x, z, size, 0.0), shade=0.95, name="tree"))
    return planes


def _tree(rng: np.random.Generator) -> Image:
    """A cut-out tree, (640, 448, 4) BGR and opacity."""
    rows, columns = 640, 448
    y, x = np.mgrid[0:rows, 0:columns].astype(np.float32)
    crown = ((x - columns / 2) / (0.47 * columns)) ** 2 + ((y - 0.37 * rows) / (0.36 * rows)) ** 2
    ragged = _noise(rng, (rows, columns), 5, 5)
    leaf = np.clip((1.08 - crown - 0.8 * (ragged - 0.45)) * 14, 0, 1)
    trunk = (np.abs(x - columns / 2 - 6 * np.sin(y / 60)) < 13 + np.maximum(0, y - 590) / 4) & (y > 0.5 * rows)
    leaves = cv2.resize(photograph("grass"), (columns, rows)) * np.array([0.30, 0.72, 0.52])
    lit = 1.25 - 0.55 * y / rows - 0.25 * (x / columns) + 0.5 * (ragged - 0.5)
    bark = np.full((rows, columns, 3), (52, 62, 74)) * (0.7 + 0.6 * x[..., None] / columns)
    opacity = np.maximum(leaf, trunk)[..., None]
    colour = np.where(leaf[..., None] > 0.5, leaves * lit[..., None], bark)
    picture: Image = np.clip(np.rint(np.concatenate([colour * opacity, 255 * opacity], -1)), 0, 255).astype(np.uint8)
    return picture


def _signs(rng: np.random.Generator) -> list[Plane]:
    """Round and triangular traffic signs on posts."""
    planes = []
    for x, z, kind in ((3.9, 12.0, "30"), (-4.2, 18.5, "!"), (4.0, 38.0, "50"), (-4.2, 52.0, "!")):
        turn = float(rng.uniform(-6, 6))
        planes.append(Plane(Mipmap(_sign(kind)), (0.75, 0.75), _upright(x, z, (0.75, 0.75), turn, 1.9), name="sign"))
        planes.append(_post(x, z + 0.02, 2.5, 0.07, "post of a sign"))
    return planes


def _sign(kind: str) -> Image:
    n = 256
    picture = np.zeros((n, n, 4), dtype=np.uint8)
    red, white, black = (38, 30, 190, 255), (225, 228, 228, 255), (25, 25, 25, 255)
    if kind == "!":
        corners = np.array([[128, 14], [246, 224], [10, 224]])
        inner = np.array([[128, 62], [206, 201], [50, 201]])
        cv2.fillPoly(picture, [corners], red, cv2.LINE_8)
        cv2.fillPoly(picture, [inner], white, cv2.LINE_8)
        cv2.rectangle(picture, (119, 98), (137, 160), black, -1)
        cv2.circle(picture, (128, 181), 11, black, -1)
        return picture
    cv2.circle(picture, (128, 128), 124, red, -1)
    cv2.circle(picture, (128, 128), 96, white, -1)
    (width, height), _ = cv2.getTextSize(kind, cv2.FONT_HERSHEY_DUPLEX, 3.3, 11)
    cv2.putText(picture, kind, (128 - width // 2, 128 + height // 2), cv2.FONT_HERSHEY_DUPLEX, 3.3, black, 11)
    return picture


def _sky(rng: np.random.Generator) -> Sky:
    """Clouds over a gradient, and hills on the horizon."""
    rows, columns = 1024, 2048
    upper, lower = math.radians(40.0), math.radians(-8.0)
    elevation = upper + (lower - upper) * (np.arange(rows) + 0.5) / rows
    high = np.clip(elevation / upper, 0, 1)[:, None, None]
    gradient = np.array([226, 214, 205]) * (1 - high) + np.array([205, 160, 118]) * high
    clouds = _noise(rng, (rows, columns), 4, 7)
    share = np.clip((clouds - 0.42) * 3.2, 0, 1)[..., None] * np.clip(high * 6 + 0.25, 0, 1)
    light = gradient + share * (np.array([240, 238, 236]) - gradient)
    ridge = np.radians(1.2 + 2.2 * _noise(rng, (64, columns), 4, 6)[7])
    hills = elevation[:, None] < ridge[None, :]
    haze = np.array([178, 172, 158]) * (0.85 + 0.3 * _noise(rng, (rows, columns), 32, 3)[..., None])
    light = np.where(hills[..., None], haze, light)
    picture = np.clip(np.rint(light), 0, 255).astype(np.uint8)
    half = math.radians(60.0)
    return Sky(Mipmap(picture), (-half, half), (lower, upper))


__all__ = ["CAMERA_HEIGHT", "LANES", "LENGTH", "drive", "street"]
