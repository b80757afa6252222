"""A console to learn on: simulated contacts arrive, requests and decisions travel, nothing leaves this process."""

from __future__ import annotations

import logging
import random
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

from sonarpost import keys, wire
from sonarpost.messages import (
    AcousticFrame,
    Advice,
    Command,
    Decision,
    DownlinkState,
    DownlinkStep,
    Health,
    LinkQuality,
    QueuedImage,
    QueueState,
    ReconstructedImage,
)
from sonarpost.modem.micromodem import RATES
from sonarpost.services.console.fleet import frame_event
from sonarpost.services.console.state import Board
from sonarpost.services.console.training.contacts import VEHICLES, Simulated, simulated_contacts, wider_image_id
from sonarpost.services.console.web.map_routes import fleet

log = logging.getLogger(__name__)

VESSEL = "training"
RATE = 1
SERVICES = ("op_modem", "decompressor", "relay", "console")
TICK_S = 0.5
BACKLOG_AT_ONCE = 40
ADVICE_EVERY = 5
KEPT = 300


@dataclass
class _Arriving:
    simulated: Simulated
    first_utc_s: float
    step: int = 0


@dataclass
class _Travelling:
    """A decision or a command on its way down; `steps` still to come, each with its time."""

    record: Decision | Command
    steps: list[tuple[float, DownlinkStep]] = field(default_factory=list)


