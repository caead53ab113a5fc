"""A calibration in progress in the terminal: a live picture of coverage and the figure, or plain lines elsewhere."""

from __future__ import annotations

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.text import Text

from rainstereo.apps.watch_state import CELLS, State

_MARKS = " .:+#"
_FATES = {"used": "bold green", "redundant": "cyan", "rejected": "bold red", "waiting": "yellow"}


class Screen:
    """Shows states: live where the output is a terminal, else one line for each thing that happens."""

    def __init__(self, console: Console | None = None) -> None:
        self.console = Console(highlight=False) if console is None else console
        self._live = (
            Live(console=self.console, auto_refresh=False, transient=True) if self.console.is_terminal else None
        )

    def __enter__(self) -> Screen:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Take the live picture away; lines may still be said."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    def say(self, words: str) -> None:
        """A line that stays."""
        self.console.print(words, markup=False, soft_wrap=True)

    def event(self, state: State) -> None:
        """What became of a frame; a line where there is no live picture."""
        if self._live is None and state.last is not None:
            self.say(line(state))

    def show(self, state: State, url: str) -> None:
        """Renew the live picture."""
        if self._live is not None:
            self._live.update(Panel(picture(state), title="rainstereo calibrate", subtitle=url), refresh=True)


def line(state: State) -> str:
    """The newest frame's fate and where the calibration stands, in one line."""
    last = state.last
    told = f"{last.name} {last.fate}" + (f" ({last.reason})" if last.reason else "") if last else "no frame"
    figure = (
        "" if state.figure is None else f"; worst {state.figure:.3f} px ({state.worst_at}), target {state.target:g} px"
    )
    proposal = "" if state.proposal is None else f"; next: {words(state)}"
    return f"{told}; {counts(state)}{figure}{proposal}"


def counts(state: State) -> str:
    """How many frames had which fate."""
    parts = [f"{state.used} used"]
    for number, what in ((state.redundant, "redundant"), (state.rejected, "rejected"), (state.pending, "to come")):
        parts += [f"{number} {what}"] if number else []
    return ", ".join(parts)


def words(state: State) -> str:
    """Where to hold the board next."""
    proposal = state.proposal
    return "" if proposal is None else ", ".join(str(proposal[key]) for key in ("where", "how_far", "lean"))


def picture(state: State) -> RenderableType:
    """Coverage by cell, coloured by certainty, beside the figure and the words."""
    head = Text()
    if state.figure is None:
        head.append(state.trouble or "waiting for the first pair of images", "bold yellow")
    else:
        met = state.figure <= state.target
        head.append(f"{state.figure:.3f} px", "bold green" if met else "bold yellow")
        head.append(f" at the worst place ({state.worst_at}), {state.typical or float('nan'):.3f} px typically; ")
        head.append(f"target {state.target:g} px" + (" met" if met else ""), "bold green" if met else "")
    parts: list[RenderableType] = [head, cells(state), Text(counts(state))]
    if state.redundant:
        parts.append(Text(f"leaving the redundant frames out saves {state.saved_seconds:.2f} s a solution", "dim"))
    if state.proposal is not None:
        parts.append(Text("next: " + words(state), "bold"))
    if state.last is not None:
        text = Text(f"{state.last.name}: ")
        text.append(state.last.fate, _FATES.get(state.last.fate, ""))
        parts.append(text.append(f" {state.last.reason}"))
    parts += [Text(note, "yellow") for note in state.notes]
    return Group(*parts)


def cells(state: State) -> Text:
    """The dry image: a mark for how many corners, a colour for how certain."""
    cover = state.coverage.get("dry") or [[0] * CELLS[0]] * CELLS[1]
    text = Text()
    for r, row in enumerate(cover):
        for c, count in enumerate(row):
            sigma = state.sigma[r][c] if state.sigma else None
            mark = _MARKS[min(len(_MARKS) - 1, 0 if not count else 1 + count // 8)]
            text.append(mark * 3, _style(sigma, state.target))
        text.append("\n")
    return text


def _style(sigma: float | None, target: float) -> str:
    if sigma is None:
        return "white on grey23"
    ratio = sigma / target
    return f"black on {'green' if ratio <= 1 else 'yellow' if ratio <= 2 else 'dark_orange' if ratio <= 4 else 'red'}"
