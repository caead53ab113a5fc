"""Pages, records and pictures: escaped, self-contained, whole or absent, and the same bytes twice."""

import base64
import dataclasses
import enum
import html.parser
import json
import math
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rainstereo.apps import figures, overlays
from rainstereo.apps.canvas import INK, to_inline_svg, to_png, to_svg
from rainstereo.apps.report import Report, Tile, quantity
from rainstereo.apps.run_record import RESERVED, Record, jsonable, write_atomically, write_json
from rainstereo.apps.tradeoff import error_against_time, times_alone

VOID = {"meta", "link", "img", "input", "br", "hr"}


class Page(html.parser.HTMLParser):
    """Reads a page, checks that its tags nest, and keeps its texts, ids and everything that it points at."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.references: list[str] = []
        self.texts: list[str] = []
        self.scripts = 0
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.scripts += tag == "script" or any(name.startswith("on") and name != "oninput" for name in values)
        self.ids += [values["id"] or ""] if "id" in values else []
        self.references += [values[key] or "" for key in ("src", "href", "xlink:href") if key in values]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def picture(seed: int = 0, shape: tuple[int, ...] = (40, 60, 3)) -> Any:
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


@pytest.fixture(scope="module")
def full_page() -> str:
    page = Report("Calibration", "of a rig")
    page.verdict("good", "It works.")
    page.tiles(Tile("rms", 0.147, "px", "inliers"), Tile("model", "OPENCV8"))
    for heading in ("One", "Two", "Three"):
        page.section(heading, "A lead sentence.")
        page.figure(error_against_time(["a", "b"], [1, 2], [1e-3, 1e-6]), "Error against time.")
    page.image(picture(), "An image.")
    page.images([picture(1), picture(2, (40, 60))], ["colour", "gray"])
    page.compare(picture(1), picture(2), ("dry", "wet"), "Drag.")
    page.blink(picture(1), picture(2), ("dry", "wet"), "Blink.")
    page.table(["variant", "ms"], [["a", 1.5], ["b", None]], "Times.", strong=[0])
    page.details("More", {"options": {"seed": 0}, "list": [1, 2]})
    page.bullets(["one", "two"])
    page.code("rainstereo demo --out out")
    page.record(Record("calibrate", {"out": Path("rig")}, seed=3))
    return page.html()


def test_page_is_whole_and_loads_nothing(full_page: str) -> None:
    text = full_page
    page = Page(text)
    assert page.scripts == 0
    assert len(page.ids) == len(set(page.ids))
    for reference in page.references:
        assert reference.startswith(("data:image/", "#")), reference[:60]
    inner = {reference[1:] for reference in page.references if reference.startswith("#")}
    assert inner <= set(page.ids)
    assert set(re.findall(r"url\(#([^)]+)\)", text)) <= set(page.ids)
    assert not re.findall(r"url\((?!#)|@import|https?://(?!www\.w3\.org/)", text)


def test_pictures_in_a_page_can_be_told_from_each_other(full_page: str) -> None:
    page = Page(full_page)
    led = {name.split("-")[0] for name in page.ids if "-" in name}
    assert {"f1", "f2", "f3"} <= led


@given(st.text(min_size=1, max_size=60))
def test_every_text_is_escaped(text: str) -> None:
    hostile = f"<script>{text}</script>\"'&`<b>`"
    report = Report(hostile, hostile)
    report.verdict("bad", hostile, hostile)
    report.tiles(Tile(hostile, hostile, hostile, hostile))
    report.section(hostile, hostile)
    report.text(hostile)
    report.bullets([hostile])
    report.code(hostile)
    report.table([hostile], [[hostile]], hostile)
    report.details(hostile, hostile)
    report.details(hostile, {hostile: {hostile: hostile}})
    report.image(picture(shape=(4, 4)), hostile)
    report.compare(picture(shape=(4, 4)), picture(shape=(4, 4)), (hostile, hostile), hostile)
    assert Page(report.html()).scripts == 0


def test_figure_caption_is_escaped_in_the_picture_too() -> None:
    report = Report("x")
    report.figure(error_against_time(["a"], [1], [1]), 'a "<quoted>" caption')
    page = Page(report.html())
    assert 'a "<quoted>" caption' in page.texts


def test_png_in_a_page_is_the_image_bit_for_bit() -> None:
    image = picture()
    report = Report("x")
    report.image(image, "lossless", quality=100)
    code = re.search(r"data:image/png;base64,([^\"]+)", report.html())
    assert code is not None
    decoded = cv2.imdecode(np.frombuffer(base64.b64decode(code[1]), np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(decoded, image)


def test_bad_images_and_rows_are_refused() -> None:
    report = Report("x")
    with pytest.raises(ValueError, match="uint8"):
        report.image(np.zeros((4, 4)), "float")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="same size"):
        report.compare(picture(), picture(shape=(4, 4)), ("a", "b"), "c")
    with pytest.raises(ValueError, match="1 cells and the header 2"):
        report.table(["a", "b"], [["only one"]])


@pytest.mark.parametrize(
    ("value", "words"),
    [(0.147, "0.147 px"), (83.1712, "83.2 px"), (0.0, "0 px"), (1234567.0, "1.23e6 px"), (2.5e-13, "2.50e-13 px"),
     (-0.05, "-0.0500 px"), (12345.6, "12,346 px"), (math.nan, "–"), (math.inf, "–"), (None, "–")],
)  # fmt: skip
def test_quantity(value: float | None, words: str) -> None:
    assert quantity(value, "px") == words


def test_cells_drop_trailing_zeros_only_behind_the_point() -> None:
    report = Report("x")
    report.table(["v"], [[0.07], [100.0], [83.17], [1e-13], [1500]])
    cells = re.findall(r'<td class="number">([^<]*)</td>', report.html())
    assert cells == ["0.07", "100", "83.17", "1e-13", "1,500"]


# -- report.json -------------------------------------------------------------------------------------------------------


class Colour(enum.Enum):
    RED = 1


@dataclasses.dataclass(frozen=True)
class Choice:
    out: Path
    tilt: float
    colour: Colour


def test_json_holds_numpy_nan_paths_and_dataclasses(tmp_path: Path) -> None:
    value = {
        "matrix": np.array([[1.5, np.nan], [np.inf, -2]]),
        "count": np.int32(3),
        "flag": np.bool_(True),
        "single": np.float32(0.5),
        "options": Choice(Path("a/b"), math.nan, Colour.RED),
        "set": {"b", "a"},
        "empty": np.zeros((0, 2)),
    }
    read = json.loads(write_json(tmp_path / "deep" / "x.json", value).read_text())
    assert read == {
        "matrix": [[1.5, None], [None, -2.0]],
        "count": 3,
        "flag": True,
        "single": 0.5,
        "options": {"out": "a/b", "tilt": None, "colour": "RED"},
        "set": ["a", "b"],
        "empty": [],
    }


NESTED = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


@given(NESTED)
def test_json_is_strict_and_repeats(value: object) -> None:
    plain = jsonable(value)
    text = json.dumps(plain, allow_nan=False)
    assert jsonable(json.loads(text)) == plain


def test_json_names_what_it_cannot_hold() -> None:
    with pytest.raises(TypeError, match=r"\$\.a\[1\] is a complex"):
        jsonable({"a": [1, 1j]})


def test_record_has_results_on_top_and_versions_beside(tmp_path: Path) -> None:
    record = Record("calibrate", Choice(Path("rig"), 0.2, Colour.RED), seed=7)
    record["rms_px"] = np.float64(0.147)
    record.status = "degenerate"
    read = json.loads(record.write(tmp_path / "report.json").read_text())
    assert list(read)[:3] == ["command", "status", "rms_px"]
    assert set(RESERVED) <= read.keys()
    assert (read["rms_px"], read["status"], read["seed"]) == (0.147, "degenerate", 7)
    assert read["versions"]["numpy"] == np.__version__
    assert read["versions"]["opencv"].startswith(cv2.__version__)
    assert 0 <= read["elapsed_s"] < 60


def test_record_takes_the_seed_from_the_options() -> None:
    @dataclasses.dataclass(frozen=True)
    class Seeded:
        seed: int = 11

    assert Record("simulate", Seeded()).as_dict()["seed"] == 11


@pytest.mark.parametrize("key", RESERVED)
def test_record_keeps_its_own_keys(key: str) -> None:
    with pytest.raises(ValueError, match=key):
        Record("x")[key] = 1


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    target = write_atomically(tmp_path / "report.json", b"old")
    with pytest.raises(TypeError):
        write_atomically(target, "not bytes")  # type: ignore[arg-type]
    assert target.read_bytes() == b"old"
    assert [path.name for path in tmp_path.iterdir()] == ["report.json"]


# -- pictures ----------------------------------------------------------------------------------------------------------

RNG = np.random.default_rng(5)
POINTS = RNG.uniform((0, 0), (639, 479), (60, 2))
POINTS[3] = np.nan
RESIDUALS = RNG.normal(0, 0.2, (60, 2))
BOARD = np.array([[-0.1, -0.1, 1], [0.1, -0.1, 1], [0.1, 0.1, 1.1], [-0.1, 0.1, 1.1]])
FRUSTUM = np.array([[0, 0, 0], [-0.5, -0.4, 1], [0.5, -0.4, 1], [0.5, 0.4, 1], [-0.5, 0.4, 1.0]])
MAKERS = {
    "residuals": lambda: figures.residual_field(POINTS, RESIDUALS, (640, 480), RESIDUALS[:, 0] > 0.3),
    "no residuals": lambda: figures.residual_field(np.full((4, 2), np.nan), np.zeros((4, 2)), (640, 480)),
    "coverage": lambda: figures.coverage(POINTS, (640, 480)),
    "no coverage": lambda: figures.coverage(np.full((4, 2), np.nan), (640, 480)),
    "heat": lambda: figures.heat_map(np.hypot(*np.mgrid[-1:1:9j, -1:1:12j]), (640, 480), "px"),
    "flat heat": lambda: figures.heat_map(np.full((9, 12), 0.1), (640, 480), "px"),
    "unknown heat": lambda: figures.heat_map(np.full((9, 12), np.nan), (640, 480), "px"),
    "rig": lambda: figures.rig_view([BOARD, BOARD + 0.2], {"dry": FRUSTUM, "wet": FRUSTUM + 0.029}, [BOARD * 0.05]),
    "bare rig": lambda: figures.rig_view(np.zeros((0, 4, 3)), {"dry": FRUSTUM}),
    "frames": lambda: figures.frame_bars(["a.png", "b" * 60], [50, 40], [0, 9], [0.1, np.nan], limit=0.1),
    "no frames": lambda: figures.frame_bars([], [], []),
    "trade": lambda: error_against_time(["a", "b", "c"], [1, 2, 3], [0, 1e-9, np.nan], [0.9, 2, 3], [1.1, 2, 3]),
    "through zero": lambda: error_against_time(["a", "b", "c"], [1, 2, 3], [-39, 0, 0.05], [0.9, 2, 3], [1.1, 2, 3]),
    "no trade": lambda: error_against_time(["a"], [np.nan], [1]),
    "same trade": lambda: error_against_time(["a", "b"], [1, 1], [1e-3, 1e-3]),
    "times": lambda: times_alone(["a", "b"], [1, 3], [0.9, 2], [1.1, 4], [True, False]),
    "grid": lambda: figures.image_grid([picture(), picture(1, (20, 30))], ["one", "two"]),
}


@pytest.mark.parametrize("name", MAKERS)
def test_a_picture_is_the_same_bytes_twice_and_follows_the_page(name: str) -> None:
    inline, again = (to_inline_svg(MAKERS[name](), "f1", "title") for _ in range(2))
    assert inline == again
    assert inline.startswith("<svg")
    assert INK not in inline
    Page(inline)


def test_svg_file_is_the_same_bytes_twice_and_stands_alone() -> None:
    first, second = to_svg(MAKERS["trade"]()), to_svg(MAKERS["trade"]())
    assert first == second
    assert first.startswith("<?xml")
    assert INK in first


def test_png_is_the_same_bytes_twice() -> None:
    first, second = to_png(MAKERS["residuals"](), dpi=50), to_png(MAKERS["residuals"](), dpi=50)
    assert first == second
    assert cv2.imdecode(np.frombuffer(first, np.uint8), cv2.IMREAD_COLOR).shape[1] > 200


def test_residual_field_says_the_rms_of_the_inliers() -> None:
    residuals = np.array([[3.0, 4.0], [-3.0, -4.0], [100.0, 0.0]])
    figure = figures.residual_field(POINTS[:3], residuals, (640, 480), [False, False, True])
    words = " ".join(text.get_text() for text in figure.axes[0].texts)
    assert "2 corners, rms 3.54 px" in words
    assert "1 outliers" in words


def test_residual_arrows_have_the_length_they_claim() -> None:
    figure = figures.residual_field([[100.0, 100.0]], [[0.5, -0.25]], (640, 480), magnify=200)
    (segment,) = figure.axes[0].collections[0].get_segments()
    np.testing.assert_allclose(segment, [[100, 100], [200, 50]])


def test_coverage_counts_cells() -> None:
    points = np.array([[10.0, 10.0], [11.0, 11.0], [630.0, 470.0]])
    figure = figures.coverage(points, (640, 480), columns=4)
    counts = figure.axes[0].images[0].get_array()
    assert counts.shape == (3, 4)
    assert counts[0, 0] == 2
    assert counts[2, 3] == 1
    assert "17% of 12 cells" in figure.axes[0].texts[0].get_text()


def test_rig_view_puts_depth_up_and_x_across() -> None:
    figure = figures.rig_view([BOARD], {"dry": FRUSTUM})
    outline = figure.axes[0].collections[0].get_paths()[0].vertices[:4]
    np.testing.assert_allclose(outline, BOARD[:, [0, 2]])


def test_names_in_the_trade_off_do_not_cover_each_other() -> None:
    figure = error_against_time(["first", "second", "third"], [1, 1.02, 1.04], [1e-3, 1.1e-3, 1.05e-3])
    figure.draw_without_rendering()
    boxes = [
        text.get_window_extent() for text in figure.axes[0].texts if text.get_text() in ("first", "second", "third")
    ]
    assert len(boxes) == 3
    assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])


def test_arrays_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="points has 60 entries and residuals 59"):
        figures.residual_field(POINTS, RESIDUALS[1:], (640, 480))
    with pytest.raises(ValueError, match="grid"):
        figures.heat_map(np.zeros(4), (640, 480), "px")
    with pytest.raises(ValueError, match="names has 1"):
        figures.frame_bars(["a"], [1, 2], [0])
    with pytest.raises(ValueError, match="empty"):
        figures.image_grid([], [])


def test_anaglyph_of_one_image_is_gray_and_of_two_red_and_cyan() -> None:
    a, b = picture(0, (8, 8)), picture(1, (8, 8))
    same, two = overlays.anaglyph(a, a), overlays.anaglyph(a, b)
    np.testing.assert_array_equal(same, np.repeat(a[..., None], 3, 2))
    np.testing.assert_array_equal(two[..., 2], a)
    np.testing.assert_array_equal(two[..., 0], b)


def test_checkerboard_takes_squares_in_turn() -> None:
    a, b = np.zeros((8, 12), np.uint8), np.full((8, 12), 255, np.uint8)
    mixed = overlays.checkerboard(a, b, 4)
    np.testing.assert_array_equal(mixed[:4], np.repeat([[0, 255, 0]], 4, 1).repeat(4, 0))
    np.testing.assert_array_equal(mixed[4:], 255 - mixed[:4])
    assert not a.any()


def test_difference_is_gray_where_two_agree_and_signed_elsewhere() -> None:
    a = np.full((2, 2), 100, np.uint8)
    assert (overlays.difference(a, a) == 128).all()
    assert (overlays.difference(a + 10, a, gain=4) == 168).all()
    assert (overlays.difference(a, a + 100, gain=4) == 0).all()
    with pytest.raises(ValueError, match="same size"):
        overlays.difference(a, a[:1])


def test_errors_below_zero_are_shown_where_they_are() -> None:
    """PSNR lost may be negative: no mark is lifted to a floor, and none lies beyond the axis."""
    axes = error_against_time(["a", "b"], [1.0, 2.0], [-0.2, 0.05]).axes[0]
    low, high = axes.get_ylim()
    assert low < -0.2
    assert high > 0.05
    assert sorted(float(line.get_ydata()[0]) for line in axes.get_lines()) == [-0.2, 0.05]
    assert error_against_time(["a", "b"], [1.0, 2.0], [0.2, 0.05]).axes[0].get_yscale() == "log"
