"""A board on a sheet of paper, in millimetres, as SVG and as PDF: vectors only, at exact scale."""

from __future__ import annotations

import math
import re
import textwrap
from dataclasses import dataclass, replace
from xml.sax.saxutils import escape

import numpy as np

from rainstereo.calib.board import Board
from rainstereo.calib.board_pattern import black_rectangles
from rainstereo.types import Array

PAPERS = {"A0": (841, 1189), "A1": (594, 841), "A2": (420, 594), "A3": (297, 420), "A4": (210, 297), "A5": (148, 210),
          "LETTER": (215.9, 279.4), "LEGAL": (215.9, 355.6), "TABLOID": (279.4, 431.8)}  # fmt: skip
MARGIN = 5.0
"""Millimetres of white on every side; printers reach no nearer to the edge."""
STRIP = 8.0
"""Height of the strip at the lower edge, millimetres, that holds the scale bar and the words."""
BARS = (200, 100, 50, 20, 10)
TEXT, LINE = 1.9, 1.25
"""Height of letters, millimetres, and distance of lines in that height."""
WIDE = 0.52
"""Mean width of a letter of Helvetica in its height."""
LARGEST_PAPER = 5080.0
"""Millimetres; a PDF page can be no larger than 200 inches."""
POINTS = 72 / 25.4
"""PDF's unit is a seventy-second of an inch."""


@dataclass(frozen=True, eq=False)
class Sheet:
    """What is drawn on a paper of `size` (width, height) millimetres; x to the right, y down from the upper left.

    black: (N, 4) rectangles x, y, width, height of the board; bar: the same of the scale bar. bar_mm: its length.
    origin: (2,), the board's corner [0, 0]. texts: (x, y of the base line, height, words).
    """

    size: tuple[float, float]
    black: Array
    bar: Array
    bar_mm: int
    origin: Array
    texts: tuple[tuple[float, float, float, str], ...]


def paper_size(words: str) -> tuple[float, float]:
    """Width and height in millimetres of a paper: a name such as A4, or 500x700mm."""
    name = words.strip().upper()
    if name in PAPERS:
        width, height = PAPERS[name]
        return float(width), float(height)
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)[X×]([0-9]+(?:\.[0-9]+)?)\s*MM", name)
    if match is None:
        raise ValueError(f"the paper {words!r} is unknown; expected {', '.join(PAPERS)}, or a size such as 500x700mm")
    width, height = float(match[1]), float(match[2])
    if not (40 <= width <= LARGEST_PAPER and 40 <= height <= LARGEST_PAPER):
        raise ValueError(f"a paper of {words} was asked for; expected sides of 40 to {LARGEST_PAPER:g} mm")
    return width, height


def sheet(board: Board, paper: str) -> Sheet:
    """The board in the middle of the paper, upright or on its side; ValueError, with what would fit, if it does not.

    A paper given by its size is turned only where the board does not fit otherwise.
    """
    width, height = paper_size(paper)
    tall, wide = (width, height), (height, width)
    across, down = (1000 * n for n in board.size)
    upright = across <= down or paper.strip().upper() not in PAPERS
    for size in (tall, wide) if upright else (wide, tall):
        if across <= size[0] - 2 * MARGIN + 1e-6 and down <= size[1] - 2 * MARGIN - STRIP + 1e-6:
            return _laid_out(board, size)
    raise ValueError(_too_large(board, paper, (tall, wide)))


def _too_large(board: Board, paper: str, sizes: tuple[tuple[float, float], ...]) -> str:
    across, down = (1000 * n for n in board.size)
    share = max(min((w - 2 * MARGIN) / across, (h - 2 * MARGIN - STRIP) / down) for w, h in sizes)
    largest = math.floor(share * board.square * 1e5 + 1e-6) / 100  # whole hundredths of a millimetre
    fitting = replace(board, square=largest / 1000)
    if board.marker is not None:
        fitting = replace(fitting, marker=math.floor(share * board.marker * 1e5 + 1e-6) / 1e5)
    larger = [name for name, (w, h) in sorted(PAPERS.items(), key=lambda item: item[1])
              if name.startswith("A") and max(min((a - 2 * MARGIN) / across, (b - 2 * MARGIN - STRIP) / down)
                                              for a, b in ((w, h), (h, w))) >= 1]  # fmt: skip
    what = "tags" if board.kind == "aprilgrid" else "squares"
    remedy = f"; or take {larger[0]}" if larger else ""
    return (
        f"the pattern of {board.spec} spans {across:g} x {down:g} mm, which does not fit on {paper} with {MARGIN:g} mm "
        f"of white on each side and {STRIP:g} mm for the scale bar. The largest that fits has {what} of {largest:g} "
        f"mm: {fitting.spec}{remedy}"
    )


