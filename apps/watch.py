"""`rainstereo calibrate --watch DIR`: calibrates while somebody captures, and says where to hold the board next."""

from __future__ import annotations

import re
import signal
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import FrameType
from typing import Any

import numpy as np

from rainstereo import Chamber
from rainstereo.apps import calibrate
from rainstereo.apps.calibration_captures import Captures
from rainstereo.apps.calibration_findings import Findings
from rainstereo.apps.run_record import Record
from rainstereo.apps.watch_page import PAGE
from rainstereo.apps.watch_screen import Screen
from rainstereo.apps.watch_server import PageServer, Served
from rainstereo.apps.watch_session import Session
from rainstereo.apps.watch_state import State
from rainstereo.calib import mixed_captures, mrcal_versions
from rainstereo.calib.board import Board
from rainstereo.calib.checks import MORE_VIEWS, Finding, Verdict
from rainstereo.calib.incremental import AUTOMATIC, FEWEST, SPLINED
from rainstereo.calib.observations import Observations
from rainstereo.calib.rejection import NotEnoughData, Rejection
from rainstereo.calib.solve import Dropped
from rainstereo.rig import ROLES

BETWEEN_LOOKS_S = 0.15
FAREWELL_S = 1.2
"""How long the page is still served at the end, where one is open, so that it can show the end."""
TOLERATED = 1.02
_TARGET = re.compile(r"\s*([0-9]*\.?[0-9]+(?:[eE][+-]?[0-9]+)?)\s*(px)?\s*")


def run(options: calibrate.Options) -> int:
    """Watch, calibrate, write; the exit status."""
    folder = options.watch
    if folder is None or options.dry or options.wet:
        raise ValueError("give either --watch DIR, or --dry DIR and --wet DIR")
    target = pixels(options.target)
    board = Board.parse(options.board)
    chamber = None if options.chamber is None else Chamber.load(options.chamber)
    mrcal_versions.load()
    if options.lensmodel not in (AUTOMATIC, SPLINED):
        mrcal_versions.parameters(options.lensmodel)
    cache = options.cache or options.out / "corners"
    options = replace(options, cache=cache)
    record = Record("calibrate", options)
    served = Served(PAGE)
    with PageServer(served, options.port) as server, Screen() as screen, ends_as_interrupt():
        screen.say(
            f"watching {folder}; the page for whoever holds the board: {server.url}  (Ctrl-C ends and writes the rig)"
        )

        def publish(state: State, picture: bytes | None) -> None:
            served.show(state, picture)
            screen.show(state, server.url)

        session = Session(folder, board, options.lensmodel, chamber, target, cache, publish, screen.event)
        clock = calibrate.Clock()
        findings = _watch(session, options, chamber, screen, clock)
        screen.close()
        record["watch"] = account(session, findings)
        status = calibrate.finish(options, record, findings, clock)
        reason = "; ".join(f.text for f in findings.verdict.findings if f.severity == "refused")
        session.enter("failed" if status else "done", reason)
        print(farewell(session))
        if served.looked_at(3.0):
            time.sleep(FAREWELL_S)
    return status


def pixels(text: str) -> float:
    """The target in pixels; ValueError for what is none."""
    match = _TARGET.fullmatch(text)
    value = float(match[1]) if match else 0.0
    if match is None or not 0.001 <= value <= 100:
        raise ValueError(f"--target {text!r} was given; expected pixels, such as 0.1px (0.001 to 100)")
    return value


def _watch(session: Session, options: calibrate.Options, chamber: Chamber | None, screen: Screen,
           clock: calibrate.Clock) -> Findings:  # fmt: skip
    """Until the target is met by the final solution, or the user ends it: what the frames used came to."""
    examined, announced = 0, False
    try:
        while True:
            busy = session.step()
            used = 0 if session.running is None else len(session.running.names("used"))
            if session.met and options.keep_going and not announced:
                announced = True
                screen.say(f"the target of {session.target:g} px is met with {used} frames; going on until Ctrl-C")
            elif session.met and not options.keep_going and used > examined:
                examined = used
                findings = _final(session, options, chamber, clock)
                if _confirmed(session, findings, screen):
                    return findings
            if not busy:
                time.sleep(BETWEEN_LOOKS_S)
    except KeyboardInterrupt:
        screen.say("ending: solving what there is")
        return _final(session, options, chamber, clock)


def _confirmed(session: Session, findings: Findings, screen: Screen) -> bool:
    """Whether the final solution, with the lens model that cross-validation chose, keeps what was promised."""
    solution = findings.solution
    if solution is None or findings.verdict.status == "refused":
        reason = next((f.text for f in findings.verdict.findings if f.severity == "refused"), "it does not hold")
        screen.say(f"the target looked met, but the final solution is refused: {reason}; going on")
        session.phase = "capturing"
        return False
    worst = worst_of(findings)
    if worst <= TOLERATED * session.target or solution.lensmodel == session.solved_with:
        return True
    screen.say(f"with {solution.lensmodel}, which predicts frames better, the worst place is {worst:.3f} px; going on")
    session.use_lensmodel(solution.lensmodel)
    return session.met


