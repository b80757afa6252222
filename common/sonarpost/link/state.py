"""Saved state of the link: dataclasses as named parts of msgpack bytes, and back with validation.

A service saves every part that changed and restores all of them after a restart. A part is small, so that the cost of a
frame does not grow with the number of contacts. A part that cannot be read is reported and skipped.

A part is a list: the format version, then the fields of one dataclass in the order of their definition. A new field is
appended and has a default. The annotations of the fields are the schema. Supported are numbers (with `Bounds`), text,
bytes, enumerations, tuples, lists, dictionaries, optional values, float64 arrays, dataclasses, and classes with the
methods `pack` and `unpack`, which are saved as bytes.
"""

from __future__ import annotations

import math
import types
from bisect import bisect_left
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from functools import cache
from itertools import takewhile
from typing import Annotated, Final, NamedTuple, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import msgpack
import numpy as np

from sonarpost.errors import BadInputError, FrameError

FORMAT_VERSION: Final = 2
"""Version of all parts; parts of another version are not read."""

Parts = Mapping[str, bytes]
Errors = Mapping[str, FrameError]
"""Why parts could not be read, by their names."""

SEPARATE: Final = {"part": "separate"}
"""Metadata of a dataclass field that is not in the part of its dataclass."""
PROGRESS: Final = {"part": "progress"}
"""Metadata of a dataclass field that changes often: it is saved in a part of its own."""

_T = TypeVar("_T")


class Bounds(NamedTuple):
    """Least and greatest value of a number, as an annotation."""

    low: float
    high: float


SavedCount = Annotated[int, Bounds(0, 2**62)]
Byte = Annotated[int, Bounds(0, 255)]
Word = Annotated[int, Bounds(0, 2**32 - 1)]


def check_bounds(value: object, where: str, error: type[BadInputError]) -> None:
    """Raise `error` for the first field of a dataclass that is not within its `Bounds`; None is accepted."""
    kind: type = type(value)
    for name, bounds in _bounds_of(kind):
        number = getattr(value, name)
        if number is not None and not bounds.low <= number <= bounds.high:
            raise error(where, name, number, f"{bounds.low}..{bounds.high}")


@cache
def _bounds_of(kind: type) -> list[tuple[str, Bounds]]:
    found: list[tuple[str, Bounds]] = []
    for name, hint in get_type_hints(kind, include_extras=True).items():
        optional = get_origin(hint) in (Union, types.UnionType)
        for each in get_args(hint) if optional else (hint,):
            found += [(name, bounds) for bounds in getattr(each, "__metadata__", ()) if isinstance(bounds, Bounds)]
    return found


def pack_part(value: object, part: str = "") -> bytes:
    """Return a dataclass as the bytes of a part.

    Args:
        value: The dataclass.
        part: "progress" for the fields with the metadata `PROGRESS`; otherwise the fields without metadata.
    """
    kind: type = type(value)
    packed: bytes = msgpack.packb([FORMAT_VERSION, *(to_plain(getattr(value, name)) for name in _names(kind, part))])
    return packed


def unpack_plain(kind: type[_T], data: bytes, where: str) -> _T:
    """Return the value that msgpack bytes hold.

    Raises:
        FrameError: `data` is not msgpack, or not a `kind` (list or dict).
    """
    try:
        plain = msgpack.unpackb(data, strict_map_key=False)
    except (ValueError, TypeError, RecursionError, msgpack.exceptions.UnpackException) as error:
        raise FrameError(where, "", data, f"msgpack ({error or type(error).__name__})") from error
    if not isinstance(plain, kind):
        raise FrameError(where, "", plain, f"a {kind.__name__}")
    return plain


def unpack_value(kind: type[_T], data: bytes, where: str) -> _T:
    """Return the list, tuple or dataclass of type `kind` that msgpack bytes hold.

    Raises:
        FrameError: They hold something else.
    """
    return from_plain(kind, unpack_plain(list, data, where), where)


def prefixed(prefix: str, parts: Mapping[str, _T]) -> dict[str, _T]:
    """Return the parts with `prefix` before their names."""
    return {prefix + name: data for name, data in parts.items()}


def below(prefix: str, parts: Mapping[str, _T]) -> dict[str, _T]:
    """Return the parts whose names begin with `prefix`, without it."""
    return {name.removeprefix(prefix): part for name, part in parts.items() if name.startswith(prefix)}


