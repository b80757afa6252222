"""Text reports of contacts: lines in the form of CARIS contact files, and a report in the manner of APP-11.

Neither is conformant. `docs/reference/exports.md` lists which parts are publicly described.
"""

import re
from datetime import UTC, datetime
from typing import IO, Final

from sonarpost.export.contacts import ExportContact
from sonarpost.export.formats import Format
from sonarpost.export.source import ExportSource
from sonarpost.export.text import csv_text
from sonarpost.review.decisions import ReviewState

_NOT_MTF: Final = re.compile(r"[^A-Z0-9 .,()?\-]")
MAX_FIELD_CHARACTERS: Final = 60
"""Longest free text of a set."""

_ASSESSMENTS: Final[dict[ReviewState, str]] = {
    "unreviewed": "NOT REVIEWED",
    "mine_like": "MILCO",
    "not_mine_like": "NONMILCO",
    "unsure": "UNSURE",
    "disputed": "MILCO DISPUTED",
}
"""MILCO is a mine-like contact in the terms of mine countermeasures, NONMILCO one that is not."""


def write_caris_text(file: IO[bytes], source: ExportSource) -> None:
    """Write one line for each contact with a position, its fields separated by commas.

    Fields 1 to 10 are those of CARIS `ContactSingle`: contact index, key, line index, contact number, creation date,
    time and user, modification date, time and user. Fields 11 to 14 have the form of `ContactMultiPoints`: profile
    number, across-track distance in metres (port negative), latitude and longitude in degrees. Field 15 is a remark.
    """
    line_names: dict[str, int] = {}
    for index, contact in enumerate(contact for contact in source.contacts if contact.position is not None):
        assert contact.position is not None
        record, decision = contact.image.contact, contact.decision
        assert record is not None
        line = _plain(record.line_name or contact.image.vehicle_id)
        line_index = line_names.setdefault(line, len(line_names))
        number = int(contact.image.image_id, 36) % 10_000
        created_s = record.time_utc_s or contact.image.first_frame_utc_s
        modified_s = created_s if decision is None else decision.decided_utc_s
        across_m = record.ground_range_m or 0.0
        lat_deg, lon_deg = contact.position
        fields = (
            f"{index:04}",
            f"{line[:8]:8}{number:04}",
            f"{line_index:04}",
            f"{number:04}",
            _date(created_s),
            _time(created_s),
            "ATD",
            _date(modified_s),
            _time(modified_s),
            "ATD" if decision is None else f"{_plain(decision.operator)[:3]:3}",
            f"{(record.ping_number or 0) % 10_000:04}",
            f"{-across_m if record.channel == 'port' else across_m:.2f}",
            f"{lat_deg:.7f}",
            f"{lon_deg:.7f}",
            _plain(_remark(contact)),
        )
        file.write(f"{','.join(fields)}\n".encode())


def write_mine_report(file: IO[bytes], source: ExportSource) -> None:
    """Write a report of sets in the manner of APP-11: fields separated by `/`, each set ended by `//`.

    The first set states that the message is not conformant. Free text is reduced to capital letters, digits and
    punctuation that do not separate fields.
    """
    contacts = tuple(source.contacts)
    sets = [
        "NOTE/NOT CONFORMANT WITH APP-11. IN THE MANNER OF A MINE REPORT. BY SONARPOST",
        f"CONTACTS/{len(contacts)}/WITHOUT POSITION/{sum(contact.position is None for contact in contacts)}",
    ]
    for number, contact in enumerate(contacts, start=1):
        record, decision = contact.image.contact, contact.decision
        seen_s = contact.image.first_frame_utc_s if record is None or record.time_utc_s is None else record.time_utc_s
        sigma_m = None if record is None else record.position_sigma_m
        sets += [
            f"CONTACT/{number:03}/{_field(contact.uid)}/{_ASSESSMENTS[contact.review]}",
            f"POSITION/{_position(contact)}/WGS84/{_metres(sigma_m)}",
            f"TIME/{_date_time_group(seen_s)}",
            f"WATERDEPTH/{_metres(_water_depth_m(contact))}",
            f"CLASS/{_field(decision.mlo_class or '') if decision else ''}/{_probability(contact)}",
        ]
        if decision is not None:
            sets.append(f"DECIDED/{_field(decision.operator)}/{_date_time_group(decision.decided_utc_s)}")
            if decision.remark:
                sets.append(f"REMARK/{_field(decision.remark)}")
    file.write("".join(f"{each}//\n" for each in sets).encode("ascii"))


def _plain(text: str) -> str:
    """Return text without line ends, control characters and commas."""
    return csv_text(text).replace(",", ";")


def _remark(contact: ExportContact) -> str:
    decision = contact.decision
    parts = [contact.name, contact.review, "" if decision is None else decision.mlo_class or ""]
    return " ".join(part for part in (*parts, "" if decision is None else decision.remark) if part)


def _date(utc_s: float) -> str:
    return datetime.fromtimestamp(utc_s, UTC).strftime("%m/%d/%Y")


def _time(utc_s: float) -> str:
    tenths = int(utc_s % 86_400 * 10)
    return f"{tenths // 36_000:02}:{tenths // 600 % 60:02}:{tenths // 10 % 60:02}.{tenths % 10}"


def _date_time_group(utc_s: float) -> str:
    """Return a date-time group: day, hour and minute, Z, month, year."""
    return datetime.fromtimestamp(utc_s, UTC).strftime("%d%H%MZ%b%Y").upper()


def _position(contact: ExportContact) -> str:
    """Return degrees, minutes with three decimals and the hemisphere."""
    if contact.position is None:
        return "UNKNOWN"
    return _angle(contact.position[0], 2, "NS") + "-" + _angle(contact.position[1], 3, "EW")


def _angle(degrees: float, digits: int, hemispheres: str) -> str:
    thousandths = round(abs(degrees) * 60_000)
    whole, rest = divmod(thousandths, 60_000)
    return f"{whole:0{digits}}{rest / 1000:06.3f}{hemispheres[degrees < 0]}"


def _water_depth_m(contact: ExportContact) -> float | None:
    """Return depth plus altitude of the vehicle at the contact; None if either is unknown."""
    record = contact.image.contact
    if record is None or record.depth_m is None or record.altitude_m is None:
        return None
    return record.depth_m + record.altitude_m


def _metres(value_m: float | None) -> str:
    return "UNKNOWN" if value_m is None else f"{value_m:.1f}M"


def _probability(contact: ExportContact) -> str:
    record = contact.image.contact
    if record is None or record.p_mine_like is None:
        return "UNKNOWN"
    return f"PMINELIKE {record.p_mine_like:.2f}"


def _field(text: str) -> str:
    return _NOT_MTF.sub(" ", text.upper())[:MAX_FIELD_CHARACTERS].strip()


CARIS_TEXT: Final = Format(write_caris_text, "text/plain; charset=utf-8")
MINE_REPORT: Final = Format(write_mine_report, "text/plain; charset=us-ascii")
