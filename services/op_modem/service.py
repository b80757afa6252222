"""op_modem: receives the vehicles' frames, assembles images from them, and sends commands and feedback."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence

from pydantic import ValidationError

from sonarpost import keys, wire
from sonarpost.config import PlatformConfig
from sonarpost.errors import DeliveryError, PayloadError
from sonarpost.link.downlink.vessel_endpoint import ReceivedContent
from sonarpost.link.receiver import ImageUpdate
from sonarpost.logs import kv
from sonarpost.messages import AcousticFrame, LinkQuality, ReceivedImage, ReceivedMessage
from sonarpost.modem.micromodem import FrameDecoded, ModemEvent, PacketFailed, PacketReceived, PacketSent
from sonarpost.runtime.service import UnitOfWork
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.downlink_service import DownlinkService
from sonarpost.services.op_modem.packets import pack_partial, quality_of, received_frame, unpack_partial
from sonarpost.services.op_modem.vessel_endpoint import VesselLink

log = logging.getLogger(__name__)

_PACKETS = "packets"
_PARTIAL_PACKET = "arriving"
_QUEUE_0_1 = "decompressor"
"""Queue in which version 0.1 kept received frames."""
TICK_S = 0.1
SAVE_RETRY_S = 1.0
MAX_UNSAVED = 10_000
BROADCAST = 127


class OpModemService(DownlinkService):
    """The vessel's end of the acoustic link.

    The service processes every frame that the modem delivers. It sends the coded content of each image to
    `image_consumers`, again after more of it arrived. One transaction holds everything that follows from a packet: the
    state of the receivers, the images, and the state of commands and feedback. While the disk rejects it, packets wait
    in memory. The frames of an unfinished packet are stored as they arrive.

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
        self._rejections = 0
        self._last_rejection = ""
        self._limit_log = self.interval_log(log, logging.WARNING, "Image limit reached")

    def start(self) -> bool:
        """Process the frames that version 0.1 left in the outbox, then start."""
        self._process_queued_frames()
        return super().start()

    def on_start(self) -> None:
        """Process the unfinished packet of a killed process, then open the port."""
        saved = self.store.get_state(_PARTIAL_PACKET)
        if (interrupted := unpack_partial(saved) if saved is not None else None) is not None:
            self._add_unsaved(*interrupted)
            self._process_received()
        self.publish_open_commands()
        super().on_start()
        self.start_thread(self._run, "link")

    def on_stop(self) -> None:
        """Close the port and process the packets in memory."""
        super().on_stop()
        self._process_received()
        self._log_rejections()
        if self._unsaved:
            log.error("Packets lost: the disk rejected them until the stop", extra=kv(packets=len(self._unsaved)))

    def on_modem_event(self, event: ModemEvent) -> None:
        """Process a received packet, store a frame of an unfinished one, or record the end of a transmission."""
        if isinstance(event, (PacketSent, PacketFailed)):
            self.packet_ended(event)
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

    def gauges(self) -> Mapping[str, float]:
        """Return the state of modem, link and store, and the quality of the last measured packet."""
        measured = {"snr_in_db": self._quality.snr_in_db, "snr_out_db": self._quality.snr_out_db}
        return {
            **super().gauges(),
            "unsaved": float(len(self._unsaved)),
            **self.link_gauges(),
            **{name: value for name, value in measured.items() if value is not None},
        }

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
            if len(self._unsaved) >= MAX_UNSAVED:
                self._unsaved.popleft()
                self.count("packets_lost")
                log.error("Oldest packet in memory dropped", extra=kv(unsaved=len(self._unsaved)))
            self._unsaved.append((packet, received_utc_s))

    def _process_received(self) -> None:
        """Process the packets in memory, oldest first, then the images whose wait has ended."""
        error = ""
        with self._unsaved_lock:
            try:
                while self._unsaved:
                    self._process_packet(*self._unsaved[0])
                    self._unsaved.popleft()
                self._send_due_images()
            except DeliveryError as caught:
                error = str(caught)
            before, self._storage_error = self._storage_error, error
        if error and not before:
            log.error("Received frames cannot be stored; retrying", extra=kv(error=error))
        elif before and not error:
            log.info("Received frames stored again")

    def _process_packet(self, packet: PacketReceived, received_utc_s: float) -> None:
        if not packet.frames:
            return
        number = int(self.store.get_state(_PACKETS) or b"0") + 1
        effects = UnitOfWork()
        frames: list[AcousticFrame] = []
        for frame in packet.frames:
            try:
                frames.append(received_frame(self.platform.id, frame, packet, number, received_utc_s))
            except ValidationError as error:
                # No Micro-Modem sends such a frame: an error on the serial line that its checksum did not detect.
                reason = f"frame {frame.frame_number} of {len(frame.data)} bytes: {error.errors()[0]['msg']}"
                log.error("Frame quarantined", extra=kv(source=frame.src, reason=reason))
                effects.quarantine(keys.acoustic_rx(self.platform.id), frame.data, reason)
                effects.count("frames_refused")
        with self._link_step() as link:
            contents = [(frame, self._accept(link, frame)) for frame in frames]
            images = [update for _, content in contents for update in content.images]
            rejected = [reason for _, content in contents for reason in content.rejected]
            messages = [self._message(frame, data) for frame, content in contents for data in content.messages]
            self._send_images(images, effects)
            for message in messages:
                for consumer in self.config.message_consumers:
                    effects.send(keys.message_received(self.platform.id), consumer, message)
            effects.count("frames_rejected", len(rejected))
            effects.count("messages_received", len(messages))
            self._save_state(effects)
            effects.put_state(_PACKETS, str(number).encode())
            # Frames of the next packet may have arrived.
            effects.put_state(_PARTIAL_PACKET, pack_partial(self._partial_packet, received_utc_s))
            self.commit(effects)
        for record in frames:
            self.publish(keys.acoustic_rx(self.platform.id), record)
        for message in messages if not self.config.message_consumers else ():
            self.publish(keys.message_received(self.platform.id), message)
        self._publish_states([command for _, content in contents for command in content.commands])
        if rejected:
            self._rejections, self._last_rejection = self._rejections + len(rejected), str(rejected[-1])
        log.info(
            "Packet received",
            extra=kv(source=packet.src, rate=packet.rate, frames=len(packet.frames), bad=packet.bad_frames),
        )
        self._log_images(images)

    def _accept(self, link: VesselLink, frame: AcousticFrame) -> ReceivedContent:
        """Pass a frame to the endpoint; only a frame to this modem or to all can hold messages for this vessel."""
        addressed = frame.destination in (self.config.address, BROADCAST) and frame.source != BROADCAST
        overheard = not (addressed and self.config.transmits)
        return link.endpoint.accept(frame.source, frame.data, frame.time_utc_s, overheard=overheard)

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

    # Migration

    def _process_queued_frames(self) -> None:
        """Process the frames that version 0.1 queued for the decompressor.

        The v1 receiver has already processed those addressed to this vessel, but its images were not sent. They are
        sent again from its state.
        """
        key = keys.acoustic_rx(self.platform.id)
        numbers = self.store.queued_numbers(_QUEUE_0_1, 2**31)
        items = [item for item in self.store.queued_items(_QUEUE_0_1, numbers) if item.key == key]
        if not items:
            return
        effects = UnitOfWork()
        frames: list[AcousticFrame] = []
        for item in items:
            try:
                frames.append(wire.decode(AcousticFrame, item.payload, item.key))
            except PayloadError as error:
                effects.quarantine(item.key, item.payload, str(error))
        with self._link_step() as link:
            if frames:
                self._send_images(link.endpoint.v1.repeat_updates(min(frame.time_utc_s for frame in frames)), effects)
            for frame in frames:
                self._send_images(self._accept(link, frame).images, effects)
            self._save_state(effects)
            with self.store.transaction() as tx:
                effects.write(tx)
                tx.remove_acknowledged(_QUEUE_0_1, [item.seq for item in items])
            self._is_committed = True
        log.info("Frames of version 0.1 processed", extra=kv(frames=len(items)))
