"""Progress of a long command on standard error: a bar on a terminal, else a line every ten seconds."""

import logging
import sys
import threading
import time
from collections.abc import Callable

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

LINE_EVERY_S = 10.0


def progress_console() -> Console:
    """Return the console for progress, on standard error. With --quiet it prints nothing."""
    return Console(stderr=True, quiet=not logging.getLogger().isEnabledFor(logging.WARNING))


class ProgressDisplay:
    """Context manager that shows what a command does. A command shorter than ten seconds prints nothing in a log.

    Args:
        console: Output (default: `progress_console`); shows a bar if it is a terminal.
        step: Name of the first step.
        clock: Monotonic clock in seconds.
    """

    def __init__(
        self, console: Console | None = None, step: str = "", clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._console = progress_console() if console is None else console
        self._clock = clock
        self._step, self._count, self._since_s = step, "", clock()
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[count]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        self._bar = Bar(
            *columns,
            console=self._console,
            transient=True,
            disable=not self._console.is_terminal,
            redirect_stdout=sys.stdout.isatty(),  # results that go to a file stay there
        )
        self._task = self._bar.add_task(step, total=None, count="")
        self._stop = threading.Event()
        self._lines = threading.Thread(target=self._print_lines, daemon=True)

    def __enter__(self) -> "ProgressDisplay":
        if self._console.is_terminal:
            self._bar.start()
        else:
            self._lines.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._bar.stop()
        if self._lines.is_alive():
            self._lines.join()  # no line follows the results

    def show(self, step: str, done: int = 0, total: int | None = None, detail: str = "") -> None:
        """Set the progress of a step.

        Args:
            step: Name of the step.
            done: Amount done.
            total: Total amount; None if it is unknown.
            detail: Further text.
        """
        if step != self._step:
            self._since_s = self._clock()
        count = ", ".join(part for part in ("" if total is None else f"{done} of {total}", detail) if part)
        self._step, self._count = step, count
        self._bar.update(self._task, description=step, completed=done, total=total, count=count)

    def line(self, text: str) -> None:
        """Print a line, above the bar if there is one."""
        self._bar.console.print(text, markup=False, highlight=False, soft_wrap=True)

    def state(self) -> str:
        """Return the line of a log: step, amount, time since the step began; empty without a step."""
        count = f"{self._count}, " if self._count else ""
        return f"{self._step}: {count}{self._clock() - self._since_s:.0f} s" if self._step else ""

    def _print_lines(self) -> None:
        while not self._stop.wait(LINE_EVERY_S):
            if text := self.state():
                self.line(text)
