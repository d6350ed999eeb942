"""How far a verb is: bars for people at a terminal, a line now and then where standard error goes elsewhere."""

from __future__ import annotations

import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol

import typer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from contextlib import AbstractContextManager

    from rich.console import Console
    from rich.progress import Progress, ProgressColumn, TaskID


EVERY = 10.0
"""Least time between two lines [s]; what is done sooner says nothing."""


class ShowStage(Protocol):
    """Takes what is new: the stage, its share of 0 to 1, and the best so far."""

    def __call__(self, stage: str | None = None, share: float | None = None, best: str | None = None) -> None: ...

    def paused(self) -> AbstractContextManager[None]:
        """Without the bar, so that a person can be asked something."""
        ...


def bars(console: Console, *columns: str | ProgressColumn, transient: bool = False) -> Progress:
    """Bars of these columns, or rich's own where none is given; ``transient`` ones are gone at the end."""
    from rich.progress import Progress

    return Progress(*columns, console=console, transient=transient, disable=not console.is_terminal)


def time_left() -> tuple[ProgressColumn, ...]:
    """Columns with the time that is left."""
    from rich.progress import TextColumn, TimeRemainingColumn

    return TextColumn("left"), TimeRemainingColumn()


def times() -> tuple[ProgressColumn, ...]:
    """Columns with the time taken and the time that is left."""
    from rich.progress import TimeElapsedColumn

    return TimeElapsedColumn(), *time_left()


@contextmanager
def best_so_far(console: Console) -> Iterator[Callable[[], bool]]:
    """Ctrl-C asks for the best so far, and pressed again ends at once; what is yielded tells whether it was pressed."""
    import signal

    asked = False

    def pressed(number: int, frame: object) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True
        console.print("the best so far follows after this step; Ctrl-C again ends at once", markup=False)

    before = signal.signal(signal.SIGINT, pressed)
    try:
        yield lambda: asked
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def share_bar(console: Console, name: str) -> Iterator[Callable[[float], None]]:
    """One bar that takes the share done, and is gone at the end."""
    with bars(console, transient=True) as progress:
        task = progress.add_task(name, total=1.0)
        yield lambda share: progress.update(task, completed=share)


class _Shown:
    """See ``ShowStage``."""

    def __init__(self, progress: Progress, task: TaskID) -> None:
        self._progress, self._task = progress, task
        self._begun = self._last_shown = time.monotonic()

    def __call__(self, stage: str | None = None, share: float | None = None, best: str | None = None) -> None:
        progress, task = self._progress, self._task
        progress.update(task, description=stage, completed=share)
        if best is not None:
            progress.update(task, best=best)
        now, console = time.monotonic(), progress.console
        if not console.is_terminal and now - self._last_shown >= EVERY:
            self._last_shown = now
            own = progress.tasks[task]
            so_far = f"; best so far: {own.fields['best']}" if own.fields["best"] else ""
            line = f"{own.description}, {100 * own.completed:.0f} % after {now - self._begun:.0f} s{so_far}"
            console.print(line, markup=False, soft_wrap=True)

    @contextmanager
    def paused(self) -> Iterator[None]:
        """See ``ShowStage``."""
        self._progress.stop()
        try:
            yield
        finally:
            self._progress.start()


@contextmanager
def stage_bar(
    console: Console, first: str, *, width: int = 0, bar_width: int = 40, stopped: str = "stopped: nothing was written"
) -> Iterator[ShowStage]:
    """One bar that goes from stage to stage and is gone at the end; a line every ``EVERY`` seconds without a terminal.

    Args:
        console: where people read.
        first: stage.
        width: of the longest stage's name.
        bar_width: of the bar alone.
        stopped: what is said where Ctrl-C stops it.

    Raises:
        typer.Exit: with code 130 where Ctrl-C stops what is done under the bar, having said so.
    """
    from rich.progress import BarColumn, TextColumn

    columns = (
        TextColumn(f"{{task.description:<{width}}}"),
        BarColumn(bar_width=bar_width),
        TextColumn("{task.fields[best]}"),
        *times(),
    )
    try:
        with bars(console, *columns, transient=True) as progress:
            yield _Shown(progress, progress.add_task(first, total=1.0, best=""))
    except KeyboardInterrupt:
        console.print(stopped, markup=False)
        raise typer.Exit(130) from None
