"""Breadth-first search over all states, with the shortest trace to a violation."""

import time
from collections import deque
from dataclasses import dataclass

from typing_extensions import override

from research.delivery_model.invariants import violations_by, violations_in
from research.delivery_model.machine import State, World, cooperative_step, initial, steps


@dataclass(frozen=True)
class Result:
    """Result of a search.

    Attributes:
        states: Number of different states.
        steps: Number of transitions.
        depth: Longest shortest path.
        violation: The first violated invariant, empty for none.
        trace: Labels of the shortest path to it.
        duration_s: Time of the search.
    """

    states: int
    steps: int
    depth: int
    violation: str
    trace: tuple[str, ...]
    duration_s: float

    @override
    def __str__(self) -> str:
        head = f"{self.states} states, {self.steps} transitions, depth {self.depth}, {self.duration_s:.1f} s: "
        if not self.violation:
            return head + "no violation"
        lines = [f"  {number}. {label}" for number, label in enumerate(self.trace, 1)]
        return "\n".join([head + self.violation, *lines])


def explore(world: World, only: str | tuple[str, ...] = "", max_states: int = 2_000_000) -> Result:
    """Search all states of a configuration, up to the first violation.

    Args:
        world: The configuration.
        only: Names of the invariants to check, for example `I1`; by default all.
        max_states: Limit of the search.

    Raises:
        RuntimeError: The configuration has more than `max_states` states.
    """
    began_s = time.perf_counter()
    first = initial(world)
    parents: dict[State, tuple[State, str] | None] = {first: None}
    depths = {first: 0}
    delivered: dict[State, bool] = {}
    waiting = deque([first])
    transitions = depth = 0

    def result(violation: str, last: State | None, *labels: str) -> Result:
        trace = [*reversed(labels)]
        while last is not None and (parent := parents[last]) is not None:
            last, label = parent
            trace.append(label)
        duration_s = time.perf_counter() - began_s
        return Result(len(parents), transitions, depth, violation, tuple(reversed(trace)), duration_s)

    while waiting:
        state = waiting.popleft()
        if "P1".startswith(only) and not _reaches_empty_outbox(world, state, delivered):
            return result("P1: a queued record is not delivered although all faults have ended", state)
        for step in steps(world, state):
            transitions += 1
            for violation in violations_by(world, state, step):
                if violation.startswith(only):
                    return result(violation, state, step.label)
            if step.after in parents:
                continue
            if len(parents) >= max_states:
                raise RuntimeError(f"more than {max_states} states")
            parents[step.after] = (state, step.label)
            depth = depths[step.after] = depths[state] + 1
            for violation in violations_in(world, step.after):
                if violation.startswith(only):
                    return result(violation, step.after)
            waiting.append(step.after)
    return result("", None)


def _reaches_empty_outbox(world: World, state: State, known: dict[State, bool]) -> bool:
    """Follow one schedule without faults; every state of it is itself searched, so that results are shared."""
    path: list[State] = []
    reached: bool | None = None
    on_path: set[State] = set()
    while reached is None:
        if state in known:
            reached = known[state]
        elif state in on_path:
            reached = False
        else:
            path.append(state)
            on_path.add(state)
            following = cooperative_step(world, state)
            if following is None:
                reached = True
            else:
                state = following
    for visited in path:
        known[visited] = reached
    return reached
