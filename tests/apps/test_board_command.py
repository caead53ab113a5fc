"""`rainstereo board`: scale, round trip through the detector, the description, and what does not fit."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from rainstereo.apps import board as command
from rainstereo.apps import simulate
from rainstereo.apps.board_sheet import paper_size
from rainstereo.apps.cli import main
from rainstereo.calib import board_file, corners
from rainstereo.calib.board import Board

SPECS = ["chessboard:9x6:25mm", "charuco:8x5:30mm:22mm:DICT_4X4_50", "aprilgrid:5x3:38mm:0.3"]
PATH = re.compile(r"M(-?[\d.]+) (-?[\d.]+)h([\d.]+)v([\d.]+)h-[\d.]+z")


def svg_rectangles(text: str, identity: str) -> np.ndarray:
    path = re.search(rf'id="{identity}"[^>]* d="([^"]*)"', text)
    assert path is not None
    found = PATH.findall(path[1])
    assert "".join(f"M{x} {y}h{w}v{h}h-{w}z" for x, y, w, h in found) == path[1], "something else is drawn"
    return np.array(found, dtype=float)


def pdf_rectangles(data: bytes) -> tuple[tuple[float, float], np.ndarray]:
    """Size of the page and its rectangles, both in millimetres, y down: the cross-reference table leads to them."""
    table = int(re.findall(rb"startxref\n(\d+)\n%%EOF", data)[0])
    count = int(re.match(rb"xref\n0 (\d+)\n", data[table:])[1])  # type: ignore[index]
    places = [int(n) for n in re.findall(rb"(\d{10}) 00000 n \n", data[table:])]
    assert len(places) == count - 1
    for number, place in enumerate(places, 1):
        assert data[place:].startswith(b"%d 0 obj\n" % number)
    box = re.search(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", data)
    assert box is not None
    width, height = (float(n) for n in box.groups())
    length = int(re.search(rb"/Length (\d+)", data)[1])  # type: ignore[index]
    start = data.index(b"stream\n") + len(b"stream\n")
    assert data[start + length :].startswith(b"\nendstream")
    content = data[start : start + length].decode("ascii")
    a, b, c, d, e, f = (float(n) for n in content.split(" cm", 1)[0].split())
    assert (b, c, e) == (0, 0, 0)
    found = np.array(re.findall(r"^(\S+) (\S+) (\S+) (\S+) re$", content, re.M), dtype=float)
    page = np.column_stack([found[:, 0] * a, found[:, 1] * d + f, found[:, 2] * a, found[:, 3] * d])  # points, y up
    page[:, 1] = height - page[:, 1]
    page[:, 3] *= -1
    return (width / 72 * 25.4, height / 72 * 25.4), page / 72 * 25.4


def rasterised(rectangles: np.ndarray, size: tuple[float, float], per_mm: float) -> np.ndarray:
    """Exact share of black of each pixel, as gray levels."""
    ink = np.zeros((round(size[1] * per_mm), round(size[0] * per_mm)))
    for x, y, w, h in rectangles * per_mm:
        across, down = (
            np.clip(np.minimum(np.arange(n) + 1, at + long) - np.maximum(np.arange(n), at), 0, 1)
            for n, at, long in ((ink.shape[1], x, w), (ink.shape[0], y, h))
        )
        rows, columns = down > 0, across > 0
        ink[np.ix_(rows, columns)] += np.outer(down[rows], across[columns])
    assert ink.max() <= 1 + 1e-4, "rectangles overlap"
    return np.round(230 - 200 * ink).astype(np.uint8)


@pytest.mark.parametrize("spec", SPECS)
def test_the_drawing_is_found_where_it_should_be_and_to_scale(spec: str, tmp_path: Path) -> None:
    out = tmp_path / "sub" / "b.svg"
    assert command.run(command.Options(spec, out)) == 0
    text, board, per_mm = out.read_text(), Board.parse(spec), 4.0
    size = re.search(r'width="([\d.]+)mm" height="([\d.]+)mm" viewBox="0 0 ([\d.]+) ([\d.]+)"', text)
    assert size is not None
    assert size.groups() == ("297", "210", "297", "210")
    black = svg_rectangles(text, "board")
    spans = {"chessboard": (250, 175), "charuco": (240, 150), "aprilgrid": (258.4, 159.6)}[board.kind]
    assert black[:, :2].min(0) == pytest.approx([(297 - spans[0]) / 2, (202 - spans[1]) / 2], abs=1e-5)
    first = {"chessboard": 25, "charuco": 30, "aprilgrid": 0.3 * 38}[board.kind]
    image = rasterised(np.vstack([black, svg_rectangles(text, "scale-bar")]), (297, 210), per_mm)
    found = corners.detect(image, board)
    assert found
    expected = (black[:, :2].min(0) + first + 1000 * board.points[..., :2]) * per_mm - 0.5
    assert np.abs(found.xy - expected).max() < 0.1
    report = json.loads((tmp_path / "sub" / "b.report.json").read_text())
    assert report["command"] == "board"
    assert report["board"] == spec
    assert Board.parse(str(tmp_path / "sub" / "b.toml")) == board


@pytest.mark.parametrize("spec", SPECS)
def test_pdf_and_svg_are_the_same_drawing(spec: str, tmp_path: Path) -> None:
    for name in ("b.svg", "b.pdf"):
        assert main(["board", spec, "--out", str(tmp_path / name), "--paper", "A3"]) == 0
    size, drawn = pdf_rectangles((tmp_path / "b.pdf").read_bytes())
    text = (tmp_path / "b.svg").read_text()
    assert size == pytest.approx((420, 297), abs=1e-5)
    both = np.vstack([svg_rectangles(text, "board"), svg_rectangles(text, "scale-bar")])
    assert np.abs(drawn - both).max() < 1e-5
    bar = svg_rectangles(text, "scale-bar")
    assert (bar[:, 0] + bar[:, 2]).max() - bar[:, 0].min() == pytest.approx(200, abs=1e-6)
    assert "200 mm between outer edges" in text
    assert spec in text


def test_texture_and_drawing_agree() -> None:
    """The texture that simulation prints is another formulation of the same board."""
    from rainstereo.calib.board_pattern import black_rectangles

    board = Board.parse(SPECS[1])
    image, origin = board.texture(22, border=0)
    rectangles = black_rectangles(board) / board.square
    rectangles[:, :2] += 1
    drawn = rasterised(rectangles, board.squares, 22)
    assert np.abs((230.0 - drawn) / 200 - (255.0 - image) / 255).max() < 0.01
    assert origin == pytest.approx([21.5, 21.5])


def test_what_does_not_fit_is_refused_with_what_would(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spec = "charuco:11x8:25mm:19mm:DICT_4X4_250"
    assert main(["board", spec, "--out", str(tmp_path / "b.pdf")]) == 2
    told = " ".join(capsys.readouterr().err.split())
    assert "squares of 24 mm" in told
    assert "or take A3" in told
    assert not list(tmp_path.iterdir())
    fitting = re.search(r"charuco:11x8:24mm:\S+:DICT_4X4_250", told)
    assert fitting is not None
    assert main(["board", fitting[0].rstrip(";"), "--out", str(tmp_path / "b.pdf")]) == 0
    larger = fitting[0].rstrip(";").replace("24mm", "24.01mm")
    assert main(["board", larger, "--out", str(tmp_path / "c.pdf")]) == 2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--out", "b.png"], ".pdf or .svg"),
        (["--out", "b.pdf", "--paper", "B4"], "500x700mm"),
        (["--out", "b.pdf", "--paper", "9x9mm"], "sides of 40"),
    ],
)
def test_bad_usage_is_told(arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["board", SPECS[0], *arguments]) == 2
    assert words in " ".join(capsys.readouterr().err.split())


def test_a_measured_description_is_never_overwritten(tmp_path: Path) -> None:
    out = tmp_path / "b.svg"
    assert main(["board", SPECS[0], "--out", str(out)]) == 0
    described = tmp_path / "b.toml"
    described.write_text(described.read_text().replace("square_mm = 25\n", "square_mm = 25.04\n"))
    before = out.read_bytes()
    assert main(["board", SPECS[0], "--out", str(out)]) == 2
    assert "25.04" in described.read_text()
    assert out.read_bytes() == before
    assert Board.parse(str(described)).square == 25.04 / 1000


def test_simulate_takes_a_description(tmp_path: Path) -> None:
    """calibrate reads its board with the same `Board.parse`."""
    file = tmp_path / "b.toml"
    file.write_text(board_file.description(Board.parse("aprilgrid:5x3:24mm:0.3")))
    options = simulate.Options(tmp_path / "out", boards=(str(file),), frames=2, bare_frames=0, drive_frames=0)
    plan = simulate.simulation(options)
    assert [capture.board.spec for capture in plan.captures] == ["aprilgrid:5x3:24mm:0.3"]
    assert [capture.name for capture in plan.captures] == ["aprilgrid"]


def test_paper_sizes() -> None:
    assert paper_size("a4") == (210, 297)
    assert paper_size("500x700mm") == (500, 700)


@pytest.mark.parametrize("spec", [*SPECS, "chessboard:9x6:1m", "chessboard:5x4:0.1mm"])
def test_descriptions_round_trip(spec: str, tmp_path: Path) -> None:
    file = tmp_path / "b.toml"
    file.write_text(board_file.description(Board.parse(spec)))
    assert Board.parse(str(file)) == Board.parse(spec)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("kind = 3", "kind is 3"),
        ("kind = [", "not TOML"),
        ('kind = "chessboard"\ninner_corners = [9, 6]', "lacks square_mm"),
        ('kind = "chessboard"\ninner_corners = [9, 6]\nsquare_mm = 25\nmarker_mm = 3', "marker_mm, which a chessboard"),
        ('kind = "chessboard"\ninner_corners = [9.5, 6]\nsquare_mm = 25', "two whole numbers"),
        ('kind = "chessboard"\ninner_corners = [9, 6]\nsquare_mm = "25mm"', "number of millimetres"),
        ('kind = "chessboard"\ninner_corners = [9, 6]\nsquare_mm = -1', "positive"),
    ],
)
def test_a_wrong_description_says_what_is_wrong(text: str, words: str, tmp_path: Path) -> None:
    file = tmp_path / "b.toml"
    file.write_text(text)
    with pytest.raises(ValueError, match=words):
        Board.parse(str(file))
    with pytest.raises(FileNotFoundError):
        Board.parse(str(tmp_path / "none.toml"))
