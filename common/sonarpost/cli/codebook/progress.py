"""How far a long command is: a bar on a terminal, else a line now and then."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from sonarpost.codec.vq.training_config import BuildProgress, RefinementProgress

LINE_EVERY_S = 10.0


class ProgressDisplay:
    """Shows steps of work; enter it before and leave it after.

    Args:
        console: Where to show them; a bar if it is a terminal.
        clock: Returns seconds from any start, never going back.
    """

    def __init__(self, console: Console, clock: Callable[[], float] = time.monotonic) -> None:
        self._console = console
        self._clock = clock
        self._shown_at = -math.inf
        self._step = ""
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        self._bar = Bar(*columns, console=console, transient=True, disable=not console.is_terminal)
        self._task = self._bar.add_task("", total=None)

    def __enter__(self) -> ProgressDisplay:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def build(self, progress: BuildProgress | RefinementProgress) -> None:
        """Show where a build stands."""
        if isinstance(progress, BuildProgress):
            step = f"round {progress.round_number + 1} of {progress.rounds}"
            self.show(step, progress.done_in_round, progress.images_in_round, f"{progress.tiles} tiles")
            return
        step = f"refining {progress.number} of {progress.passes}"
        if math.isnan(progress.rms):
            self.show(step, progress.done_images, progress.images)
        else:
            self.line(f"{step}: the error was {progress.rms:.2f} grey levels RMS before")

    def show(self, step: str, done: int, whole: int, more: str = "") -> None:
        """Show how much of a step is done.

        Args:
            step: Its name; a step of another name begins anew.
            done: What is done of it.
            whole: What there is to do.
            more: What else there is to say.
        """
        if self._console.is_terminal:
            self._bar.update(self._task, description=f"{step} {more}".rstrip(), completed=done, total=whole)
            return
        now = self._clock()
        if done >= whole or step != self._step or now - self._shown_at >= LINE_EVERY_S:
            self.line(f"{step}: {done} of {whole}" + (f", {more}" if more else ""))
            self._step, self._shown_at = step, now

    def line(self, text: str) -> None:
        """Print a line, above the bar if there is one."""
        self._bar.console.print(text, markup=False, highlight=False)
