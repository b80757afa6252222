"""Makes visible what a router refuses: its own log, its health record, and a `hello` for vessels that ask.

Zenoh's core logs to the process's standard output. `LogCapture` takes that over before the session opens, so that each
refusal becomes one line of our log, a counter, and a part of `health/router`.
"""

from __future__ import annotations

import json
import logging
import re
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import zenoh

from sonarpost import keys, wire
from sonarpost.bus import presence as hello
from sonarpost.bus.log_capture import LogCapture
from sonarpost.bus.zenoh_log import Denied, Event, TlsRejected, UnknownCertificateAuthority, ZenohLogMessage
from sonarpost.errors import BadInputError, DeliveryError
from sonarpost.logs import kv
from sonarpost.messages import Health, ServiceState
from sonarpost.security import tls_files
from sonarpost.security.tls_files import OwnCertificate

log = logging.getLogger(__name__)

NAME = "router"
INTERVAL_S = 5.0
# So many different refusals are told one by one in an interval; a flood of more is counted only.
MAX_TOLD = 64
WARN_DAYS = 30.0
_DIGITS = re.compile(r"[0-9]+")
# The last refusal stands in the health record's detail for so long. The state stays as it is: a stranger at the door
# keeps the router from nothing.
RECENT_S = 60.0


class RefusedPeers:
    """Counts refusals and says which are to be logged: each kind once in an interval, and how often afterwards."""

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        self._seen: Counter[tuple[str, ...]] = Counter()

    def count(self, counter: str, *what: str) -> bool:
        """Count one; return whether it is the first of its kind in this interval and should be told."""
        self.counters[counter] += 1
        kind = (counter, *what)
        if kind not in self._seen and len(self._seen) >= MAX_TOLD:
            kind = (counter, "others")
            self._seen[kind] += 1
            return False
        self._seen[kind] += 1
        return self._seen[kind] == 1

    def repeated(self) -> list[tuple[tuple[str, ...], int]]:
        """End the interval; return what came more often than it was told, with the number of times untold."""
        told = [(kind, times if kind[-1] == "others" else times - 1) for kind, times in self._seen.items()]
        self._seen.clear()
        return [(kind, times) for kind, times in told if times > 0]


