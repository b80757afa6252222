"""Saved parts of the link's state, changed for tests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import msgpack

from sonarpost.link.state import Parts


def plain_of(parts: Parts, name: str) -> list[Any]:
    """Return the list in a part: the format version, then the fields."""
    plain: list[Any] = msgpack.unpackb(parts[name], strict_map_key=False)
    return plain


def field_names(kind: type, part: str = "") -> list[str]:
    """Return the names of the fields in a part, in their order."""
    return ["format version", *(f.name for f in fields(kind) if f.metadata.get("part", "") == part)]


def with_fields(parts: Parts, name: str, kind: type, changes: Mapping[str, object]) -> dict[str, bytes]:
    """Return the parts with other values of some fields of the dataclass `kind` in one of them."""
    names = field_names(kind, "progress" if "progress" in name else "")
    plain = plain_of(parts, name)
    for field, value in changes.items():
        plain[names.index(field)] = value
    return {**parts, name: msgpack.packb(plain)}


def group(parts: Parts, first: str) -> dict[str, bytes]:
    """Return the parts whose names begin with `first` and a slash."""
    return {name: data for name, data in parts.items() if name.startswith(f"{first}/")}
