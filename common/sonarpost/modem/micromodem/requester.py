"""Follows the one request under way, and says what arrives of pings, mini-packets and flexible data of others."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import ClassVar

from sonarpost.modem.micromodem.config import MicroModemConfig
from sonarpost.modem.micromodem.events import (
    FailureReason,
    FlexibleDataReceived,
    MiniPacketAnswered,
    MiniPacketReceived,
    ModemEvent,
    PacketReceived,
    PingAnswered,
    PingReceived,
    RequestFailed,
)
from sonarpost.modem.micromodem.nmea import Sentence
from sonarpost.modem.micromodem.requests import ModemRequest, RequestExchange, RequestKind
from sonarpost.modem.micromodem.short_sentences import (
    MiniPacket,
    MiniReply,
    PingCommand,
    PingReply,
    ReceivedFlexibleData,
)


class RequestTracker:
    """The side of the driver that is no data cycle.

    Args:
        config: Time-outs and tries.
        send: Takes the sentences to send.
    """

    def __init__(self, config: MicroModemConfig, send: Callable[[Sentence], None]) -> None:
        self._config = config
        self._send = send
        self.exchange: RequestExchange | None = None

    @property
    def deadline_s(self) -> float | None:
        """When `poll` has something to do, or None."""
        return None if self.exchange is None else self.exchange.deadline_s

    def start(self, request: ModemRequest, now: float) -> None:
        """Begin a request; there is none under way."""
        self.exchange = RequestExchange(request, self._config, self._send, now)

    def receive(self, sentence: Sentence, now: float) -> list[ModemEvent]:
        """Take a sentence of the kinds in `KINDS`.

        Raises:
            SentenceError: One of its fields is wrong.
        """
        if self.exchange is not None:
            self.exchange.on_echo(sentence.kind[2:], now)
        tell = self.KINDS[sentence.kind]
        return [] if tell is None else tell(self, sentence, now)

    def heard(self, events: Iterable[ModemEvent]) -> None:
        """See what the listener says: the packet of a polled modem ends the poll."""
        if self.exchange is not None:
            for event in events:
                if isinstance(event, PacketReceived):
                    self.exchange.on_answer(RequestKind.POLL, event.src)

    def poll(self, now: float) -> list[ModemEvent]:
        """Do what is due; return the end of the request, once."""
        if self.exchange is None:
            return []
        self.exchange.poll(now)
        result = self.exchange.result
        if result is None:
            return []
        self.exchange = None
        return [result]

    def abort(self, reason: FailureReason) -> list[ModemEvent]:
        """End the request from outside."""
        exchange, self.exchange = self.exchange, None
        return [] if exchange is None else [exchange.abort(reason)]

    def _on_ping(self, sentence: Sentence, _now: float) -> list[ModemEvent]:
        ping = PingCommand.parse(sentence)
        return [PingReceived(ping.src, ping.dest)]

    def _on_ping_reply(self, sentence: Sentence, _now: float) -> list[ModemEvent]:
        reply = PingReply.parse(sentence)
        if self.exchange is not None:
            self.exchange.on_answer(RequestKind.PING, reply.src)
        return [PingAnswered(reply.src, reply.dest, reply.travel_s)]

    def _on_mini(self, sentence: Sentence, _now: float) -> list[ModemEvent]:
        mini = MiniPacket.parse(sentence)
        return [MiniPacketReceived(mini.src, mini.dest, mini.bits)]

    def _on_mini_reply(self, sentence: Sentence, _now: float) -> list[ModemEvent]:
        reply = MiniReply.parse(sentence)
        if self.exchange is not None:
            self.exchange.on_answer(RequestKind.MINI_PACKET, reply.src)
        return [MiniPacketAnswered(reply.src, reply.dest)]

    def _on_flexible(self, sentence: Sentence, now: float) -> list[ModemEvent]:
        return [FlexibleDataReceived(ReceivedFlexibleData.parse(sentence), now)]

    KINDS: ClassVar[Mapping[str, Callable[[RequestTracker, Sentence, float], list[ModemEvent]] | None]] = {
        "CAMPC": None,
        "CAMPA": _on_ping,
        "CAMPR": _on_ping_reply,
        "CAMUC": None,
        "CAMUA": _on_mini,
        "CAMUR": _on_mini_reply,
        "CATDP": None,
        "CARDP": _on_flexible,
    }


def is_modems_fault(event: ModemEvent) -> bool:
    """Tell whether a request failed for a reason that lies with the own modem and not with the water."""
    return isinstance(event, RequestFailed) and event.reason is FailureReason.NO_ECHO
