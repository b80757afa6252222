"""Sends pictures and messages through the vehicle's modem, by the v1 link or as the paper does."""

from __future__ import annotations

import logging
import queue
import time
from collections.abc import Mapping, Sequence

import msgpack
import zenoh

from sonarpost import keys, wire
from sonarpost.config import PlatformConfig
from sonarpost.delivery.records import InboxItem
from sonarpost.errors import RetryLaterError
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.sender import Packet, plan_packets
from sonarpost.logs import kv
from sonarpost.messages import (
    AcousticFrame,
    Contact,
    EncodedImage,
    OutgoingMessage,
    QueuedImage,
    QueueState,
    Record,
)
from sonarpost.modem.micromodem import RATES, ModemEvent, PacketFailed, PacketSent
from sonarpost.runtime.modem_service import ModemService
from sonarpost.runtime.service import ServiceStoppingError, UnitOfWork
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.line import IMAGES_ACCEPTED, VehicleEndpoint
from sonarpost.services.uuv_modem.line_runner import TAKEN, LineRunner
from sonarpost.sonar.survey import Side

log = logging.getLogger(__name__)

_PROGRESS = "progress"
_WAIT_S = 0.2
MAX_IMAGES_TOLD = 500
_LAST_TIME_UTC_S = 0xFFFF_FFFE
"""The latest second the contact record of the link can name, in the year 2106."""


