"""`sonarpost c2 cot`: sends the contacts of a shore site to a TAK endpoint, live or once."""

import argparse
import logging
import os
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from sonarpost import keys, logs, wire
from sonarpost.bus.session import open_with_retry
from sonarpost.cli.c2.watch import ContactChange, ContactStream, add_live_options
from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.shared import flag, log_level, option, print_rejected, router_of
from sonarpost.config import PlatformConfig, load
from sonarpost.errors import ConfigError, PortError
from sonarpost.export.contacts import ExportContact, load_contacts
from sonarpost.export.live import MAX_NAMES
from sonarpost.export.text import utc_text
from sonarpost.extensions.tak.cot import cot_event, cot_events
from sonarpost.extensions.tak.cot_sender import MAX_BATCH, CotSender
from sonarpost.extensions.tak.data_package import (
    PackageRefusedError,
    TakFiles,
    UploadedPackage,
    attachment_sha256,
    data_package,
    file_name,
    file_transfer_event,
)
from sonarpost.limits import Turns, limit, oldest_of_largest
from sonarpost.logs import kv
from sonarpost.messages import Health, ServiceState
from sonarpost.security.client_tls import TlsFiles
from sonarpost.stop_signals import stop_on_signals

log = logging.getLogger(__name__)

REPEAT_S: Final = (0.0, 5.0, 30.0)
"""Times of an event after its change: clients lose events, above all the first one after they connect."""
REFRESH_S: Final = 600.0
"""Interval of all events, for clients that connect later."""
RETRY_S: Final = (5.0, 10.0, 30.0, 60.0)
UPLOAD_RETRY_S: Final = 5.0
MAX_IMAGES: Final = limit(
    64, "images", "shares", "TAK server", "vessel", "images to upload", "the largest source sends one without"
)
GIVE_UP_S: Final = 10.0
"""With `--once`, no attempt starts later than this."""
EXIT_INCOMPLETE: Final = 1
HEALTH_INTERVAL_S: Final = 5.0
NAME: Final = "cot"
"""Name in health records."""
SENDER: Final = "sonarpost"


@dataclass(slots=True)
class _Marker:
    """What is sent of one contact; times are those of a monotonic clock."""

    contact: ExportContact
    due_s: list[float] = field(default_factory=list)
    attachment: str | None = None
    package: UploadedPackage | None = None
    transfers_left: int = 0