class SavedParts:
    """The parts that are on the disk, to write only what changed.

    Args:
        saved: The parts on the disk.
    """

    def __init__(self, saved: Parts) -> None:
        self._saved = dict(saved)

    def changes(self, parts: Parts) -> dict[str, bytes | None]:
        """Return the parts to write, and None for those to delete; call `commit` after they are written."""
        changed: dict[str, bytes | None] = {n: data for n, data in parts.items() if self._saved.get(n) != data}
        return changed | dict.fromkeys(self._saved.keys() - parts.keys())

    def commit(self, parts: Parts) -> None:
        """Record that the disk holds these parts."""
        self._saved = dict(parts)


class PartReader:
    """Reads parts and collects why others cannot be read.

    Attributes:
        errors: By the name of the part.

    Args:
        parts: The saved parts.
        where: Name of the state in errors.
    """

    def __init__(self, parts: Parts, where: str) -> None:
        self.errors: dict[str, FrameError] = {}
        self._where = where
        self._parts = parts
        self._names = sorted(parts)

    def __contains__(self, name: str) -> bool:
        return name in self._parts

    def read(self, name: str, kind: type[_T]) -> _T | None:
        """Return the part `name`, None if there is none or it cannot be read."""
        return self._read(name, kind) if name in self else None

    def read_group(
        self, group: str, kind: type[_T], *, progress: str = "", apply: Callable[[_T], object] | None = None
    ) -> list[_T]:
        """Return the parts `group`/..., in the order of their names.

        Args:
            group: The name up to a slash.
            kind: Type of the parts.
            progress: The group of the parts with the `PROGRESS` fields, if there are any. These fields have their
                defaults where such a part is missing or cannot be read.
            apply: Receives each part; raises BadInputError to reject it.
        """
        found: list[_T] = []
        prefix = f"{group}/"
        names = self._names[bisect_left(self._names, prefix) :]
        for name in takewhile(lambda name: name.startswith(prefix), names):
            second = progress + name.removeprefix(group)
            part = self._read(name, kind, apply, second) if progress and second in self else None
            part = part or self._read(name, kind, apply)
            found += [] if part is None else [part]
        return found

    def _read(
        self, name: str, kind: type[_T], apply: Callable[[_T], object] | None = None, progress: str = ""
    ) -> _T | None:
        """Return a part, together with its `progress` part if it is named; None if one of them cannot be read."""
        invalid = name
        try:
            plain = self._plain(name, kind, "")
            if progress:
                invalid = progress
                plain |= self._plain(progress, kind, "progress")
            part = from_plain(kind, plain, self._where)
            if apply is not None:
                apply(part)
        except BadInputError as error:
            self.errors[invalid] = FrameError(f"{self._where}: {invalid}", error.field, error.value, error.expected)
            return None
        return part

    def _plain(self, name: str, kind: type, part: str) -> dict[str, object]:
        """Return the fields in a part by name."""
        version, *values = unpack_plain(list, self._parts[name], self._where) or [None]
        if type(version) is not int or version != FORMAT_VERSION:
            raise FrameError(self._where, "format version", version, str(FORMAT_VERSION))
        return _Reader(self._where).by_name(_names(kind, part), values)