class UuvModemService(ModemService[UuvModemConfig]):
    """The vehicle's end of the acoustic link.

    With `link = "v1"` accepted records go from the inbox to the queue, which `LineRunner` works off. With "paper" an
    image leaves the inbox when its last packet has gone into the water. How far either has come is kept with every
    packet, so that a restart sends at most one packet twice; the receiver knows repeated frames.
    """

    NAME = "uuv_modem"

    def __init__(self, platform: PlatformConfig, config: UuvModemConfig) -> None:
        super().__init__(platform, config)
        self._outcomes: queue.Queue[PacketSent | PacketFailed] = queue.Queue()
        self._packet_number = 0
        self._line: VehicleEndpoint | None = None
        self._line_trouble = ""
        self._runner: LineRunner | None = None
        if config.link == "v1":
            try:
                self._line, self._runner = self._new_line()
            except BaseException:
                self.store.close()
                raise

    def _new_line(self) -> tuple[VehicleEndpoint, LineRunner]:
        line = VehicleEndpoint(self.platform, self.config, self.store, _summary_of_image, self.count)
        runner = LineRunner(
            line,
            self.modem,
            self.config,
            self.config.new_mac(),
            self.stopping,
            show=self._show,
            tell=self._tell_queue,
            problem=self._line_problem,
            count=self.count,
        )
        return line, runner

    def consumed_keys(self) -> Mapping[str, type[Record]]:
        """Encoded images of this vehicle, and with v1 other traffic."""
        images: dict[str, type[Record]] = {keys.image_encoded(self.platform.id): EncodedImage}
        if self.config.link == "v1":
            images[keys.message_outgoing(self.platform.id)] = OutgoingMessage
        return images

    def validate(self, key: str, record: Record) -> None:
        """Refuse what can never be sent, while its sender can still be told."""
        assert isinstance(record, (EncodedImage, OutgoingMessage))
        if self._line is not None:
            self._line.check(record)
        elif isinstance(record, EncodedImage):
            self._plan(record)

    def check_capacity(self, key: str) -> None:
        """Leave messages with their programs while too many wait."""
        if (
            self._line is not None
            and key == keys.message_outgoing(self.platform.id)
            and not self._line.queue.accepts_messages
        ):
            raise RetryLaterError(f"{key}: {self.config.max_messages} messages wait already")

    def on_start(self) -> None:
        """Open the port, and go on with what was under way."""
        super().on_start()
        if self._line is not None and self._runner is not None:
            self._line.load(self.platform.id, time.time())
            self.start_thread(self._runner.run, "link")
        else:
            self.start_thread(self._publish_paper_queue, "queue state")

    def commit_batch(self, handled: Sequence[tuple[UnitOfWork, InboxItem | None]]) -> int:
        """As the base does, and wake the link."""
        superseded = super().commit_batch(handled)
        if self._runner is not None:
            self._runner.take(None)
        return superseded

    def gauges(self) -> Mapping[str, float]:
        """Return what waits for the water."""
        line = self._line
        if line is None:
            return super().gauges()
        # Read while the link works on it: numbers of one moment or the next, never of a half-done change.
        return {
            **super().gauges(),
            **line.queue.gauges(),
        }

    def degraded_reason(self) -> str:
        """Return what is wrong with the port, the modem or the link's disk."""
        return super().degraded_reason() or self._line_trouble

    def _line_problem(self, detail: str) -> None:
        if detail and detail != self._line_trouble:
            log.error("The link waits", extra=kv(reason=detail))
        self._line_trouble = detail

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Queue a record, or with the paper's link send an image, however long it takes."""
        if self._line is not None:
            effects.put_state(self._line.arrival_name(), effects.payload)
            return
        assert isinstance(record, EncodedImage)
        packets = self._plan(record)
        done = self._packets_done(record, len(packets))
        log.info("Sending", extra=kv(image_id=record.image_id, packets=len(packets), already_sent=done))
        for number in range(done, len(packets)):
            self._send(packets[number])
            if number + 1 < len(packets):
                self._remember(record, number + 1)
        effects.delete_state(_PROGRESS)
        effects.put_state(IMAGES_ACCEPTED, str(int(self.store.get_state(IMAGES_ACCEPTED) or b"0") + 1).encode())
        effects.count("images_sent")
        log.info("Image sent", extra=kv(image_id=record.image_id, contact_id=record.contact.contact_id))

    def on_modem_event(self, event: ModemEvent) -> None:
        """Hand the fate of packets, and with v1 what is heard, to the sending thread."""
        if self._runner is not None:
            if isinstance(event, TAKEN):
                self._runner.take(event)
        elif isinstance(event, (PacketSent, PacketFailed)):
            self._outcomes.put(event)

    def _plan(self, image: EncodedImage) -> tuple[Packet, ...]:
        rate = RATES[self.config.rate]
        summary = summary_of(image.contact, image.height_px, image.width_px)
        return plan_packets(image.image_id, image.stream, summary, rate.frames, rate.frame_bytes)

    def _packets_done(self, image: EncodedImage, packets: int) -> int:
        """Return how many packets of this image have gone, 0 when they were planned for another rate."""
        kept = self.store.get_state(_PROGRESS)
        if kept is None:
            return 0
        progress = msgpack.unpackb(kept)
        same = (progress["image_id"], progress["rate"], progress["of"]) == (image.image_id, self.config.rate, packets)
        return int(progress["done"]) if same else 0

    def _remember(self, image: EncodedImage, done: int) -> None:
        rate, packets = self.config.rate, len(self._plan(image))
        progress = {"image_id": image.image_id, "rate": rate, "of": packets, "done": done}
        with self.store.transaction() as tx:
            tx.put_state(_PROGRESS, msgpack.packb(progress))

    def _send(self, packet: Packet) -> None:
        """Send one packet, trying until the modem has sent it."""
        while True:
            packet_id = self.modem.send_packet(self.config.destination, self.config.rate, packet)
            outcome = self._wait_for(packet_id)
            if isinstance(outcome, PacketSent):
                self._show(outcome)
                return
            self.count("packets_failed")
            log.warning("Packet not sent, trying again", extra=kv(reason=outcome.reason, maybe=outcome.maybe_sent))
            if self.stopping.wait(self.config.retry_s):
                raise ServiceStoppingError

    def _wait_for(self, packet_id: int) -> PacketSent | PacketFailed:
        while not self.stopping.is_set():
            try:
                outcome = self._outcomes.get(timeout=_WAIT_S)
            except queue.Empty:
                continue
            if outcome.packet_id == packet_id:
                return outcome
        raise ServiceStoppingError

    def _show(self, sent: PacketSent) -> None:
        """Publish the frames for observers."""
        self._packet_number += 1
        self.count("packets_sent")
        self.count("frames_sent", len(sent.frames))
        now_utc_s = time.time()
        for number, data in enumerate(sent.frames, start=1):
            frame = AcousticFrame(
                direction="tx",
                platform_id=self.platform.id,
                time_utc_s=now_utc_s,
                source=self.config.address,
                destination=sent.dest,
                rate=sent.rate,
                packet=self._packet_number,
                frame_number=number,
                frame_count=len(sent.frames),
                data=data,
            )
            self._publish(frame)

    def _publish(self, frame: AcousticFrame) -> None:
        try:
            key = keys.acoustic_tx(self.platform.id)
            self.session.put(key, wire.encode(frame), encoding=wire.encoding_of(AcousticFrame))
        except zenoh.ZError as error:
            # The frame has gone into the water; that nobody could watch must not send it again.
            log.warning("Frame not shown to observers", extra=kv(error=str(error)))

    def _tell_queue(self, now_utc_s: float) -> None:
        """Publish what waits and when it is expected to have gone."""
        assert self._line is not None
        waiting = self._line.queue
        expected = waiting.expected(now_utc_s)
        images = tuple(
            QueuedImage(
                image_id=each.image_id,
                contact_id=each.contact_id,
                bytes_left=each.bytes_left,
                preview_utc_s=each.preview_s,
                expected_utc_s=each.done_s,
            )
            for each in expected[:MAX_IMAGES_TOLD]
        )
        state = QueueState(
            platform_id=self.platform.id,
            time_utc_s=now_utc_s,
            rate=waiting.rate,
            frame_loss=waiting.measured_loss,
            packet_interval_s=min(waiting.packet_interval_s, 86400.0),
            messages_waiting=waiting.messages_waiting,
            message_bytes=waiting.message_bytes,
            images_waiting=len(expected),
            images=images,
            images_accepted=self._line.images_accepted,
        )
        self._publish_state(state)

    def _publish_paper_queue(self) -> None:
        """Publish how many images wait in the inbox, every 0.2 s while that changes."""
        published: tuple[int, int] | None = None
        published_s = 0.0
        while not self.stopping.wait(0.2):
            sent = self.store.get_state(IMAGES_ACCEPTED)
            waiting = self.store.inbox_depth()
            if sent != self.store.get_state(IMAGES_ACCEPTED):
                continue  # an image has gone between the two reads
            accepted = int(sent or b"0") + waiting
            if (waiting, accepted) == published and time.monotonic() - published_s < self.config.queue_interval_s:
                continue
            published, published_s = (waiting, accepted), time.monotonic()
            self._publish_state(
                QueueState(
                    platform_id=self.platform.id,
                    time_utc_s=time.time(),
                    rate=self.config.rate,
                    frame_loss=None,
                    packet_interval_s=RATES[self.config.rate].airtime_s,
                    messages_waiting=0,
                    message_bytes=0,
                    images_waiting=waiting,
                    images=(),
                    images_accepted=accepted,
                )
            )

    def _publish_state(self, state: QueueState) -> None:
        try:
            key = keys.acoustic_queue(self.platform.id)
            self.session.put(key, wire.encode(state), encoding=wire.encoding_of(QueueState))
        except zenoh.ZError as error:
            log.warning("State of the queue not published", extra=kv(error=str(error)))


