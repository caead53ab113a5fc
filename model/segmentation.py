"""Images with labels, in the layouts of CamVid and Cityscapes: which pixels are road markings, which class each has."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from rainstereo import imagefile
from rainstereo.model.segmentation_metrics import VOID
from rainstereo.types import Image

Task = Literal["markings", "semantic"]
TASKS: tuple[Task, ...] = ("markings", "semantic")
LAYOUTS = ("camvid11", "camvid32", "cityscapes", "cityscapes-trainids")
LabelImage = npt.NDArray[np.uint8]
TESTED = 0.3
"""Share of the frames of each drive that test, where a data set has no split of its own: the last ones."""
GUARD = 4
"""Frames between those that teach and those that test, used for neither: neighbours in time show the same scene."""

CAMVID11 = (
    "Sky", "Building", "Pole", "Road", "Pavement", "Tree", "SignSymbol", "Fence", "Car", "Pedestrian", "Bicyclist",
)  # fmt: skip
CITYSCAPES: Mapping[str, int] = {
    "road": 7, "sidewalk": 8, "building": 11, "wall": 12, "fence": 13, "pole": 17, "traffic light": 19,
    "traffic sign": 20, "vegetation": 21, "terrain": 22, "sky": 23, "person": 24, "rider": 25, "car": 26, "truck": 27,
    "bus": 28, "train": 31, "motorcycle": 32, "bicycle": 33,
}  # fmt: skip
"""The 19 classes that are evaluated, in the order of their trainIds, with their labelIds."""
CAMVID32: Mapping[str, tuple[tuple[int, int, int], str]] = {
    "Animal": ((64, 128, 64), "Pedestrian"), "Archway": ((192, 0, 128), "Building"),
    "Bicyclist": ((0, 128, 192), "Bicyclist"), "Bridge": ((0, 128, 64), "Building"),
    "Building": ((128, 0, 0), "Building"), "Car": ((64, 0, 128), "Car"),
    "CartLuggagePram": ((64, 0, 192), "Pedestrian"), "Child": ((192, 128, 64), "Pedestrian"),
    "Column_Pole": ((192, 192, 128), "Pole"), "Fence": ((64, 64, 128), "Fence"),
    "LaneMkgsDriv": ((128, 0, 192), "Road"), "LaneMkgsNonDriv": ((192, 0, 64), "Road"),
    "Misc_Text": ((128, 128, 64), "SignSymbol"), "MotorcycleScooter": ((192, 0, 192), "Bicyclist"),
    "OtherMoving": ((128, 64, 64), "Car"), "ParkingBlock": ((64, 192, 128), "Pavement"),
    "Pedestrian": ((64, 64, 0), "Pedestrian"), "Road": ((128, 64, 128), "Road"),
    "RoadShoulder": ((128, 128, 192), "Pavement"), "Sidewalk": ((0, 0, 192), "Pavement"),
    "SignSymbol": ((192, 128, 128), "SignSymbol"), "Sky": ((128, 128, 128), "Sky"),
    "SUVPickupTruck": ((64, 128, 192), "Car"), "TrafficCone": ((0, 0, 64), "Pole"),
    "TrafficLight": ((0, 64, 64), "SignSymbol"), "Train": ((192, 64, 128), "Car"), "Tree": ((128, 128, 0), "Tree"),
    "Truck_Bus": ((192, 128, 192), "Car"), "Tunnel": ((64, 0, 64), "Building"),
    "VegetationMisc": ((192, 192, 0), "Tree"), "Void": ((0, 0, 0), ""), "Wall": ((64, 192, 0), "Building"),
}  # fmt: skip
"""CamVid's 32 classes: their colour (R, G, B), and the one of the 11 that each is counted as."""
MARKINGS = ("LaneMkgsDriv", "LaneMkgsNonDriv")


@dataclass(frozen=True)
class Scene:
    """name: below the data set, with its folders, no suffix."""

    name: str
    image: Path
    label: Path


@dataclass(frozen=True)
class LabelledSet:
    """layout: one of `LAYOUTS`. train, test: no frame is in both, nor close in time to one of the other."""

    layout: str
    train: tuple[Scene, ...]
    test: tuple[Scene, ...]


