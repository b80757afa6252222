"""Encoding of records as msgpack.

A payload is a plain msgpack map: the fields of the record, `type` (name of the record) and `v` (schema version). Any
msgpack library can read it without sonarpost. Unknown fields are ignored. A field that is missing, of another type or
out of range is an error with the key and the name of the field.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import TypeVar

import msgpack
from pydantic import BaseModel, ValidationError

from sonarpost.errors import PayloadError
from sonarpost.messages import Record

R = TypeVar("R", bound=Record)
M = TypeVar("M", bound=BaseModel)

MAX_PAYLOAD_BYTES = 40 * 1024 * 1024
ENCODING_PREFIX = "application/msgpack;schema=sonarpost."


@cache
def encoding_of(record_type: type[Record]) -> str:
    """Return the Zenoh encoding of a record type: application/msgpack;schema=sonarpost.contact.v1."""
    return f"{ENCODING_PREFIX}{record_type.TYPE}.v{record_type.VERSION}"


def encode(record: Record) -> bytes:
    """Return the record as msgpack: `type`, `v`, then its fields in the order of their definition.

    Equal records give equal bytes on every platform. A sparse record omits fields with their default value.
    """
    packed: bytes = msgpack.packb(map_of(record), use_bin_type=True)
    return packed


def map_of(record: Record) -> dict[str, object]:
    """Return the map of a record's payload, which `unpack_map` reads from it."""
    return {"type": record.TYPE, "v": record.VERSION, **record.model_dump(exclude_defaults=record.SPARSE)}


def unpack_map(payload: bytes, where: str) -> dict[str, object]:
    """Return the map of a payload, without validation of its fields.

    Raises:
        PayloadError: The payload is not msgpack, has trailing bytes, or is not a map with text keys.
    """
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise PayloadError(where, "payload", f"{len(payload)} bytes", f"at most {MAX_PAYLOAD_BYTES} bytes")
    try:
        value = msgpack.unpackb(payload, raw=False, use_list=False, strict_map_key=True)
    except (ValueError, TypeError, RecursionError, msgpack.exceptions.UnpackException) as error:
        raise PayloadError(
            where, "payload", payload[:40], f"a msgpack map ({error or type(error).__name__})"
        ) from error
    if not isinstance(value, dict) or set(map(type, value)) - {str}:
        raise PayloadError(where, "payload", value, "a msgpack map with text keys")
    return value


def decode(record_type: type[R], payload: bytes, where: str) -> R:
    """Decode and validate a record.

    Args:
        record_type: Expected type.
        payload: msgpack bytes.
        where: Key expression or file, for errors.

    Raises:
        PayloadError: The payload is not a valid record of this type.
    """
    fields = unpack_map(payload, where)
    if fields.get("type") != record_type.TYPE:
        raise PayloadError(where, "type", fields.get("type"), repr(record_type.TYPE))
    version = fields.get("v")
    # In Python 1.0 and true equal 1; other languages distinguish them.
    if type(version) is not int or version != record_type.VERSION:
        raise PayloadError(where, "v", version, str(record_type.VERSION))
    return validated(record_type, fields, where)


def validated(model: type[M], fields: Mapping[str, object], where: str) -> M:
    """Validate the fields of a map.

    Raises:
        PayloadError: A field is missing or invalid.
    """
    try:
        record: M = model.__pydantic_validator__.validate_python(fields)
    except ValidationError as error:
        field, value, expected = first_error(error)
        raise PayloadError(where, field or str(getattr(model, "TYPE", "")), value, expected) from error
    return record


def first_error(error: ValidationError) -> tuple[str, object, str]:
    """Return field, value and expected value of the first error of pydantic, as arguments of a `BadInputError`."""
    first = error.errors(include_url=False)[0]
    value = "nothing" if first["type"] == "missing" else first["input"]
    return ".".join(str(part) for part in first["loc"]), value, expected_text(first["type"], first["msg"])


def expected_text(kind: str, message: str) -> str:
    """Return the text after 'expected' for an error of pydantic."""
    if kind == "missing":
        return "a value"
    if kind == "extra_forbidden":
        return "a known name"
    for prefix in ("Input should be ", "Value error, "):
        if message.startswith(prefix):
            return message[len(prefix) :]
    return message
