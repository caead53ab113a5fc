"""Labels in each layout, who teaches and who tests, and what is no label."""

from pathlib import Path

import numpy as np
import pytest

from rainstereo import imagefile
from rainstereo.model.segmentation import (
    CAMVID11,
    CAMVID32,
    CITYSCAPES,
    GUARD,
    VOID,
    Scene,
    classes,
    find,
    split_in_time,
    target,
)

BLANK = np.zeros((4, 6, 3), np.uint8)


def put(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        imagefile.write(folder / name, BLANK)


def test_each_layout_is_known_by_its_folders(tmp_path: Path) -> None:
    a, b, c, d = (tmp_path / name for name in "abcd")
    put(a, "train/x_1.jpg", "trainannot/x_1.png", "train/x_2.jpg", "val/x_3.png", "valannot/x_3.png")
    put(b, *(f"images/s_{i:02d}.png" for i in range(10)), *(f"labels/s_{i:02d}_L.png" for i in range(10)))
    for part in ("train", "val"):
        put(c, f"leftImg8bit/{part}/bonn/bonn_1_leftImg8bit.png", f"gtFine/{part}/bonn/bonn_1_gtFine_labelIds.png")
        put(d, f"leftImg8bit/{part}/bonn/bonn_1_leftImg8bit.png", f"gtFine/{part}/bonn/bonn_1_gtFine_labelTrainIds.png")
    names = {}
    for folder in (a, b, c, d):
        one = find(folder)
        names[one.layout] = [s.name for s in one.train], [s.name for s in one.test]
    assert names["camvid11"] == (["train/x_1"], ["val/x_3"])  # x_2 has no label
    assert names["camvid32"] == (["images/s_00", "images/s_01", "images/s_02"], [f"images/s_0{i}" for i in (7, 8, 9)])
    assert names["cityscapes"] == names["cityscapes-trainids"] == (["train/bonn/bonn_1"], ["val/bonn/bonn_1"])
    put(a, "test/x_4.png", "testannot/x_4.png")
    assert [s.name for s in find(a).test] == ["test/x_4"]
    assert [s.name for s in find(b, 2).train] == ["images/s_00", "images/s_02"]


def test_neighbours_in_time_never_teach_and_test() -> None:
    scenes = [Scene(f"{drive}_{i:04d}", Path(), Path()) for drive in ("one", "two") for i in range(40)]
    train, test = split_in_time(scenes[::-1])
    assert (len(train), len(test)) == (2 * (28 - GUARD), 24)
    for drive in ("one", "two"):
        taught, tested = ([int(s.name[-4:]) for s in part if s.name.startswith(drive)] for part in (train, test))
        assert min(tested) - max(taught) == GUARD + 1


def test_what_is_no_data_set_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no folder"):
        find(tmp_path / "none")
    with pytest.raises(ValueError, match="none of the known layouts"):
        find(tmp_path)
    put(tmp_path, "train/a.png", "trainannot/a.png")
    with pytest.raises(ValueError, match="has no image with a label to test on"):
        find(tmp_path)


def test_colours_are_those_of_the_data_set(shared_data: Path) -> None:
    text = (shared_data / "camseq01_32class_960x720/label_colors.txt").read_text()
    theirs = {name: tuple(map(int, rgb)) for *rgb, name in map(str.split, text.splitlines())}
    assert theirs == {name: colour for name, (colour, _) in CAMVID32.items()}


def test_targets_of_colours() -> None:
    image = np.array([[CAMVID32[name][0][::-1] for name in CAMVID32]], np.uint8)
    found = dict(zip(CAMVID32, target(image, "markings", "camvid32")[0].tolist(), strict=True))
    assert {name for name, label in found.items() if label == 1} == {"LaneMkgsDriv", "LaneMkgsNonDriv"}
    assert {name for name, label in found.items() if label == VOID} == {"Void"}
    merged = target(image, "semantic", "camvid32")[0].tolist()
    for (name, (_, into)), label in zip(CAMVID32.items(), merged, strict=True):
        assert label == VOID if name == "Void" else CAMVID11[label] == into
    assert set(merged) == {*range(11), VOID}


def test_targets_of_numbers() -> None:
    assert target(np.arange(12, dtype=np.uint8)[None], "semantic", "camvid11").tolist() == [[*range(11), VOID]]
    ids = np.array([[0, 7, 26, 33, 29, VOID]], np.uint8)
    assert target(ids, "semantic", "cityscapes").tolist() == [[VOID, 0, 13, 18, VOID, VOID]]
    train_ids = np.array([[0, 18, VOID]], np.uint8)
    assert target(train_ids, "semantic", "cityscapes-trainids").tolist() == [[0, 18, VOID]]
    assert (len(classes("semantic", "cityscapes")), classes("semantic", "camvid11")) == (len(CITYSCAPES), CAMVID11)


@pytest.mark.parametrize(
    ("labels", "task", "layout", "words"),
    [
        (np.full((2, 2), 12, np.uint8), "semantic", "camvid11", "holds 12; expected 0 to 11"),
        (np.full((2, 2), 19, np.uint8), "semantic", "cityscapes-trainids", "holds 19; expected 0 to 18"),
        (np.full((2, 2, 3), 9, np.uint8), "markings", "camvid32", r"colour \(9, 9, 9\)"),
        (np.zeros((2, 2), np.uint8), "markings", "camvid32", "BGR in layout camvid32|expected uint8"),
        (np.zeros((2, 2), np.uint16), "semantic", "camvid11", "is uint16"),
        (np.zeros((2, 2), np.uint8), "markings", "camvid11", "do not tell road markings"),
    ],
)
def test_what_is_no_label_is_refused(labels: np.ndarray, task: str, layout: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        target(labels, task, layout)  # type: ignore[arg-type]
