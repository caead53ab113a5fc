"""A progress bar with a row for each thing that is done, and how fast."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

Advance = Callable[[str, int, int], None]
"""What is done, how many more of it are, and how many there will be (0: nobody knows)."""


@contextmanager
def progress_bar(console: Console) -> Iterator[Advance]:
    """Gives what is to be told of the work."""
    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(), TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*columns, console=console, transient=True) as bar:
        tasks: dict[str, TaskID] = {}

        def told(what: str, count: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bar.add_task(what, total=total or None, rate="")
            speed = bar.tasks[bar.task_ids.index(tasks[what])].speed
            bar.update(tasks[what], advance=count, rate=f"{speed:.2f}/s" if speed else "")

        yield told
