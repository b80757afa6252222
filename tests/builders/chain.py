"""A chain of real processes, small enough for tests: pictures instead of surveys, a fast clock in the water."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from sonarpost.cli.demo.chain import Chain
from sonarpost.cli.demo.settings import ChainSettings, free_ports
from sonarpost.cli.demo.watch import Watcher
from sonarpost.sonar.image_files import write_png

PICTURES = 6
TIME_SCALE = 40.0


def picture(number: int) -> npt.NDArray[np.uint8]:
    """A seabed of its own with a highlight and a shadow, 80 x 140 px."""
    rng = np.random.default_rng(number)
    image = rng.gamma(4.0, 25.0, (80, 140))
    image[30:44, 50:60] += 120
    image[32:42, 60:100] *= 0.1
    return np.clip(image, 0, 255).astype(np.uint8)


class RunningChain:
    """A started chain and what is seen of it."""

    def __init__(self, chain: Chain, watcher: Watcher) -> None:
        self.chain = chain
        self.watcher = watcher
        self.settings = chain.settings
        self.deposited = 0

    def deposit(self, count: int = PICTURES) -> None:
        """Put pictures where the vehicle polls."""
        for _ in range(count):
            hidden = self.settings.incoming / f".picture-{self.deposited:03}.png"
            write_png(hidden, picture(self.deposited))
            hidden.rename(hidden.with_name(hidden.name[1:]))
            self.deposited += 1

    def until(self, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
        """Wait for `condition()`; fail with what the chain is busy with when it does not come true."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline:
                pytest.fail(f"{what}: not within {timeout_s} s; busy: {self.busy()}")
            time.sleep(0.05)

    def busy(self) -> str:
        """Return what the chain has left to do."""
        return self.watcher.busy(0, time.time() - 3.0)

    def until_idle(self, timeout_s: float = 60.0) -> None:
        """Wait until nothing is left to do, for longer than a packet needs."""
        quiet_since: list[float] = []

        def quiet() -> bool:
            if self.busy():
                quiet_since.clear()
                return False
            quiet_since.append(time.monotonic())
            return quiet_since[-1] - quiet_since[0] > 1.5

        self.until(quiet, timeout_s, "chain idle")


ChainMaker = Callable[..., "contextmanager[RunningChain]"]


@pytest.fixture
def start_chain(tmp_path: Path) -> Iterator[Callable[..., RunningChain]]:
    """Starts a chain; it is stopped when the test ends."""
    with ExitStack() as stack:

        def start(**changes: object) -> RunningChain:
            ports = free_ports(3)
            settings = ChainSettings(
                folder=tmp_path / "run",
                mode="snippets",
                time_scale=TIME_SCALE,
                router_ports=(ports[0], ports[1], ports[2]),
            )
            settings = dataclasses.replace(settings, **changes)  # type: ignore[arg-type]
            chain = stack.enter_context(Chain(settings))
            watcher = stack.enter_context(Watcher(settings))
            watcher.wait_until_started(chain.check)
            return RunningChain(chain, watcher)

        yield start
