"""Moves packets of the v1 link between its state and the modem: one thread, everything saved before it is sent."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final

from sonarpost import wire
from sonarpost.errors import BadInputError, DeliveryError
from sonarpost.link.mac import MediumAccess
from sonarpost.logs import kv
from sonarpost.messages import EncodedImage, OutgoingMessage
from sonarpost.modem.micromodem import (
    RATES,
    FrameDecoded,
    FrameReceived,
    MiniPacketReceived,
    ModemEvent,
    PacketFailed,
    PacketSent,
    PollReceived,
)
from sonarpost.runtime.modem_runner import ModemRunner
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.line import VehicleEndpoint

log = logging.getLogger(__name__)

LONGEST_WAIT_S: Final = 0.2
_LEAST_WAIT_S: Final = 0.005
STATE_INTERVAL_S: Final = 0.2
"""Minimum time between two publications of the queue state when images are accepted or have gone."""
TAKEN = (PacketSent, PacketFailed, FrameReceived, FrameDecoded, MiniPacketReceived)
"""Events of the modem that the link acts on."""


class LineRunner:
    """Drives a `VehicleEndpoint` and a modem.

    Args:
        line: Used by nobody else while `run` runs, but for its `arrival_name` and `check`.
        modem: The modem.
        config: The service's.
        mac: When to send.
        stopping: Ends `run`.
        show: Called with each packet that has gone.
        tell: Called when the state of the queue is to be published.
        problem: Called with what keeps the link from working, or an empty text.
        count: Adds to a health counter.
    """

    def __init__(
        self,
        line: VehicleEndpoint,
        modem: ModemRunner,
        config: UuvModemConfig,
        mac: MediumAccess,
        stopping: threading.Event,
        *,
        show: Callable[[PacketSent], None],
        tell: Callable[[float], None],
        problem: Callable[[str], None],
        count: Callable[[str], None],
    ) -> None:
        self._line = line
        self._modem = modem
        self._config = config
        self._mac = mac
        self._stopping = stopping
        self._show = show
        self._tell = tell
        self._problem = problem
        self.count = count
        self._inputs: queue.SimpleQueue[ModemEvent | None] = queue.SimpleQueue()
        self._asked: int | None = None
        self._offered: tuple[bytes, ...] = ()
        self._changed = False
        self._retry_at = 0.0
        self._begun_at = 0.0
        self._ended_at: float | None = None
        self._packet_s: dict[int, float] = {}
        self._told_at: float | None = None
        self._told_images: tuple[int, int] = (0, 0)

    def take(self, event: ModemEvent | None) -> None:
        """Give an event of the modem, or None where records were accepted; from any thread."""
        self._inputs.put(event)

    def answer_poll(self, polled: PollReceived) -> Sequence[bytes]:
        """Return frames for another modem that asks for a packet; called in the modem's thread."""
        fitting = self._offered[: polled.frames]
        if any(len(frame) > polled.frame_bytes for frame in fitting):
            log.warning(
                "Polled at a rate with shorter frames", extra=kv(rate=polled.rate, configured=self._config.rate)
            )
            return ()
        return fitting

    def run(self) -> None:
        """Work until the service stops."""
        if self._config.mac == "polled":
            self._modem.set_poll_handler(self.answer_poll)
        wait_s = 0.0
        while not self._stopping.is_set():
            self._take_inputs(wait_s)
            try:
                wait_s = self._turn(time.time())
                self._problem("")
            except DeliveryError as error:
                # What has changed is in memory and is written with the next attempt; nothing is sent before.
                self._problem(str(error))
                wait_s = LONGEST_WAIT_S
            except BadInputError as error:
                self._problem(str(error))
                wait_s = LONGEST_WAIT_S

    def _take_inputs(self, wait_s: float) -> None:
        try:
            self._act(self._inputs.get(timeout=max(_LEAST_WAIT_S, min(wait_s, LONGEST_WAIT_S))))
            while True:
                self._act(self._inputs.get_nowait())
        except queue.Empty:
            return

    def _act(self, event: ModemEvent | None) -> None:
        now = time.time()
        match event:
            case PacketSent():
                self._packet_sent(event, now)
            case PacketFailed():
                self._packet_failed(event, now)
            case FrameDecoded():
                self._mac.channel_busy(now)
            case FrameReceived(dest=dest) if dest == self._config.address:
                self._line.hear(event.src, [event.data], now)
                self._changed = True
            case MiniPacketReceived(dest=dest) if dest == self._config.address:
                self._line.hear_mini(event.src, event.bits, now)
                self._changed = True
            case _:
                pass  # accepted records are looked for in any case, and what is for others is theirs

    def _packet_sent(self, sent: PacketSent, now: float) -> None:
        if self._asked not in (None, sent.packet_id):
            return
        self._asked = None
        taken_s = max(0.0, sent.finished_s - sent.started_s)
        self._packet_s[sent.rate] = taken_s
        self._mac.sent(now - taken_s, now)
        began = self._ended_at if self._ended_at is not None else now - taken_s
        self._line.queue.sent(sent.frames, now - began)
        self._ended_at = now
        self._offered = ()
        self._changed = True
        self._show(sent)

    def _packet_failed(self, failed: PacketFailed, now: float) -> None:
        if self._asked not in (None, failed.packet_id):
            return
        self._asked = None
        self._retry_at = now + self._config.retry_s
        self.count("packets_failed")
        log.warning("Packet not sent, trying again", extra=kv(reason=failed.reason, maybe=failed.maybe_sent))

    def _turn(self, now: float) -> float:
        """Do what is due; return for how long nothing is, unless something comes."""
        self._accept(now)
        wait_s = LONGEST_WAIT_S
        if self._asked is None:
            wait_s = self._send(now)
        if self._changed:
            self._save()
        images = (self._line.images_accepted, len(self._line.queue.open_numbers()))
        interval_s = self._config.queue_interval_s
        if images != self._told_images:
            interval_s = min(interval_s, STATE_INTERVAL_S)
        if self._told_at is None or not 0 <= now - self._told_at < interval_s:
            self._told_at, self._told_images = now, images
            self._tell(now)
        return wait_s

    def _accept(self, now: float) -> None:
        for name, payload in self._line.accepted():
            where = f"uuv_modem.db: {name}"
            record = _decoded(payload, where)
            try:
                self._line.accept(name, record, now)
            except BadInputError as error:
                # It was checked when it came: only a number that another picture uses can be wrong by now.
                self.count("images_refused")
                log.error("Picture not sent", extra=kv(reason=str(error)))
            self._changed = True

    def _send(self, now: float) -> float:
        packet = self._line.queue.in_flight
        rate = packet.rate if packet else self._line.queue.rate
        wait_s = self._mac.wait_s(self._packet_s.get(rate, RATES[rate].airtime_s), now)
        polled = wait_s is None
        wait_s = max(wait_s or 0.0, self._retry_at - now if self._retry_at - now <= self._config.retry_s else 0.0)
        if wait_s > 0 or not (polled or self._modem.ready):
            return wait_s or LONGEST_WAIT_S
        if packet is None:
            packet = self._line.choose(now)
            self._changed = packet is not None or self._changed
        if packet is None:
            self._ended_at = None
            return LONGEST_WAIT_S
        if self._changed:
            self._save()
        if polled:
            self._offered = packet.frames
        else:
            self._asked = self._modem.send_packet(self._config.destination, packet.rate, packet.frames)
        return LONGEST_WAIT_S

    def _save(self) -> None:
        self._line.save()
        self._changed = False


def _decoded(payload: bytes, where: str) -> EncodedImage | OutgoingMessage:
    if wire.unpack_map(payload, where).get("type") == OutgoingMessage.TYPE:
        return wire.decode(OutgoingMessage, payload, where)
    return wire.decode(EncodedImage, payload, where)
