"""Snippet files: a TIFF or PNG image with a text file beside it.

The paper's vehicle writes a text file with the position of the target for each snippet. This one contains the whole
contact record, a line `name: value` for each known field. People read it, and so does the service in snippets mode.
"""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, get_args

from pydantic import ValidationError
from pydantic_core import to_json

from sonarpost.codec.interface import check_image
from sonarpost.errors import StreamError, SurveyFileError
from sonarpost.files import write_atomically
from sonarpost.messages import Contact, Pixels, Snippet
from sonarpost.services.atd_stub.input_folder import printable
from sonarpost.sonar.image_files import read_image, tiff_bytes

SNIPPET_SUFFIXES: Final = (".txt", ".tiff")
"""Suffixes of the files of a snippet."""
_TIME: Final = "time_utc"
_MAX_TEXT_BYTES: Final = 1 << 16
_UNSAFE_CHARACTER: Final = re.compile(r"[^A-Za-z0-9._-]")


def write_snippet(folder: Path, snippet: Snippet) -> Path:
    """Write a snippet as `CONTACT_ID.tiff` and, last, `CONTACT_ID.txt`; return the path of the TIFF.

    Raises:
        OSError: The folder cannot be made or written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    tiff = folder / f"{_UNSAFE_CHARACTER.sub('_', snippet.contact.contact_id)}.tiff"
    write_atomically(tiff, tiff_bytes(tiff, snippet.picture.to_array()))
    write_atomically(tiff.with_suffix(".txt"), contact_text(snippet.contact).encode())
    return tiff


def read_snippet(path: Path, content: str, vehicle_id: str) -> Snippet:
    """Read a TIFF or PNG as the snippet of a contact; a text file beside it has the fields of the contact.

    Args:
        path: The image.
        content: Hex SHA-256 of its content; part of the contact identifier where the text file has none.
        vehicle_id: This vehicle.

    Raises:
        SurveyFileError: Not a grey image of 8 or 16 bits with 16 to 512 pixels a side, or not such a text file.
    """
    image = read_image(path)
    try:
        check_image(image, str(path))
    except StreamError as error:
        raise SurveyFileError(error.where, error.field, error.value, error.expected) from error
    contact_id = f"{printable(path.stem)[:80]}-{content[:8]}"
    text = path.with_suffix(".txt")
    contact = Contact(contact_id=contact_id, vehicle_id=vehicle_id)
    if text.is_file():
        contact = read_contact(text, contact_id, vehicle_id)
    return Snippet(contact=contact, picture=Pixels.from_array(image), source=printable(path.name))


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


def read_contact(path: Path, contact_id: str, vehicle_id: str) -> Contact:
    """Read the contact of a text file. Names that are no fields of the record are ignored.

    Args:
        path: The file.
        contact_id: Identifier of the contact where the file has none.
        vehicle_id: This vehicle; replaces the one in the file.

    Raises:
        SurveyFileError: The file cannot be read, a line is not `name: value`, or a value is out of the field's range.
    """
    try:
        raw = path.read_bytes()
        if len(raw) > _MAX_TEXT_BYTES:
            raise SurveyFileError(str(path), "size", len(raw), f"at most {_MAX_TEXT_BYTES} bytes")
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
    """Return the types in a field's annotation."""
    inner = [kind for kind in get_args(annotation) if not isinstance(kind, str)]
    return [leaf for kind in inner for leaf in _leaves(kind)] if inner else [annotation]


def _number(text: str, name: str, path: Path) -> float | int:
    try:
        return int(text) if re.fullmatch(r"[+-]?\d{1,18}", text) else float(text)
    except ValueError as error:
        raise SurveyFileError(str(path), name, text[:80], "a number") from error


def _seconds(text: str, path: Path) -> float:
    try:
        time_utc = datetime.fromisoformat(text)
    except ValueError as error:
        raise SurveyFileError(str(path), _TIME, text[:80], "a time as 2016-10-12T09:20:00.250Z") from error
    return (time_utc if time_utc.tzinfo else time_utc.replace(tzinfo=UTC)).timestamp()
