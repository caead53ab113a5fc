"""`rainstereo calibrate --watch`: pairs that arrive, files that are not what they should be, the page, the end."""

from __future__ import annotations

import http.client
import json
import os
import shutil
import subprocess
import time
from collections.abc import Callable
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
from rich.console import Console

from rainstereo import Rig
from rainstereo.apps import arrivals, watch, watch_session
from rainstereo.apps.arrivals import Arrivals
from rainstereo.apps.board_poses import board_poses
from rainstereo.apps.cli import main
from rainstereo.apps.digital_rig import RigOptions, digital_rig, exact_observations
from rainstereo.apps.guided_capture import anywhere, unsteady
from rainstereo.apps.watch_page import PAGE
from rainstereo.apps.watch_screen import Screen
from rainstereo.apps.watch_server import PageServer, Served
from rainstereo.apps.watch_session import Session
from rainstereo.apps.watch_state import Last, State
from rainstereo.calib import corners as corner_search
from rainstereo.calib.board import Board
from rainstereo.calib.corner_cache import Found, fingerprint, remember
from rainstereo.calib.detection import Detection, nothing
from rainstereo.rig import ROLES

pytest.importorskip("mrcal")

BOARD = Board.parse("chessboard:10x7:22mm")
LENS: Literal["LENSMODEL_OPENCV5"] = "LENSMODEL_OPENCV5"
PAIRS = 9


class Folder:
    """A capture: image files whose corners are known already, so that no board need be drawn or found."""

    def __init__(self, path: Path) -> None:
        self.path, self.cache, self.truth = path / "capture", path / "corners", digital_rig(RigOptions(lens=LENS), 1)
        self.path.mkdir()
        rng = np.random.default_rng(2)
        seen = exact_observations(self.truth, BOARD, board_poses(self.truth, BOARD, PAIRS, 1))
        self.corners = {role: xy + rng.normal(0, 0.1, xy.shape) for role, xy in zip(ROLES, seen, strict=True)}

    def image(self, role: str, number: int, *, size: tuple[int, int] = (1280, 960), board: bool = True) -> bytes:
        """An image file's bytes; what is in it lies in the cache."""
        picture = np.full(size[::-1], 40 + number, np.uint8)
        picture[:8, :8] = 200 if role == "dry" else 100
        picture[8:16, :8] = 255 * board
        data = bytes(cv2.imencode(".png", picture)[1])
        detection = Detection(self.corners[role][number % PAIRS]) if board else nothing(BOARD, "no board found")
        remember(self.cache / f"{fingerprint(data, BOARD)}.npz", Found(size, detection))
        return data

    def put(self, role: str, number: int, data: bytes | None = None, name: str = "{}.png") -> Path:
        """Write an image of the capture, as if some time ago."""
        path = self.path / role / name.format(f"{number:03d}")
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(self.image(role, number) if data is None else data)
        return aged(path)

    def pairs(self, count: int, start: int = 0) -> None:
        """Write pairs."""
        for number in range(start, start + count):
            for role in ROLES:
                self.put(role, number)

    def command(self, out: Path, *more: str) -> int:
        """The command line on this capture."""
        chamber = str(self.chamber(out))
        return main(["calibrate", "--watch", str(self.path), "--board", BOARD.spec, "--out", str(out), "--port", "0",
                     "--cache", str(self.cache), "--lensmodel", LENS, "--chamber", chamber, *more])  # fmt: skip

    def chamber(self, beside: Path) -> Path:
        """The true panels as a file."""
        folder = beside.parent / "truth"
        self.truth.save(folder)
        return folder / "chamber.toml"

    def session(self, target: float = 0.01) -> tuple[Session, list[State]]:
        """A session and the states that it publishes."""
        states: list[State] = []
        made = Session(self.path, BOARD, LENS, self.truth.chamber, target, self.cache, lambda s, _: states.append(s),
                       lambda _: None)  # fmt: skip
        return made, states


def aged(path: Path) -> Path:
    """The file as if it had been there for a while."""
    os.utime(path, (time.time() - 60, time.time() - 60))
    return path


def settle(session: Session, rounds: int = 40) -> None:
    """Step until nothing happens."""
    for _ in range(rounds):
        if not session.step():
            return
    raise AssertionError("the session never comes to rest")


def told(folder: Path) -> dict:
    return json.loads((folder / "report.json").read_text())


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    return Folder(tmp_path)