def add_options(parser: CommandParser) -> None:
    """Add the action `cot`."""
    option(parser, "url URL", "endpoint: tcp://host:port, tls://… or udp://…")
    for name, help_text in (
        ("ca", "trusted authorities, PEM or PKCS#12 (*.p12)"),
        ("certificate", "client certificate, PEM, or PKCS#12 with its key (*.p12)"),
        ("key", "private key of a PEM certificate"),
        ("passphrase-file", "passphrase of an encrypted key and of PKCS#12 files; mode 0600"),
    ):
        parser.add_argument(f"--cot-{name}", type=Path, metavar="FILE", help=f"{help_text}; for tls://… and https://…")
    option(
        parser,
        "--cot-server-name NAME",
        "name in the server's certificate (default: the host); for tls://… and https://…",
    )
    option(
        parser,
        "--tak-api URL",
        "HTTP interface of the TAK server, for example https://host:8443, for the images of contacts",
    )
    flag(parser, "--once", "send the contacts of --archive, without images, and end")
    option(parser, "--archive DIR", "folder of c2, for --once", Path)
    add_live_options(parser)
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Send events until interrupted, or once; return 0, or 1 if a stored file was rejected."""
    tls = TlsFiles(
        parsed.cot_ca, parsed.cot_certificate, parsed.cot_key, parsed.cot_passphrase_file, parsed.cot_server_name
    )
    if parsed.once:
        return _send_once(CotSender(parsed.url, tls), parsed.archive, parsed.vessel)
    endpoints, router_tls = router_of(parsed)
    platform = parsed.site
    if parsed.config is not None:
        platform = load(parsed.config, "platform", PlatformConfig, os.environ)[0].id
    files = None if parsed.tak_api is None else TakFiles(parsed.tak_api, tls)
    logs.configure_logging("cot", log_level(parsed))
    sender = CotSender(parsed.url, tls)
    with stop_on_signals() as stop:
        session = open_with_retry(endpoints, stop, router_tls)
        if session is None:
            return 0
        with session:
            stream = ContactStream(session, parsed.site, parsed.vessel, stored=parsed.stored)
            service = CotService(sender, files)
            token = session.liveliness().declare_token(keys.alive(platform, NAME))
            log.info("Sending contacts", extra=kv(endpoint=sender.endpoint, site=parsed.site))
            state: ServiceState | None = None
            health_s = 0.0
            while state != "stopping":
                for change in stream.poll():
                    service.add(change)
                service.send_due()
                state = "stopping" if stop.is_set() else None
                if state or time.monotonic() >= health_s:
                    health_s = time.monotonic() + HEALTH_INTERVAL_S
                    health = wire.encode(service.health(platform, state))
                    session.put(keys.health(platform, NAME), health, encoding=wire.encoding_of(Health))
            token.undeclare()
    return 0


def _send_once(sender: CotSender, archive: Path | None, vessel: str | None) -> int:
    if archive is None:
        raise ConfigError("c2 cot", "--once", "no archive", "--archive DIR")
    stored = load_contacts(archive)
    chosen = [contact for contact in stored.contacts if vessel in (None, contact.image.vessel_id)]
    events = cot_events(chosen, time.time())
    evidence = sender.send(events, GIVE_UP_S)
    omitted = len(chosen) - len(events)
    print(f"{sender.endpoint}: {len(events)} events, {omitted} contacts without a position omitted; {evidence}")
    return EXIT_INCOMPLETE if print_rejected(stored.problems) else 0


class CotService:
    """Sends the event of each changed contact, repeats it, and sends all events again every 10 minutes.

    With `files`, the image of a contact is uploaded as a data package **before** its event names the image, and an
    event asks the clients to download the package. Without an answer of the server the event is sent without the image,
    and the upload is repeated with the next event.

    Args:
        sender: Sender of events.
        files: HTTP interface of the TAK server; None sends events without images.
        clock: Monotonic clock, seconds.
        utc: UTC clock, seconds.
    """

    def __init__(
        self,
        sender: CotSender,
        files: TakFiles | None,
        *,
        clock: Callable[[], float] = time.monotonic,
        utc: Callable[[], float] = time.time,
    ) -> None:
        self._sender = sender
        self._files = files
        self._clock = clock
        self._utc = utc
        self._markers: OrderedDict[str, _Marker] = OrderedDict()
        self._waiting: OrderedDict[str, bytes] = OrderedDict()
        self._turns = Turns()
        self._retry_s = self._upload_retry_s = clock()
        self._refresh_s = clock() + REFRESH_S
        self._started_utc_s = self._delivered_utc_s = utc()
        self._delivered_before = 0
        self._is_accepted = False
        self._failures = 0
        self._problem = ""

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
                uid = oldest_of_largest(self._waiting, self._vessel_of)
                del self._waiting[uid]
                log.warning("Image not uploaded: too many wait", extra=kv(contact=uid, limit=MAX_IMAGES))
        if len(self._markers) > MAX_NAMES:  # the least recently changed contact of the vessel with the most is dropped
            dropped = oldest_of_largest(self._markers, self._vessel_of)
            del self._markers[dropped]
            self._waiting.pop(dropped, None)

    def _vessel_of(self, uid: str) -> str:
        return self._markers[uid].contact.image.vessel_id

    def send_due(self) -> int:
        """Send the events that are due; return their number, 0 after a failure, which is logged and tried again."""
        now_s = self._clock()
        if now_s >= self._refresh_s:
            self._refresh_s = now_s + REFRESH_S
            for marker in self._markers.values():
                marker.due_s.append(now_s)
        if now_s < self._retry_s:
            return 0
        waiting: dict[str, list[_Marker]] = {}
        for marker in self._markers.values():
            if any(at_s <= now_s for at_s in marker.due_s):
                waiting.setdefault(marker.contact.image.vessel_id, []).append(marker)
        due = self._turns.pick(waiting, MAX_BATCH)
        if not due and self._is_accepted:
            return 0
        # Without an event the first connection shows whether the server accepts this client.
        events: list[bytes] = []
        for marker in due:
            try:
                self._upload(marker)
                events += self._events(marker)
            except Exception:
                log.exception("Contact left out until its next event", extra=kv(contact=marker.contact.uid))
        try:
            evidence = self._sender.send(events, give_up_after_s=0.0)
        except PortError as error:
            pause_s = RETRY_S[min(self._failures, len(RETRY_S) - 1)]
            self._retry_s = self._clock() + pause_s
            self._failures += 1
            self._problem = str(error)
            fields = kv(waiting=len(due), since=utc_text(self._delivered_utc_s), retry_s=pause_s, error=self._problem)
            log.warning("Nothing delivered; retrying", extra=fields)
            return 0
        if self._problem or not self._is_accepted:
            log.info("Server accepts events", extra=kv(delivered=self._sender.delivered, evidence=evidence))
        self._is_accepted, self._failures, self._problem = True, 0, ""
        self._delivered_utc_s, self._delivered_before = self._utc(), self._sender.delivered
        for marker in due:
            marker.due_s = [at_s for at_s in marker.due_s if at_s > now_s]
            marker.transfers_left = max(0, marker.transfers_left - 1)
        return len(due)

    def health(self, platform: str, state: ServiceState | None = None) -> Health:
        """Return the health record of this moment. It is degraded while the server does not accept events."""
        before = self._delivered_before
        counts = f"{self._sender.delivered - before} delivered since {utc_text(self._delivered_utc_s)}, {before} before"
        return Health(
            platform_id=platform,
            service=NAME,
            time_utc_s=self._utc(),
            started_utc_s=self._started_utc_s,
            state=state or ("degraded" if self._problem else "ok"),
            detail=f"{counts}; retrying: {self._problem}" if self._problem else "",
            counters={"events_delivered": self._sender.delivered},
            gauges={"contacts": float(len(self._markers)), "images_waiting": float(len(self._waiting))},
        )

    def _upload(self, marker: _Marker) -> None:
        png = self._waiting.get(marker.contact.uid)
        if png is None or self._files is None or self._clock() < self._upload_retry_s:
            return
        package = data_package(marker.contact, png, self._utc())
        try:
            marker.package = self._files.upload(f"{file_name(marker.contact)}.zip", package, SENDER)
        except PortError as error:
            if not isinstance(error, PackageRefusedError):
                self._upload_retry_s = self._clock() + UPLOAD_RETRY_S
            log.warning("Image not uploaded; retrying with the next event", extra=kv(error=str(error)))
            return
        marker.attachment, marker.transfers_left = attachment_sha256(png), len(REPEAT_S)
        del self._waiting[marker.contact.uid]

    def _events(self, marker: _Marker) -> list[bytes]:
        now_utc_s = self._utc()
        events = [cot_event(marker.contact, now_utc_s, marker.attachment)]
        if marker.package is not None and marker.transfers_left:
            events.append(file_transfer_event(marker.contact, marker.package, SENDER, now_utc_s))
        return events
