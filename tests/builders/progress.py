"""Waits that depend on progress and not on the speed of the machine."""

import time
from collections.abc import Callable

import pytest

from builders.common import WAIT_S


def wait_while_progressing(
    condition: Callable[[], bool], progress: Callable[[], object], what: str, state: Callable[[], object] = lambda: ""
) -> None:
    """Wait for `condition()`; fail, with `state()`, when `progress()` has not changed for `WAIT_S`."""
    last, since_s = progress(), time.monotonic()
    while not condition():
        if (now := progress()) != last:
            last, since_s = now, time.monotonic()
        elif time.monotonic() - since_s > WAIT_S:
            pytest.fail(f"{what}: no progress for {WAIT_S:.0f} s; {state()}")
        time.sleep(0.05)  # noqa: TID251 the only poll of waits without a total limit
