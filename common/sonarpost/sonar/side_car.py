"""Side-cars of images: a text file `NAME.txt` beside `NAME.png` with the fields of the contact that the image shows.

The paper's vehicle writes a text file with the position of the target for each snippet. This one contains the whole
contact record, a line `name: value` for each known field. People write and read it, and so do the services.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, get_args

from pydantic import ValidationError
from pydantic_core import to_json

from sonarpost.errors import SurveyFileError
from sonarpost.files import read_regular, write_atomically
from sonarpost.messages import Contact

_TIME: Final = "time_utc"
_MAX_TEXT_BYTES: Final = 1 << 16


@dataclass(frozen=True)
class SideCar:
    """The content of a side-car.

    Attributes:
        contact: The contact.
        notes: A phrase for each line that was ignored.
    """

    contact: Contact
    notes: tuple[str, ...]


def write_side_car(path: Path, contact: Contact) -> None:
    """Write a side-car, atomically.

    Raises:
        OSError: The file cannot be written.
    """
    write_atomically(path, contact_text(contact).encode())


def contact_text(contact: Contact) -> str:
    """Return a line `name: value` for each known field, in the order of the record; the time as ISO 8601."""
    lines = []
    for name, value in contact.model_dump(exclude_none=True).items():
        if name == "time_utc_s":
            time_utc = datetime.fromtimestamp(value, UTC).isoformat(timespec="milliseconds")
            lines.append(f"{_TIME}: {time_utc.replace('+00:00', 'Z')}\n")
        else:
            lines.append(f"{name}: {' '.join(str(value).splitlines())}\n")
    return "".join(lines)


def read_side_car(path: Path, contact_id: str, vehicle_id: str) -> SideCar:
    """Read the contact of a text file. Names that are no fields of the record are ignored with a note.

    Args:
        path: The file.
        contact_id: Identifier of the contact where the file has none.
        vehicle_id: This vehicle; replaces the one in the file.

    Raises:
        SurveyFileError: The file cannot be read, a line is not `name: value`, or a value is out of the field's range.
    """
    try:
        lines = read_regular(path, _MAX_TEXT_BYTES).decode("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise SurveyFileError(str(path), "", str(error), "a readable text file in UTF-8") from error
    fields: dict[str, object] = {"contact_id": contact_id}
    lines_by_field: dict[str, int] = {}
    notes = []
    for number, line in enumerate(lines, start=1):
        name, colon, text = (part.strip() for part in line.partition(":"))
        where = f"{path} line {number}"
        field = "time_utc_s" if name == _TIME else name
        if not colon:
            if name:
                raise SurveyFileError(where, "", line[:80], "name: value")
        elif field not in Contact.model_fields:
            notes.append(f"line {number} ignored: {name[:40]!r} is not a field of a contact")
        elif text:
            lines_by_field[field] = number
            fields[field] = _value(name, text, where)
    fields["vehicle_id"] = vehicle_id
    try:
        return SideCar(Contact.model_validate_json(to_json(fields), strict=True), tuple(notes))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        name = str(first["loc"][0])
        where = f"{path} line {lines_by_field[name]}" if name in lines_by_field else str(path)
        raise SurveyFileError(where, name, first["input"], first["msg"]) from error


def _value(name: str, text: str, where: str) -> object:
    if name == _TIME:
        return _seconds(text, where)
    return text if _is_text(name) else _number(text, name, where)


def _is_text(name: str) -> bool:
    annotation = Contact.model_fields[name].annotation
    return not any(kind in (int, float) for kind in _leaves(annotation))


def _leaves(annotation: object) -> list[object]:
    """Return the types in a field's annotation."""
    inner = [kind for kind in get_args(annotation) if not isinstance(kind, str)]
    return [leaf for kind in inner for leaf in _leaves(kind)] if inner else [annotation]


def _number(text: str, name: str, where: str) -> float | int:
    try:
        return int(text) if re.fullmatch(r"[+-]?\d{1,18}", text) else float(text)
    except ValueError as error:
        raise SurveyFileError(where, name, text[:80], "a number") from error


def _seconds(text: str, where: str) -> float:
    try:
        time_utc = datetime.fromisoformat(text)
    except ValueError as error:
        raise SurveyFileError(where, _TIME, text[:80], "a time as 2016-10-12T09:20:00.250Z") from error
    return (time_utc if time_utc.tzinfo else time_utc.replace(tzinfo=UTC)).timestamp()
