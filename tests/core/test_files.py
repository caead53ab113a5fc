"""Image files and pairs of them: whole or not at all, and matched by what their names share."""

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


def test_every_cut_of_a_file_is_refused(tmp_path: Path) -> None:
    for suffix in (".png", ".jpg"):
        data = cv2.imencode(suffix, PICTURE)[1].tobytes()
        assert imagefile.decode(data).shape == PICTURE.shape
        for cut in (*range(1, 40, 7), len(data) // 2, len(data) - 20, len(data) - 3):
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
        (["0001.png", "0002.png"], ["0002.png", "0001.png"], ["0001", "0002"]),
        (["left01.jpg", "left02.jpg"], ["right01.jpg", "right02.jpg"], ["01", "02"]),
        (["left_pA_B.png"], ["right_pA_B.png"], ["pA_B"]),
        (["dry-7.png"], ["wet-7.jpg"], ["7"]),
        (["12_l.png"], ["12_r.png"], ["12"]),
        (["cam0_5.png"], ["cam1_5.png"], ["5"]),
        (["1520000000123456.png"], ["1520000000123456.png"], ["1520000000123456"]),
    ],
)
def test_pairs_by_name(tmp_path: Path, dry: list[str], wet: list[str], names: list[str]) -> None:
    pairing = match(touch(tmp_path / "a", *dry), touch(tmp_path / "b", *wet))
    assert [pair.name for pair in pairing.pairs] == names
    assert not pairing.unpaired
    assert all(pair.dry.parent.name == "a" and pair.wet.parent.name == "b" for pair in pairing.pairs)


def test_files_without_a_partner_are_named(tmp_path: Path) -> None:
    pairing = match(
        touch(tmp_path / "a", "left1.png", "left2.png", "notes.txt"), touch(tmp_path / "b", "right2.png", "right3.png")
    )
    assert [pair.name for pair in pairing.pairs] == ["2"]
    assert [(path.name, reason) for path, reason in pairing.unpaired] == [
        ("left1.png", "no wet image of this name"),
        ("right3.png", "no dry image of this name"),
    ]


def test_one_folder_and_two_globs(tmp_path: Path) -> None:
    touch(tmp_path / "a", "left1.png", "right1.png")
    pairing = match(str(tmp_path / "a" / "left*"), str(tmp_path / "a" / "right*"))
    assert [(pair.dry.name, pair.wet.name) for pair in pairing.pairs] == [("left1.png", "right1.png")]


def test_what_cannot_be_paired_is_explained(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="holds no image"):
        list_images(touch(tmp_path / "empty"))
    with pytest.raises(FileNotFoundError, match="is no folder and matches no image"):
        list_images(str(tmp_path / "absent"))
    both = touch(tmp_path / "both", "left1.png", "right1.png")
    with pytest.raises(ValueError, match="same name apart from their role"):
        match(both, both)
    dry, wet = touch(tmp_path / "dry", "1.png"), touch(tmp_path / "wet", "1.png")
    with pytest.raises(ValueError, match="the cameras are swapped"):
        match(wet, dry)
    assert len(match(dry, wet).pairs) == 1