@pytest.fixture
def interrupted_when_idle(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C as soon as there is nothing left to do."""

    def stop(_seconds: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(watch.time, "sleep", stop)


# -- the command ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_it_ends_when_the_target_is_met_with_the_rig_of_a_plain_calibration(
    folder: Folder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder.pairs(PAIRS)
    assert folder.command(tmp_path / "rig", "--target", "2px") == 0
    report = told(tmp_path / "rig")
    assert report["status"] in ("good", "doubtful")
    assert report["watch"]["met"] is True
    assert report["watch"]["worst_px"] <= 2
    assert report["watch"]["update_seconds_median"] > 0
    used = [name for name, judged in report["watch"]["frames"].items() if judged["fate"] == "used"]
    assert report["frames_used"] == len(used)
    words = capsys.readouterr().out
    assert "http://127.0.0.1:" in words
    assert "worst" in words
    for role in ROLES:
        (tmp_path / role).mkdir()
        for name in used:
            shutil.copy(folder.path / role / f"{name}.png", tmp_path / role)
    assert main(["calibrate", "--dry", str(tmp_path / "dry"), "--wet", str(tmp_path / "wet"), "--board", BOARD.spec,
                 "--cache", str(folder.cache), "--lensmodel", LENS, "--chamber", str(folder.chamber(tmp_path / "rig")),
                 "--out", str(tmp_path / "plain")]) == 0  # fmt: skip
    watched, plain = Rig.load(tmp_path / "rig"), Rig.load(tmp_path / "plain")
    np.testing.assert_array_equal(watched.dry.intrinsics, plain.dry.intrinsics)
    np.testing.assert_array_equal(watched.rt_wet_dry, plain.rt_wet_dry)
    assert (tmp_path / "rig" / "report.html").stat().st_size > 10_000


@pytest.mark.slow
@pytest.mark.usefixtures("interrupted_when_idle")
def test_ctrl_c_writes_what_there_is(folder: Folder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder.pairs(7)
    shutil.copytree(folder.path / "dry", tmp_path / "kept")
    assert folder.command(tmp_path / "rig", "--target", "0.01px") == 0
    report = told(tmp_path / "rig")
    assert report["watch"]["met"] is False
    assert report["watch"]["next"]["words"]
    assert report["watch"]["next"]["predicted_px"] < report["watch"]["worst_while_capturing_px"]
    assert Rig.load(tmp_path / "rig").baseline == pytest.approx(folder.truth.baseline, rel=0.02)

    def search(*_: object, **__: object) -> None:
        raise AssertionError("a restart searched an image again")

    monkeypatch.setattr(corner_search, "detect", search)  # started again, the corners come from the cache
    assert folder.command(tmp_path / "again", "--target", "0.01px") == 0
    again = Rig.load(tmp_path / "again")
    np.testing.assert_array_equal(again.dry.intrinsics, Rig.load(tmp_path / "rig").dry.intrinsics)


@pytest.mark.slow
@pytest.mark.usefixtures("interrupted_when_idle")
def test_pairs_of_another_focus_are_named_at_the_end(folder: Folder, tmp_path: Path) -> None:
    """While capturing they only did not fit in; what they have in common is found at the end."""
    dry = folder.truth.dry
    changed = replace(dry, intrinsics=dry.intrinsics * np.array([1.1, 1.1, *([1.0] * (len(dry.intrinsics) - 2))]))
    zoomed = exact_observations(replace(folder.truth, dry=changed), BOARD, board_poses(folder.truth, BOARD, PAIRS, 1))
    folder.corners["dry"][6:] = zoomed[0][6:] + np.random.default_rng(5).normal(0, 0.1, zoomed[0][6:].shape)
    folder.pairs(PAIRS)
    folder.command(tmp_path / "rig", "--target", "0.01px", "--no-cross-validate")
    report = told(tmp_path / "rig")
    assert report["watch"]["fates"]["rejected"] >= 3
    assert report["frames_used"] <= 6
    assert sorted(report["mixed_captures"]["frames"]) == ["006", "007", "008"]
    assert report["mixed_captures"]["focal"][0] == pytest.approx(0.1, abs=0.01)
    assert any("the 3 frames named were taken" in finding["text"] for finding in report["findings"])


@pytest.mark.usefixtures("interrupted_when_idle")
def test_too_little_writes_a_report_and_no_rig(folder: Folder, tmp_path: Path) -> None:
    folder.pairs(2)
    assert folder.command(tmp_path / "rig") == 1
    assert told(tmp_path / "rig")["status"] == "refused"
    assert "at least 3" in told(tmp_path / "rig")["findings"][0]["text"]
    assert not (tmp_path / "rig" / "dry.cameramodel").exists()
    assert (tmp_path / "rig" / "report.html").exists()


@pytest.mark.usefixtures("interrupted_when_idle")
def test_an_empty_folder_is_no_error_until_the_end(folder: Folder, tmp_path: Path) -> None:
    assert folder.command(tmp_path / "rig") == 1
    assert told(tmp_path / "rig")["frames_given"] == 0


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--watch", "DIR", "--target", "a lot"), "such as 0.1px"),
        (("--watch", "DIR", "--target", "0px"), "such as 0.1px"),
        (("--watch", "DIR", "--target", "0.1mm"), "such as 0.1px"),
        (("--watch", "DIR", "--dry", "x", "--wet", "y"), "either --watch"),
        (("--watch", "DIR/none"), "no folder"),
        (("--watch", "DIR", "--port", "70000"), "--port"),
        (("--dry", "x"), "--wet"),
        ((), "--watch"),
    ],
)
def test_bad_usage(more: tuple[str, ...], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = [word.replace("DIR", str(tmp_path)) for word in more]
    port = [] if "--port" in more else ["--port", "0"]
    assert main(["calibrate", "--board", BOARD.spec, "--out", str(tmp_path / "rig"), *port, *given]) == 2
    assert words in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "rig").exists()


# -- the session: files that are not what they should be -----------------------------------------------------------


def test_frames_come_and_go(folder: Folder) -> None:
    session, states = folder.session()
    assert not session.step()
    assert states[-1].phase == "waiting"
    assert states[-1].proposal is not None  # where to begin
    folder.pairs(2)
    settle(session)
    assert states[-1].phase == "learning"
    folder.pairs(5, 2)
    settle(session)
    state = states[-1]
    assert state.phase == "capturing"
    assert state.used + state.redundant == 7
    assert state.figure is not None
    assert state.figure > (state.typical or 0)
    assert state.proposal is not None
    assert state.proposal["predicted"] < state.figure
    assert np.array(state.coverage["dry"]).sum() == 70 * state.used
    assert np.shape(state.sigma) == np.shape(state.coverage["dry"])
    assert session.running is not None
    before = session.running.names("used")
    for role in ROLES:
        (folder.path / role / "003.png").unlink()
    settle(session)
    assert set(session.running.judged) == {f"{i:03d}" for i in range(7)} - {"003"}
    assert session.running.names("used") == tuple(name for name in before if name != "003")


def test_files_that_are_not_what_they_should_be(folder: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    session, states = folder.session()
    folder.pairs(5)
    settle(session)
    (folder.path / "dry" / "notes.txt").write_text("not an image")
    folder.put("dry", 5)  # its partner comes later
    for role in ROLES:
        folder.put(role, 6, folder.image(role, 6, size=(640, 480)))
        folder.put(role, 7, folder.image(role, 7, board=role == "dry"))
    settle(session)
    notes = " ".join(states[-1].notes)
    assert "notes.txt: is no image" in notes
    assert "005.png: waits for its wet partner" in notes
    assert session.running is not None
    assert "640x480" in session.running.judged["006"].reason
    assert "wet image: no board found" in session.running.judged["007"].reason
    assert states[-1].rejected == 2
    folder.put("wet", 5)
    settle(session)
    assert session.running.judged["005"].fate in ("used", "redundant")
    # half an image: waited for, then taken when it is whole
    whole = {role: folder.image(role, 8) for role in ROLES}
    folder.put("dry", 8, whole["dry"])
    path = folder.put("wet", 8, whole["wet"][: len(whole["wet"]) // 2])
    os.utime(path)
    monkeypatch.setattr(arrivals, "STILL_S", 0.0)
    for _ in range(3):
        session.step()
    assert "008" not in session.running.judged
    assert any("008" in note and "yet" in note for note in states[-1].notes)
    folder.put("wet", 8, whole["wet"])
    settle(session)
    assert session.running.judged["008"].fate in ("used", "redundant")
    # half an image that stays so is named and does no harm
    folder.put("dry", 9, whole["dry"][:200])
    folder.put("wet", 9, whole["wet"])
    monkeypatch.setattr(watch_session, "PATIENCE_S", -1.0)
    settle(session)
    assert "truncated" in session.running.judged["009"].reason


def test_the_target_is_met_only_by_what_is_solved(folder: Folder) -> None:
    session, states = folder.session(target=2.0)
    folder.pairs(4)
    settle(session)
    assert not session.met  # four pairs say little about themselves
    folder.pairs(PAIRS - 4, 4)
    session.step()
    assert not session.met  # more is at hand
    settle(session)
    assert session.met
    assert states[-1].phase == "met"
    session.use_lensmodel("LENSMODEL_OPENCV8")
    assert session.solved_with == "LENSMODEL_OPENCV8"
    assert session.running is not None
    assert len(session.running.judged) == PAIRS


# -- files as they arrive ------------------------------------------------------------------------------------------


def test_a_file_counts_when_it_stands_still(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    looking = Arrivals(tmp_path)
    now = [100.0]
    monkeypatch.setattr(arrivals.time, "monotonic", lambda: now[0])
    for name in ("left_1.png", "right_1.png"):
        (tmp_path / name).write_bytes(b"half")
    assert looking.look().pairs == ()
    assert {note.reason for note in looking.look().waiting} == {"is being written"}
    now[0] += 1
    assert [pair.name for pair in looking.look().pairs] == ["1"]
    (tmp_path / "right_1.png").write_bytes(b"more than half")
    assert looking.look().pairs == ()
    now[0] += 1
    assert len(looking.look().pairs) == 1
    (tmp_path / "left_1.png").unlink()
    look = looking.look()
    assert look.pairs == ()
    assert look.waiting[0] == ("right_1.png", "waits for its dry partner")


def test_names_tell_the_cameras_apart_and_numbers_the_order(tmp_path: Path) -> None:
    names = ("left9.png", "left10.png", "right9.png", "right10.png", "overview.png", ".left11.png", "leftover.txt")
    for name in names:
        (tmp_path / name).write_bytes(b"x")
        aged(tmp_path / name)
    look = Arrivals(tmp_path).look()
    assert [(pair.dry.name, pair.wet.name) for pair in look.pairs] == [
        ("left9.png", "right9.png"), ("left10.png", "right10.png")
    ]  # fmt: skip
    assert [note.name for note in look.ignored] == ["leftover.txt", "overview.png"]


def test_folders_may_come_later(tmp_path: Path) -> None:
    looking = Arrivals(tmp_path)
    assert looking.look().pairs == ()
    for role in ROLES:
        (tmp_path / role).mkdir()
        (tmp_path / role / "a.jpg").write_bytes(b"x")
        aged(tmp_path / role / "a.jpg")
    assert len(looking.look().pairs) == 1


# -- the server ----------------------------------------------------------------------------------------------------


def fetch(url: str, path: str, method: str = "GET", **headers: str) -> tuple[int, bytes, dict[str, str]]:
    connection = http.client.HTTPConnection(url.removeprefix("http://").rstrip("/"), timeout=10)
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    got = answer.status, answer.read(), dict(answer.headers)
    connection.close()
    return got


def test_the_server_answers_this_machine_only() -> None:
    served = Served(PAGE)
    with PageServer(served, 0) as server:
        assert server.url.startswith("http://127.0.0.1:")
        assert not served.looked_at(10)
        served.show(State(figure=0.5))
        status, body, headers = fetch(server.url, "/state.json?1")
        assert (status, json.loads(body)["figure"]) == (200, 0.5)
        assert headers["Cache-Control"] == "no-store"
        assert served.looked_at(10)
        status, body, headers = fetch(server.url, "/")
        assert status == 200
        assert body.decode() == PAGE
        assert "default-src 'none'" in headers["Content-Security-Policy"]
        assert fetch(server.url, "/", "HEAD")[:2] == (200, b"")
        assert fetch(server.url, "/picture.jpg")[0] == 404
        served.show(State(), b"\xff\xd8")
        assert fetch(server.url, "/picture.jpg")[:2] == (200, b"\xff\xd8")
        assert fetch(server.url, "/../../etc/passwd")[0] == 404
        assert fetch(server.url, "/state.json", "POST")[0] == 501
        assert fetch(server.url, "/state.json", Host="elsewhere.example")[0] == 403
        with pytest.raises(ValueError, match="--port 0"):
            PageServer(Served(PAGE), int(server.url.rstrip("/").rpartition(":")[2]))
    with pytest.raises(OSError, match=r"refused|reset"):
        fetch(server.url, "/")


def test_the_page_loads_nothing_from_elsewhere() -> None:
    assert "http://" not in PAGE.replace("http://www.w3.org", "")
    assert "https://" not in PAGE
    assert "innerHTML" not in PAGE  # names of files are text


# -- what is shown -------------------------------------------------------------------------------------------------


def capturing() -> State:
    """A state with everything in it."""
    square = [[100.0, 100.0], [500.0, 120.0], [500.0, 400.0], [100.0, 420.0]]
    proposal = {"where": "top left corner", "how_far": "half the distance: 36 cm away",
                "lean": "right side tilted away by 35 degrees", "outline": {"dry": square, "wet": square},
                "mesh": {"dry": [square[:2]], "wet": [square[:2]]}, "predicted": 0.2, "distance_m": 0.36}  # fmt: skip
    return State(
        "capturing", 0.1, 0.314, 0.05, "bottom left, wet", 0.1, 12, 3, 1, 0, 0.1, 0.2,
        Last("<b>left_07</b>", "rejected", "no board found"), {"dry": (1280, 960), "wet": (1280, 960)},
        {"dry": [[3] * 12] * 9, "wet": [[3] * 12] * 9}, [[0.09] * 6 + [0.3] * 6] * 9, proposal,
    )  # fmt: skip


CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")


@pytest.fixture
def browse(tmp_path: Path) -> Callable[[State], str]:
    """The page's document, as headless Chromium has it after two seconds of its own time."""

    def dump(state: State) -> str:
        served = Served(PAGE)
        served.show(state)
        with PageServer(served, 0) as server:
            done = subprocess.run(
                [str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
                 "--disable-background-networking", "--disable-component-update", "--disable-sync",
                 f"--user-data-dir={tmp_path / state.phase}", "--window-size=1280,720", "--virtual-time-budget=2000",
                 "--dump-dom", server.url],
                capture_output=True, text=True, timeout=120, check=False,
            )  # fmt: skip
        return done.stdout

    return dump


@needs_chromium
def test_the_page_in_a_browser(browse: Callable[[State], str]) -> None:
    page = browse(capturing())
    assert '<body class="capturing">' in page
    assert ">0.31<small>px</small>" in page
    assert "top left corner" in page
    assert "right side tilted away" in page
    assert 'id="outline" points="100,100 500,120 500,400 100,420"' in page
    assert page.count('class="cell"') == 108
    assert page.count('fill="#1fa463"') == 54  # the half that meets the target
    assert "&lt;b&gt;left_07&lt;/b&gt;: no board found" in page  # text, not markup
    assert "<b>12</b> used" in page


@needs_chromium
@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"phase": "waiting", "figure": None, "last": None, "proposal": None, "used": 0},
            "for the first pair of images",
        ),
        ({"phase": "met", "figure": 0.0912}, "Enough"),
        ({"phase": "failed", "trouble": "2 usable pairs were captured"}, "2 usable pairs were captured"),
    ],
)
def test_each_stage_in_a_browser(changes: dict, words: str, browse: Callable[[State], str]) -> None:
    page = browse(replace(capturing(), **changes))
    assert f'<body class="{changes["phase"]}">' in page
    assert words in page
    assert 'id="outline"' not in page