class RouterMonitor:
    """Watches one router session of this process.

    Args:
        session: The router's open session.
        capture: Its log; None watches links and answers vessels only.
        platform: Whose router it is, for keys; None when nobody said so, and then it only logs.
        sites: Words this router answers to vessels as shore; none on a vessel.
        certificate: Its certificate, whose end health warns of.
        interval_s: How often health is published.
    """

    def __init__(
        self,
        session: zenoh.Session,
        capture: LogCapture | None,
        platform: str | None,
        sites: Sequence[str] = (),
        certificate: OwnCertificate | None = None,
        interval_s: float = INTERVAL_S,
    ) -> None:
        self._session = session
        self._platform = platform
        self._certificate = certificate
        self._interval_s = interval_s
        self._started_utc_s = time.time()
        self._lock = threading.Lock()
        self._refusals = RefusedPeers()
        self._peers: dict[str, tuple[str, str]] = {}
        self._strangers: set[str] = set()
        self._last = ("", 0.0)
        self._stop = threading.Event()
        self._token = session.liveliness().declare_token(keys.alive(platform, NAME)) if platform else None
        self._links = session.info.declare_link_events_listener(self._on_link, history=True)
        self._hellos = [hello.declare_presence(session, platform, NAME, site) for site in sites if platform]
        if capture is not None:
            capture.listen(self.on_event)
        self._thread = threading.Thread(target=self._report, name="router-health", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Publish a last health record and stop; the session stays open."""
        self._stop.set()
        self._thread.join()
        self._publish("stopping")

    def on_event(self, event: Event) -> None:
        """Count and log one event of the router's log."""
        with self._lock:
            if isinstance(event, TlsRejected):
                self._tell("tls_rejected", "TLS connection refused", reason=event.reason)
            elif isinstance(event, UnknownCertificateAuthority):
                self._strangers.add(event.zid)
                self._tell_stranger(event.zid)
            elif isinstance(event, Denied):
                self._denied(event)
            else:
                self._remark(event)

    def _denied(self, event: Denied) -> None:
        if event.flow == "egress":
            # What a peer was not to get: the lists at work, nobody's doing.
            self._refusals.counters["messages_withheld"] += 1
            return
        name, address = self._peers.get(event.zid, (event.name, ""))
        if not event.zid:
            self._tell("messages_denied", "Message denied", peer="on no list, or too large a message")
            return
        self._tell(
            "messages_denied",
            "Message denied",
            peer=name or event.name or "no certificate",
            address=address,
            message=event.message,
            key=event.key,
        )

    def _remark(self, event: ZenohLogMessage) -> None:
        if self._refusals.count("zenoh_warnings", event.module, event.text[:80]):
            log.warning("Zenoh warns", extra=kv(module=event.module, text=event.text[:400]))

    def _tell(self, counter: str, sentence: str, **fields: str) -> None:
        shown = ", ".join(f"{name} {value}" for name, value in fields.items() if value)
        self._last = (f"{sentence}: {shown}", time.monotonic())
        # Addresses and numbers (seconds since an expiry) change with every try; the kind of a refusal does not.
        kind = [
            _DIGITS.sub("#", value) if name == "reason" else value
            for name, value in fields.items()
            if name != "address"
        ]
        if self._refusals.count(counter, *kind):
            log.warning(sentence, extra=kv(**fields))

    def _tell_stranger(self, zid: str) -> None:
        """Log a peer that is on no list as soon as its name is known: log and link events come in any order."""
        if zid not in self._strangers or zid not in self._peers:
            return
        self._strangers.discard(zid)
        name, address = self._peers[zid]
        sentence = "A peer is on no list, whatever it says is denied"
        self._tell("peers_on_no_list", sentence, peer=name or "no certificate", address=address)

    def _on_link(self, event: zenoh.LinkEvent) -> None:
        link = event.link
        zid, name, address = str(link.zid), link.auth_identifier or "", str(link.dst)
        with self._lock:
            if event.kind == zenoh.SampleKind.PUT:
                self._peers[zid] = (name, address)
                if name:
                    log.info("Peer connected", extra=kv(peer=name, address=address))
                self._tell_stranger(zid)
            elif self._peers.pop(zid, None) is not None and name:
                log.info("Peer gone", extra=kv(peer=name, address=address))

    def health(self, platform: str, state: ServiceState | None = None) -> Health:
        """Return the state of a platform's router now."""
        with self._lock:
            text, when = self._last
            recent = text if text and time.monotonic() - when < RECENT_S else ""
            ending, days_left = self._certificate_ends()
            gauges = {"links": float(len(self._peers))}
            if days_left is not None:
                gauges["certificate_days_left"] = days_left
            expired = days_left is not None and days_left <= 0
            return Health(
                platform_id=platform,
                service=NAME,
                time_utc_s=time.time(),
                started_utc_s=self._started_utc_s,
                state=state or ("degraded" if expired else "ok"),
                detail="; ".join(part for part in (ending, recent) if part)[:2000],
                counters=dict(self._refusals.counters),
                gauges=gauges,
            )

    def _certificate_ends(self) -> tuple[str, float | None]:
        if self._certificate is None:
            return "", None
        now_utc_s = time.time()
        warning = tls_files.expiry_warning(self._certificate, WARN_DAYS, now_utc_s)
        return warning, self._certificate.days_left(now_utc_s)

    def _report(self) -> None:
        while not self._stop.wait(self._interval_s):
            self._publish(None)
            with self._lock:
                repeated = self._refusals.repeated()
            for (counter, *what), times in repeated:
                log.warning("Refused again", extra=kv(counter=counter, what=" ".join(what), times=times))

    def _publish(self, state: ServiceState | None) -> None:
        if self._platform is None:
            return
        try:
            record = self.health(self._platform, state)
            key = keys.health(self._platform, NAME)
            self._session.put(key, wire.encode(record), encoding=wire.encoding_of(Health))
        except (DeliveryError, zenoh.ZError) as error:
            log.warning("Health not published", extra=kv(error=str(error)))


@contextmanager
def monitored_router(config: zenoh.Config) -> Iterator[zenoh.Session]:
    """Open a router of this process and watch it where its configuration says whose it is (`metadata.platform`).

    Raises:
        ConfigError: Its TLS files are missing, unreadable, do not fit together, or the key is not private.
        BadInputError: `metadata` is not what it must be.
        zenoh.ZError: The router cannot open.
    """
    platform, sites = platform_and_sites(config)
    certificate = own_certificate(config)
    for remark in certificate.remarks if certificate else ():
        log.warning("TLS files", extra=kv(remark=remark))
    capture = LogCapture()
    session = zenoh.open(config)
    watch = None
    try:
        watch = RouterMonitor(session, capture, platform, sites, certificate)
        yield session
    finally:
        if watch is not None:
            watch.close()
        session.close()


def platform_and_sites(config: zenoh.Config) -> tuple[str | None, tuple[str, ...]]:
    """Return whose router a configuration is for, None when it does not say, and which sites it answers for.

    Raises:
        BadInputError: It says so with something that is no name.
    """
    metadata = json.loads(config.get_json("metadata"))
    if not isinstance(metadata, dict) or "platform" not in metadata:
        return None, ()
    platform, sites = metadata["platform"], metadata.get("sites", [])
    if not isinstance(sites, list):
        raise BadInputError("router configuration", "metadata.sites", sites, "a list of names")
    for field, value in (("platform", platform), *(("sites", site) for site in sites)):
        if not isinstance(value, str):
            raise BadInputError("router configuration", f"metadata.{field}", value, "text")
        keys.alive(value, NAME)
    return platform, tuple(sites)


def own_certificate(config: zenoh.Config) -> OwnCertificate | None:
    """Return the certificate that a router listens with, checked; None when it has none.

    Raises:
        ConfigError: The files are missing, unreadable, do not fit together, or the key is not private.
    """
    names = ("root_ca_certificate", "listen_certificate", "listen_private_key")
    paths = [json.loads(config.get_json(f"transport/link/tls/{name}")) for name in names]
    if not all(isinstance(path, str) and path for path in paths):
        return None
    ca, certificate, key = (Path(path) for path in paths)
    return tls_files.check(ca, certificate, key, time.time())
