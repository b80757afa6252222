"""`sonarpost c2 watch`: prints a line for each record that a shore site accepts; live contacts for other commands."""

import argparse
import json
import logging
import sys
import threading
import time
from contextlib import suppress
from dataclasses import dataclass

import zenoh

from sonarpost import keys, wire
from sonarpost.bus.catch_up import AcceptedRecord, CatchUpSubscriber
from sonarpost.bus.session import lost_reason, open_with_retry
from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.shared import (
    add_router_options,
    add_site_option,
    flag,
    option,
    printable,
    router_of,
    time_text,
)
from sonarpost.errors import PayloadError
from sonarpost.export.contacts import ExportContact
from sonarpost.export.live import LiveContacts
from sonarpost.logs import kv
from sonarpost.messages import Decision, ReconstructedImage, Record, TaskingState
from sonarpost.review.rendering import eight_bits, encode_png

log = logging.getLogger(__name__)

POLL_S = 0.2
DISCONNECTED_AFTER_S = 1.0


def add_actions(parser: CommandParser) -> None:
    """Add the action `watch`."""
    parser = parser.add_action(
        "watch",
        "print a line for each accepted record, live; Ctrl-C ends it",
        run,
        "--router tcp/127.0.0.1:7447 --count 1",
    )
    add_site_option(parser)
    add_router_options(parser)
    option(parser, "--vessel NAME", "only this vessel")
    flag(parser, "--json", "print one JSON object for each line")
    option(parser, "--count N", "end after N lines", int)


def run(parsed: argparse.Namespace) -> int:
    """Print records until interrupted, or until `--count` lines were printed; return 0."""
    endpoints, tls = router_of(parsed)
    session = open_with_retry(endpoints, threading.Event(), tls)
    assert session is not None
    shown = 0
    with session, suppress(KeyboardInterrupt):
        _log(f"watching {parsed.site} at {', '.join(endpoints)}")
        watch = RecordSubscription(session, parsed.site, parsed.vessel)
        while parsed.count is None or shown < parsed.count:
            record = watch.poll()
            if record is not None:
                print(json.dumps(_fields(record)) if parsed.json else printable(line_of(record)), flush=True)
                shown += 1
    return 0


class RecordSubscription:
    """Records that a site accepts from now on.

    Args:
        session: Session at the router of the site.
        site: Name of the site.
        vessel: Only records of this vessel; None for all.
    """

    def __init__(self, session: zenoh.Session, site: str, vessel: str | None) -> None:
        self._connection = ConnectionLog(session)
        self._vessel = vessel
        self._turns = [
            CatchUpSubscriber(session, key, only_new=True)
            for key in (keys.shore_contact_all(site), keys.tasking_state_all(site))
        ]

    def poll(self) -> ReconstructedImage | Decision | TaskingState | None:
        """Return the next record; None if there is none for 0.2 s, or if it is invalid or of another vessel."""
        self._connection.check()
        for timeout_s in (0.0, POLL_S / 2):
            for _ in self._turns:
                self._turns.reverse()
                found = self._turns[0].poll(timeout_s)
                if found is not None:
                    return decoded(found, self._vessel)
        return None