class Training:
    """Feeds a board.

    Args:
        board: Of the console.
        contacts: How many there will be.
        seed: Source of every chance.
        interval_s: From one packet of a vehicle to the next.
    """

    def __init__(self, board: Board, contacts: int, seed: int = 1, interval_s: float = 6.0) -> None:
        self._board = board
        self._contacts = contacts
        self._interval_s = interval_s
        self._chance = random.Random(seed)  # noqa: S311  nothing secret comes of it
        self._source: Iterator[Simulated] = simulated_contacts(seed, time.time() - 3600.0)
        self._made = 0
        self._packet = 0
        self._arriving: list[_Arriving] = []
        self._kept: dict[str, _Arriving] = {}
        self._wider: dict[str, str] = {}
        self._travelling: list[_Travelling] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="training", daemon=True)

    def backlog(self, contacts: int) -> None:
        """Let some contacts have arrived before."""
        begun = time.time() - 30.0 * contacts
        records: list[ReconstructedImage] = []
        for number in range(contacts):
            simulated = next(self._source)
            self._made += 1
            first = begun + 30.0 * number
            steps = range(len(simulated.versions))
            self._keep(_Arriving(simulated, first, len(simulated.versions)))
            records += [simulated.record(VESSEL, step, first, first + 6.0 * step) for step in steps]
            if len(records) >= BACKLOG_AT_ONCE or number == contacts - 1 or self._stop.is_set():
                self._board.take_images(records)
                records.clear()
            if self._stop.is_set():
                return

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(timeout=5.0)

    def _run(self) -> None:
        next_packet_s = time.monotonic()
        while not self._stop.wait(TICK_S):
            now_s = time.monotonic()
            if now_s >= next_packet_s:
                next_packet_s = now_s + self._interval_s
                self.packet(time.time())
                self._tell_health(time.time())
            self.send(time.time())
            self.travel(time.time())
            self._board.hub.publish("fleet", fleet(self._board))

    # Up

    def packet(self, now_utc_s: float) -> None:
        """Let one packet of a vehicle come out of the water, with what it leads to."""
        if self._made < self._contacts and len(self._arriving) < 3:
            self._arriving.append(_Arriving(next(self._source), now_utc_s))
            self._made += 1
        self._packet += 1
        arriving = self._arriving[self._packet % len(self._arriving)] if self._arriving else None
        vehicle = arriving.simulated.contact.vehicle_id if arriving else self._chance.choice(VEHICLES)
        self._hear(vehicle, now_utc_s)
        self._tell_queues(now_utc_s)
        if arriving is None:
            return
        record = arriving.simulated.record(VESSEL, arriving.step, arriving.first_utc_s, now_utc_s)
        self._board.take_image(record)
        if self._packet % ADVICE_EVERY == ADVICE_EVERY - 2:
            self._board.take_advice(self._advice(record))
        arriving.step += 1
        if arriving.step == len(arriving.simulated.versions):
            self._arriving.remove(arriving)
            self._keep(arriving)

    def _keep(self, arrived: _Arriving) -> None:
        """Remember what may be asked for again; the vehicle forgets the oldest."""
        self._kept[arrived.simulated.image_id] = arrived
        while len(self._kept) > KEPT:
            del self._kept[next(iter(self._kept))]

    def _obey(self, command: Command, now_utc_s: float) -> None:
        """Send what a command asks for, as the vehicle would."""
        image_id = command.image_id or ""
        # What was widened before is given again.
        known = self._kept.get(self._wider.get(image_id, image_id) if command.kind == "wider" else image_id)
        if known is None or command.kind == "revisit":
            return
        if command.kind == "wider" and image_id not in self._wider:
            wide = known.simulated.wider(wider_image_id(len(self._wider)))
            if wide is not None:
                self._wider[image_id] = wide.image_id
                self._arriving.append(_Arriving(wide, now_utc_s))
            return
        more = known.simulated.more(refine=command.kind == "refine")
        self._arriving.append(_Arriving(more, known.first_utc_s, len(more.versions) - 1))

    def _advice(self, record: ReconstructedImage) -> Advice:
        """Return what an expert ashore would say of a picture that has just come."""
        sure = record.contact.atd_confidence if record.contact else None
        likely = sure is not None and sure > 1.1
        return Advice(
            advice_id=f"training-{self._packet}",
            vessel_id=VESSEL,
            vehicle_id=record.vehicle_id,
            image_id=record.image_id,
            image_version=record.version,
            verdict="mine_like" if likely else "unsure",
            confidence=0.7 if likely else 0.4,
            remark="Simulated: the shadow has a straight edge." if likely else "Simulated: wait for more of it.",
            author="ashore",
            advised_utc_s=record.last_frame_utc_s,
        )

    def _hear(self, vehicle: str, now_utc_s: float) -> None:
        bad = int(self._chance.random() < 0.15)
        quality = LinkQuality(
            snr_in_db=round(self._chance.gauss(14, 2), 1),
            snr_out_db=round(self._chance.gauss(9, 2), 1),
            frames=RATES[RATE].frames,
            bad_frames=bad,
        )
        frame = AcousticFrame(
            direction="rx",
            platform_id=VESSEL,
            time_utc_s=now_utc_s,
            source=3 + VEHICLES.index(vehicle),
            destination=1,
            rate=RATE,
            packet=self._packet,
            frame_number=1,
            frame_count=RATES[RATE].frames,
            data=bytes(RATES[RATE].frame_bytes),
            quality=quality,
        )
        self._board.fleet.hear(vehicle, frame)
        self._board.hub.publish("frame", frame_event(vehicle, frame))

    def _tell_queues(self, now_utc_s: float) -> None:
        for vehicle in VEHICLES:
            mine = [a for a in self._arriving if a.simulated.contact.vehicle_id == vehicle]
            images = tuple(
                QueuedImage(
                    image_id=waiting.simulated.image_id,
                    contact_id=waiting.simulated.contact.contact_id,
                    bytes_left=64 * (len(waiting.simulated.versions) - waiting.step),
                    preview_utc_s=None,
                    expected_utc_s=now_utc_s + self._interval_s * (place + 1),
                )
                for place, waiting in enumerate(mine)
            )
            self._board.fleet.take_queue(
                QueueState(
                    platform_id=vehicle,
                    time_utc_s=now_utc_s,
                    rate=RATE,
                    frame_loss=self._board.fleet.loss_of(vehicle),
                    packet_interval_s=self._interval_s,
                    messages_waiting=0,
                    message_bytes=0,
                    images_waiting=len(images),
                    images=images,
                )
            )

    def _tell_health(self, now_utc_s: float) -> None:
        for service in SERVICES:
            health = Health(
                platform_id=VESSEL,
                service=service,
                time_utc_s=now_utc_s,
                started_utc_s=now_utc_s,
                state="ok",
                detail="simulated, for training",
                counters={},
                gauges={},
            )
            self._board.fleet.services.take(keys.health(VESSEL, service), wire.encode(health), time.monotonic())

    # Down

    def send(self, now_utc_s: float) -> None:
        """Take what people decided and asked for, as relay and op_modem would."""
        for item in self._board.unsent():
            self._board.mark_sent(item)
            if isinstance(item.record, (Decision, Command)):
                for consumer in ("relay", "op_modem") if isinstance(item.record, Decision) else ("op_modem",):
                    self._board.settled(item.table, item.record_id, consumer, None)
                steps: list[tuple[float, DownlinkStep]] = [(now_utc_s + 4.0, "sent"), (now_utc_s + 10.0, "confirmed")]
                self._travelling.append(_Travelling(item.record, steps))

    def travel(self, now_utc_s: float) -> None:
        """Let decisions and commands come as far as they would by now."""
        self._board.all_ashore_before(now_utc_s - 3.0)
        for order in list(self._travelling):
            while order.steps and order.steps[0][0] <= now_utc_s:
                self._board.take_downlink(self._state(order.record, order.steps.pop(0)[1], now_utc_s))
            if not order.steps:
                self._travelling.remove(order)
                if isinstance(order.record, Command):
                    self._obey(order.record, now_utc_s)

    @staticmethod
    def _state(record: Decision | Command, step: DownlinkStep, now_utc_s: float) -> DownlinkState:
        return DownlinkState(
            vessel_id=VESSEL,
            vehicle_id=record.vehicle_id,
            kind="decision" if isinstance(record, Decision) else record.kind,
            record_id=record.decision_id if isinstance(record, Decision) else record.command_id,
            state=step,
            times_sent=1,
            expires_utc_s=now_utc_s + 3600.0,
            changed_utc_s=now_utc_s,
        )
