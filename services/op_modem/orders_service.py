"""The half of op_modem that speaks: orders and reports for the vehicles, and what is kept of them."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager

import zenoh

from sonarpost import keys, wire
from sonarpost.config import PlatformConfig
from sonarpost.delivery.records import InboxItem
from sonarpost.errors import DeliveryError, FrameError, PayloadError
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import Direction
from sonarpost.link.downlink.commands import PendingCommand
from sonarpost.link.downlink.vessel_endpoint import DownlinkPacket
from sonarpost.link.state import Parts, SavedParts
from sonarpost.logs import kv
from sonarpost.messages import AcousticFrame, Command, Decision, ReceivedMessage, Record
from sonarpost.modem.micromodem import RATES, FrameReceived, PacketFailed, PacketReceived, PacketSent
from sonarpost.runtime.modem_service import ModemService
from sonarpost.runtime.service import UnitOfWork
from sonarpost.security.acoustic_key import read_key
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.speaking import TransmitGate
from sonarpost.services.op_modem.station import VesselStation

log = logging.getLogger(__name__)

_STATION = "station"
"""The whole state, as version 0.1 kept it."""
_STATION_PARTS = "station/"
_SEAL_LIMIT = "seal-limit/"
TICK_S = 0.1
EVERYBODY = 127


class DownlinkService(ModemService[OpModemConfig]):
    """A vessel's modem service as far as it speaks; what it hears is told to it by its subclass.

    Raises:
        ConfigError: The key file cannot be read or is not the owner's alone.
    """

    def __init__(self, platform: PlatformConfig, config: OpModemConfig) -> None:
        # Before the store is opened: what is wrong with the configuration leaves nothing open behind it.
        self._key = None if platform.acoustic_key_file is None else read_key(platform.acoustic_key_file)
        super().__init__(platform, config)
        self._arriving: list[FrameReceived] = []
        self._turn = TransmitGate(config)
        self._speaks = config.link == "v1"
        # The station belongs to whoever holds this lock; `_in_step`: it is as it is on the disk.
        self._station_lock = threading.RLock()
        self._station = self._new_station()
        self._saved_parts = SavedParts({})
        self._in_step = False
        self._under_way: tuple[int, DownlinkPacket] | None = None
        self._link_problem = ""
        self._asked: list[PendingCommand] = []

    def begin_speaking(self) -> None:
        """Show what is still open, and speak from now on."""
        if not self._speaks:
            return
        with self._station_step() as station:
            still_open = station.book.open_commands
            self._in_step = True
        self._show(still_open, time.time())
        self.start_thread(self._speak, "speak")

    def _new_station(self) -> VesselStation:
        seal = None
        if self._key is not None:
            limit = int(self.store.get_state(_SEAL_LIMIT + self._key.fingerprint) or b"0")
            seal = FrameAuthenticator(self._key, self.config.address, Direction.TO_VEHICLE, first_counter=limit)
        return VesselStation(self.platform.id, self.config, seal)

    def consumed_keys(self) -> Mapping[str, type[Record]]:
        """Commands and decisions for vehicles; nothing where the vessel only listens."""
        if not self._speaks:
            return {}
        return {keys.command_all(self.platform.id): Command, keys.contact_decision(self.platform.id): Decision}

    def validate(self, key: str, record: Record) -> None:
        """Refuse what can never be sent, while its sender can still be told."""
        assert isinstance(record, (Command, Decision))
        if isinstance(record, Command) and key != keys.command(self.platform.id, record.kind):
            raise PayloadError(key, "kind", record.kind, "the kind in the key")
        if isinstance(record, Decision) and record.vessel_id != self.platform.id:
            raise PayloadError(key, "vessel_id", record.vessel_id, self.platform.id)
        # Without the lock: this is called within a transaction, and who holds the lock may be waiting for one.
        self._station.check(record, key)

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Take an order; the same record once more changes nothing."""
        assert isinstance(record, (Command, Decision))
        now = time.time()
        self._load()
        order = self._station.ask(record, now)
        if order is None:
            effects.count("orders_repeated")
            return
        effects.count("orders_taken")
        self._keep_station(effects)
        self._asked.append(order)

    def _handle_item(self, item: InboxItem) -> None:
        with self._station_lock:
            self._asked.clear()
            super()._handle_item(item)
            asked, now = tuple(self._asked), time.time()
        self._show(asked, now)

    def commit(self, effects: UnitOfWork, item: InboxItem | None = None) -> None:
        """Commit; only then does the station in memory stand for the one on the disk."""
        with self._station_lock:
            super().commit(effects, item)
            self._in_step = True

    def _load(self) -> None:
        """Go back to the last committed state when memory may be ahead of it. Needs the lock."""
        if not self._in_step:
            self._station = self._new_station()
            names = self.store.state_names(_STATION_PARTS)
            parts = {name.removeprefix(_STATION_PARTS): self.store.get_state(name) or b"" for name in names}
            self._saved_parts = SavedParts(parts)
            old = self.store.get_state(_STATION)
            self._restore(parts, old)
        self._in_step = False

    def _restore(self, parts: Parts, old: bytes | None) -> None:
        errors = self._station.restore(parts)
        if not parts and old is not None:
            try:
                self._station.restore_old(old)
            except FrameError as error:
                errors = {_STATION: error}
        for name, reason in errors.items():
            self.count("states_discarded")
            log.error("Discarding an unreadable part of the link state", extra=kv(part=name, reason=str(reason)))

    def _keep_station(self, effects: UnitOfWork) -> None:
        """Write the parts of the station that changed; a step that is not committed is followed by `_load`."""
        parts = self._station.parts()
        for name, data in self._saved_parts.changes(parts).items():
            if data is None:
                effects.delete_state(_STATION_PARTS + name)
            else:
                effects.put_state(_STATION_PARTS + name, data)
        effects.delete_state(_STATION)
        self._saved_parts.commit(parts)

    @contextmanager
    def _station_step(self) -> Iterator[VesselStation]:
        """Lend the station for a step that ends with a commit; where it does not, the next one begins from the disk."""
        with self._station_lock:
            self._load()
            yield self._station

    def _speak(self) -> None:
        while not self.stopping.wait(TICK_S):
            try:
                self._expire_orders()
                self._speak_once()
            except (OSError, DeliveryError) as error:
                self._link_problem = f"{type(error).__name__}: {error}"
                self._turn.failed(time.monotonic())
            except FrameError as error:
                # A seal whose key is used up, or an order too long for a lower rate after a change of configuration.
                if str(error) != self._link_problem:
                    log.error("Nothing can be sent to vehicles", extra=kv(reason=str(error)))
                self._link_problem = str(error)
                self._turn.failed(time.monotonic())
            else:
                self._link_problem = ""

    def _expire_orders(self) -> None:
        now = time.time()
        with self._station_lock:
            if all(order.expires_s > now for order in self._station.book.open_commands):
                return
            with self._station_step() as station:
                expired = station.book.expire(now)
                effects = UnitOfWork()
                effects.count("orders_expired", len(expired))
                self._keep_station(effects)
                self.commit(effects)
        self._show(expired, now)

    def _speak_once(self) -> None:
        if self._under_way is not None or not self.modem.ready or self.modem.queued:
            return
        now_s, now = time.monotonic(), time.time()
        receiving = self.modem.receiving or bool(self._arriving)
        with self._station_lock:
            wanted = self._station.link.due_address(now) is not None
            if self._turn.may_speak(now_s, now, receiving=receiving, wanted=wanted):
                self._send(now)
            elif not wanted and not receiving:
                self._poll(now_s)

    def _send(self, now: float) -> None:
        """Choose what to send, keep that it was chosen, and send it. Needs the lock."""
        rate = RATES[self.config.downlink_rate]
        with self._station_step() as station:
            self._reserve_counters(station)
            packet = station.link.next_packet(rate.frames, rate.frame_bytes, now)
            effects = UnitOfWork()
            self._keep_station(effects)
            self.commit(effects)
            if packet is not None:
                packet_id = self.modem.send_packet(packet.address, rate.number, packet.frames)
                self._under_way = (packet_id, packet)

    def _reserve_counters(self, station: VesselStation) -> None:
        """Make the counters of seals durable before they are used."""
        seal = station.seal
        if seal is None or self._key is None or (limit := seal.requested_limit) is None:
            return
        with self.store.transaction() as tx:
            tx.put_state(_SEAL_LIMIT + self._key.fingerprint, str(limit).encode())
        seal.grant(limit)

    def _poll(self, now_s: float) -> None:
        address = self._turn.vehicle_to_poll(now_s, sorted(int(address) for address in self.config.vehicles))
        if address is not None:
            self.modem.request_packet(address, self.config.poll_rate, RATES[self.config.poll_rate].frames)
            self.count("polls_sent")

    def _packet_is_over(self, event: PacketSent | PacketFailed) -> None:
        now = time.time()
        with self._station_lock:
            if self._under_way is None or self._under_way[0] != event.packet_id:
                return
            packet = self._under_way[1]
            self._under_way = None
            if isinstance(event, PacketFailed):
                self._station.link.failed(packet)
                self._turn.failed(time.monotonic())
                self.count("packets_failed")
                log.warning("Packet not sent", extra=kv(destination=packet.address, reason=event.reason))
                return
            changed = self._packet_was_sent(packet, now)
        self._show_frames(event, now)
        self._show(changed, now)

    def _packet_was_sent(self, packet: DownlinkPacket, now: float) -> tuple[PendingCommand, ...]:
        with self._station_step() as station:
            changed = station.link.sent(packet, now)
            effects = UnitOfWork()
            effects.count("packets_sent")
            effects.count("reports_sent", int(packet.has_feedback))
            self._keep_station(effects)
            try:
                self.commit(effects)
            except DeliveryError as error:
                # It was sent, and is sent again: the vehicle takes an order once.
                log.warning("What was sent is not on the disk", extra=kv(error=str(error)))
        return changed

    def _show(self, orders: Iterable[PendingCommand], now: float) -> None:
        """Publish how far orders have come."""
        for order in orders:
            state = self._station.state_of(order, now)
            self._publish(keys.acoustic_downlink(self.platform.id), state)
            log.info(
                "Order",
                extra=kv(vehicle=order.vehicle, kind=order.kind, record_id=order.record_id, state=str(order.state)),
            )

    def _show_frames(self, sent: PacketSent, now: float) -> None:
        key = keys.acoustic_tx(self.platform.id)
        for number, data in enumerate(sent.frames, start=1):
            record = AcousticFrame(
                direction="tx",
                platform_id=self.platform.id,
                time_utc_s=now,
                source=self.config.address,
                destination=sent.dest,
                rate=sent.rate,
                packet=sent.packet_id,
                frame_number=number,
                frame_count=len(sent.frames),
                data=data,
            )
            self._publish(key, record)

    def _publish(self, key: str, record: Record) -> None:
        """Show a record to whoever watches."""
        try:
            self.session.put(key, wire.encode(record), encoding=wire.encoding_of(type(record)))
        except zenoh.ZError as error:
            log.warning("Not published", extra=kv(key=key, error=str(error)))

    def _station_gauges(self) -> Mapping[str, float]:
        with self._station_lock:
            seal = self._station.seal
            gauges = {"orders_open": float(len(self._station.book.open_commands))}
            if seal is not None:
                counts = seal.counts
                gauges |= {"frames_forged": float(counts.forged), "frames_replayed": float(counts.replayed)}
                gauges |= {"frames_genuine": float(counts.genuine), "key_frames_left": float(seal.frames_left)}
            return gauges

    def degraded_reason(self) -> str:
        """Return what is wrong with the port, the modem, or what is to be sent."""
        return super().degraded_reason() or self._link_problem

    def _hear(self, packet: PacketReceived, heard_utc_s: float, effects: UnitOfWork) -> tuple[PendingCommand, ...]:
        """Give the station the frames that were for this vessel; return the orders that changed by them."""
        self._load()
        changed: list[PendingCommand] = []
        for frame in packet.frames:
            if frame.dest not in (self.config.address, EVERYBODY) or not 0 <= frame.src < EVERYBODY:
                continue
            heard = self._station.link.accept(frame.src, frame.data, heard_utc_s)
            changed += heard.commands
            effects.count("frames_foreign", len(heard.rejected))
            for data in heard.messages:
                self._take_message(frame.src, data, heard_utc_s, effects)
        self._keep_station(effects)
        return tuple(changed)

    def _take_message(self, source: int, data: bytes, heard_utc_s: float, effects: UnitOfWork) -> None:
        record = ReceivedMessage(
            vessel_id=self.platform.id,
            vehicle_id=self.config.name_of(source),
            received_utc_s=heard_utc_s,
            data=data,
        )
        effects.count("messages_received")
        key = keys.message_received(self.platform.id)
        for consumer in self.config.message_consumers:
            effects.send(key, consumer, record)
        if not self.config.message_consumers:
            self._publish(key, record)
