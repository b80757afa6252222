"""Sends images and messages through the vehicle's modem, and receives feedback and commands from the vessel."""

from __future__ import annotations

import logging
import queue
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Final

import zenoh
from typing_extensions import override

from sonarpost import keys, wire
from sonarpost.config import PlatformConfig
from sonarpost.errors import BadInputError, DeliveryError, RetryLaterError
from sonarpost.limits import limit
from sonarpost.link.auth.key import Direction
from sonarpost.link.sender import OutgoingPacket
from sonarpost.logs import kv
from sonarpost.messages import EncodedImage, OutgoingMessage, Record, VehicleStatus
from sonarpost.modem.interface import (
    FrameDecoded,
    FrameReceived,
    ModemEvent,
    PacketFailed,
    PacketSent,
    PollReceived,
    ShortMessageReceived,
)
from sonarpost.runtime.health import disk_gauges
from sonarpost.runtime.modem_service import ServiceModem, sent_frames
from sonarpost.runtime.saved_endpoint import SavedEndpoint, reserve_counters, stored_authenticator
from sonarpost.runtime.service import Service, UnitOfWork
from sonarpost.security.acoustic_key import key_warning
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.status_beacon import StatusBeacon
from sonarpost.services.uuv_modem.transmissions import TransmissionTimes
from sonarpost.services.uuv_modem.vehicle_endpoint import VehicleEndpoint

log = logging.getLogger(__name__)

MAX_EVENTS: Final = limit(
    10_000, "events", "claims", "acoustic link", "modem", "events waiting", "further ones are dropped"
)
MAX_UNSAVED: Final = limit(
    1000, "frames", "shares", "acoustic link", "all modems", "frames without a disk", "further ones are dropped"
)
SAVE_AGAIN_S: Final = 0.5
_MAX_WAIT_S: Final = 0.2
_MIN_WAIT_S: Final = 0.005
_STATE_INTERVAL_S: Final = 0.2
"""Minimum time between two publications of the queue state when images were accepted or sent."""


