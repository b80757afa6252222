"""Objects by name: those of the core, of the extensions of this package, and of other installed packages (plug-ins).

A registry is a group of entry points, for example `sonarpost.modems`. An extension names its objects in
`entry_points.toml` in its folder, a plug-in in the metadata of its package. An object is imported when it is asked for:
a plug-in that cannot be imported is an error only for the command or service that asks for it.
"""

from __future__ import annotations

import logging
import tomllib
from collections.abc import Callable, Iterable, Mapping
from contextlib import redirect_stdout
from functools import cache
from importlib.metadata import EntryPoint, distributions
from io import StringIO
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

from sonarpost.errors import ConfigError

log = logging.getLogger(__name__)

ENTRY_POINTS_FILE: Final = "entry_points.toml"
EXTENSIONS: Final = Path(__file__).with_name("extensions")

T = TypeVar("T")


class Registry(Generic[T]):
    """Objects of one group by name.

    The core has priority over an extension, an extension over a plug-in; the first of two plug-ins counts, in the order
    of their modules. What does not count is reported in the log.

    Args:
        group: Name of the group of entry points.
        expected: What an object has to be, for errors.
        is_valid: Whether an object is one. It gets the object and its name.
        core: Objects of the core.
        points: Entry points of extensions and plug-ins, by priority; None: those that are installed.
    """

    def __init__(
        self,
        group: str,
        expected: str,
        is_valid: Callable[[object, str], bool],
        core: Mapping[str, T],
        points: Iterable[EntryPoint] | None = None,
    ) -> None:
        self.group = group
        self._expected = expected
        self._is_valid = is_valid
        self._core = tuple(core)
        self._objects = dict(core)
        self._points: dict[str, EntryPoint] = {}
        self._unusable: set[str] = set()
        for point in installed_points(group) if points is None else points:
            if point.name in self._objects or point.name in self._points:
                log.warning("Plug-in ignored: its name is taken: %s:%s = %s", group, point.name, point.value)
            else:
                self._points[point.name] = point

    def names(self) -> tuple[str, ...]:
        """Return all names, sorted; whether an object can be imported is not known."""
        return tuple(sorted({*self._objects, *self._points}))

    def get(self, name: str) -> T:
        """Return an object; import it if it was not used before.

        Raises:
            ConfigError: There is no such name, or its entry point cannot be imported or is invalid.
        """
        if name not in self._objects:
            if name not in self._points:
                known = "one of " + ", ".join(self.names()) if self.names() else "an extension or a plug-in that has it"
                raise ConfigError(self.group, "name", name, known)
            self._objects[name] = self._load(self._points[name])
        return self._objects[name]

    def working(self, is_wanted: Callable[[str], bool] = lambda name: True) -> dict[str, T]:
        """Return all objects that can be imported, by name; each of the others is tried and reported in the log once.

        Those of the core are first, in their order.

        Args:
            is_wanted: Whether the object of a name is returned; others are not imported.
        """
        found = {}
        for name in filter(is_wanted, (*self._core, *sorted(self._points))):
            if name in self._unusable:
                continue  # its import can take long
            try:
                found[name] = self.get(name)
            except ConfigError as error:
                log.warning("Plug-in ignored: %s", error)
                self._unusable.add(name)
        return found

    def _load(self, point: EntryPoint) -> T:
        found: T = load(point)
        if not self._is_valid(found, point.name):
            where = f"entry point {self.group}:{point.name}"
            raise ConfigError(where, "value", f"{point.value} ({found!r})", self._expected)
        return found


def load(point: EntryPoint) -> Any:  # noqa: ANN401 the entry point names it
    """Import the object of an entry point. What its module prints is logged: it belongs to no output of a command.

    Raises:
        ConfigError: It cannot be imported.
    """
    where, printed = f"entry point {point.group}:{point.name}", StringIO()
    try:
        with redirect_stdout(printed):
            return point.load()
    except (Exception, SystemExit) as error:  # foreign code can raise any exception, and call `sys.exit`
        raise ConfigError(where, "value", f"{point.value} ({error!r})", "an object that imports") from error
    finally:
        if printed.getvalue():
            log.warning("Output at import of %s: %r", where, printed.getvalue()[:200])


@cache
def installed_points(group: str) -> tuple[EntryPoint, ...]:
    """Return the entry points of the extensions, then those of plug-ins, each in the order of names and values."""
    plug_ins = [point for point in _plug_in_points() if point.group == group]
    return (*_extension_points(group), *sorted(plug_ins, key=lambda p: (p.name, p.value)))


@cache
def _plug_in_points() -> tuple[EntryPoint, ...]:
    """Return the entry points of all installed packages; one whose metadata are damaged is reported in the log."""
    found: list[EntryPoint] = []
    for package in distributions():
        try:
            if "sonarpost." in (package.read_text("entry_points.txt") or ""):  # few have: parsing all takes long
                found += package.entry_points
        except Exception as error:  # noqa: BLE001 damaged metadata: one of many types
            log.warning("Plug-ins ignored: metadata of an installed package: %r", error)
    return tuple(dict.fromkeys(found))  # a package can be on the path twice


def _extension_points(group: str) -> list[EntryPoint]:
    found = []
    for path in sorted(EXTENSIONS.glob(f"*/{ENTRY_POINTS_FILE}")):
        found += [EntryPoint(name, value, group) for name, value in _named_in(path).get(group, {}).items()]
    return sorted(found, key=lambda p: (p.name, p.value))


@cache
def _named_in(path: Path) -> Mapping[str, Mapping[str, str]]:
    """Return the entry points in the file of an extension by group; none, and one line in the log, if it is invalid."""
    try:
        groups = tomllib.loads(path.read_text(encoding="utf-8"))
        return {group: {name: str(value) for name, value in named.items()} for group, named in groups.items()}
    except (OSError, ValueError, AttributeError) as error:
        log.warning("Extension ignored: %s", ConfigError(str(path), "", str(error), "TOML with a table for each group"))
        return {}
