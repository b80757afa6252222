"""`sonarpost c2 alert`: sends an alert for each contact above a threshold to a webhook or an MQTT broker."""

import argparse
import json
import logging
import math
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from sonarpost import logs
from sonarpost.bus.session import open_with_retry
from sonarpost.cli.c2.watch import ContactStream, add_live_options
from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.shared import in_new_folder, log_level, option, router_of
from sonarpost.errors import ConfigError, PortError
from sonarpost.export.contacts import ExportContact
from sonarpost.export.tables import contact_properties
from sonarpost.export.text import utc_text, xml_text
from sonarpost.extensions.alerts.senders import (
    AlertNotAcceptedError,
    AlertRefusedError,
    AlertWebhook,
    Mqtt,
    read_secret,
)
from sonarpost.limits import Turns, limit
from sonarpost.logs import kv
from sonarpost.security.client_tls import TlsFiles
from sonarpost.sqlite_file import SqliteFile
from sonarpost.stop_signals import stop_on_signals

log = logging.getLogger(__name__)

TYPE: Final = "sonarpost.alert"
VERSION: Final = 1
MAX_CONFIDENCE: Final = 2.0
"""Highest confidence of the detector."""
RETRY_S: Final = (1.0, 2.0, 5.0, 10.0, 30.0, 60.0)
MAX_NOT_ACCEPTED_RETRY_S: Final = limit(
    5.0, "s", "blame", "alerts", "vessel", "delay by alerts that the receiver refuses", "other vessels follow"
)
MAX_WAITING: Final = limit(
    1000, "alerts", "shares", "alerts", "vessel", "waiting alerts", "further ones are sent after the next start"
)
MAX_SENT: Final = 200_000
"""Identifiers in the state file; the oldest are deleted."""
_SCHEMA: Final = "CREATE TABLE IF NOT EXISTS sent (number INTEGER PRIMARY KEY AUTOINCREMENT, id TEXT NOT NULL UNIQUE);"


def add_options(parser: CommandParser) -> None:
    """Add the action `alert`."""
    where = parser.add_mutually_exclusive_group(required=True)
    option(where, "--webhook URL", "address that receives an HTTP POST of JSON")
    option(where, "--mqtt URL", "broker and topic, mqtts://[user@]host[:port]/topic or mqtt://…")
    option(
        parser,
        "--threshold P",
        "probability of a mine-like object, 0 to 1, or half the confidence of the detector",
        float,
        0.5,
    )
    option(parser, "--state FILE", "file with the identifiers of the alerts that were sent", Path, required=True)
    option(parser, "--secret-file FILE", "key of the webhook's signature, or password of the MQTT user", Path)
    for name in ("ca", "certificate", "key"):
        parser.add_argument(f"--alert-{name}", type=Path, metavar="PEM", help=f"{name} for https://… and mqtts://…")
    add_live_options(parser)
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Send alerts until interrupted; return 0."""
    if not 0 <= parsed.threshold <= 1:
        raise ConfigError("command line", "--threshold", parsed.threshold, "0 to 1")
    tls = TlsFiles(parsed.alert_ca, parsed.alert_certificate, parsed.alert_key)
    secret = None if parsed.secret_file is None else read_secret(parsed.secret_file, "--secret-file")
    endpoints, router_tls = router_of(parsed)
    logs.configure_logging("alert", log_level(parsed))
    with stop_on_signals() as stop, ExitStack() as stack:
        sender: AlertWebhook | Mqtt = (
            AlertWebhook(parsed.webhook, tls, secret, stop=stop) if parsed.webhook else Mqtt(parsed.mqtt, tls, secret)
        )
        stack.enter_context(closing(sender))
        sent = stack.enter_context(closing(SentAlerts(in_new_folder(parsed.state))))
        session = open_with_retry(endpoints, stop, router_tls)
        if session is None:
            return 0
        with session:
            stream = ContactStream(session, parsed.site, parsed.vessel, stored=parsed.stored)
            service = AlertService(sender, sent, parsed.threshold)
            log.info("Sending alerts", extra=kv(site=parsed.site, threshold=parsed.threshold))
            while not stop.is_set():
                for change in stream.poll():
                    service.add(change.contact)
                while not stop.is_set() and service.send_due():
                    pass
    return 0


class SentAlerts(SqliteFile):
    """Identifiers of sent alerts in a SQLite file, so that a restart does not repeat them.

    Args:
        path: The file; it is created if it does not exist.

    Raises:
        DeliveryError: It cannot be opened, or is no such file.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, _SCHEMA, version=1)

    def __contains__(self, alert_id: str) -> bool:
        with self.read() as db:
            return db.execute("SELECT 1 FROM sent WHERE id = ?", (alert_id,)).fetchone() is not None

    def add(self, alert_id: str) -> None:
        """Add an identifier, durably; delete the oldest above the limit.

        Raises:
            DeliveryError: The file cannot be written.
        """
        with self.transaction() as db:
            cursor = db.execute("INSERT OR IGNORE INTO sent (id) VALUES (?)", (alert_id,))
            db.execute("DELETE FROM sent WHERE number <= ?", ((cursor.lastrowid or 0) - MAX_SENT,))


@dataclass(slots=True)
class _Alert:
    contact: ExportContact
    failures: int = 0
    due_s: float = -math.inf