def to_plain(value: object) -> object:  # noqa: PLR0911 one return a kind
    """Return a value as msgpack can hold it."""
    if isinstance(value, Enum):
        return value.value
    if value is None or isinstance(value, (bool, int, float, str, bytes)):
        return value
    if isinstance(value, (tuple, list)):
        return [to_plain(item) for item in value]
    if isinstance(value, dict):
        return {to_plain(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return value.astype("<f8").tobytes()
    if hasattr(value, "unpack"):
        return value.pack()  # type: ignore[attr-defined]
    kind: type = type(value)
    return [to_plain(getattr(value, name)) for name in _names(kind)]


def from_plain(kind: type[_T], plain: object, where: str, field: str = "") -> _T:
    """Return the value of type `kind` that `to_plain` turned into `plain`; a dataclass may also be a map of its fields.

    Raises:
        FrameError: `plain` does not fit `kind`. `field` is the path of the value in the error.
    """
    return cast("_T", _Reader(where).read(kind, plain, field))


class _Attribute(NamedTuple):
    kind: object
    required: bool
    part: str


@cache
def _attributes(kind: type) -> dict[str, _Attribute]:
    """Return the fields of a dataclass that are saved, by name."""
    if not is_dataclass(kind):
        raise TypeError(f"{kind.__name__} cannot be saved")
    hints = get_type_hints(kind, include_extras=True)
    return {
        f.name: _Attribute(
            hints[f.name], f.default is MISSING and f.default_factory is MISSING, f.metadata.get("part", "")
        )
        for f in fields(kind)
        if f.metadata != SEPARATE
    }


@cache
def _names(kind: type, part: str = "") -> tuple[str, ...]:
    """Return the names of the fields in a part."""
    return tuple(name for name, attribute in _attributes(kind).items() if attribute.part == part)


class _Reader(NamedTuple):
    where: str

    def read(self, kind: object, plain: object, field: str) -> object:
        origin, args = get_origin(kind), get_args(kind)
        if origin is Annotated:
            value, bounds = cast("float", self.read(args[0], plain, field)), args[1]
            self.check(bounds.low <= value <= bounds.high, field, value, f"{bounds.low}..{bounds.high}")
            return value
        if origin in (Union, types.UnionType):
            (some,) = (arg for arg in args if arg is not types.NoneType)
            return None if plain is None else self.read(some, plain, field)
        if origin in (tuple, list):
            return self._sequence(origin, args, plain, field)
        if origin is dict:
            if not isinstance(plain, dict):
                raise FrameError(self.where, field, plain, "a map")
            pairs = ((self.read(args[0], k, field), self.read(args[1], v, f"{field}[{k!r}]")) for k, v in plain.items())
            return dict(pairs)
        if origin is np.ndarray:
            return self._array(plain, field)
        assert isinstance(kind, type), f"{kind} cannot be saved"
        return self._scalar(kind, plain, field)

    def check(self, fits: object, field: str, value: object, expected: str) -> None:
        if not fits:
            raise FrameError(self.where, field, value, expected)

    def by_name(self, names: tuple[str, ...], values: list[object], field: str = "") -> dict[str, object]:
        self.check(len(values) <= len(names), field, f"{len(values)} fields", f"at most {len(names)}")
        return dict(zip(names, values, strict=False))

    def _sequence(self, origin: type, args: tuple[object, ...], plain: object, field: str) -> object:
        if not isinstance(plain, list | tuple):
            raise FrameError(self.where, field, plain, "a list")
        kinds: tuple[object, ...] = (args[0],) * len(plain) if origin is not tuple or args[-1] is ... else args
        self.check(len(kinds) == len(plain), field, plain, f"a list of {len(kinds)}")
        items = [self.read(k, item, f"{field}[{n}]") for n, (k, item) in enumerate(zip(kinds, plain, strict=True))]
        return origin(items)

    def _array(self, plain: object, field: str) -> object:
        if not isinstance(plain, bytes) or len(plain) % 8:
            raise FrameError(self.where, field, plain, "bytes of float64 values")
        values = np.frombuffer(plain, "<f8").astype(np.float64)
        self.check(np.isfinite(values).all(), field, "not finite", "finite values")
        return values

    def _scalar(self, kind: type, plain: object, field: str) -> object:
        if kind in (bool, int, str, bytes):
            self.check(type(plain) is kind, field, plain, kind.__name__)
            return plain
        if kind is float:
            if type(plain) not in (int, float) or not math.isfinite(cast("float", plain)):
                raise FrameError(self.where, field, plain, "a finite number")
            return float(cast("float", plain))
        if issubclass(kind, Enum):
            known = {member.value: member for member in kind}
            fits = type(plain) in {type(value) for value in known} and plain in known
            self.check(fits, field, plain, ", ".join(map(str, known)))
            return known[plain]
        try:
            return self._object(kind, plain, field)
        except BadInputError as error:
            if isinstance(error, FrameError) and error.where == self.where:
                raise
            path = ".".join(filter(None, (field, error.field)))
            raise FrameError(self.where, path, error.value, error.expected) from error

    def _object(self, kind: type, plain: object, field: str) -> object:
        if hasattr(kind, "unpack"):
            self.check(type(plain) is bytes, field, plain, "bytes")
            value = kind.unpack(plain)
            self.check(value.pack() == plain, field, plain, f"{len(value.pack())} bytes")
            return value
        if isinstance(plain, list):
            plain = self.by_name(_names(kind), plain, field)
        if not isinstance(plain, dict):
            raise FrameError(self.where, field, plain, "a list of fields")
        values: dict[str, object] = {}
        for name, attribute in _attributes(kind).items():
            path = f"{field}.{name}" if field else name
            if name in plain:
                values[name] = self.read(attribute.kind, plain[name], path)
            else:
                self.check(not attribute.required, path, "nothing", "a value")
        return kind(**values)
