"""Transmissions of the vessel: medium access, distances by ping, and the packets with commands and feedback."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterable, Sequence
from typing import Final

from sonarpost import keys
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.errors import DeliveryError, FrameError
from sonarpost.link.downlink.commands import PendingCommand
from sonarpost.link.downlink.vessel_endpoint import DownlinkPacket
from sonarpost.logs import kv
from sonarpost.messages import VehicleRange
from sonarpost.modem.interface import PacketFailed, PacketSent, RangeMeasured, RequestDone, RequestFailed
from sonarpost.runtime.modem_service import ServiceModem, sent_frames
from sonarpost.runtime.saved_endpoint import SavedEndpoint, reserve_counters
from sonarpost.runtime.service import Service
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.vessel_endpoint import VesselLink

log = logging.getLogger(__name__)

MAX_TRAVEL_S: Final = 100.0
_PING_TIMEOUT_S: Final = 120.0
"""Time after which a ping counts as failed although the driver has not reported its end."""
_PACKET_MARGIN_S = 1.0
_WAIT_AFTER_FAILURE_S = 2.0


class TransmitGate:
    """Decides when the vessel may transmit, by its medium access control. `now_s` is monotonic time in seconds.

    Modems are half-duplex: each sent packet can cost a received one.

    Args:
        config: Configuration of op_modem.
    """

    def __init__(self, config: OpModemConfig) -> None:
        self._config = config
        self._mac = config.new_mac()
        self._pending_since_s: float | None = None
        self._not_before_s = self._polled_s = -math.inf
        self._next_vehicle = 0

    def frame_received(self, now_s: float) -> None:
        """Record that a frame was received."""
        self._mac.channel_busy(now_s)

    def failed(self, now_s: float) -> None:
        """Record that the modem failed to send."""
        self._not_before_s = now_s + _WAIT_AFTER_FAILURE_S

    def may_transmit(self, now_s: float, utc_s: float, *, receiving: bool, pending: bool) -> bool:
        """Return whether a packet may be sent now; with "csma", `max_defer_s` limits the wait for a free channel.

        Args:
            now_s: Monotonic time.
            utc_s: UTC in seconds, for TDMA.
            receiving: Whether a packet is being received.
            pending: Whether a packet is pending.
        """
        if not pending:
            self._pending_since_s = None
            return False
        if self._pending_since_s is None:
            self._pending_since_s = now_s
        if self.is_free(now_s, utc_s, receiving=receiving):
            return True
        is_late = self._config.mac == "csma" and now_s - self._pending_since_s >= self._config.max_defer_s
        return is_late and not receiving and now_s >= self._not_before_s

    def is_free(self, now_s: float, utc_s: float, *, receiving: bool) -> bool:
        """Return whether the vessel may transmit now without a wait that is limited by `max_defer_s`.

        Args:
            now_s: Monotonic time.
            utc_s: UTC in seconds, for TDMA.
            receiving: Whether a packet is being received.
        """
        if receiving or now_s < self._not_before_s:
            return False
        time_s = utc_s if self._config.mac == "tdma" else now_s
        packet_s = self._config.rate_info(self._config.downlink_rate).airtime_s
        # The margin covers the start of the modem; a slot that is too short for it is used without.
        wait_s = self._mac.wait_s(packet_s + _PACKET_MARGIN_S, time_s)
        return (self._mac.wait_s(packet_s, time_s) if wait_s is None else wait_s) == 0.0

    def vehicle_to_poll(self, now_s: float, addresses: Sequence[int]) -> int | None:
        """Return the modem address to poll now, None for none."""
        if self._config.mac != "polled" or not addresses or now_s - self._polled_s < self._config.poll_interval_s:
            return None
        self._polled_s = now_s
        address = addresses[self._next_vehicle % len(addresses)]
        self._next_vehicle += 1
        return address


class Ranging:
    """Decides which vehicle is pinged, and accepts answers to pings in progress only. Not thread-safe.

    Args:
        vessel_id: Name of the vessel in records.
        config: Configuration of op_modem; without `ranging_period_s` no vehicle is pinged.
    """

    def __init__(self, vessel_id: str, config: OpModemConfig) -> None:
        self._vessel_id = vessel_id
        self._config = config
        self._addresses = sorted(int(address) for address in config.vehicles)
        self._next = 0
        self._started_s = -math.inf
        self._pinged: tuple[int, int] | None = None  # request and modem address

    @property
    def in_progress(self) -> bool:
        """Whether an answer is awaited."""
        return self._pinged is not None

    def due_address(self, now_s: float) -> int | None:
        """Return the modem address to ping, None for none; `now_s` is monotonic."""
        if self._pinged is not None and now_s - self._started_s >= _PING_TIMEOUT_S:
            self._pinged = None
        is_due = self._config.ranging_period_s and now_s - self._started_s >= self._config.ranging_period_s
        if not is_due or self._pinged is not None or not self._addresses:
            return None
        return self._addresses[self._next % len(self._addresses)]

    def started(self, request_id: int, address: int, now_s: float) -> None:
        """Record that a ping was queued."""
        self._pinged, self._started_s = (request_id, address), now_s
        self._next += 1

    def ended(self, event: RequestDone | RequestFailed) -> bool:
        """Record the end of a request; return whether it was the ping in progress."""
        if self._pinged is None or self._pinged[0] != event.request_id:
            return False
        self._pinged = None
        return True

    def measured(self, event: RangeMeasured, now: float) -> VehicleRange | None:
        """Return the record of an answer; None if it answers no ping in progress, or has no travel time.

        Args:
            event: The answer.
            now: UTC in seconds.
        """
        if self._pinged is None or (event.src, event.dest) != (self._pinged[1], self._config.address):
            return None
        if event.travel_s is None or not 0 <= event.travel_s <= MAX_TRAVEL_S:
            return None
        speed_mps = self._config.sound_speed_mps
        return VehicleRange(
            vessel_id=self._vessel_id,
            vehicle_id=self._config.name_of(event.src),
            measured_utc_s=now,
            travel_s=event.travel_s,
            sound_speed_mps=speed_mps,
            distance_m=round(event.travel_s * speed_mps, 2),
        )


class VesselTransmitter:
    """Sends commands and feedback to the vehicles, polls and pings them, when the channel is free.

    The state that follows from a packet is committed before it is sent, so that nothing is transmitted again and again
    while the disk is full, and once more when the modem has sent it.

    Attributes:
        error: Why no packet can be sent; empty if the last one could.

    Args:
        service: Commits, publishes and counts.
        link: The endpoint.
        modem: The modem.
    """

    def __init__(self, service: Service[OpModemConfig], link: SavedEndpoint[VesselLink], modem: ServiceModem) -> None:
        self._service = service
        self._config = service.config
        self._vessel_id = service.platform.id
        self._link = link
        self._modem = modem
        self._gate = TransmitGate(self._config)
        self._ranging = Ranging(self._vessel_id, self._config)
        self._is_packet_arriving = False
        self._in_flight: tuple[int, DownlinkPacket] | None = None
        self.error = ""

    @property
    def has_feedback_in_flight(self) -> bool:
        """Whether the packet that is being sent has feedback."""
        return self._in_flight is not None and self._in_flight[1].has_feedback

    def frame_received(self, *, ends_packet: bool) -> None:
        """Record that a frame was received: the channel is busy until the end of its packet."""
        self._gate.frame_received(time.monotonic())
        self._is_packet_arriving = not ends_packet

    def transmit(self) -> None:
        """Close expired commands, and send a packet or a poll if one is due and the channel is free."""
        if not self._config.transmits:
            return
        error = ""
        try:
            self._expire_commands()
            self._send_if_due()
        except (OSError, DeliveryError) as caught:
            error = f"{type(caught).__name__}: {caught}"
        except FrameError as caught:
            # The key is used up, or a command is too long for a downlink_rate that was lowered later.
            error = str(caught)
            if error != self.error:
                log.error("Packet cannot be built", extra=kv(reason=error))
        if error:
            self._gate.failed(time.monotonic())
        self.error = error

    def _expire_commands(self) -> None:
        now = time.time()
        with self._link.step() as link:
            expired = link.commands.expire(now)
            if expired:
                effects = UnitOfWork()
                effects.count("commands_expired", len(expired))
                self._service.commit(effects)
        self.publish_states(expired)

    def _send_if_due(self) -> None:
        if self._in_flight is not None or not self._modem.ready or self._modem.queued:
            return
        if self._ranging.in_progress and self._ranging.due_address(time.monotonic()) is None:
            return
        with self._link.step() as link:
            # Read with the lock held: a frame that arrived while it was waited for makes the channel busy.
            now_s, now = time.monotonic(), time.time()
            receiving = self._modem.receiving or self._is_packet_arriving
            pending = link.endpoint.due_address(now) is not None
            if self._gate.may_transmit(now_s, now, receiving=receiving, pending=pending):
                self._send(link, now)
            elif not pending and not receiving and not self._ping_vehicle(now_s, now):
                self._poll_vehicle(now_s)

    def _send(self, link: VesselLink, now: float) -> None:
        rate = self._config.rate_info(self._config.downlink_rate)
        reserve_counters(self._service.store, link.authenticator)
        packet = link.endpoint.next_packet(rate.frames, rate.frame_bytes, now)
        if packet is not None:
            self._service.commit(UnitOfWork())
            packet_id = self._modem.send_packet(packet.address, rate.number, packet.frames)
            self._in_flight = (packet_id, packet)

    def _poll_vehicle(self, now_s: float) -> None:
        address = self._gate.vehicle_to_poll(now_s, sorted(int(address) for address in self._config.vehicles))
        if address is not None:
            self._modem.request_packet(
                address, self._config.poll_rate, self._config.rate_info(self._config.poll_rate).frames
            )
            self._service.count("polls_sent")

    def _ping_vehicle(self, now_s: float, now: float) -> bool:
        """Ping a vehicle if one is due and the channel is free; return whether a ping was sent."""
        address = self._ranging.due_address(now_s)
        if address is None or not self._gate.is_free(now_s, now, receiving=False):
            return False
        request_id = self._modem.request(lambda driver, at_s: driver.ping(address, at_s))
        self._ranging.started(request_id, address, now_s)
        self._service.count("pings_sent")
        return True

    def range_event(self, event: RangeMeasured | RequestDone | RequestFailed) -> None:
        """Publish a measured distance, or record the end of a ping."""
        with self._link.lock:
            if not isinstance(event, RangeMeasured):
                if self._ranging.ended(event) and isinstance(event, RequestFailed):
                    self._service.count("pings_failed")
                return
            record = self._ranging.measured(event, time.time())
        if record is None:
            self._service.count("ranges_ignored")
            return
        self._service.count("ranges_measured")
        self._service.publish(keys.acoustic_range(self._vessel_id), record)

    def packet_ended(self, event: PacketSent | PacketFailed) -> None:
        """Record that the modem has sent a packet, or failed to."""
        now = time.time()
        with self._link.lock:
            if self._in_flight is None or self._in_flight[0] != event.packet_id:
                return
            packet = self._in_flight[1]
            self._in_flight = None
            if isinstance(event, PacketFailed):
                self._link.current.endpoint.failed(packet)
                self._gate.failed(time.monotonic())
                self._service.count("packets_failed")
                log.warning("Packet not sent", extra=kv(destination=packet.address, reason=event.reason))
                return
            changed = self._commit_sent(packet, now)
        for record in sent_frames(self._vessel_id, self._config, event, event.packet_id, now):
            self._service.publish(keys.acoustic_tx(self._vessel_id), record)
        self.publish_states(changed)

    def _commit_sent(self, packet: DownlinkPacket, now: float) -> tuple[PendingCommand, ...]:
        changed: tuple[PendingCommand, ...] = ()
        effects = UnitOfWork()
        effects.count("packets_sent")
        effects.count("feedback_sent", int(packet.has_feedback))
        try:
            with self._link.step() as link:
                changed = link.endpoint.sent(packet, now)
                self._service.commit(effects)
        except DeliveryError as error:
            log.warning("Sent packet not committed", extra=kv(error=str(error)))
        return changed

    def publish_states(self, commands: Iterable[PendingCommand]) -> None:
        """Publish and log the states of commands."""
        now = time.time()
        for command in commands:
            record = self._link.current.state_record(command, now)
            self._service.publish(keys.acoustic_downlink(self._vessel_id), record)
            fields = kv(vehicle=command.vehicle, kind=command.kind, record_id=command.record_id, state=record.state)
            log.info("Command state changed", extra=fields)
