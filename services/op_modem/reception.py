"""Reception of the vessel: packets of the modem become images, messages and statuses, in one transaction each."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, replace

from pydantic import ValidationError

from sonarpost import keys, wire
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.errors import DeliveryError, FrameError
from sonarpost.limits import limit, oldest_of_largest
from sonarpost.link.downlink.commands import PendingCommand
from sonarpost.link.downlink.status_message import StatusMessage
from sonarpost.link.downlink.vessel_endpoint import ReceivedContent
from sonarpost.link.receiver import ImageUpdate
from sonarpost.logs import kv
from sonarpost.messages import (
    AcousticFrame,
    LinkQuality,
    ReceivedImage,
    ReceivedMessage,
    ReceivedStatus,
    VehicleStatus,
)
from sonarpost.modem.interface import FrameReceived, ModemCapabilities, PacketReceived, ReceptionQuality
from sonarpost.runtime.saved_endpoint import SavedEndpoint
from sonarpost.runtime.service import Service
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.vessel_endpoint import VesselLink

log = logging.getLogger(__name__)

_PACKETS = "packets"
MAX_UNSAVED = limit(
    10_000, "packets", "shares", "acoustic link", "modem address", "packets without a disk", "the oldest is dropped"
)


class Reception:
    """Processes the packets of this vessel, and the frames of other vessels.

    One transaction holds everything that follows from a packet: the state of the receivers, the images, and the state
    of commands and feedback. While the disk rejects it, packets wait in memory.

    Attributes:
        error: Why packets cannot be stored; empty if they can.

    Args:
        service: Commits, publishes and counts.
        link: The endpoint.
        authenticated: Whether frames are authenticated.
        on_commands: Called with the commands whose state a committed packet has changed.
    """

    def __init__(
        self,
        service: Service[OpModemConfig],
        link: SavedEndpoint[VesselLink],
        on_commands: Callable[[Sequence[PendingCommand]], None],
        *,
        authenticated: bool,
    ) -> None:
        self._service = service
        self._config = service.config
        self._vessel_id = service.platform.id
        self._link = link
        self._authenticated = authenticated
        self._on_commands = on_commands
        self._quality = LinkQuality()
        self._unsaved: deque[tuple[PacketReceived, float]] = deque()
        self._lock = threading.Lock()
        self.error = ""
        self._rejections = 0
        self._last_rejection = ""
        self._status_limiter = StatusLimiter(
            self._config.status_interval_s, [int(address) for address in self._config.vehicles]
        )
        self._limit_log = service.interval_log(log, logging.WARNING, "Image limit reached")

    @property
    def unsaved(self) -> int:
        """Number of packets in memory."""
        return len(self._unsaved)

    def gauges(self) -> dict[str, float]:
        """Return the number of packets in memory, and the quality of the last measured packet."""
        measured = {"snr_in_db": self._quality.snr_in_db, "snr_out_db": self._quality.snr_out_db}
        found = {name: value for name, value in measured.items() if value is not None}
        return {"unsaved": float(self.unsaved), **found}

    def log_rejections(self) -> None:
        """Log the frames that were rejected since the last call."""
        if self._rejections:
            log.warning("Frames rejected", extra=kv(rejected=self._rejections, last_reason=self._last_rejection))
            self._rejections = 0

    def packet_received(self, packet: PacketReceived) -> None:
        """Count and process a packet."""
        self._service.count("packets_received")
        self._service.count("frames_received", len(packet.frames))
        self._service.count("frames_bad", packet.bad_frames)
        self._quality = quality_of(packet.statistics) or self._quality
        self._add_unsaved(packet, time.time())
        self.process()

    def _add_unsaved(self, packet: PacketReceived, received_utc_s: float) -> None:
        with self._lock:
            self._unsaved.append((packet, received_utc_s))
            if len(self._unsaved) > MAX_UNSAVED:
                dropped = oldest_of_largest(self._unsaved, lambda waiting: waiting[0].src)
                self._unsaved.remove(dropped)
                self._service.count("packets_lost")
                fields = kv(source=dropped[0].src, unsaved=len(self._unsaved))
                log.error("Oldest packet in memory dropped", extra=fields)

    def process(self) -> None:
        """Process the packets in memory, oldest first, then the images whose wait has ended."""
        error = ""
        with self._lock:
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
            before, self.error = self.error, error
        if error and not before:
            log.error("Received frames cannot be stored; retrying", extra=kv(error=error))
        elif before and not error:
            log.info("Received frames stored again")

    def _refuse_frame(self, packet: PacketReceived, reason: str) -> None:
        effects = UnitOfWork()
        effects.quarantine(keys.acoustic_rx(self._vessel_id), packet.frames[0].data, reason)
        effects.count("frames_refused")
        with self._link.step():
            self._service.commit(effects)

    def _process_packet(self, packet: PacketReceived, received_utc_s: float) -> None:
        if not packet.frames:
            return
        number = self._service.store.read_state(_PACKETS, int, 0) + 1
        effects = UnitOfWork()
        frames: list[AcousticFrame] = []
        modem = self._config.capabilities
        for frame in packet.frames:
            try:
                frames.append(received_frame(self._vessel_id, frame, packet, number, received_utc_s, modem))
            except (ValidationError, FrameError) as error:
                # No modem sends such a frame: an error on the serial line that its checksum did not detect.
                reason = f"frame {frame.frame_number} of {len(frame.data)} bytes: {_text(error)}"
                log.error("Frame quarantined", extra=kv(source=frame.src, reason=reason))
                effects.quarantine(keys.acoustic_rx(self._vessel_id), frame.data, reason)
                effects.count("frames_refused")
        with self._link.step() as link:
            contents = [(frame, self._accept(link, frame)) for frame in frames]
            images = [update for _, content in contents for update in content.images]
            rejected = [reason for _, content in contents for reason in content.rejected]
            messages = self._add_effects(contents, effects)
            statuses = self._statuses(contents, effects)
            if self._config.lead_vessel is not None:
                key = keys.vessel_frames(self._config.lead_vessel, self._vessel_id)
                for record in (record for record, content in contents if not content.rejected):
                    effects.send(key, self._service.NAME, record)
            effects.put_state(_PACKETS, str(number).encode())
            self._service.commit(effects)
        for record in frames:
            self._service.publish(keys.acoustic_rx(self._vessel_id), record)
        self.publish_messages(messages)
        for status in statuses:
            self._service.publish(keys.acoustic_status(self._vessel_id), status)
        self._on_commands([command for _, content in contents for command in content.commands])
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
            for consumer in self._config.message_consumers:
                effects.send(keys.message_received(self._vessel_id), consumer, message)
        effects.count("frames_rejected", sum(len(content.rejected) for _, content in contents))
        effects.count("messages_received", len(messages))
        return messages

    def _add_rejections(self, rejected: Sequence[FrameError]) -> None:
        if rejected:
            self._rejections, self._last_rejection = self._rejections + len(rejected), str(rejected[-1])

    def _accept(self, link: VesselLink, frame: AcousticFrame, vessel: str = "") -> ReceivedContent:
        """Pass a frame to the endpoint; only a frame to this modem or to all can hold messages for this vessel."""
        broadcast = self._config.capabilities.broadcast
        addressed = frame.destination in (self._config.address, broadcast) and frame.source != broadcast
        overheard = not (addressed and self._config.transmits)
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
                vehicle, authenticated = self._config.name_of(frame.source), self._authenticated
                records.append(
                    status_record(latest, self._vessel_id, vehicle, frame.time_utc_s, authenticated=authenticated)
                )
        return records

    def _message(self, frame: AcousticFrame, data: bytes) -> ReceivedMessage:
        return ReceivedMessage(
            vessel_id=self._vessel_id,
            vehicle_id=self._config.name_of(frame.source),
            received_utc_s=frame.time_utc_s,
            data=data,
            authenticated=self._authenticated,
        )

    def _send_due_images(self) -> None:
        """Send the images whose wait for more frames, or for the allowance of their vehicle, has ended."""
        with self._link.step() as link:
            now = time.time()
            releasable = link.limiter.can_release(now)
            if link.endpoint.next_deadline() is None and not releasable:
                return
            images = link.endpoint.poll(now)
            if images or releasable:
                effects = UnitOfWork()
                self._send_images(images, effects)
                self._service.commit(effects)
        self._log_images(images)

    def _send_images(self, images: Sequence[ImageUpdate], effects: UnitOfWork) -> None:
        """Send images as far as the limits of their vehicles permit, and those that have waited for that."""
        limiter, now = self._link.current.limiter, time.time()
        effects.count("images_received", len(images))
        self._send_payloads(limiter.release(now), effects)
        for image in images:
            record = self._link.current.image_record(image)
            accepted = limiter.add(record, wire.encode(record))
            payloads = limiter.release(now)
            self._send_payloads(payloads, effects)
            if not (accepted and payloads):
                effects.count("images_limited" if accepted else "images_dropped")
                fields = {"action": "held" if accepted else "dropped", "waiting": limiter.held}
                self._limit_log.log(vehicle=record.vehicle_id, image_id=record.image_id, **fields)

    def _send_payloads(self, payloads: Sequence[bytes], effects: UnitOfWork) -> None:
        for payload in payloads:
            for consumer in self._config.image_consumers:
                effects.send_payload(keys.acoustic_image(self._vessel_id), consumer, payload, ReceivedImage)

    def _log_images(self, images: Sequence[ImageUpdate]) -> None:
        for image in images:
            log.info(
                "Image received",
                extra=kv(
                    vehicle=self._config.name_of(image.source),
                    image_id=image.image_id,
                    version=image.version,
                    bytes=image.received_bytes,
                    complete=image.complete,
                ),
            )

    # Frames of other vessels

    def merge(
        self, record: AcousticFrame, effects: UnitOfWork
    ) -> tuple[list[ReceivedMessage], tuple[PendingCommand, ...]]:
        """Process a frame of another vessel, within a step.

        Returns:
            The messages in it, and the commands that it changed, to publish after the commit.
        """
        content = self._accept(self._link.current, record, record.platform_id)
        messages = self._add_effects([(record, content)], effects)
        effects.count("frames_merged", int(not content.rejected))
        self._add_rejections(content.rejected)
        self._log_images(content.images)
        return messages, content.commands

    def publish_messages(self, messages: Sequence[ReceivedMessage]) -> None:
        """Publish messages of vehicles, unless they have consumers."""
        for message in messages if not self._config.message_consumers else ():
            self._service.publish(keys.message_received(self._vessel_id), message)


class StatusLimiter:
    """Limits how often the status of a vehicle is published.

    Args:
        interval_s: Minimum time between two statuses of a vehicle.
        addresses: Modem addresses of the configured vehicles. All others share one limit.
    """

    def __init__(self, interval_s: float, addresses: Collection[int]) -> None:
        self._interval_s = interval_s
        self._addresses = frozenset(addresses)
        self._accepted_s: dict[int | None, float] = {}

    def latest(self, source: int, statuses: Sequence[StatusMessage], now: float) -> StatusMessage | None:
        """Return the status to publish, None if there is none or the vehicle sends too many.

        Args:
            source: Modem address of the vehicle.
            statuses: Statuses of one frame, the newest last.
            now: UTC in seconds; a clock that was set back accepts the next status.
        """
        limited = source if source in self._addresses else None
        if not statuses or 0 <= now - self._accepted_s.get(limited, float("-inf")) < self._interval_s:
            return None
        self._accepted_s[limited] = now
        return statuses[-1]


def status_record(
    status: StatusMessage, vessel_id: str, vehicle_id: str, received_utc_s: float, *, authenticated: bool
) -> ReceivedStatus:
    """Return the record of a received status."""
    fields = asdict(status) | {"vehicle_id": vehicle_id, "time_utc_s": float(status.time_utc_s)}
    if status.depth_m is not None:
        fields["depth_m"] = min(12000.0, status.depth_m)
    return ReceivedStatus(
        vessel_id=vessel_id,
        vehicle_id=vehicle_id,
        received_utc_s=received_utc_s,
        status=VehicleStatus(**fields),
        authenticated=authenticated,
    )


def received_frame(
    vessel_id: str,
    frame: FrameReceived,
    packet: PacketReceived,
    number: int,
    received_utc_s: float,
    modem: ModemCapabilities,
) -> AcousticFrame:
    """Return the record of a received frame.

    Args:
        vessel_id: Name of the vessel.
        frame: The frame.
        packet: Its packet.
        number: Number of the packet on this vessel.
        received_utc_s: End of the packet.
        modem: Capabilities of the modem.

    Raises:
        FrameError: This modem does not send such a frame.
        ValidationError: No modem sends such a frame.
    """
    most = max(rate.frames for rate in modem.rates.values())
    if not modem.min_address <= frame.src <= modem.max_address:
        raise FrameError("acoustic frame", "source", frame.src, f"{modem.min_address}..{modem.max_address}")
    if not 1 <= frame.frame_number <= most:
        raise FrameError("acoustic frame", "frame_number", frame.frame_number, f"1..{most}")
    rate = None if frame.rate is None else modem.rates.get(frame.rate)
    return AcousticFrame(
        direction="rx",
        platform_id=vessel_id,
        time_utc_s=received_utc_s,
        source=frame.src,
        destination=frame.dest,
        rate=None if rate is None else rate.number,
        packet=number,
        frame_number=frame.frame_number,
        frame_count=_within(packet.nframes, most),
        data=frame.data,
        quality=quality_of(packet.statistics),
        airtime_s=None if rate is None else rate.airtime_s,
    )


def quality_of(statistics: ReceptionQuality | None) -> LinkQuality | None:
    """Return the modem's statistics as a record; an impossible count becomes None."""
    if statistics is None:
        return None
    return LinkQuality(
        snr_in_db=statistics.snr_in_db,
        snr_out_db=statistics.snr_out_db,
        spl_db=None if statistics.spl_db is None else float(statistics.spl_db),
        mse_db=statistics.mse_db,
        doppler=statistics.doppler,
        frames=_within(statistics.nframes),
        bad_frames=_within(statistics.nbad),
    )


def _within(number: int | None, high: int | None = None) -> int | None:
    """Return a count if it is in 0..high, else None."""
    return number if number is not None and number >= 0 and (high is None or number <= high) else None


def _text(error: ValidationError | FrameError) -> str:
    return str(error) if isinstance(error, FrameError) else str(error.errors()[0]["msg"])
