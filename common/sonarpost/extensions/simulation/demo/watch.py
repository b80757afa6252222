"""Observation of a running chain over Zenoh, as any subscriber can do it, and detection of its end."""

import logging
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import TypeVar

import zenoh

from sonarpost import keys, wire
from sonarpost.bus.session import open_with_retry
from sonarpost.errors import PayloadError, PortError
from sonarpost.extensions.simulation.demo.settings import PLATFORM_OF, SHORE, UUV, VESSEL, WATER, ChainSettings
from sonarpost.link.downlink.messages import image_of_number, number_of_image
from sonarpost.messages import AcousticFrame, EncodedImage, Health, ReconstructedImage, Record, Snippet

log = logging.getLogger(__name__)

R = TypeVar("R", bound=Record)

CONNECT_S = 120.0
# Gauges that are zero when a service has no work left.
IDLE_GAUGES: Mapping[str, tuple[str, ...]] = {
    "atd_stub": ("files_waiting", "contacts_waiting", "outbox"),
    "compressor": ("inbox", "outbox"),
    "uuv_modem": ("inbox", "images_waiting"),
    "op_modem": ("outbox", "unsaved", "images_waiting"),
    "decompressor": ("inbox", "outbox"),
    "relay": ("inbox", "outbox"),
    "c2": ("inbox", "images_undecoded"),
}


class Watcher:
    """Collects the records that the chain publishes.

    Args:
        settings: Settings of the chain.
        check: Called repeatedly during the start; raises an exception when a process has ended.

    Attributes:
        snippets: By contact identifier.
        encoded: By the identifier that an image has on the vessel.
        vessel: Latest version of each image on the vessel, by image identifier.
        shore: The same, as published at the shore site.
        health: Latest health report by service.
        packets_sent: Packets that the vehicle sent.
        changes: Number of changes so far.
    """

    def __init__(self, settings: ChainSettings, check: Callable[[], None]) -> None:
        self.settings = settings
        self._check = check
        self.snippets: dict[str, Snippet] = {}
        self.encoded: dict[str, EncodedImage] = {}
        self.vessel: dict[str, ReconstructedImage] = {}
        self.shore: dict[str, ReconstructedImage] = {}
        self.health: dict[str, Health] = {}
        self.packets_sent = 0
        self.changes = 0
        self._packets: set[tuple[float, int]] = set()
        self._lock = threading.Lock()
        self._sessions: list[zenoh.Session] = []

    def __enter__(self) -> "Watcher":
        uuv, vessel, shore = (self._open(port) for port in self.settings.router_ports)
        self._subscribe(uuv, keys.contact_detected(UUV), Snippet, self._on_snippet)
        self._subscribe(uuv, keys.image_encoded(UUV), EncodedImage, self._on_encoded)
        self._subscribe(uuv, keys.acoustic_tx(UUV), AcousticFrame, self._on_sent)
        self._subscribe(
            vessel, keys.image_reconstructed(VESSEL), ReconstructedImage, partial(self._latest, self.vessel)
        )
        self._subscribe(shore, keys.shore_image(VESSEL), ReconstructedImage, partial(self._latest, self.shore))
        for session, platform in ((uuv, UUV), (uuv, WATER), (vessel, VESSEL), (shore, SHORE)):
            self._subscribe(session, keys.health_all(platform), Health, self._on_health)
        return self

    def __exit__(self, *_: object) -> None:
        for session in self._sessions:
            session.close()

    def _open(self, port: int) -> zenoh.Session:
        endpoint = f"tcp/127.0.0.1:{port}"
        deadline_s = time.monotonic() + CONNECT_S

        def on_failure(reason: str) -> None:
            self._check()
            if time.monotonic() > deadline_s:
                raise PortError(f"{endpoint}: no router answered within {CONNECT_S:.0f} s: {reason}")

        session = open_with_retry([endpoint], threading.Event(), on_failure=on_failure)
        assert session is not None
        self._sessions.append(session)
        return session

    def _subscribe(self, session: zenoh.Session, key: str, record_type: type[R], take: Callable[[R], None]) -> None:
        def on_sample(sample: zenoh.Sample) -> None:
            try:
                record = wire.decode(record_type, sample.payload.to_bytes(), str(sample.key_expr))
            except PayloadError as error:
                log.warning("%s", error)
                return
            with self._lock:
                take(record)

        session.declare_subscriber(key, on_sample)

    def _on_snippet(self, snippet: Snippet) -> None:
        self.changes += snippet.contact.contact_id not in self.snippets
        self.snippets[snippet.contact.contact_id] = snippet

    def _on_encoded(self, image: EncodedImage) -> None:
        image_id = image.image_id
        if self.settings.link == "v1":
            image_id = image_of_number(number_of_image(image_id))
        self.changes += image_id not in self.encoded
        self.encoded[image_id] = image

    def _on_sent(self, frame: AcousticFrame) -> None:
        packet = (frame.time_utc_s, frame.packet)
        if packet not in self._packets:
            self._packets.add(packet)
            self.packets_sent += 1
            self.changes += 1

    def _latest(self, known: dict[str, ReconstructedImage], image: ReconstructedImage) -> None:
        before = known.get(image.image_id)
        if before is None or before.version < image.version:
            known[image.image_id] = image
            self.changes += 1

    def _on_health(self, health: Health) -> None:
        self.health[health.service] = health

    @property
    def contact_of_image(self) -> dict[str, str]:
        """Contact identifier of each encoded image, by image identifier."""
        with self._lock:
            return {image_id: image.contact.contact_id for image_id, image in self.encoded.items()}

    @property
    def all_complete(self) -> bool:
        """Whether every encoded image is complete at the shore site."""
        with self._lock:
            return all(i in self.shore and self.shore[i].complete for i in self.encoded)

    def busy(self, files_expected: int, since_utc_s: float) -> str:
        """Return what still keeps the chain busy, an empty text if nothing does.

        Args:
            files_expected: Number of input files that atd_stub has to process.
            since_utc_s: Older health reports are not considered.
        """
        with self._lock:
            health = dict(self.health)
            contacts, encoded = len(self.snippets), len(self.encoded)
        for service, gauges in IDLE_GAUGES.items():
            report = health.get(service)
            if report is None or report.time_utc_s < since_utc_s:
                return f"no recent health report of {service}"
            for gauge in gauges:
                if report.gauges.get(gauge, 1.0) != 0.0:
                    return f"{service}: {gauge} {report.gauges.get(gauge, 1.0):g}"
        counters = health["atd_stub"].counters
        processed = counters.get("files_processed", 0) + counters.get("files_quarantined", 0)
        if processed < files_expected:
            return f"atd_stub: {processed} of {files_expected} files"
        if encoded < contacts:
            return f"compressor: {encoded} of {contacts} contacts"
        if self.settings.link == "paper" or self.all_complete:
            return ""
        # The vessel repeats its feedback until the vehicle has sent what is missing.
        feedback_open = health["op_modem"].gauges.get("feedback_open", 1.0)
        return f"op_modem: feedback_open {feedback_open:g}" if feedback_open else ""

    def wait_until_started(self) -> None:
        """Wait for the first health report of every service.

        Raises:
            PortError: A service has not reported in time.
        """
        deadline = time.monotonic() + 2 * CONNECT_S
        while True:
            with self._lock:
                missing = [service for service in PLATFORM_OF if service not in self.health]
            if not missing:
                return
            self._check()
            if time.monotonic() > deadline:
                raise PortError(f"no health report of {', '.join(missing)} within {2 * CONNECT_S:.0f} s")
            time.sleep(0.05)