def test_the_terminal_shows_the_same() -> None:
    text = StringIO()
    with Screen(Console(file=text, force_terminal=True, width=120)) as screen:
        screen.event(capturing())  # nothing: the picture says it
        screen.show(capturing(), "http://127.0.0.1:1/")
    live = text.getvalue()
    for words in ("0.314 px", "12 used", "top left corner", "no board found", "target 0.1 px"):
        assert words in live
    plain = StringIO()
    with Screen(Console(file=plain, width=120)) as screen:
        screen.show(capturing(), "http://127.0.0.1:1/")  # nothing: lines say it
        screen.event(capturing())
    assert plain.getvalue().count("\n") == 1
    assert "<b>left_07</b> rejected (no board found); 12 used, 3 redundant, 1 rejected" in plain.getvalue()
    assert "worst 0.314 px (bottom left, wet), target 0.1 px; next: top left corner" in plain.getvalue()


def test_a_person_holds_the_board_nearly_where_it_is_proposed() -> None:
    truth, rng = digital_rig(seed=0), np.random.default_rng(0)
    wanted = anywhere(truth, BOARD, rng)
    held = np.stack([unsteady(truth, BOARD, wanted, rng) for _ in range(8)])
    assert np.isfinite(np.stack(exact_observations(truth, BOARD, held))).all()
    assert 0 < np.abs(held - wanted).max() < 0.4