class AlertService:
    """Sends one alert for each contact, at least once; vessels are served in turn.

    An identifier is stored after the receiver has accepted the alert: a crash between both repeats the alert with the
    same identifier. A refused alert is logged and not repeated. After a failure, the other alerts are sent first.

    Args:
        sender: Way of the alerts.
        sent: Alerts that were sent before.
        threshold: Smallest score of a contact without a verdict, 0 to 1.
        clock: Monotonic clock, seconds.
        utc: UTC clock, seconds.
    """

    def __init__(
        self,
        sender: AlertWebhook | Mqtt,
        sent: SentAlerts,
        threshold: float,
        *,
        clock: Callable[[], float] = time.monotonic,
        utc: Callable[[], float] = time.time,
    ) -> None:
        self._sender = sender
        self._sent = sent
        self._threshold = threshold
        self._clock = clock
        self._utc = utc
        self._waiting: dict[str, dict[str, _Alert]] = {}
        self._turns = Turns()
        self._failures = 0
        self._next_s = clock()

    def add(self, contact: ExportContact) -> None:
        """Queue the alert of a contact, if it needs one that was not sent before."""
        vessel = contact.image.vessel_id
        alerts = self._waiting.get(vessel, {})
        if contact.uid in alerts:
            alerts[contact.uid].contact = contact
            return
        if not needs_alert(contact, self._threshold) or contact.uid in self._sent:
            return
        if len(alerts) >= MAX_WAITING:
            log.error("Alert dropped until the next start: too many wait", extra=kv(contact=contact.uid, vessel=vessel))
            return
        self._waiting.setdefault(vessel, {})[contact.uid] = _Alert(contact)

    def send_due(self) -> bool:
        """Send an alert if it is time; return whether the receiver has accepted or refused it."""
        now_s = self._clock()
        if now_s < self._next_s:
            return False
        due = {
            vessel: sorted(
                (alert for alert in alerts.values() if alert.due_s <= now_s), key=lambda alert: alert.failures
            )
            for vessel, alerts in self._waiting.items()
        }
        for alert in self._turns.pick(due, 1):
            return self._send(alert)
        return False

    def _send(self, alert: _Alert) -> bool:
        contact, vessel = alert.contact, alert.contact.image.vessel_id
        try:
            self._sender.send(contact.uid, vessel, alert_document(contact, utc_text(self._utc())))
        except AlertRefusedError as error:
            log.error("Alert refused; it is not sent again", extra=kv(contact=contact.uid, error=str(error)))
        except Exception as error:  # other than of the port: it can concern this alert alone
            pause_s = _pause_s(self._failures)
            is_port_error = isinstance(error, PortError)
            if not is_port_error or isinstance(error, AlertNotAcceptedError):
                pause_s = min(pause_s, MAX_NOT_ACCEPTED_RETRY_S)
            now_s = self._clock()
            self._next_s, alert.due_s = now_s + pause_s, now_s + max(pause_s, _pause_s(alert.failures))
            self._failures += 1
            alert.failures += 1
            fields = kv(contact=contact.uid, retry_s=pause_s, error=str(error))
            log.warning("Alert not sent; retrying", exc_info=not is_port_error, extra=fields)
            return False
        else:
            log.info("Alert sent", extra=kv(contact=contact.uid, review=contact.review))
        self._failures = 0
        self._sent.add(contact.uid)
        del self._waiting[vessel][contact.uid]
        if not self._waiting[vessel]:
            del self._waiting[vessel]
        return True


def _pause_s(failures: int) -> float:
    return RETRY_S[min(failures, len(RETRY_S) - 1)]


def score(contact: ExportContact) -> float | None:
    """Return how much a contact resembles a mine, 0 to 1; None if it is not known.

    It is the probability of a mine-like object. A contact without probabilities has half the confidence of the
    detector, which is 0 to 2 and not a probability.
    """
    record = contact.image.contact
    if record is None:
        return None
    if record.p_mine_like is not None:
        return record.p_mine_like
    return None if record.atd_confidence is None else record.atd_confidence / MAX_CONFIDENCE


def needs_alert(contact: ExportContact, threshold: float) -> bool:
    """Return whether a contact causes an alert.

    An operator's verdict counts more than the detector: a mine-like or disputed contact causes one, a contact that is
    not mine-like causes none.

    Args:
        contact: The contact.
        threshold: Smallest score of a contact without a verdict, 0 to 1.
    """
    if contact.review in ("mine_like", "disputed"):
        return True
    value = score(contact)
    return contact.review != "not_mine_like" and value is not None and value >= threshold


def alert_document(contact: ExportContact, sent_utc: str) -> bytes:
    """Return the alert as JSON: `type`, `v`, `id`, `sent_utc`, `score`, and the known properties of the contact.

    Args:
        contact: The contact.
        sent_utc: Time of the first attempt to send it, ISO 8601.
    """
    known = {
        name: xml_text(value) if isinstance(value, str) else value
        for name, value in contact_properties(contact).items()
        if value is not None and name != "image_file"
    }
    head = {"type": TYPE, "v": VERSION, "id": contact.uid, "sent_utc": sent_utc, "score": score(contact)}
    return json.dumps({**head, "contact": known}, ensure_ascii=False, allow_nan=False).encode()
