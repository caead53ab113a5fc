"""Image files and pairs of them: whole or not at all, and matched by what their names share."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from rainstereo import imagefile
from rainstereo.imagefile import UnreadableImageError
from rainstereo.pairs import list_images, match

PICTURE = np.random.default_rng(0).integers(0, 255, (24, 32, 3), dtype=np.uint8)


DEEP = PICTURE[..., 0].astype(np.uint16) * 257


@pytest.mark.parametrize(
    ("suffix", "image"),
    [(s, i) for s in (".png", ".tiff", ".bmp") for i in (PICTURE, PICTURE[..., 0])] + [(".png", DEEP), (".tiff", DEEP)],
)
def test_what_is_written_is_read(tmp_path: Path, suffix: str, image: np.ndarray) -> None:
    path = tmp_path / f"a{suffix}"
    imagefile.write(path, image)
    read = imagefile.read(path)
    np.testing.assert_array_equal(read if read.ndim == image.ndim else read[..., 0], image)
    assert imagefile.read(path, gray=True).shape == (24, 32)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]  # nothing temporary is left


def test_other_pixels_and_thumbnails_are_not_mistaken() -> None:
    jpeg = cv2.imencode(".jpg", PICTURE)[1].tobytes()
    thumbnail = jpeg[:2] + b"\xff\xe1" + (len(jpeg) + 2).to_bytes(2, "big") + jpeg + jpeg[2:-40]
    with pytest.raises(UnreadableImageError, match="truncated"):
        imagefile.decode(thumbnail)  # its thumbnail is whole, the image is not
    floats = cv2.imencode(".tiff", DEEP.astype(np.float32))[1].tobytes()
    with pytest.raises(UnreadableImageError, match="float32"):
        imagefile.decode(floats)


def test_every_cut_of_a_file_is_refused(tmp_path: Path) -> None:
    for suffix in (".png", ".jpg", ".tiff", ".bmp", ".ppm", ".webp"):
        data = cv2.imencode(suffix, PICTURE)[1].tobytes()
        assert imagefile.decode(data).shape == PICTURE.shape
        tail = (len(data) - 20, len(data) - 3) if suffix in (".png", ".jpg") else ()
        for cut in (*range(1, 40, 7), len(data) // 2, *tail):
            with pytest.raises(UnreadableImageError):
                imagefile.decode(data[:cut])


def test_reasons_are_told(tmp_path: Path) -> None:
    (tmp_path / "empty.png").touch()
    (tmp_path / "words.png").write_text("not an image")
    for name, reason in (("empty.png", "zero bytes"), ("words.png", "not an image"), ("absent.png", "cannot be read")):
        with pytest.raises(UnreadableImageError, match=reason):
            imagefile.read(tmp_path / name)


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.png"
    imagefile.write(path, PICTURE)

    def full(self: Path, data: bytes) -> int:
        self.touch()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space left"):
        imagefile.write(path, PICTURE // 2)
    np.testing.assert_array_equal(imagefile.read(path), PICTURE)
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]


def touch(folder: Path, *names: str) -> str:
    folder.mkdir(exist_ok=True)
    for name in names:
        (folder / name).touch()
    return str(folder)


@pytest.mark.parametrize(
    ("dry", "wet", "names"),
    [
        (["left01.jpg", "left02.jpg"], ["right02.jpg", "right01.jpg"], ["01", "02"]),
        (["left_01.png", "left_02.png"], ["right_01.png", "right_02.png"], ["01", "02"]),
        (["left_p0_0.png", "left_p1_3.png"], ["right_p0_0.png", "right_p1_3.png"], ["p0_0", "p1_3"]),
        (["001-dry.png", "002-dry.png"], ["001-wet.png", "002-wet.png"], ["001", "002"]),
        (["img_L_1.png", "img_L_2.png"], ["img_R_1.png", "img_R_2.png"], ["img_1", "img_2"]),
        (["boardLeft1.png", "boardLeft2.png"], ["boardRight1.png", "boardRight2.png"], ["board_1", "board_2"]),
        (["cam0_7.png", "cam0_8.png"], ["cam1_7.png", "cam1_8.png"], ["7", "8"]),
        (["cam_01.png", "cam_02.png"], ["cam_01.png", "cam_02.png"], ["cam_01", "cam_02"]),
        (["1400505794141322.png", "1400505794203.png"], ["1400505794141322.png"], ["1400505794141322"]),
        (
            ["basler_4411_0001.png", "basler_4411_0002.png"],
            ["basler_9876_0001.png", "basler_9876_0002.png"],
            ["0001", "0002"],
        ),
        (["lower.png", "drying.png"], ["lower.png", "drying.png"], ["lower", "drying"]),
    ],
)
def test_pairs_by_name(dry: list[str], wet: list[str], names: list[str]) -> None:
    pairing = match([Path("a") / name for name in dry], [Path("b") / name for name in wet])
    pairs, rejected = pairing.pairs, pairing.unpaired
    assert [pair.name for pair in pairs] == names
    for pair in pairs:
        assert re.findall(r"[0-9]+", pair.dry.stem)[-1:] == re.findall(r"[0-9]+", pair.wet.stem)[-1:]
    assert len(rejected) == len(dry) + len(wet) - 2 * len(names)


def test_a_name_used_twice_pairs_nothing() -> None:
    pairing = match(
        [Path("x/left1.png"), Path("y/left1.png"), Path("left2.png")], [Path("right1.png"), Path("right2.png")]
    )
    pairs, rejected = pairing.pairs, pairing.unpaired
    assert [pair.name for pair in pairs] == ["2"]
    left_over = [("left1.png", "dry"), ("left1.png", "dry"), ("right1.png", "wet")]
    assert [(r.path.name, r.role) for r in rejected] == left_over


def test_folders_and_globs(tmp_path: Path) -> None:
    touch(tmp_path / "a", "left2.png", "left1.png", "right1.png", "notes.txt", ".left3.png")
    pairing = match(str(tmp_path / "a" / "left*"), tmp_path / "a" / "right1.png")
    assert [(pair.name, pair.dry.name, pair.wet.name) for pair in pairing.pairs] == [("1", "left1.png", "right1.png")]
    assert [(file.path.name, file.reason) for file in pairing.unpaired] == [
        ("left2.png", "has no partner among the 1 wet images")
    ]
    assert [path.name for path in list_images(tmp_path / "a", "dry")] == ["left1.png", "left2.png", "right1.png"]


def test_what_cannot_be_paired_is_explained(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="there is no dry image at"):
        list_images(touch(tmp_path / "empty"), "dry")
    with pytest.raises(FileNotFoundError, match="given for the wet images, does not exist"):
        list_images(str(tmp_path / "absent"), "wet")
    both = touch(tmp_path / "both", "left1.png", "right1.png")
    with pytest.raises(ValueError, match="the same images were given for both cameras"):
        match(both, both)
    dry, wet = touch(tmp_path / "dry", "1.png"), touch(tmp_path / "wet", "1.png")
    with pytest.raises(ValueError, match="the cameras look swapped"):
        match(wet, dry)
    assert len(match(dry, wet).pairs) == 1
