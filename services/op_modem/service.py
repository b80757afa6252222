"""op_modem: receives the vehicles' frames, assembles images from them, and sends commands and feedback."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace

from pydantic import ValidationError
from typing_extensions import override

from sonarpost import keys, wire
from sonarpost.config import PlatformConfig
from sonarpost.delivery.queue_sender import QueuePolicy
from sonarpost.errors import DeliveryError, FrameError, PayloadError
from sonarpost.limits import limit, oldest_of_largest
from sonarpost.link.downlink.vessel_endpoint import ReceivedContent
from sonarpost.link.receiver import ImageUpdate
from sonarpost.logs import kv
from sonarpost.messages import AcousticFrame, LinkQuality, ReceivedImage, ReceivedMessage, ReceivedStatus, Record
from sonarpost.modem.interface import (
    FrameDecoded,
    ModemEvent,
    PacketFailed,
    PacketReceived,
    PacketSent,
    RangeMeasured,
    RequestDone,
    RequestFailed,
)
from sonarpost.runtime.service import UnitOfWork
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.downlink_service import DownlinkService
from sonarpost.services.op_modem.packets import pack_partial, quality_of, received_frame, unpack_partial
from sonarpost.services.op_modem.received_statuses import StatusLimiter, status_record
from sonarpost.services.op_modem.vessel_endpoint import VesselLink

log = logging.getLogger(__name__)

_PACKETS = "packets"
_PARTIAL_PACKET = "arriving"
TICK_S = 0.1
SAVE_RETRY_S = 1.0
MAX_UNSAVED = limit(
    10_000, "packets", "shares", "acoustic link", "modem address", "packets without a disk", "the oldest is dropped"
)


class OpModemService(DownlinkService):
    """The vessel's end of the acoustic link.

    The service processes every frame that the modem delivers. It sends the coded content of each image to
    `image_consumers`, again after more of it arrived. One transaction holds everything that follows from a packet: the
    state of the receivers, the images, and the state of commands and feedback. While the disk rejects it, packets wait
    in memory. The frames of an unfinished packet are stored as they arrive.

    A vessel with a `lead_vessel` also sends the frames that it accepted to that vessel. The lead vessel processes the
    frames of `other_vessels` as its own.

    With `link = "v1"` the service also sends commands, decisions and feedback to the vehicles.

    Raises:
        ConfigError: As `DownlinkService`.
    """

    NAME = "op_modem"
    PAGE_BYTES = 512

    def __init__(self, platform: PlatformConfig, config: OpModemConfig) -> None:
        super().__init__(platform, config)
        self._quality = LinkQuality()
        self._unsaved: deque[tuple[PacketReceived, float]] = deque()
        self._unsaved_lock = threading.Lock()
        self._storage_error = ""
        self._merged_messages: list[ReceivedMessage] = []
        self._rejections = 0
        self._last_rejection = ""
        self._status_limiter = StatusLimiter(
            self.config.status_interval_s, [int(address) for address in self.config.vehicles]
        )
        self._limit_log = self.interval_log(log, logging.WARNING, "Image limit reached")

    @override
    def on_start(self) -> None:
        """Process the unfinished packet of a killed process, then open the port."""
        if (interrupted := self.store.read_state(_PARTIAL_PACKET, unpack_partial, None)) is not None:
            self._add_unsaved(*interrupted)
            self._process_received()
        self.publish_open_commands()
        super().on_start()
        self.start_thread(self._run, "link")

    @override
    def on_stop(self) -> None:
        """Close the port and process the packets in memory."""
        super().on_stop()
        self._process_received()
        self._log_rejections()
        if self._unsaved:
            log.error("Packets lost: the disk rejected them until the stop", extra=kv(packets=len(self._unsaved)))

    @override
    def on_modem_event(self, event: ModemEvent) -> None:
        """Process a received packet, store a frame of an unfinished one, or record the end of a transmission."""
        if isinstance(event, (PacketSent, PacketFailed)):
            self.packet_ended(event)
        elif isinstance(event, (RangeMeasured, RequestDone, RequestFailed)):
            self.range_event(event)
        elif isinstance(event, FrameDecoded):
            self._gate.frame_received(time.monotonic())
            self._partial_packet.append(event.frame)
            self._store_partial_packet()
        elif isinstance(event, PacketReceived):
            self._gate.frame_received(time.monotonic())
            self.count("packets_received")
            self.count("frames_received", len(event.frames))
            self.count("frames_bad", event.bad_frames)
            self._quality = quality_of(event.statistics) or self._quality
            self._partial_packet = []
            self._add_unsaved(event, time.time())
            self._process_received()

    @override
    def gauges(self) -> Mapping[str, float]:
        """Return the state of modem, link and store, and the quality of the last measured packet."""
        measured = {"snr_in_db": self._quality.snr_in_db, "snr_out_db": self._quality.snr_out_db}
        return {
            **super().gauges(),
            "unsaved": float(len(self._unsaved)),
            **self.link_gauges(),
            **{name: value for name, value in measured.items() if value is not None},
        }

    @override
    def degraded_reason(self) -> str:
        """Return why the store, the port, the modem or the transmission does not work."""
        return self._storage_error or super().degraded_reason()

    def _run(self) -> None:
        next_report_s = 0.0
        while not self.stopping.wait(SAVE_RETRY_S if self._storage_error else TICK_S):
            self._process_received()
            self.transmit()
            if time.monotonic() >= next_report_s:
                self._log_rejections()
                next_report_s = time.monotonic() + self.platform.health_interval_s

    def _log_rejections(self) -> None:
        if self._rejections:
            log.warning("Frames rejected", extra=kv(rejected=self._rejections, last_reason=self._last_rejection))
            self._rejections = 0

    # Received packets

    def _store_partial_packet(self) -> None:
        try:
            with self.store.transaction() as tx:
                tx.put_state(_PARTIAL_PACKET, pack_partial(self._partial_packet, time.time()))
        except DeliveryError as error:
            # The frames are in memory and arrive again with their packet.
            log.warning("Frames of an unfinished packet not stored", extra=kv(error=str(error)))

    def _add_unsaved(self, packet: PacketReceived, received_utc_s: float) -> None:
        with self._unsaved_lock:
            self._unsaved.append((packet, received_utc_s))
            if len(self._unsaved) > MAX_UNSAVED:
                dropped = oldest_of_largest(self._unsaved, lambda waiting: waiting[0].src)
                self._unsaved.remove(dropped)
                self.count("packets_lost")
                fields = kv(source=dropped[0].src, unsaved=len(self._unsaved))
                log.error("Oldest packet in memory dropped", extra=fields)

    def _process_received(self) -> None:
        """Process the packets in memory, oldest first, then the images whose wait has ended."""
        error = ""
        with self._unsaved_lock:
            try:
                while self._unsaved:
                    packet, received_utc_s = self._unsaved[0]
                    try:
                        self._process_packet(packet, received_utc_s)
                    except DeliveryError:
                        raise
                    except Exception as failure:
                        # Nothing of the packet was committed: its frames are processed one by one.
                        if len(packet.frames) > 1:
                            parts = [(replace(packet, frames=(frame,)), received_utc_s) for frame in packet.frames]
                            self._unsaved.popleft()
                            self._unsaved.extendleft(reversed(parts))
                            continue
                        log.exception("Frame quarantined after an unexpected exception", extra=kv(source=packet.src))
                        self._refuse_frame(packet, f"{type(failure).__name__}: {failure}")
                    self._unsaved.popleft()
                self._send_due_images()
            except DeliveryError as caught:
                error = str(caught)
            before, self._storage_error = self._storage_error, error
        if error and not before:
            log.error("Received frames cannot be stored; retrying", extra=kv(error=error))
        elif before and not error:
            log.info("Received frames stored again")

    def _refuse_frame(self, packet: PacketReceived, reason: str) -> None:
        effects = UnitOfWork()
        effects.quarantine(keys.acoustic_rx(self.platform.id), packet.frames[0].data, reason)
        effects.count("frames_refused")
        self.commit(effects)

    def _process_packet(self, packet: PacketReceived, received_utc_s: float) -> None:
        if not packet.frames:
            return
        number = self.store.read_state(_PACKETS, int, 0) + 1
        effects = UnitOfWork()
        frames: list[AcousticFrame] = []
        modem = self.config.capabilities
        for frame in packet.frames:
            try:
                frames.append(received_frame(self.platform.id, frame, packet, number, received_utc_s, modem))
            except (ValidationError, FrameError) as error:
                # No modem sends such a frame: an error on the serial line that its checksum did not detect.
                reason = f"frame {frame.frame_number} of {len(frame.data)} bytes: {_text(error)}"
                log.error("Frame quarantined", extra=kv(source=frame.src, reason=reason))
                effects.quarantine(keys.acoustic_rx(self.platform.id), frame.data, reason)
                effects.count("frames_refused")
        with self._link_step() as link:
            contents = [(frame, self._accept(link, frame)) for frame in frames]
            images = [update for _, content in contents for update in content.images]
            rejected = [reason for _, content in contents for reason in content.rejected]
            messages = self._add_effects(contents, effects)
            statuses = self._statuses(contents, effects)
            if self.config.lead_vessel is not None:
                key = keys.vessel_frames(self.config.lead_vessel, self.platform.id)
                for record in (record for record, content in contents if not content.rejected):
                    effects.send(key, self.NAME, record)
            self._save_state(effects)
            effects.put_state(_PACKETS, str(number).encode())
            # Frames of the next packet may have arrived.
            effects.put_state(_PARTIAL_PACKET, pack_partial(self._partial_packet, received_utc_s))
            self.commit(effects)
        for record in frames:
            self.publish(keys.acoustic_rx(self.platform.id), record)
        for message in messages if not self.config.message_consumers else ():
            self.publish(keys.message_received(self.platform.id), message)
        for status in statuses:
            self.publish(keys.acoustic_status(self.platform.id), status)
        self._publish_states([command for _, content in contents for command in content.commands])
        self._add_rejections(rejected)
        log.info(
            "Packet received",
            extra=kv(source=packet.src, rate=packet.rate, frames=len(packet.frames), bad=packet.bad_frames),
        )
        self._log_images(images)

    def _add_effects(
        self, contents: Sequence[tuple[AcousticFrame, ReceivedContent]], effects: UnitOfWork
    ) -> list[ReceivedMessage]:
        """Add the images and messages of frames to a unit of work; return the messages."""
        messages = [self._message(frame, data) for frame, content in contents for data in content.messages]
        self._send_images([update for _, content in contents for update in content.images], effects)
        for message in messages:
            for consumer in self.config.message_consumers:
                effects.send(keys.message_received(self.platform.id), consumer, message)
        effects.count("frames_rejected", sum(len(content.rejected) for _, content in contents))
        effects.count("messages_received", len(messages))
        return messages

    def _add_rejections(self, rejected: Sequence[FrameError]) -> None:
        if rejected:
            self._rejections, self._last_rejection = self._rejections + len(rejected), str(rejected[-1])

    def _accept(self, link: VesselLink, frame: AcousticFrame, vessel: str = "") -> ReceivedContent:
        """Pass a frame to the endpoint; only a frame to this modem or to all can hold messages for this vessel."""
        broadcast = self.config.capabilities.broadcast
        addressed = frame.destination in (self.config.address, broadcast) and frame.source != broadcast
        overheard = not (addressed and self.config.transmits)
        # The clocks of two vessels differ: the time of this one counts.
        now = time.time() if vessel else frame.time_utc_s
        return link.endpoint.accept(frame.source, frame.data, now, overheard=overheard, vessel=vessel)

    def _statuses(
        self, contents: Sequence[tuple[AcousticFrame, ReceivedContent]], effects: UnitOfWork
    ) -> list[ReceivedStatus]:
        """Return the records of the received statuses that are published."""
        records: list[ReceivedStatus] = []
        for frame, content in contents:
            latest = self._status_limiter.latest(frame.source, content.statuses, frame.time_utc_s)
            effects.count("statuses_received", len(content.statuses))
            effects.count("statuses_dropped", len(content.statuses) - (latest is not None))
            if latest is not None:
                vehicle, authenticated = self.config.name_of(frame.source), self.key is not None
                records.append(
                    status_record(latest, self.platform.id, vehicle, frame.time_utc_s, authenticated=authenticated)
                )
        return records

    def _message(self, frame: AcousticFrame, data: bytes) -> ReceivedMessage:
        return ReceivedMessage(
            vessel_id=self.platform.id,
            vehicle_id=self.config.name_of(frame.source),
            received_utc_s=frame.time_utc_s,
            data=data,
            authenticated=self.key is not None,
        )

    def _send_due_images(self) -> None:
        """Send the images whose wait for more frames, or for the allowance of their vehicle, has ended."""
        with self._link_lock:
            now = time.time()
            releasable = self._link.limiter.can_release(now)
            if self._link.endpoint.next_deadline() is None and not releasable:
                return
            with self._link_step() as link:
                images = link.endpoint.poll(now)
                if images or releasable:
                    effects = UnitOfWork()
                    self._send_images(images, effects)
                    self._save_state(effects)
                    self.commit(effects)
                self._is_committed = True
        self._log_images(images)

    def _send_images(self, images: Sequence[ImageUpdate], effects: UnitOfWork) -> None:
        """Send images as far as the limits of their vehicles permit, and those that have waited for that."""
        limiter, now = self._link.limiter, time.time()
        effects.count("images_received", len(images))
        self._send_payloads(limiter.release(now), effects)
        for image in images:
            record = self._link.image_record(image)
            accepted = limiter.add(record, wire.encode(record))
            payloads = limiter.release(now)
            self._send_payloads(payloads, effects)
            if not (accepted and payloads):
                effects.count("images_limited" if accepted else "images_dropped")
                fields = {"action": "held" if accepted else "dropped", "waiting": limiter.held}
                self._limit_log.log(vehicle=record.vehicle_id, image_id=record.image_id, **fields)

    def _send_payloads(self, payloads: Sequence[bytes], effects: UnitOfWork) -> None:
        for payload in payloads:
            for consumer in self.config.image_consumers:
                effects.send_payload(keys.acoustic_image(self.platform.id), consumer, payload, ReceivedImage)

    def _log_images(self, images: Sequence[ImageUpdate]) -> None:
        for image in images:
            log.info(
                "Image received",
                extra=kv(
                    vehicle=self.config.name_of(image.source),
                    image_id=image.image_id,
                    version=image.version,
                    bytes=image.received_bytes,
                    complete=image.complete,
                ),
            )

    # Frames of other vessels

    @override
    def consumed_keys(self) -> Mapping[str, type[Record]]:
        """Return commands and decisions for vehicles, and the frames of other vessels."""
        return {**super().consumed_keys(), **dict.fromkeys(self.delivery_only_keys(), AcousticFrame)}

    @override
    def delivery_only_keys(self) -> Collection[str]:
        """Return the keys of the frames of other vessels."""
        return [keys.vessel_frames(self.platform.id, vessel) for vessel in self.config.other_vessels]

    @override
    def queue_policy(self, queue: str) -> QueuePolicy:
        """Return that frames for the lead vessel are not published, and leave the platform."""
        is_local = queue != self.NAME
        return QueuePolicy(publish=self.PUBLISH and is_local, is_local=is_local)

    @override
    def validate(self, key: str, record: Record) -> None:
        """Reject a record that can never be sent, or a frame that the vessel in its key did not receive."""
        if not isinstance(record, AcousticFrame):
            super().validate(key, record)
            return
        vessel = keys.frames_vessel(key)
        if record.platform_id != vessel:
            raise PayloadError(key, "platform_id", record.platform_id, vessel)
        if record.direction != "rx":
            raise PayloadError(key, "direction", record.direction, "rx")
        modem = self.config.capabilities
        if not modem.min_address <= record.source <= modem.max_address:
            raise PayloadError(key, "source", record.source, f"{modem.min_address}..{modem.max_address}")

    @override
    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Add a command or a decision, or process a frame of another vessel."""
        if not isinstance(record, AcousticFrame):
            super().handle(key, record, effects)
            return
        self._load()
        content = self._accept(self._link, record, record.platform_id)
        self._merged_messages = self._add_effects([(record, content)], effects)
        self._new_commands += content.commands
        effects.count("frames_merged", int(not content.rejected))
        self._save_state(effects)
        self._add_rejections(content.rejected)
        self._log_images(content.images)

    @override
    @contextmanager
    def handling(self, *, wait: bool = True) -> Iterator[bool]:
        """As `DownlinkService`; then publish the messages in frames of other vessels."""
        self._merged_messages = []
        with super().handling(wait=wait) as is_held:
            yield is_held
        for message in self._merged_messages if not self.config.message_consumers else ():
            self.publish(keys.message_received(self.platform.id), message)


def _text(error: ValidationError | FrameError) -> str:
    return str(error) if isinstance(error, FrameError) else str(error.errors()[0]["msg"])
