"""`sonarpost c2 cot`: sends the contacts of a shore site to a TAK endpoint, live."""

from __future__ import annotations

import argparse
import logging
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from sonarpost import logs
from sonarpost.bus.session import open_with_retry
from sonarpost.cli.c2.live import ContactChange, ContactStream, add_live_options
from sonarpost.cli.shared import Subparsers, log_level, router_of
from sonarpost.errors import PortError
from sonarpost.export.contacts import ExportContact
from sonarpost.export.cot import CotOptions, cot_event
from sonarpost.export.cot_sender import CotSender, TlsFiles
from sonarpost.export.live import MAX_NAMES
from sonarpost.export.tak import UploadedPackage, attachment_sha256, data_package, file_name, file_transfer_event
from sonarpost.export.tak_files import TakFiles
from sonarpost.logs import kv
from sonarpost.stop_signals import stop_on_signals

log = logging.getLogger(__name__)

REPEAT_S: Final = (0.0, 5.0, 30.0)
"""Times of an event after its change: clients lose events, above all the first one after they connect."""
REFRESH_S: Final = 600.0
"""Interval of all events, for clients that connect later."""
RETRY_S: Final = 5.0
MAX_IMAGES: Final = 64
"""Images that wait for their upload; the oldest is dropped, and its contact is sent without it."""
MAX_BATCH: Final = 500
SENDER: Final = "sonarpost"


@dataclass(slots=True)
class _Marker:
    """What is sent of one contact; times are those of a monotonic clock."""

    contact: ExportContact
    due_s: list[float] = field(default_factory=list)
    attachment: str | None = None
    package: UploadedPackage | None = None
    transfers_left: int = 0


def add_actions(actions: Subparsers) -> None:
    """Add the action `cot`."""
    parser = actions.add_parser("cot", help="send the contacts of a shore site to a TAK endpoint, live; Ctrl-C ends it")
    parser.add_argument("url", metavar="URL", help="endpoint: tcp://host:port, tls://… or udp://…")
    for name in ("ca", "certificate", "key"):
        parser.add_argument(f"--cot-{name}", type=Path, metavar="PEM", help=f"{name} for tls://… and https://…")
    parser.add_argument(
        "--tak-api",
        metavar="URL",
        help="HTTP interface of the TAK server, for example https://host:8443, for the images of contacts",
    )
    add_live_options(parser)
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Send events until interrupted; return 0."""
    endpoints, router_tls = router_of(parsed)
    tls = TlsFiles(parsed.cot_ca, parsed.cot_certificate, parsed.cot_key)
    files = None if parsed.tak_api is None else TakFiles(parsed.tak_api, tls)
    logs.configure_logging("cot", log_level(parsed))
    with stop_on_signals() as stop, CotSender(parsed.url, tls, wait=stop.wait) as sender:
        session = open_with_retry(endpoints, stop, router_tls)
        if session is None:
            return 0
        try:
            stream = ContactStream(session, parsed.site, parsed.vessel, parsed.archive)
            service = CotService(sender, files)
            log.info("Sending contacts", extra=kv(endpoint=sender.endpoint, site=parsed.site))
            while not stop.is_set():
                for change in stream.poll():
                    service.add(change)
                service.send_due()
        finally:
            session.close()
    return 0


class CotService:
    """Sends the event of each changed contact, repeats it, and sends all events again every 10 minutes.

    With `files`, the image of a contact is uploaded as a data package **before** its event names the image, and an
    event asks the clients to download the package. Without an answer of the server the event is sent without the image,
    and the upload is repeated with the next event.

    Args:
        sender: Sender of events.
        files: HTTP interface of the TAK server; None sends events without images.
        options: Options of the events.
        clock: Monotonic clock, seconds.
        utc: UTC clock, seconds.
        max_contacts: Above it the least recently changed contact is dropped.
    """

    def __init__(
        self,
        sender: CotSender,
        files: TakFiles | None,
        options: CotOptions | None = None,
        *,
        clock: Callable[[], float] = time.monotonic,
        utc: Callable[[], float] = time.time,
        max_contacts: int = MAX_NAMES,
    ) -> None:
        self._sender = sender
        self._files = files
        self._options = options or CotOptions()
        self._clock = clock
        self._utc = utc
        self._max_contacts = max_contacts
        self._markers: OrderedDict[str, _Marker] = OrderedDict()
        self._waiting: OrderedDict[str, bytes] = OrderedDict()
        self._retry_s = self._upload_retry_s = clock()
        self._refresh_s = clock() + REFRESH_S

    def add(self, change: ContactChange) -> None:
        """Schedule the event of a changed contact. One without a position has none."""
        contact = change.contact
        if contact.position is None:
            return
        marker = self._markers.setdefault(contact.uid, _Marker(contact))
        self._markers.move_to_end(contact.uid)
        marker.contact = contact
        now_s = self._clock()
        marker.due_s = [now_s + pause_s for pause_s in REPEAT_S]
        if change.png is not None and self._files is not None:
            self._waiting[contact.uid] = change.png
            if len(self._waiting) > MAX_IMAGES:
                uid, _ = self._waiting.popitem(last=False)
                log.warning("Image not uploaded: too many wait", extra=kv(contact=uid, limit=MAX_IMAGES))
        if len(self._markers) > self._max_contacts:
            dropped, _ = self._markers.popitem(last=False)
            self._waiting.pop(dropped, None)

    def send_due(self) -> int:
        """Send the events that are due; return their number, 0 after a failure, which is logged and tried again."""
        now_s = self._clock()
        if now_s >= self._refresh_s:
            self._refresh_s = now_s + REFRESH_S
            for marker in self._markers.values():
                marker.due_s.append(now_s)
        if now_s < self._retry_s:
            return 0
        due = [marker for marker in self._markers.values() if any(at_s <= now_s for at_s in marker.due_s)][:MAX_BATCH]
        if not due:
            return 0
        for marker in due:
            self._upload(marker)
        try:
            self._sender.send([event for marker in due for event in self._events(marker)], give_up_after_s=0.0)
        except PortError as error:
            self._retry_s = self._clock() + RETRY_S
            log.warning("Events not sent; retrying", extra=kv(events=len(due), error=str(error)))
            return 0
        for marker in due:
            marker.due_s = [at_s for at_s in marker.due_s if at_s > now_s]
            marker.transfers_left = max(0, marker.transfers_left - 1)
        return len(due)

    def _upload(self, marker: _Marker) -> None:
        png = self._waiting.get(marker.contact.uid)
        if png is None or self._files is None or self._clock() < self._upload_retry_s:
            return
        package = data_package(marker.contact, png, self._utc(), self._options)
        try:
            marker.package = self._files.upload(f"{file_name(marker.contact)}.zip", package, SENDER)
        except PortError as error:
            self._upload_retry_s = self._clock() + RETRY_S
            log.warning("Image not uploaded; retrying with the next event", extra=kv(error=str(error)))
            return
        marker.attachment, marker.transfers_left = attachment_sha256(png), len(REPEAT_S)
        del self._waiting[marker.contact.uid]

    def _events(self, marker: _Marker) -> list[bytes]:
        now_utc_s = self._utc()
        events = [cot_event(marker.contact, now_utc_s, self._options, marker.attachment)]
        if marker.package is not None and marker.transfers_left:
            events.append(file_transfer_event(marker.contact, marker.package, SENDER, now_utc_s))
        return events
