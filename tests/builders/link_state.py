"""Saved parts of the link's state, changed for tests."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import msgpack
from hypothesis import strategies as st

from sonarpost.link.receiver import Event, FrameRejected
from sonarpost.link.state import Parts

WRONG = (None, -1, 3, 2.5, float("nan"), b"", b"xx", "x", [], {}, True, 2**63, b"\x92\x05\xc3")


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


def replace_a_value(plain: Any, data: st.DataObject) -> None:
    """Replace a drawn value, at any depth of lists and maps, by one that is mostly wrong."""
    while True:
        key = data.draw(st.sampled_from(list(plain) if isinstance(plain, dict) else list(range(len(plain)))))
        if not (isinstance(plain[key], dict | list) and plain[key] and data.draw(st.booleans())):
            plain[key] = data.draw(st.sampled_from(WRONG))
            return
        plain = plain[key]


def comparable(events: list[Event]) -> list[Any]:
    """Return the events with errors as text, because errors cannot be compared."""
    return [(e.source, e.received_s, str(e.reason)) if isinstance(e, FrameRejected) else e for e in events]
