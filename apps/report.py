"""Builds `report.html`: one file that holds its pictures, reads well on a phone, and says the verdict first.

    page = Report("Calibration", "13 pairs, chessboard 9x6")
    page.verdict("good", "The rig is calibrated: 0.147 px RMS, infinity known to 0.07 px.")
    page.tiles(Tile("RMS per coordinate", "0.147", "px"), Tile("baseline", "83.17", "mm", "+- 0.02"))
    page.section("Residuals", "They have no pattern, so the lens model fits.")
    page.figure(figures.residual_field(points, residuals, (640, 480)), "Residuals of every corner.")
    page.write(out / "report.html")

All text is escaped; a `word` in backquotes is set as code. Images are uint8, gray or BGR as OpenCV reads them.
"""

from __future__ import annotations

import base64
import html
import json
import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from rainstereo.apps.canvas import to_inline_svg, to_png
from rainstereo.apps.run_record import Record, jsonable, write_atomically
from rainstereo.apps.stylesheet import CSS, ICON

Image = npt.NDArray[np.uint8]
Mood = Literal["good", "warn", "bad"]
Cell = str | int | float | None
_WORD: dict[Mood, str] = {"good": "Good.", "warn": "Take care.", "bad": "Not usable."}


class Tile(NamedTuple):
    """A key figure: what it is, its value, its unit, and a few words beneath."""

    label: str
    value: Cell
    unit: str = ""
    note: str = ""


