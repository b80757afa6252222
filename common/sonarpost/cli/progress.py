"""Progress of a long command: a bar on a terminal, else a line every ten seconds."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from sonarpost.codec.vq.builder import BuildProgress, RefinementProgress

LINE_EVERY_S = 10.0


class ProgressDisplay:
    """Context manager that shows the progress of steps.

    Args:
        console: Output; shows a bar if it is a terminal.
        clock: Monotonic clock in seconds.
    """

    def __init__(self, console: Console, clock: Callable[[], float] = time.monotonic) -> None:
        self._console = console
        self._clock = clock
        self._last_line_s = -math.inf
        self._step = ""
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        self._bar = Bar(*columns, console=console, transient=True, disable=not console.is_terminal)
        self._task = self._bar.add_task("", total=None)

    def __enter__(self) -> ProgressDisplay:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def build(self, progress: BuildProgress | RefinementProgress) -> None:
        """Show the progress of a codebook build."""
        if isinstance(progress, BuildProgress):
            step = f"round {progress.round_number + 1} of {progress.rounds}"
            self.show(step, progress.done_in_round, progress.images_in_round, f"{progress.tiles} tiles")
            return
        step = f"refining {progress.pass_number} of {progress.passes}"
        if math.isnan(progress.rms):
            self.show(step, progress.done_images, progress.images)
        else:
            self.line(f"{step}: the error was {progress.rms:.2f} grey levels RMS before")

    def show(self, step: str, done: int, total: int, detail: str = "") -> None:
        """Show the progress of a step.

        Args:
            step: Name of the step.
            done: Amount done.
            total: Total amount.
            detail: Further text.
        """
        if self._console.is_terminal:
            self._bar.update(self._task, description=f"{step} {detail}".rstrip(), completed=done, total=total)
            return
        now = self._clock()
        if done >= total or step != self._step or now - self._last_line_s >= LINE_EVERY_S:
            self.line(f"{step}: {done} of {total}" + (f", {detail}" if detail else ""))
            self._step, self._last_line_s = step, now

    def line(self, text: str) -> None:
        """Print a line, above the bar if there is one."""
        self._bar.console.print(text, markup=False, highlight=False)
