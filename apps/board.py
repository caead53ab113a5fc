"""`rainstereo board`: a calibration board as a drawing to print, with its description."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from rainstereo.apps.board_sheet import pdf, sheet, svg
from rainstereo.apps.cli import DONE
from rainstereo.apps.run_record import Record, write_atomically
from rainstereo.calib import board_file
from rainstereo.calib.board import Board

WRITERS = {".pdf": pdf, ".svg": svg}


@dataclass(frozen=True)
class Options:
    """Draw a calibration board to be printed at exact scale, and write its description beside it.

    FILE.toml, the description, may be given wherever a board is asked for: --board FILE.toml. Print at 100 %, check
    the scale bar with a ruler, measure the print, and correct the lengths in FILE.toml.
    """

    spec: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="BOARD")]
    """chessboard:9x6:25mm (inner corners, side of a square), charuco:11x8:25mm:19mm:DICT_4X4_250 (squares, their side,
    side of a marker, dictionary), aprilgrid:6x6:88mm:0.3 (tags, side of a tag, gap in sides of a tag); or a
    description, FILE.toml."""
    out: Path
    """Drawing to write: FILE.pdf or FILE.svg; beside it FILE.toml and FILE.report.json."""
    paper: str = "A4"
    """A0 to A5, letter, legal, tabloid, or a size such as 500x700mm; turned as the board needs it."""


def run(options: Options) -> int:
    """Draw; the exit status. ValueError where the board does not fit on the paper."""
    record = Record("board", options)
    write = WRITERS.get(options.out.suffix.lower())
    if write is None:
        raise ValueError(f"--out {options.out} was given; expected a name that ends in {' or '.join(WRITERS)}")
    board = Board.parse(options.spec)
    described = options.out.with_suffix(".toml")
    page = sheet(board, options.paper)
    text = board_file.description(board)
    if described.exists() and described.read_bytes() != text.encode() and board_of(described) != board:
        raise ValueError(
            f"{described} describes something else, perhaps a board that was measured; move it away, or name another "
            "--out"
        )
    write_atomically(options.out, write(page, board.spec))
    if not described.exists():
        write_atomically(described, text.encode())
    record["board"] = board.spec
    record["paper_mm"] = page.size
    record["pattern_mm"] = [1000 * n for n in board.size]
    record["scale_bar_mm"] = page.bar_mm
    record["files"] = [options.out, described]
    record.write(options.out.with_suffix(".report.json"))
    width, height = board.size
    print(
        f"{options.out}: {board.spec} on {page.size[0]:g} x {page.size[1]:g} mm. Print it at 100 %; the scale bar is "
        f"{page.bar_mm} mm, the pattern {1000 * width:.10g} x {1000 * height:.10g} mm. Then: --board {described}"
    )
    return DONE


def board_of(path: Path) -> Board | None:
    """The board that a file describes, None if it describes none."""
    try:
        return board_file.read(path)
    except ValueError:
        return None