class Report:
    """A page under construction. Parts appear in the order in which they are added; nothing is read or loaded later."""

    def __init__(self, title: str, subtitle: str = "", kicker: str = "rainstereo") -> None:
        self.title = title
        self._head = (
            f'<header><p class="kicker">{_text(kicker)}</p><h1>{_text(title)}</h1>'
            f'<p class="subtitle">{_text(subtitle)}</p></header>'
        )
        self._parts: list[str] = []
        self._sections: list[tuple[str, str]] = []
        self._footer = ""
        self._pictures = 0
        self._gallery: list[tuple[str, Figure | Image]] = []

    def verdict(self, mood: Mood, sentence: str, word: str | None = None) -> None:
        """The one sentence that matters, on a coloured bar; `word` (default by mood) opens it in bold."""
        self._add(
            f'<p class="verdict {mood}"><b>{_text(_WORD[mood] if word is None else word)}</b>{_text(sentence)}</p>'
        )

    def tiles(self, *tiles: Tile) -> None:
        """Key figures side by side."""
        self._add(f'<div class="tiles">{"".join(map(_tile, tiles))}</div>')

    def section(self, heading: str, lead: str = "") -> None:
        """Begin a section: a heading, and a sentence that says what it shows."""
        anchor = f"s{len(self._sections) + 1}"
        self._sections.append((anchor, heading))
        self._add(f'<h2 id="{anchor}">{_text(heading)}</h2>' + (f'<p class="lead">{_text(lead)}</p>' if lead else ""))

    def text(self, *paragraphs: str) -> None:
        """Plain paragraphs."""
        self._add("".join(f"<p>{_text(paragraph)}</p>" for paragraph in paragraphs))

    def bullets(self, items: Iterable[str]) -> None:
        """A list, one line each."""
        self._add(f"<ul>{''.join(f'<li>{_text(item)}</li>' for item in items)}</ul>")

    def code(self, text: str) -> None:
        """Text to copy, such as a command line."""
        self._add(f"<pre>{html.escape(text)}</pre>")

    def figure(self, figure: Figure, caption: str) -> None:
        """A matplotlib figure, as SVG that follows the page's light or dark."""
        self._keep(figure)
        self._add(_framed(to_inline_svg(figure, self._name(), html.escape(caption, quote=True)), caption))

    def image(self, image: Image, caption: str, quality: int = 90) -> None:
        """One image. `quality` is JPEG's; 100 keeps every gray level (PNG)."""
        self._keep(image)
        self._add(_framed(_img(image, caption, quality), caption))

    def images(self, images: Sequence[Image], captions: Sequence[str], quality: int = 88) -> None:
        """Several images side by side as the page's width allows, each with its caption."""
        self._keep(*images)
        pairs = zip(images, captions, strict=True)
        self._add(f'<div class="row">{"".join(_framed(_img(i, c, quality), c) for i, c in pairs)}</div>')

    def compare(self, first: Image, second: Image, labels: tuple[str, str], caption: str, quality: int = 90) -> None:
        """Two images of one size behind a slider: `first` left of the cut, `second` right of it."""
        self._keep(first, second)
        self._same_size(first, second)
        slider = (
            f'<input type="range" min="0" max="100" step="0.1" value="50" aria-label="{_text(" or ".join(labels))}"'
            " oninput=\"this.parentElement.style.setProperty('--cut',this.value+'%')\">"
        )
        self._add(_framed(f'<div class="two slide">{_two(first, second, labels, quality)}{slider}</div>', caption))

    def blink(self, first: Image, second: Image, labels: tuple[str, str], caption: str, quality: int = 90) -> None:
        """Two images of one size in turn: whatever jumps is not aligned. A box stops them."""
        self._keep(first, second)
        self._same_size(first, second)
        stop = '<label><input type="checkbox"> hold still</label>'
        self._add(_framed(f'<div class="two">{_two(first, second, labels, quality)}</div>{stop}', caption, "blink"))

    def table(
        self,
        header: Sequence[str],
        rows: Sequence[Sequence[Cell]],
        caption: str = "",
        strong: Iterable[int] = (),
        numbers: Iterable[int] = (),
    ) -> None:
        """A table. Columns without text, and those in `numbers`, are set to the right; rows in `strong` are bold.

        None and NaN are dashes. ValueError where a row has another number of cells than the header.
        """
        self._add(_table(header, rows, caption, set(strong), set(numbers)))

    def details(self, summary: str, content: str | Mapping[str, object]) -> None:
        """Something to unfold: a text, or names and values as a table."""
        body = f"<pre>{html.escape(content)}</pre>" if isinstance(content, str) else _pairs(content)
        self._add(f"<details><summary>{_text(summary)}</summary>{body}</details>")

    def record(self, record: Record) -> None:
        """Options, versions, seed and run time of a command, folded away at the foot of the page."""
        own = record.as_dict()
        self.details(
            "How this was made", {key: own[key] for key in ("argv", "options", "seed", "started", "elapsed_s")}
        )
        self.details("Versions", own["versions"])
        self._footer = f"rainstereo {own['versions']['rainstereo']} · {own['command']} · {own['started']}"

    def save_pictures(self, folder: str | os.PathLike[str]) -> list[Path]:
        """Write each picture of the page to a file of its own, named after its section: figures PNG, images JPEG."""
        written = []
        for name, picture in self._gallery:
            if isinstance(picture, Figure):
                written.append(write_atomically(Path(folder) / f"{name}.png", to_png(picture, dpi=110)))
            else:
                data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 88])[1]
                written.append(write_atomically(Path(folder) / f"{name}.jpg", data.tobytes()))
        return written

    def html(self) -> str:
        """The whole page."""
        links = "".join(f'<a href="#{anchor}">{_text(heading)}</a>' for anchor, heading in self._sections)
        nav = f"<nav>{links}</nav>" if len(self._sections) > 2 else ""
        return (
            '<!doctype html><html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width,initial-scale=1">'
            f'<title>{_text(self.title, code=False)} · rainstereo</title><link rel="icon" href="{ICON}">'
            f"<style>{CSS}</style></head><body><main>{self._head}{nav}{''.join(self._parts)}"
            f"<footer>{_text(self._footer or 'rainstereo')}</footer></main></body></html>\n"
        )

    def write(self, path: str | os.PathLike[str]) -> Path:
        """Write the page to `path` (atomically) and return the path."""
        return write_atomically(path, self.html().encode())

    def _add(self, part: str) -> None:
        self._parts.append(part + "\n")

    def _keep(self, *pictures: Figure | Image) -> None:
        """Remember pictures under the name of their section and a number: residuals-1, residuals-2, ..."""
        heading = self._sections[-1][1] if self._sections else self.title
        slug = re.sub(r"[^a-z0-9]+", "-", heading.lower()).strip("-")
        for picture in pictures:
            count = sum(name.rpartition("-")[0] == slug for name, _ in self._gallery)
            self._gallery.append((f"{slug}-{count + 1}", picture))

    def _name(self) -> str:
        self._pictures += 1
        return f"f{self._pictures}"

    @staticmethod
    def _same_size(first: Image, second: Image) -> None:
        if first.shape[:2] != second.shape[:2]:
            raise ValueError(f"images of {first.shape[:2]} and {second.shape[:2]} pixels; expected the same size")