def _laid_out(board: Board, size: tuple[float, float]) -> Sheet:
    across, down = (1000 * n for n in board.size)
    corner = np.array([(size[0] - across) / 2, (size[1] - STRIP - down) / 2])
    origin = corner + 1000 * board.margin
    black = 1000 * black_rectangles(board)
    black[:, :2] += origin
    length = next(n for n in BARS if n <= size[0] * 0.5 - MARGIN or n == BARS[-1])
    base = size[1] - MARGIN
    ticks = np.arange(0, length + 1, 10.0)
    tall = np.where(np.isin(ticks, (0, length)), 3.0, 1.5)
    # the outer edges of the end ticks are `length` apart: what a ruler is laid against
    at = MARGIN + ticks - np.where(ticks == length, 0.2, np.where(ticks == 0, 0.0, 0.1))
    bar = np.vstack([
        np.column_stack([at, base - tall, np.full_like(at, 0.2), tall - 0.2]),
        [[MARGIN, base - 0.2, length, 0.2]],
    ])  # fmt: skip
    texts = [(MARGIN + 1.0, base - 3.8, TEXT, f"{length} mm between outer edges: check with a ruler")]
    words = f"{board.spec}   span {across:.10g} x {down:.10g} mm   print at 100 %, not fitted to the page"
    left = MARGIN + max(length, len(texts[0][3]) * WIDE * TEXT) + 5
    room = size[0] - MARGIN - left
    lines = textwrap.wrap(words, max(int(room / (WIDE * TEXT)), 12))
    height = min(TEXT, STRIP / LINE / max(len(lines), 1), room / (WIDE * max(map(len, lines))))
    first = base - (len(lines) - 1) * LINE * height - 0.2
    texts += [(left, first + i * LINE * height, height, line) for i, line in enumerate(lines)]
    return Sheet(size, black, bar, length, origin, tuple(texts))


def svg(page: Sheet, title: str) -> bytes:
    """The sheet as SVG whose user unit is the millimetre."""
    width, height = (_number(n) for n in page.size)
    words = "\n".join(
        f'<text x="{_number(x)}" y="{_number(y)}" font-size="{_number(tall)}" '
        f'font-family="Helvetica, Arial, sans-serif" xml:space="preserve">{escape(text)}</text>'
        for x, y, tall, text in page.texts
    )
    return f"""\
<?xml version="1.0" encoding="UTF-8"?>
<svg xmlns="http://www.w3.org/2000/svg" width="{width}mm" height="{height}mm" viewBox="0 0 {width} {height}">
<title>{escape(title)}</title>
<rect width="{width}" height="{height}" fill="#fff"/>
<path id="board" fill="#000" d="{_svg_path(page.black)}"/>
<path id="scale-bar" fill="#000" d="{_svg_path(page.bar)}"/>
{words}
</svg>
""".encode()


def _svg_path(rectangles: Array) -> str:
    return "".join(
        f"M{_number(x)} {_number(y)}h{_number(w)}v{_number(h)}h{_number(-w)}z" for x, y, w, h in rectangles.tolist()
    )


def pdf(page: Sheet, title: str) -> bytes:
    """The sheet as PDF 1.4: one page, its drawing in millimetres, letters in the Helvetica that every reader has."""
    width, height = page.size
    drawn = [f"{POINTS:.9f} 0 0 {-POINTS:.9f} 0 {height * POINTS:.6f} cm", "0 g"]
    for rectangles in (page.black, page.bar):
        drawn += [" ".join(_number(n) for n in each) + " re" for each in rectangles.tolist()] + ["f"]
    for x, y, tall, text in page.texts:
        drawn.append(f"BT /F1 {_number(tall)} Tf 1 0 0 -1 {_number(x)} {_number(y)} Tm ({_pdf_string(text)}) Tj ET")
    content = "\n".join(drawn).encode("ascii")
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width * POINTS:.6f} {height * POINTS:.6f}] /Contents 4 0 R "
        "/Resources << /Font << /F1 5 0 R >> >> >>".encode("ascii"),
        f"<< /Length {len(content)} >>\nstream\n".encode("ascii") + content + b"\nendstream",
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
        f"<< /Title ({_pdf_string(title)}) /Producer (rainstereo) >>".encode("ascii"),
    ]
    made = bytearray(b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n")
    places = []
    for number, body in enumerate(objects, 1):
        places.append(len(made))
        made += f"{number} 0 obj\n".encode("ascii") + body + b"\nendobj\n"
    table = len(made)
    made += f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n".encode("ascii")
    made += "".join(f"{place:010d} 00000 n \n" for place in places).encode("ascii")
    made += f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R /Info 6 0 R >>\nstartxref\n{table}\n%%EOF\n".encode(
        "ascii"
    )
    return bytes(made)


def _pdf_string(text: str) -> str:
    plain = text.encode("ascii", "replace").decode("ascii")
    return plain.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")


def _number(value: float) -> str:
    """A decimal to the nanometre, without an exponent."""
    return f"{value:.6f}".rstrip("0").rstrip(".") if value % 1 else f"{value:.0f}"