def _summary_of_image(image: EncodedImage) -> ContactSummary:
    return summary_of(image.contact, image.height_px, image.width_px)


def summary_of(contact: Contact, height_px: int, width_px: int) -> ContactSummary:
    """Return what of a contact travels by sound, with the size of its picture.

    What the record cannot hold travels as unknown: a vehicle's wrong clock must not cost the picture.
    """
    time_utc_s = contact.time_utc_s
    has_fix = contact.lat_deg is not None and contact.lon_deg is not None
    return ContactSummary(
        height_px=height_px,
        width_px=width_px,
        lat_deg=contact.lat_deg if has_fix else None,
        lon_deg=contact.lon_deg if has_fix else None,
        time_utc_s=time_utc_s if time_utc_s is not None and time_utc_s <= _LAST_TIME_UTC_S else None,
        confidence=contact.atd_confidence,
        heading_deg=contact.heading_deg,
        altitude_m=contact.altitude_m,
        depth_m=contact.depth_m,
        side=Side(contact.channel) if contact.channel else None,
        ground_range_m=contact.ground_range_m if contact.channel else None,
        pixel_along_m=contact.pixel_along_m,
        pixel_across_m=contact.pixel_across_m,
        position_sigma_m=contact.position_sigma_m if has_fix else None,
    )
