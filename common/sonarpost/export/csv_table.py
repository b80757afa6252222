"""CSV (RFC 4180, UTF-8): one row a contact, those without a position too, with empty cells for it."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from sonarpost.export.accepted import Accepted
from sonarpost.export.properties import COLUMNS, Value, properties
from sonarpost.export.text import csv_text
from sonarpost.files import write_atomically

BYTE_ORDER_MARK = b"\xef\xbb\xbf"


def csv_bytes(accepted: Accepted) -> bytes:
    """Return the table: a row of column names, then one row a contact, lines ended by CR LF.

    It begins with the UTF-8 byte order mark, without which the most used spreadsheet takes it for another encoding.
    """
    buffer = io.StringIO(newline="")
    writer = csv.writer(buffer, lineterminator="\r\n")
    writer.writerow(COLUMNS)
    for contact in accepted.contacts:
        writer.writerow([_cell(value) for value in properties(contact).values()])
    return BYTE_ORDER_MARK + buffer.getvalue().encode()


def write_csv(path: Path, accepted: Accepted) -> None:
    """Write the table to `path`, whole or not at all.

    Raises:
        OSError: It cannot be written.
    """
    write_atomically(path, csv_bytes(accepted))


def _cell(value: Value) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    # A number is ours and stays one, its minus sign too; only text comes from strangers.
    return csv_text(value) if isinstance(value, str) else repr(value)
