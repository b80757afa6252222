"""Limits of what one source can use, and in which order sources are served.

Each limit is declared where it is enforced, with `limit`. docs/specifications/limits.md lists all of them.
"""

import inspect
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal, TypeVar

Rule = Literal["claims", "shares", "deadlines", "isolation", "blame"]
N = TypeVar("N", int, float)
T = TypeVar("T")
MAX_SOURCES: Final = 1000
"""Sources whose last turn is remembered."""


@dataclass(frozen=True, slots=True)
class Limit:
    """A declared limit.

    Attributes:
        rule: The rule that it implements.
        surface: Interface on which the source acts.
        source: Whom it limits.
        resource: What is limited.
        value: The limit.
        unit: Its unit.
        at_limit: What happens at the limit.
        module: Module that declares it.
    """

    rule: Rule
    surface: str
    source: str
    resource: str
    value: float
    unit: str
    at_limit: str
    module: str


DECLARED: Final[dict[tuple[str, str, str], Limit]] = {}
"""The limits of the imported modules, by module, surface and resource."""


def limit(value: N, unit: str, rule: Rule, surface: str, source: str, resource: str, at_limit: str) -> N:
    """Declare a limit in a module; return its value.

    Args:
        value: See `Limit`, as for the other arguments.
        unit: Unit, for example "bytes".
        rule: Rule.
        surface: Interface.
        source: Whom it limits.
        resource: What is limited.
        at_limit: Effect, a sentence without a full stop.

    Raises:
        ValueError: The module has declared this limit already.
    """
    frame = inspect.currentframe()
    assert frame is not None
    assert frame.f_back is not None
    module = frame.f_back.f_globals["__name__"]
    name = (module, surface, resource)
    if name in DECLARED:
        raise ValueError(f"limit declared twice: {name}")
    DECLARED[name] = Limit(rule, surface, source, resource, value, unit, at_limit, module)
    return value


def oldest_of_largest(items: Iterable[T], source_of: Callable[[T], Hashable]) -> T:
    """Return the first item of the source with the most items; it makes room for another one."""
    sources = [(source_of(item), item) for item in items]
    [(largest, _)] = Counter(source for source, _ in sources).most_common(1)
    return next(item for source, item in sources if source == largest)


class Turns:
    """Serves sources in turn, so that one with many items does not delay the others."""

    def __init__(self) -> None:
        self._served: dict[str, int] = {}
        self._count = 0

    def pick(self, waiting: Mapping[str, Sequence[T]], count: int) -> list[T]:
        """Take items, one of each source in turn; the source that was served longest ago is the first.

        Args:
            waiting: Items of each source in their order.
            count: Maximum number of items.
        """
        taken: dict[str, int] = dict.fromkeys(waiting, 0)
        picked: list[T] = []
        while len(picked) < count:
            left = [source for source, items in waiting.items() if taken[source] < len(items)]
            if not left:
                break
            source = min(left, key=lambda name: (self._served.get(name, 0), name))
            picked.append(waiting[source][taken[source]])
            taken[source] += 1
            self._count += 1
            self._served.pop(source, None)
            self._served[source] = self._count
        # A source that pauses does not come back as the first one. Above the maximum, the longest ago are forgotten.
        for source in list(self._served)[: -max(MAX_SOURCES, len(waiting))]:
            del self._served[source]
        return picked