class UuvModemService(Service[UuvModemConfig]):
    """The vehicle's end of the acoustic link.

    `handle` adds a record to the transmit queue. The transaction that removes the record from the inbox also writes the
    queue. The link's thread sends the packets. It commits each before it is sent, together with the end of the one
    before: a restart sends at most one packet twice.

    Attributes:
        modem: The modem.

    Raises:
        ConfigError: See `UuvModemConfig.check_with`.
    """

    NAME = "uuv_modem"
    BATCH = 64
    PAGE_BYTES = 512

    def __init__(self, platform: PlatformConfig, config: UuvModemConfig) -> None:
        # Before the store is opened, so that a configuration error leaves no open store.
        config = config.for_platform(platform)
        super().__init__(platform, config)
        self.modem = ServiceModem(self, self.on_modem_event)
        self._rejected_frames = self.interval_log(log, logging.WARNING, "Frame rejected")
        self._link = SavedEndpoint(self.store, "link/", self._new_endpoint)
        self._mac = self.config.new_mac()
        self._is_polled = self.config.mac == "polled" and self.config.link == "v1"
        self._failed_packets = self.interval_log(log, logging.WARNING, "Packet not sent; retrying")
        self._transmissions = TransmissionTimes()
        self._beacon = StatusBeacon(platform.id, self.config.status_period_s)
        self._malformed_statuses = self.interval_log(log, logging.WARNING, "Ignoring malformed vehicle status")
        self._events: queue.SimpleQueue[ModemEvent | None] = queue.SimpleQueue()
        self._unsaved: list[Callable[[VehicleEndpoint], None]] = []  # changes that are not committed yet
        self._packet_id: int | None = None  # the packet that the modem is sending
        self._offered: tuple[bytes, ...] = ()  # frames for the next poll
        self._retry_at_s = 0.0
        self._previous_end_s: float | None = None
        self._packet_s: dict[int, float] = {}  # measured duration of a packet by rate
        self._packets = 0
        self._link_error = ""
        self._published_at_s: float | None = None
        self._published_images = (0, 0)

    def _new_endpoint(self) -> VehicleEndpoint:
        authenticator = None
        if self.modem.key is not None:
            address = self.config.address
            authenticator = stored_authenticator(self.store, self.modem.key, address, Direction.FROM_VEHICLE)
        return VehicleEndpoint(
            self.platform.id,
            self.config,
            authenticator,
            first_block=self.store.origin[0],
            rejection_log=self._rejected_frames,
        )

    @override
    def on_start(self) -> None:
        """Open the port and start the link's thread."""
        # Before the port is opened: a subscriber that starts later asks for the transmissions it has missed.
        self.session.declare_queryable(keys.acoustic_transmissions(self.platform.id), self._reply_transmissions)
        if self.config.status_period_s:
            self.session.declare_subscriber(keys.vehicle_status(self.platform.id), self._on_status)
        self.modem.start()
        if self._is_polled:
            self.modem.set_poll_handler(self._answer_poll)
        self.start_thread(self._run_link, "link")

    @override
    def on_stop(self) -> None:
        """Close the port."""
        self.modem.stop()

    # Records of the vehicle's programs

    @override
    def consumed_keys(self) -> Mapping[str, type[Record]]:
        """Return encoded images of this vehicle, and with `v1` messages of its programs."""
        images: dict[str, type[Record]] = {keys.image_encoded(self.platform.id): EncodedImage}
        if self.config.link == "v1":
            images[keys.message_outgoing(self.platform.id)] = OutgoingMessage
        return images

    @override
    def validate(self, key: str, record: Record) -> None:
        """Refuse a record that the wire format cannot carry."""
        assert isinstance(record, (EncodedImage, OutgoingMessage))
        self._link.current.check(record)

    @override
    def check_capacity(self, key: str) -> None:
        """Leave records with their senders below the disk reserve, and messages while `max_messages` wait."""
        super().check_capacity(key)
        if key == keys.message_outgoing(self.platform.id) and not self._link.current.queue.accepts_messages:
            raise RetryLaterError(f"{key}: {self.config.max_messages} messages wait")

    @override
    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Add a record to the transmit queue."""
        assert isinstance(record, (EncodedImage, OutgoingMessage))
        self._link.current.add(record, time.time())

    def _on_status(self, sample: zenoh.Sample) -> None:
        """Keep the latest status of the vehicle; called in a thread of Zenoh."""
        if sample.kind != zenoh.SampleKind.PUT:
            return
        try:
            status = wire.decode(VehicleStatus, sample.payload.to_bytes(), str(sample.key_expr))
            self._beacon.set_status(status, time.monotonic())
        except BadInputError as error:
            self.count("statuses_ignored")
            self._malformed_statuses.log(reason=str(error))

    @override
    @contextmanager
    def handling(self, *, wait: bool = True) -> Iterator[bool]:
        """Enclose the handling in a step of the endpoint, and wake the link's thread."""
        with self._link.step(), super().handling(wait=wait) as is_held:
            yield is_held
        self._events.put(None)

    @override
    def further_effects(self) -> Sequence[UnitOfWork]:
        """Return the changes of the endpoint; called in its step."""
        return (self._link.current.take_effects(), self._link.changes())

    # Events of the modem

    def on_modem_event(self, event: ModemEvent) -> None:
        """Publish the start or end of a transmission, and pass the event to the link's thread."""
        now_utc_s = time.time()
        if self._transmissions.on_event(event, now_utc_s, time.monotonic()):
            record = self._transmissions.record(self.platform.id, now_utc_s)
            self.publish(keys.acoustic_transmissions(self.platform.id), record)
        if isinstance(event, (PacketSent, PacketFailed)) or self._events.qsize() < MAX_EVENTS:
            self._events.put(event)
        else:
            self.count("frames_dropped")

    def _reply_transmissions(self, query: zenoh.Query) -> None:
        """Reply with the latest transmissions; called in a thread of Zenoh."""
        record = self._transmissions.record(self.platform.id, time.time())
        query.reply(query.key_expr, wire.encode(record), encoding=wire.encoding_of(type(record)))

    def _answer_poll(self, poll: PollReceived) -> Sequence[bytes]:
        """Return the frames for another modem that polls this one; called in the modem's thread."""
        frames = self._offered[: poll.frames]
        if any(len(frame) > poll.frame_bytes for frame in frames):
            log.warning("Polled at a rate with shorter frames", extra=kv(rate=poll.rate, configured=self.config.rate))
            return ()
        return frames

    def _process_events(self, wait_s: float) -> None:
        try:
            self._process(self._events.get(timeout=max(_MIN_WAIT_S, min(wait_s, _MAX_WAIT_S))))
            while True:
                self._process(self._events.get_nowait())
        except queue.Empty:
            return

    def _process(self, event: ModemEvent | None) -> None:
        """Process an event, except for its changes of the endpoint, which `_advance` makes and commits."""
        now = time.time()
        match event:
            case PacketSent():
                self._packet_sent(event, now)
            case PacketFailed():
                self._packet_failed(event, now)
            case FrameDecoded():
                self._mac.channel_busy(now)
            case FrameReceived(dest=self.config.address, src=source, data=data):
                self._receive(lambda endpoint: endpoint.receive(source, data, now))
            case ShortMessageReceived(dest=self.config.address, src=source, bits=bits):
                self._receive(lambda endpoint: endpoint.receive_mini(source, bits, now))
            case _:
                pass

    def _receive(self, change: Callable[[VehicleEndpoint], None]) -> None:
        if len(self._unsaved) < MAX_UNSAVED:
            self._unsaved.append(change)
        else:
            self.count("frames_dropped")

    def _packet_sent(self, sent: PacketSent, now: float) -> None:
        if self._packet_id not in (None, sent.packet_id):
            return
        self._packet_id = None
        self._offered = ()
        packet_s = max(0.0, sent.finished_s - sent.started_s)
        self._packet_s[sent.rate] = packet_s
        self._mac.sent(now - packet_s, now)
        interval_s = packet_s if self._previous_end_s is None else now - self._previous_end_s
        self._previous_end_s = now
        self._unsaved.append(lambda endpoint: endpoint.packet_sent(sent.frames, interval_s))
        self._publish_packet(sent, now)

    def _packet_failed(self, failed: PacketFailed, now: float) -> None:
        if self._packet_id not in (None, failed.packet_id):
            return
        self._packet_id = None
        self._retry_at_s = now + self.config.retry_s
        self.count("packets_failed")
        self._failed_packets.log(reason=str(failed.reason), maybe_sent=failed.maybe_sent)

    # The link's thread

    def _run_link(self) -> None:
        wait_s = 0.0
        while not self.stopping.is_set():
            self._process_events(wait_s)
            error = ""
            try:
                now = time.time()
                wait_s = self._advance(now)
                self._publish_queue_state(now)
            except (DeliveryError, BadInputError) as failure:
                # Nothing is sent until the changes are committed.
                error = str(failure)
                if error != self._link_error:
                    log.error("Link cannot send", extra=kv(reason=error))
                self.stopping.wait(SAVE_AGAIN_S)
            self._link_error = error

    def _advance(self, now: float) -> float:
        """Change the endpoint by the events, choose the next packet, commit both together, and send the packet.

        An event that cannot be processed is left out.

        Args:
            now: UTC in seconds.

        Returns:
            Time until the next packet, in seconds.

        Raises:
            DeliveryError: The store cannot be written; the next call repeats the changes.
            FrameError: Authentication has no counters left.
        """
        try:
            return self._step(self._unsaved, now)
        except DeliveryError:
            raise
        except Exception:
            # The step has no effect: its events are processed one by one, without a packet.
            if not self._process_each_alone():
                raise
        return 0.0

    def _process_each_alone(self) -> int:
        """Change the endpoint by the events, one by one, and commit; return the number of those that are left out."""
        failed = 0
        while self._unsaved:
            try:
                with self._link.step() as endpoint:
                    self._unsaved[0](endpoint)
                    self.commit(UnitOfWork())
            except DeliveryError:
                raise
            except Exception:
                log.exception("Event of the modem left out")
                self.count("frames_failed")
                failed += 1
            del self._unsaved[0]
        return failed

    def _step(self, changes: Sequence[Callable[[VehicleEndpoint], None]], now: float) -> float:
        with self._link.step() as endpoint:
            for change in changes:
                change(endpoint)
            has_status = self._beacon.is_due(now)
            if has_status:
                self._queue_status(endpoint, now)
            wait_s = self._wait_s(endpoint, now)
            packet = None
            if wait_s is None:
                reserve_counters(self.store, endpoint.authenticator)
                packet = endpoint.next_packet(now)
                self._previous_end_s = None if packet is None else self._previous_end_s
            if endpoint.changed:
                self.commit(UnitOfWork())
            self._unsaved.clear()
            if has_status:
                self._beacon.queued(now)
                self.count("statuses_queued")
            if packet is not None:
                self._transmit(packet)
        return _MAX_WAIT_S if wait_s is None else wait_s

    def _queue_status(self, endpoint: VehicleEndpoint, now: float) -> None:
        disk_free_bytes = disk_gauges(self.platform.state_dir).get("disk_free_bytes")
        free_bytes = None if disk_free_bytes is None else int(disk_free_bytes)
        status = self._beacon.message(now, endpoint.queue.images_waiting, free_bytes)
        endpoint.add_status(status, now, self.config.status_period_s)

    def _wait_s(self, endpoint: VehicleEndpoint, now: float) -> float | None:
        """Return the time until a packet can be sent; None if it can be sent, or offered for a poll, now."""
        if self._packet_id is not None:
            return _MAX_WAIT_S
        packet = endpoint.queue.in_flight
        rate = packet.rate if packet else endpoint.queue.rate
        mac_wait_s = self._mac.wait_s(self._packet_s.get(rate, self.config.rate_info(rate).airtime_s), now)
        retry_wait_s = self._retry_at_s - now
        if retry_wait_s > self.config.retry_s:
            retry_wait_s = 0.0  # the clock was set back
        wait_s = max(mac_wait_s or 0.0, retry_wait_s)
        if wait_s > 0:
            return wait_s
        return None if mac_wait_s is None or self.modem.ready else _MAX_WAIT_S

    def _transmit(self, packet: OutgoingPacket) -> None:
        if self._is_polled:
            self._offered = packet.frames
        else:
            self._packet_id = self.modem.send_packet(self.config.destination, packet.rate, packet.frames)

    # Publications and health

    def _publish_packet(self, sent: PacketSent, now: float) -> None:
        self._packets += 1
        self.count("packets_sent")
        self.count("frames_sent", len(sent.frames))
        for frame in sent_frames(self.platform.id, self.config, sent, self._packets, now):
            self.publish(keys.acoustic_tx(self.platform.id), frame)

    def _publish_queue_state(self, now: float) -> None:
        """Publish the state of the queue if it is due.

        Raises:
            DeliveryError: The state cannot be reloaded after a failed commit.
        """
        images = (self._link.current.images_accepted, self._link.current.queue.images_waiting)
        interval_s = self.config.queue_interval_s
        if images != self._published_images:
            interval_s = min(interval_s, _STATE_INTERVAL_S)
        if self._published_at_s is None or not 0 <= now - self._published_at_s < interval_s:
            self._published_at_s, self._published_images = now, images
            with self._link.step() as endpoint:
                record = endpoint.queue_state(now)
            self.publish(keys.acoustic_queue(self.platform.id), record)

    @override
    def gauges(self) -> Mapping[str, float]:
        """Return the state of the modem, of the transmit queue and of the key."""
        endpoint = self._link.current
        authenticator = endpoint.authenticator
        key = {} if authenticator is None else {"key_frames_left": float(authenticator.frames_left)}
        return {**self.modem.gauges(), **endpoint.queue.gauges(), **key}

    @override
    def warning(self) -> str:
        """Return what concerns the key of the link, and what the modem reports wrongly."""
        texts = (self.modem.warning(), key_warning(self._link.current.authenticator))
        return "; ".join(text for text in texts if text)

    @override
    def degraded_reason(self) -> str:
        """Return why the port, the modem or the link does not work."""
        return self.modem.degraded_reason() or self._link_error
