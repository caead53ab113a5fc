"""What `rainstereo rain` is given: images, folders, globs, data sets with labels, videos. Names that outputs get."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from glob import glob, has_magic
from os.path import commonpath
from pathlib import Path

from rainstereo.imagefile import SUFFIXES

VIDEOS = frozenset({".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".mpg", ".mpeg"})


@dataclass(frozen=True)
class Label:
    """A label file. name: of its copy below the output folder. void: what marks unknown pixels; None: not an image."""

    path: Path
    name: str
    void: int | None


@dataclass(frozen=True)
class Source:
    """An image or a video. name: of its output below the output folder, without suffix; unique."""

    path: Path
    name: str
    labels: tuple[Label, ...] = ()

    @property
    def is_video(self) -> bool:
        """Whether it is a video, by its suffix."""
        return self.path.suffix.lower() in VIDEOS


def find(given: Sequence[str], labels: Path | None = None, void: int = 255) -> list[Source]:
    """Images and videos of files, folders and globs, in order of their names.

    Folders of data sets are known by what they hold: `leftImg8bit` (Cityscapes), `images` and `labels` (CamVid, 32
    classes), `train` and `trainannot` (CamVid, 11 classes); names then keep their folders. labels: a folder of label
    images named alike, for other folders. void: the label there that means none.
    FileNotFoundError where there is nothing, ValueError where two sources would get one name.
    """
    if not given:
        raise ValueError("no images were given; name a file, a folder or a quoted glob such as 'drive/*.png'")
    found = [source for text in given for source in _of(text)]
    if labels is not None:
        found = [Source(source.path, source.name, _alike(source, labels, void)) for source in found]
    seen: dict[str, Path] = {}
    for source in found:
        other = seen.setdefault(source.name.casefold(), source.path)
        if other != source.path:
            raise ValueError(f"{other} and {source.path} would both be written as {source.name}; render them apart")
    unique = {source.name: source for source in found}
    return [unique[name] for name in sorted(unique)]


def refuse_overlap(given: Sequence[str], sources: Sequence[Source], out: Path) -> None:
    """ValueError where outputs would lie among the inputs, or the other way round."""
    target = out.resolve()
    folders = [Path(text).resolve() for text in given if Path(text).is_dir()]
    inside = next((folder for folder in folders if target == folder or folder in target.parents), None)
    parents = {source.path.resolve().parent for source in sources}
    parents |= {label.path.resolve().parent for source in sources for label in source.labels}
    if inside is None:
        inside = next((parent for parent in sorted(parents) if parent == target or target in parent.parents), None)
    if inside is not None:
        raise ValueError(
            f"--out {out} and the input {inside} lie in one another; a later run would take outputs for inputs. Give a "
            "folder elsewhere"
        )


def _of(text: str) -> list[Source]:
    path = Path(text)
    if path.is_dir():
        found = _data_set(path) or [Source(p, p.stem) for p in _files(path)]
        if not found:
            raise FileNotFoundError(
                f"there is no image and no video in {text}; looked for {', '.join(sorted(SUFFIXES | VIDEOS))}. For "
                f"those in folders below, give '{text}/**/*.png' in quotes"
            )
        return found
    if path.is_file():
        return [Source(path, path.stem)]
    if not has_magic(text):
        raise FileNotFoundError(f"{text} does not exist; give a file, a folder or a quoted glob")
    paths = [Path(p) for p in glob(text, recursive=True) if _is_input(Path(p))]  # noqa: PTH207 - Path.glob refuses absolute ones
    if not paths:
        raise FileNotFoundError(f"no image and no video matches {text}")
    root = Path(commonpath([p.parent for p in paths]))
    return [Source(p, p.relative_to(root).with_suffix("").as_posix()) for p in sorted(paths)]


def _is_input(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES | VIDEOS and not path.name.startswith(".") and path.is_file()


def _files(folder: Path, pattern: str = "*") -> list[Path]:
    return sorted(path for path in folder.glob(pattern) if _is_input(path))


def _data_set(folder: Path) -> list[Source]:
    """Images and labels of a data set that is known by its folders; empty: it is none."""
    if folder.name == "leftImg8bit" and (folder.parent / "gtFine").is_dir():
        folder = folder.parent
    if (folder / "leftImg8bit").is_dir():
        return list(_cityscapes(folder))
    if (folder / "images").is_dir() and (folder / "labels").is_dir():
        return [Source(path, f"images/{path.stem}", _beside(folder, path.stem)) for path in _files(folder / "images")]
    splits = [split for split in ("train", "val", "test") if (folder / f"{split}annot").is_dir()]
    return [
        Source(path, f"{split}/{path.stem}", _existing(folder, {f"{split}annot/{path.stem}.png": 11}))
        for split in splits
        for path in _files(folder / split)
    ]


def _cityscapes(folder: Path) -> Iterator[Source]:
    ending = "_leftImg8bit"
    kinds = {"labelIds.png": 0, "labelTrainIds.png": 255, "instanceIds.png": 0, "color.png": 0, "polygons.json": None}
    for path in _files(folder, f"leftImg8bit/**/*{ending}.png"):
        place = path.parent.relative_to(folder / "leftImg8bit").as_posix()
        stem = path.stem.removesuffix(ending)
        names = {f"gtFine/{place}/{stem}_gtFine_{kind}": void for kind, void in kinds.items()}
        yield Source(path, f"leftImg8bit/{place}/{path.stem}", _existing(folder, names))


def _beside(folder: Path, stem: str) -> tuple[Label, ...]:
    return _existing(folder, {f"labels/{stem}_L.png": 0, f"labels/{stem}.png": 255})


def _existing(folder: Path, names: dict[str, int | None]) -> tuple[Label, ...]:
    return tuple(Label(folder / name, name, void) for name, void in names.items() if (folder / name).is_file())


def _alike(source: Source, labels: Path, void: int) -> tuple[Label, ...]:
    path = labels / f"{Path(source.name).name}.png"
    if not path.is_file():
        raise FileNotFoundError(f"{source.path} has no label image {path}; labels are found by name, as PNG")
    return (Label(path, f"labels/{source.name}.png", void),)