class ConnectionLog:
    """Prints when a session loses its router and when it has reconnected, which Zenoh does.

    Args:
        session: The session.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._disconnected_since_s: float | None = None
        self._disconnect_logged = False

    def check(self) -> None:
        """Print a change since the last call."""
        if self._session.info.routers_zid():
            if self._disconnect_logged:
                _log("router reconnected")
            self._disconnected_since_s, self._disconnect_logged = None, False
            return
        now_s = time.monotonic()
        if self._disconnected_since_s is None:
            self._disconnected_since_s = now_s
        elif not self._disconnect_logged and now_s - self._disconnected_since_s > DISCONNECTED_AFTER_S:
            self._disconnect_logged = True
            _log(f"router not reached, trying again ({lost_reason(self._session)})")


def decoded(found: AcceptedRecord, vessel: str | None) -> ReconstructedImage | Decision | TaskingState | None:
    """Decode a record; None if it is invalid, which is printed, in coded form, or of another vessel than `vessel`."""
    types: dict[str, type[ReconstructedImage] | type[Decision] | type[TaskingState]] = {
        "image": ReconstructedImage,
        "decision": Decision,
        "state": TaskingState,
    }
    record_type = types.get(found.key.rpartition("/")[2])
    if record_type is None:
        return None
    try:
        record = wire.decode(record_type, found.payload, found.key)
    except PayloadError as error:
        _log(str(error))
        return None
    return record if vessel in (None, record.vessel_id) else None


def _fields(record: Record) -> dict[str, object]:
    pixels = {"pixels", "missing_mask"} if isinstance(record, ReconstructedImage) else set[str]()
    return {"type": record.TYPE, **record.model_dump(exclude=pixels)}


def line_of(record: Record) -> str:
    """Return a record as one line of text."""
    if isinstance(record, ReconstructedImage):
        contact = record.contact
        parts = [f"{record.pixels.width_px} × {record.pixels.height_px} px"]
        parts.append("complete" if record.complete else f"{100 * record.missing_fraction:.0f} % missing")
        if contact is not None and contact.lat_deg is not None and contact.lon_deg is not None:
            parts.append(f"at {contact.lat_deg:.5f} {contact.lon_deg:.5f}")
        name = f"{record.vehicle_id}/{record.image_id} v{record.version}"
        return f"{time_text(record.last_frame_utc_s)}  {record.vessel_id}  image     {name}  {', '.join(parts)}"
    if isinstance(record, Decision):
        name = f"{record.vehicle_id}/{record.image_id} v{record.image_version}"
        words = " ".join(part for part in (record.verdict, record.mlo_class or "", record.remark) if part)
        return f"{time_text(record.decided_utc_s)}  {record.vessel_id}  decision  {name}  {words} ({record.operator})"
    assert isinstance(record, TaskingState)
    reason = f": {record.reason}" if record.reason else ""
    state = f"{record.kind:8}  {record.record_id}  {record.state}{reason}"
    return f"{time_text(record.changed_utc_s)}  {record.vessel_id}  {state}"


def _log(text: str) -> None:
    print(f"sonarpost c2: {text}", file=sys.stderr, flush=True)


# For commands that pass contacts on to other programs


@dataclass(frozen=True, slots=True)
class ContactChange:
    """A contact that is new or has changed; `png` is its image if that is new, else None."""

    contact: ExportContact
    png: bytes | None


def add_live_options(parser: argparse.ArgumentParser) -> None:
    """Add --site, --vessel, --stored and the options of the router."""
    add_site_option(parser)
    add_router_options(parser)
    option(parser, "--vessel NAME", "only this vessel")
    flag(parser, "--stored", "begin with the contacts that c2 has stored, not with the next one")


class ContactStream:
    """Contacts of a site as c2 accepts them; an interrupted connection loses none.

    Args:
        session: Session at the router of the site.
        site: Name of the site.
        vessel: Only contacts of this vessel; None for all.
        stored: Whether to begin with the stored contacts, not with the next one.
    """

    def __init__(self, session: zenoh.Session, site: str, vessel: str | None, *, stored: bool) -> None:
        self._connection = ConnectionLog(session)
        self._records = CatchUpSubscriber(session, keys.shore_contact_all(site), only_new=not stored)
        self._vessel = vessel
        self._contacts = LiveContacts()

    def poll(self) -> list[ContactChange]:
        """Return the contact that has changed; an empty list after 0.2 s without a change.

        Raises:
            QueryRefusedError: c2 refuses the query.
        """
        self._connection.check()
        found = self._records.poll(POLL_S)
        record = None if found is None else decoded(found, self._vessel)
        if isinstance(record, (ReconstructedImage, Decision)):
            try:
                contact = self._contacts.add(record)
                return [] if contact is None else [ContactChange(contact, _png_of(record))]
            except Exception:
                log.exception("Record left out", extra=kv(vessel=record.vessel_id, image_id=record.image_id))
        return []


def _png_of(record: ReconstructedImage | Decision) -> bytes | None:
    if isinstance(record, Decision) or not record.codec:
        # Without a codec only the contact record was received; its pixels are black.
        return None
    return encode_png(eight_bits(record.pixels.to_array()))