def quantity(value: float | None, unit: str = "", digits: int = 3) -> str:
    """`value` to `digits` significant digits with its unit: "0.147 px". No answer (None, NaN, inf) is a dash."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0:
        words = "0"
    elif 1e-3 <= abs(value) < 1e6:
        decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
        words = f"{value:,.{decimals}f}"
    else:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        words = f"{mantissa}e{int(exponent)}"
    return f"{words} {unit}".strip()


def _text(text: str, code: bool = True) -> str:
    escaped = html.escape(str(text), quote=True)
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escaped) if code else escaped


def _cell(value: Cell) -> str:
    if isinstance(value, float) or value is None:
        words = quantity(value, digits=4)
        return re.sub(r"(\.\d*?)0+(?=e|$)", r"\1", words).replace(".e", "e").rstrip(".")
    return f"{value:,}" if isinstance(value, int) else _text(value)


def _tile(tile: Tile) -> str:
    unit = f'<span class="unit">{_text(tile.unit)}</span>' if tile.unit else ""
    note = f'<div class="note">{_text(tile.note)}</div>' if tile.note else ""
    value = f'<div class="value">{_cell(tile.value)}{unit}</div>'
    return f'<div class="tile"><div class="label">{_text(tile.label)}</div>{value}{note}</div>'


def _framed(content: str, caption: str, kind: str = "") -> str:
    return (
        f'<figure class="{kind}"><div class="plate">{content}</div><figcaption>{_text(caption)}</figcaption></figure>'
    )


def _img(image: Image, alternative: str, quality: int) -> str:
    if image.dtype != np.uint8 or image.ndim not in (2, 3):
        raise ValueError(f"image is {image.dtype} {image.shape}; expected uint8, gray (H, W) or BGR (H, W, 3)")
    lossless = quality >= 100
    options = [cv2.IMWRITE_PNG_COMPRESSION, 9] if lossless else [cv2.IMWRITE_JPEG_QUALITY, quality]
    done, data = cv2.imencode(".png" if lossless else ".jpg", image, options)
    if not done:
        raise ValueError(f"an image of shape {image.shape} could not be encoded")
    code = base64.b64encode(data.tobytes()).decode()
    height, width = image.shape[:2]
    kind = "png" if lossless else "jpeg"
    size = f'width="{width}" height="{height}"'
    return f'<img {size} alt="{_text(alternative, code=False)}" src="data:image/{kind};base64,{code}">'


def _two(first: Image, second: Image, labels: tuple[str, str], quality: int) -> str:
    images = _img(first, labels[0], quality) + _img(second, labels[1], quality)
    return f'{images}<span class="tag a">{_text(labels[0])}</span><span class="tag b">{_text(labels[1])}</span>'


def _table(
    header: Sequence[str], rows: Sequence[Sequence[Cell]], caption: str, strong: set[int], numbers: set[int]
) -> str:
    for row in rows:
        if len(row) != len(header):
            raise ValueError(f"a row has {len(row)} cells and the header {len(header)}: {list(row)}")
    numeric = [
        i in numbers or (bool(rows) and not any(isinstance(row[i], str) for row in rows)) for i in range(len(header))
    ]
    kind = [' class="number"' if n else "" for n in numeric]
    head = "".join(f"<th{k}>{_text(name)}</th>" for k, name in zip(kind, header, strict=True))
    mark = dict.fromkeys(strong, ' class="strong"')
    body = "".join(
        f"<tr{mark.get(i, '')}>"
        + "".join(f"<td{k}>{_cell(cell)}</td>" for k, cell in zip(kind, row, strict=True))
        + "</tr>"
        for i, row in enumerate(rows)
    )
    note = f"<caption>{_text(caption)}</caption>" if caption else ""
    return f'<div class="scroll"><table>{note}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _pairs(content: Mapping[str, object]) -> str:
    rows = []
    for key, value in content.items():
        plain = jsonable(value)
        if isinstance(plain, dict):
            words = "\n".join(f"{k}: {json.dumps(v, ensure_ascii=False)}" for k, v in plain.items())
        else:
            words = " ".join(map(str, plain)) if isinstance(plain, list) else str(plain)
        rows.append(
            f'<tr><th>{_text(key)}</th><td><code style="white-space:pre-wrap">{html.escape(words)}</code></td></tr>'
        )
    return f'<div class="scroll"><table><tbody>{"".join(rows)}</tbody></table></div>'