def worst_of(findings: Findings) -> float:
    """Sigma of the least certain direction at infinity in all maps of a calibration, pixels; inf where one has none."""
    return max(
        (float(np.nan_to_num(field.sigma, nan=np.inf).max()) for field in findings.infinity.values()), default=np.inf
    )


def _final(session: Session, options: calibrate.Options, chamber: Chamber | None, clock: calibrate.Clock) -> Findings:
    """What `rainstereo calibrate` makes of the frames used: from their files, from nothing."""
    clock("capture")
    session.enter("finishing")
    running = session.running
    names = [] if running is None else [*running.names("used"), *running.names("waiting")]
    pairs = [session.files[name] for name in names if name in session.files]
    rejected = (
        []
        if running is None
        else [Rejection(name, "", running.judged[name].reason) for name in running.names("rejected")]
    )
    if len(pairs) < FEWEST:
        return _nothing(session, len(pairs), rejected)
    try:
        observations = Observations.from_folders(
            [pair.dry for pair in pairs], [pair.wet for pair in pairs], session.board, workers=options.workers,
            cache=session.cache,
        )  # fmt: skip
    except (NotEnoughData, FileNotFoundError) as error:  # files vanished meanwhile
        return _nothing(session, len(pairs), rejected, str(error))
    clock("detection")
    observations = replace(observations, rejected=(*observations.rejected, *rejected))
    captures = Captures(observations, chamber, None, (observations, chamber))
    return _with_rejected(session, calibrate.examine(options, captures, clock))


def _with_rejected(session: Session, findings: Findings) -> Findings:
    """Whether pairs that did not fit in while capturing were of another focus or rig: these are not in the solution."""
    running = session.running
    if running is None or running.solution is None or findings.solution is None or findings.mixture is not None:
        return findings
    misfits = [name for name in running.names("rejected") if name in running.views]
    if not misfits:
        return findings
    seen = running.observations([*running.solution.names, *misfits])
    dropped = tuple(Dropped(name, running.judged[name].reason) for name in misfits)
    mixture = mixed_captures.examine(seen, replace(running.solution, dropped=dropped))
    told = (*findings.verdict.findings, *mixed_captures.doubts(mixture))
    return replace(findings, mixture=mixture, verdict=Verdict(told))


def _nothing(session: Session, pairs: int, rejected: list[Rejection], why: str = "") -> Findings:
    blank = np.zeros((0, session.board.rows, session.board.columns, 2))
    observations = Observations(session.board, (), blank, blank, dict.fromkeys(ROLES, (0, 0)), tuple(rejected))
    text = why or f"{pairs} usable pairs were captured; at least {FEWEST} are needed"
    return Findings(observations, None, None, None, Verdict((Finding("refused", text, MORE_VIEWS),)), None)


def account(session: Session, findings: Findings) -> dict[str, Any]:
    """What `report.json` says about the capture."""
    running, proposal = session.running, session.proposal
    told: dict[str, Any] = {
        "target_px": session.target,
        "worst_px": worst_of(findings),
        "met": worst_of(findings) <= TOLERATED * session.target and findings.verdict.status != "refused",
    }
    if running is None:
        return told
    seconds = [time for _, time in session.updates]
    return told | {
        "worst_while_capturing_px": np.inf if running.known is None else running.known.worst,
        "lensmodel_while_capturing": session.solved_with,
        "frames": {name: {"fate": j.fate, "reason": j.reason, "gain": j.gain} for name, j in running.judged.items()},
        "fates": dict(Counter(judged.fate for judged in running.judged.values())),
        "redundant_share": running.redundant,
        "saved_seconds_per_solution": running.seconds_saved,
        "updates": len(seconds),
        "update_seconds_median": float(np.median(seconds)) if seconds else None,
        "update_seconds_last": seconds[-1] if seconds else None,
        "proposal_seconds_median": float(np.median(session.proposed_in)) if session.proposed_in else None,
        "solving": running.spent,
        "next": None if proposal is None else {"words": proposal.words, "predicted_px": proposal.predicted},
    }


def farewell(session: Session) -> str:
    """What was left out and what that saved, in words."""
    running = session.running
    if running is None or not running.names("redundant"):
        return "no redundant frames"
    return (
        f"{len(running.names('redundant'))} redundant frames were left out, which saved {running.seconds_saved:.2f} s "
        f"in each solution; together they would lessen no uncertainty by more than {running.redundant:.0%}"
    )


@contextmanager
def ends_as_interrupt() -> Iterator[None]:
    """A polite request to end (SIGTERM) counts as Ctrl-C meanwhile."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def raised(_signal: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, raised)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