def find(folder: Path, limit: int = 0) -> LabelledSet:
    """The data set in a folder, known by what it holds; of train and test `limit` each, evenly over them, or all.

    camvid11: train/ and trainannot/, test/ and testannot/, or val and valannot where there is no test.
    camvid32: images/ and labels/ (NAME.png or NAME_L.png); the last `TESTED` of each drive test, after `GUARD` frames.
    cityscapes: leftImg8bit/ and gtFine/ with train/ and val/, which tests, as nobody has the labels of test/; labels
    are labelIds, or labelTrainIds (cityscapes-trainids) where there are no others.
    FileNotFoundError where there is no such folder, ValueError where it is none of these, or lacks a part.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} is no folder; expected one of images with labels")
    if (folder / "leftImg8bit").is_dir():
        layout, kind = "cityscapes", "labelIds"
        if not any((folder / "gtFine").glob("train/*/*_gtFine_labelIds.png")):
            layout, kind = "cityscapes-trainids", "labelTrainIds"
        train, test = (_cityscapes(folder, part, kind) for part in ("train", "val"))
    elif (folder / "trainannot").is_dir():
        layout, last = "camvid11", "test" if (folder / "testannot").is_dir() else "val"
        train, test = (_beside(folder, part, f"{part}annot", ("",)) for part in ("train", last))
    elif (folder / "labels").is_dir():
        layout = "camvid32"
        train, test = split_in_time(_beside(folder, "images", "labels", ("_L", "")))
    else:
        raise ValueError(
            f"{folder} holds none of the known layouts: train/ and trainannot/ (camvid11), images/ and labels/ "
            "(camvid32), leftImg8bit/ and gtFine/ (cityscapes)"
        )
    for what, scenes in (("train on", train), ("test on", test)):
        if not scenes:
            raise ValueError(f"{folder}, taken for {layout}, has no image with a label to {what}")
    return LabelledSet(layout, _evenly(train, limit), _evenly(test, limit))


def split_in_time(scenes: Sequence[Scene], tested: float = TESTED, gap: int = GUARD) -> tuple[list[Scene], list[Scene]]:
    """(train, test): the first frames of each drive and, after a gap, the last. Names say the drive before `_`."""
    drives: dict[str, list[Scene]] = {}
    for scene in sorted(scenes, key=lambda scene: scene.name):
        drives.setdefault(scene.name.rpartition("_")[0], []).append(scene)
    train: list[Scene] = []
    test: list[Scene] = []
    for frames in drives.values():
        first = len(frames) - max(1, round(tested * len(frames)))
        train += frames[: max(0, first - gap)]
        test += frames[first:]
    return train, test


def classes(task: Task, layout: str) -> tuple[str, ...]:
    """Names of the labels 0, 1, ... ValueError where the layout does not tell them apart."""
    if task == "markings":
        if layout != "camvid32":
            raise ValueError(
                f"labels of layout {layout} do not tell road markings from the road; expected camvid32 (images/ and "
                f"labels/ in CamVid's 32 colours, of which {' and '.join(MARKINGS)} are markings)"
            )
        return "other", "road marking"
    return CAMVID11 if layout.startswith("camvid") else tuple(CITYSCAPES)


def target(labels: Image, task: Task, layout: str) -> LabelImage:
    """(H, W) uint8 from a label image as it was read: 0 .. classes - 1, and `VOID` where the labels say nothing.

    ValueError where the image is none of that layout's.
    """
    names = classes(task, layout)
    if labels.dtype != np.uint8 or labels.ndim != (3 if layout == "camvid32" else 2):
        raise ValueError(
            f"the label image is {labels.dtype} {labels.shape}; expected uint8 "
            f"{'(H, W, 3), BGR' if layout == 'camvid32' else '(H, W)'} in layout {layout}"
        )
    if layout == "camvid32":
        return _from_colours(labels, names, task)
    numbers = {number: i for i, number in enumerate(CITYSCAPES.values())}
    table = _table(numbers if layout == "cityscapes" else {i: i for i in range(len(names))})
    known = {"camvid11": 12, "cityscapes": 34, "cityscapes-trainids": 19}[layout]
    wrong = labels[(labels >= known) & (labels != VOID)]
    if wrong.size:
        raise ValueError(
            f"the label image holds {wrong.min()}; expected 0 to {known - 1} in layout {layout}, or {VOID}"
        )
    return np.asarray(table[labels])


def _from_colours(labels: Image, names: Sequence[str], task: Task) -> LabelImage:
    code = labels[..., 2].astype(np.int32) << 16 | labels[..., 1].astype(np.int32) << 8 | labels[..., 0]
    found = np.full(labels.shape[:2], VOID, np.uint8)
    known = np.zeros(labels.shape[:2], bool)
    for name, ((red, green, blue), merged) in CAMVID32.items():
        here = code == (red << 16 | green << 8 | blue)
        known |= here
        if name != "Void":
            found[here] = int(name in MARKINGS) if task == "markings" else names.index(merged)
    if not known.all():
        y, x = np.argwhere(~known)[0]
        raise ValueError(
            f"the label image has the colour {tuple(int(v) for v in labels[y, x, ::-1])} (R, G, B) at x {x}, y {y}, "
            "which is none of CamVid's 32; was it stored as JPEG, or scaled?"
        )
    return found


def _table(pairs: Mapping[int, int]) -> LabelImage:
    table = np.full(256, VOID, np.uint8)
    for label, number in pairs.items():
        table[label] = number
    return table


# -- files -------------------------------------------------------------------------------------------------------------


def _images(folder: Path, pattern: str = "*") -> Iterator[Path]:
    for path in sorted(folder.glob(pattern)):
        if path.suffix.lower() in imagefile.SUFFIXES and not path.name.startswith(".") and path.is_file():
            yield path


def _beside(folder: Path, images: str, labels: str, endings: Sequence[str]) -> list[Scene]:
    """Images that have a label; others are left out, as in CamVid, where few frames of each drive are labelled."""
    found = []
    for path in _images(folder / images):
        label = next((p for e in endings if (p := folder / labels / f"{path.stem}{e}.png").is_file()), None)
        if label is not None:
            found.append(Scene(f"{images}/{path.stem}", path, label))
    return found


def _cityscapes(folder: Path, part: str, kind: str) -> list[Scene]:
    ending, found = "_leftImg8bit", []
    for path in _images(folder / "leftImg8bit", f"{part}/*/*{ending}.png"):
        stem, city = path.stem.removesuffix(ending), path.parent.name
        label = folder / "gtFine" / part / city / f"{stem}_gtFine_{kind}.png"
        if label.is_file():
            found.append(Scene(f"{part}/{city}/{stem}", path, label))
    return found


def _evenly(scenes: Sequence[Scene], limit: int) -> tuple[Scene, ...]:
    if not 0 < limit < len(scenes):
        return tuple(scenes)
    return tuple(scenes[int(i)] for i in np.linspace(0, len(scenes) - 1, limit).round())
