"""The text file beside a snippet: where and what the contact is, a line for every field that is known.

The paper's vehicle leaves with every snippet a text file that says where the target lies. This one holds the contact
record, in words a person reads and, beside a picture in snippets mode, the service reads again.
"""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, get_args

from pydantic import ValidationError
from pydantic_core import to_json

from sonarpost.errors import SurveyFileError
from sonarpost.files import write_atomically
from sonarpost.messages import Contact, Snippet
from sonarpost.sonar.image_files import tiff_bytes

_TIME: Final = "time_utc"
_MOST_BYTES: Final = 1 << 16
_ODD: Final = re.compile(r"[^A-Za-z0-9._-]")


def write_snippet(folder: Path, snippet: Snippet) -> Path:
    """Write a snippet as `CONTACT_ID.tiff` and, last, `CONTACT_ID.txt`; return the TIFF's path.

    Raises:
        OSError: The folder cannot be made or written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    tiff = folder / f"{_ODD.sub('_', snippet.contact.contact_id)}.tiff"
    write_atomically(tiff, tiff_bytes(tiff, snippet.picture.to_array()))
    write_atomically(tiff.with_suffix(".txt"), contact_text(snippet.contact).encode())
    return tiff


def contact_text(contact: Contact) -> str:
    """Return a line `name: value` for every field that is known, in the order of the record; the time as ISO 8601."""
    lines = []
    for name, value in contact.model_dump(exclude_none=True).items():
        if name == "time_utc_s":
            moment = datetime.fromtimestamp(value, UTC).isoformat(timespec="milliseconds")
            lines.append(f"{_TIME}: {moment.replace('+00:00', 'Z')}\n")
        else:
            lines.append(f"{name}: {' '.join(str(value).splitlines())}\n")
    return "".join(lines)


def read_contact(path: Path, contact_id: str, vehicle_id: str) -> Contact:
    """Read what a text file says of a contact; names that are not the record's are left out.

    Args:
        path: The file.
        contact_id: The contact's, where the file has none.
        vehicle_id: This vehicle's, whatever the file says: who sends it answers for it.

    Raises:
        SurveyFileError: The file cannot be read, a line is not `name: value`, or a value is not one of the field's.
    """
    try:
        raw = path.read_bytes()
        if len(raw) > _MOST_BYTES:
            raise SurveyFileError(str(path), "size", len(raw), f"at most {_MOST_BYTES} bytes")
        lines = raw.decode("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise SurveyFileError(str(path), "", str(error), "a readable text file in UTF-8") from error
    fields: dict[str, object] = {"contact_id": contact_id}
    for number, line in enumerate(lines, start=1):
        name, colon, text = (part.strip() for part in line.partition(":"))
        if not colon and line.strip():
            raise SurveyFileError(str(path), f"line {number}", line[:80], "name: value")
        if name == _TIME:
            fields["time_utc_s"] = _seconds(text, path)
        elif text and name in Contact.model_fields:
            fields[name] = text if _is_text(name) else _number(text, name, path)
    fields["vehicle_id"] = vehicle_id
    try:
        return Contact.model_validate_json(to_json(fields), strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise SurveyFileError(str(path), str(first["loc"][0]), first["input"], first["msg"]) from error


def _is_text(name: str) -> bool:
    annotation = Contact.model_fields[name].annotation
    return not any(kind in (int, float) for kind in _leaves(annotation))


def _leaves(annotation: object) -> list[object]:
    """Return the types that a field's annotation is made of."""
    inner = [kind for kind in get_args(annotation) if not isinstance(kind, str)]
    return [leaf for kind in inner for leaf in _leaves(kind)] if inner else [annotation]


def _number(text: str, name: str, path: Path) -> float | int:
    try:
        return int(text) if re.fullmatch(r"[+-]?\d{1,18}", text) else float(text)
    except ValueError as error:
        raise SurveyFileError(str(path), name, text[:80], "a number") from error


def _seconds(text: str, path: Path) -> float:
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise SurveyFileError(str(path), _TIME, text[:80], "a time as 2016-10-12T09:20:00.250Z") from error
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
