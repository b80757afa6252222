"""Downlink of op_modem: commands and feedback for vehicles, and the saved state of the link endpoint."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager

from typing_extensions import override

from sonarpost import keys
from sonarpost.config import PlatformConfig
from sonarpost.delivery.records import InboxItem
from sonarpost.errors import DeliveryError, FrameError, PayloadError
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import Direction
from sonarpost.link.auth.merging import FrameMerger
from sonarpost.link.downlink.commands import PendingCommand
from sonarpost.link.downlink.vessel_endpoint import DownlinkPacket
from sonarpost.link.state import SavedParts
from sonarpost.logs import kv
from sonarpost.messages import Command, Decision, Record
from sonarpost.modem.interface import (
    FrameReceived,
    PacketFailed,
    PacketSent,
    RangeMeasured,
    RequestDone,
    RequestFailed,
)
from sonarpost.runtime.modem_service import ModemService, sent_frames
from sonarpost.runtime.service import UnitOfWork
from sonarpost.security.acoustic_key import key_warning
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.ranging import Ranging
from sonarpost.services.op_modem.transmit_gate import TransmitGate
from sonarpost.services.op_modem.vessel_endpoint import VesselLink

log = logging.getLogger(__name__)

_PARTS = "vehicle/"
_COUNTER_LIMIT = "counter-limit/"
_AUTHENTICATED_SINCE = "authenticated-since"
_UNFINISHED_BLOCKS = ("link/v1/block", "link/v1/rival")


class DownlinkService(ModemService[OpModemConfig]):
    """Sends commands and feedback to vehicles; `OpModemService` adds the reception.

    Several threads use the link endpoint: the one with `_link_lock`. After a failed commit the endpoint in memory is
    ahead of the disk; the next step then begins with the last committed state.

    Raises:
        ConfigError: As `ModemService`, or no wire format remains that is authenticated.
    """

    def __init__(self, platform: PlatformConfig, config: OpModemConfig) -> None:
        # Before the store is opened, so that a configuration error leaves no open store.
        config.check_with(platform)
        super().__init__(platform, config)
        self._authenticated_since_s = self._begin_authentication()
        self._partial_packet: list[FrameReceived] = []
        self._gate = TransmitGate(self.config)
        self._ranging = Ranging(platform.id, self.config)
        self._link_lock = threading.RLock()
        self._link = self._new_link()
        self._saved_parts = SavedParts({})
        self._is_committed = False
        self._in_flight: tuple[int, DownlinkPacket] | None = None
        self._transmit_error = ""
        self._new_commands: list[PendingCommand] = []

    def _new_link(self) -> VesselLink:
        authenticator, merger = None, None
        if self.key is not None:
            limit = int(self.store.get_state(_COUNTER_LIMIT + self.key.fingerprint) or b"0")
            address = self.config.address
            authenticator = FrameAuthenticator(self.key, address, Direction.TO_VEHICLE, first_counter=limit)
            if self.config.other_vessels:
                verifiers = {
                    vessel: FrameAuthenticator(self.key, address, Direction.TO_VEHICLE)
                    for vessel in self.config.other_vessels
                }
                merger = FrameMerger(authenticator, verifiers)
        return VesselLink(self.platform.id, self.config, authenticator, self._authenticated_since_s, merger)

    def _begin_authentication(self) -> float:
        """Return the time from which on the store holds content of authenticated frames only, UTC in seconds.

        When authentication is switched on, the symbols of unfinished blocks are deleted: together with later frames
        they would make images of which a part is not authenticated. Images that have begun are kept; their records say
        that they are not authenticated.
        """
        saved_s = self.store.read_state(_AUTHENTICATED_SINCE, float, None)
        if self.key is not None and saved_s is not None:
            return saved_s
        with self.store.transaction() as tx:
            if self.key is None:
                tx.delete_state(_AUTHENTICATED_SINCE)
                return 0.0
            names = self.store.state_names(_PARTS)
            since_s = time.time() if names else 0.0
            for name in names if since_s else ():
                if name.removeprefix(_PARTS).startswith(_UNFINISHED_BLOCKS):
                    tx.delete_state(name)
            tx.put_state(_AUTHENTICATED_SINCE, str(since_s).encode())
        return since_s

    # Commands

    @override
    def consumed_keys(self) -> Mapping[str, type[Record]]:
        """Return commands and decisions for vehicles; nothing if the vessel does not transmit."""
        if not self.config.transmits:
            return {}
        return {keys.command_all(self.platform.id): Command, keys.contact_decision(self.platform.id): Decision}

    @override
    def validate(self, key: str, record: Record) -> None:
        """Reject a record that can never be sent."""
        assert isinstance(record, (Command, Decision))
        if isinstance(record, Command) and key != keys.command(self.platform.id, record.kind):
            raise PayloadError(key, "kind", record.kind, "the kind in the key")
        if isinstance(record, Decision) and record.vessel_id != self.platform.id:
            raise PayloadError(key, "vessel_id", record.vessel_id, self.platform.id)
        # Without the lock: this runs inside a transaction, and the holder of the lock may be waiting for one.
        self._link.check(record, key)

    @override
    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Add a command or a decision; a repeated one changes nothing."""
        assert isinstance(record, (Command, Decision))
        self._load()
        command = self._link.add(record, time.time())
        if command is None:
            effects.count("commands_repeated")
            return
        effects.count("commands_received")
        self._save_state(effects)
        self._new_commands.append(command)

    @override
    @contextmanager
    def handling(self, *, wait: bool = True) -> Iterator[bool]:
        """Hold the lock of the endpoint too; then publish the states of the commands."""
        with self._link_lock, super().handling(wait=wait) as is_held:
            self._new_commands.clear()
            yield is_held
            added = tuple(self._new_commands)
        self._publish_states(added)

    # State of the endpoint

    @override
    def commit_batch(self, handled: Sequence[tuple[UnitOfWork, InboxItem | None]]) -> int:
        """Commit effects; then the endpoint has the committed state."""
        with self._link_lock:
            superseded = super().commit_batch(handled)
            self._is_committed = True
        return superseded

    @contextmanager
    def _link_step(self) -> Iterator[VesselLink]:
        """Lock the endpoint for a step that ends with a commit."""
        with self._link_lock:
            self._load()
            yield self._link

    def _load(self) -> None:
        """Restore the last committed state if the endpoint may be ahead of it; requires the lock."""
        if not self._is_committed:
            self._link = self._new_link()
            parts = self.store.states(_PARTS)
            self._saved_parts = SavedParts(parts)
            errors = self._link.restore(parts)
            if errors:
                with self.store.transaction() as tx:
                    for name, reason in errors.items():
                        tx.discard_state(_PARTS + name, parts.get(name, b""), str(reason))
        self._is_committed = False

    def _save_state(self, effects: UnitOfWork) -> None:
        """Add the changed parts of the endpoint's state to a unit of work."""
        parts = self._link.parts()
        effects.put_states(_PARTS, self._saved_parts.changes(parts))
        self._saved_parts.commit(parts)

    # Transmission

    def publish_open_commands(self) -> None:
        """Publish the state of the open commands after a start."""
        with self._link_step() as link:
            open_commands = link.commands.open_commands
            self._is_committed = True
        if self.config.transmits:
            self._publish_states(open_commands)

    def transmit(self) -> None:
        """Close expired commands, and send a packet or a poll if one is due and the channel is free."""
        if not self.config.transmits:
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
            if error != self._transmit_error:
                log.error("Packet cannot be built", extra=kv(reason=error))
        if error:
            self._gate.failed(time.monotonic())
        self._transmit_error = error

    def _expire_commands(self) -> None:
        now = time.time()
        with self._link_lock:
            if all(command.expires_s > now for command in self._link.commands.open_commands):
                return
            with self._link_step() as link:
                expired = link.commands.expire(now)
                effects = UnitOfWork()
                effects.count("commands_expired", len(expired))
                self._save_state(effects)
                self.commit(effects)
        self._publish_states(expired)

    def _send_if_due(self) -> None:
        if self._in_flight is not None or not self.modem.ready or self.modem.queued:
            return
        if self._ranging.in_progress and self._ranging.due_address(time.monotonic()) is None:
            return
        now_s, now = time.monotonic(), time.time()
        receiving = self.modem.receiving or bool(self._partial_packet)
        with self._link_lock:
            pending = self._link.endpoint.due_address(now) is not None
            if self._gate.may_transmit(now_s, now, receiving=receiving, pending=pending):
                self._send(now)
            elif not pending and not receiving and not self._ping_vehicle(now_s, now):
                self._poll_vehicle(now_s)

    def _send(self, now: float) -> None:
        """Build the next packet, commit the state that follows from it, and send it; requires the lock."""
        rate = self.config.rate_info(self.config.downlink_rate)
        with self._link_step() as link:
            self._reserve_counters(link.authenticator)
            packet = link.endpoint.next_packet(rate.frames, rate.frame_bytes, now)
            effects = UnitOfWork()
            self._save_state(effects)
            self.commit(effects)
            if packet is not None:
                packet_id = self.modem.send_packet(packet.address, rate.number, packet.frames)
                self._in_flight = (packet_id, packet)

    def _reserve_counters(self, authenticator: FrameAuthenticator | None) -> None:
        """Store the limit of the authentication counters before they are used."""
        if authenticator is None or self.key is None or (limit := authenticator.requested_limit) is None:
            return
        with self.store.transaction() as tx:
            tx.put_state(_COUNTER_LIMIT + self.key.fingerprint, str(limit).encode())
        authenticator.grant(limit)

    def _poll_vehicle(self, now_s: float) -> None:
        address = self._gate.vehicle_to_poll(now_s, sorted(int(address) for address in self.config.vehicles))
        if address is not None:
            self.modem.request_packet(
                address, self.config.poll_rate, self.config.rate_info(self.config.poll_rate).frames
            )
            self.count("polls_sent")

    def _ping_vehicle(self, now_s: float, now: float) -> bool:
        """Ping a vehicle if one is due and the channel is free; return whether a ping was sent."""
        address = self._ranging.due_address(now_s)
        if address is None or not self._gate.is_free(now_s, now, receiving=False):
            return False
        request_id = self.modem.request(lambda driver, at_s: driver.ping(address, at_s))
        self._ranging.started(request_id, address, now_s)
        self.count("pings_sent")
        return True

    def range_event(self, event: RangeMeasured | RequestDone | RequestFailed) -> None:
        """Publish a measured distance, or record the end of a ping."""
        with self._link_lock:
            if not isinstance(event, RangeMeasured):
                if self._ranging.ended(event) and isinstance(event, RequestFailed):
                    self.count("pings_failed")
                return
            record = self._ranging.measured(event, time.time())
        if record is None:
            self.count("ranges_ignored")
            return
        self.count("ranges_measured")
        self.publish(keys.acoustic_range(self.platform.id), record)

    def packet_ended(self, event: PacketSent | PacketFailed) -> None:
        """Record that the modem has sent a packet, or failed to."""
        now = time.time()
        with self._link_lock:
            if self._in_flight is None or self._in_flight[0] != event.packet_id:
                return
            packet = self._in_flight[1]
            self._in_flight = None
            if isinstance(event, PacketFailed):
                self._link.endpoint.failed(packet)
                self._gate.failed(time.monotonic())
                self.count("packets_failed")
                log.warning("Packet not sent", extra=kv(destination=packet.address, reason=event.reason))
                return
            changed = self._commit_sent(packet, now)
        for record in sent_frames(self.platform.id, self.config, event, event.packet_id, now):
            self.publish(keys.acoustic_tx(self.platform.id), record)
        self._publish_states(changed)

    def _commit_sent(self, packet: DownlinkPacket, now: float) -> tuple[PendingCommand, ...]:
        with self._link_step() as link:
            changed = link.endpoint.sent(packet, now)
            effects = UnitOfWork()
            effects.count("packets_sent")
            effects.count("feedback_sent", int(packet.has_feedback))
            self._save_state(effects)
            try:
                self.commit(effects)
            except DeliveryError as error:
                # The packet is sent again; the vehicle recognises a repeated command by its token.
                log.warning("Sent packet not committed", extra=kv(error=str(error)))
        return changed

    # Publications and health

    def _publish_states(self, commands: Iterable[PendingCommand]) -> None:
        now = time.time()
        for command in commands:
            self.publish(keys.acoustic_downlink(self.platform.id), self._link.state_record(command, now))
            log.info(
                "Command state changed",
                extra=kv(
                    vehicle=command.vehicle, kind=command.kind, record_id=command.record_id, state=str(command.state)
                ),
            )

    def link_gauges(self) -> Mapping[str, float]:
        """Return the state of commands, images, feedback and authentication."""
        with self._link_lock:
            endpoint, authenticator = self._link.endpoint, self._link.authenticator
            feedback_in_flight = self._in_flight is not None and self._in_flight[1].has_feedback
            gauges = {
                "commands_open": float(len(self._link.commands.open_commands)),
                "feedback_open": float(max(endpoint.feedback_open, feedback_in_flight)),
                "images_incomplete": float(endpoint.incomplete_images),
                "images_waiting": float(endpoint.next_deadline() is not None),
                "images_held": float(self._link.limiter.held),
            }
            if authenticator is not None:
                counts = authenticator.counts
                gauges |= {"frames_forged": float(counts.forged), "frames_replayed": float(counts.replayed)}
                if self.config.other_vessels:
                    merged = endpoint.v1.counts
                    gauges |= {"frames_duplicate": float(merged.duplicates), "frames_late": float(merged.late)}
                gauges |= {"frames_genuine": float(counts.genuine), "key_frames_left": float(authenticator.frames_left)}
            return gauges

    @override
    def warning(self) -> str:
        """Return what concerns the key of the link, and which vehicles exceed their limits."""
        with self._link_lock:
            names = ", ".join(self._link.limiter.held_names)
        limits = f"images wait, max_images_per_hour or max_image_bytes_per_hour is reached: {names}" if names else ""
        parts = (super().warning(), key_warning(self._link.authenticator), limits)
        return "; ".join(text for text in parts if text)

    @override
    def degraded_reason(self) -> str:
        """Return why the port, the modem or the transmission does not work."""
        return super().degraded_reason() or self._transmit_error
