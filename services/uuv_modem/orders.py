"""Orders that came by sound: each becomes a record for its consumers once, however often it came."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from sonarpost import keys
from sonarpost.link.downlink.messages import (
    CommandOutcome,
    DecisionMessage,
    DownlinkCommand,
    ExpandMessage,
    RefineMessage,
    ResendMessage,
    RevisitMessage,
    image_of_number,
    pack,
    record_id_of,
)
from sonarpost.link.state import from_plain
from sonarpost.messages import Command, CommandKind, Decision, Record
from sonarpost.services.uuv_modem.config import UuvModemConfig

_REMEMBERED: Final = 512
_VESSEL_BY_SOUND: Final = "vessel"


@dataclass(frozen=True, slots=True)
class CommandRecord:
    """A record and whom it is for."""

    key: str
    record: Record
    consumers: tuple[str, ...]


@dataclass(eq=False)
class ReceivedCommands:
    """The orders of late, and what became of them.

    Attributes:
        platform_id: The vehicle.
        config: Who takes what.
        known: Outcome by modem, token and content, oldest first.
    """

    platform_id: str
    config: UuvModemConfig
    known: dict[tuple[int, bytes], CommandOutcome] = field(default_factory=dict)

    def take(
        self, source: int, order: DownlinkCommand, image_id: str | None
    ) -> tuple[CommandOutcome, CommandRecord | None]:
        """Return what becomes of an order, and the record for its consumers if it is new.

        Args:
            source: Modem it came from.
            order: The order.
            image_id: The image it is about where the vehicle still knows it.
        """
        name = (source, pack(order, 255))
        if name in self.known:
            return self.known[name], None
        handed = self._handed(source, order, image_id)
        outcome = CommandOutcome.ACCEPTED if handed.consumers else CommandOutcome.UNSUPPORTED
        self.known[name] = outcome
        while len(self.known) > _REMEMBERED:
            del self.known[next(iter(self.known))]
        return outcome, handed if handed.consumers else None

    def _handed(self, source: int, order: DownlinkCommand, image_id: str | None) -> CommandRecord:
        kind = kind_of(order)
        consumers = {
            "revisit": self.config.revisit_consumers,
            "decision": self.config.decision_consumers,
        }.get(kind, self.config.refine_consumers)
        record_id = record_id_of(source, order.token)
        record: Record
        if isinstance(order, DecisionMessage):
            record = self._decision(record_id, order, image_id)
        else:
            record = self._command(record_id, source, order, image_id)
        return CommandRecord(keys.command(self.platform_id, kind), record, consumers)

    def _command(
        self,
        record_id: str,
        source: int,
        order: RefineMessage | ResendMessage | RevisitMessage | ExpandMessage,
        image_id: str | None,
    ) -> Command:
        lat_deg = lon_deg = None
        if isinstance(order, RevisitMessage):
            image_id, lat_deg, lon_deg = None, order.lat_deg, order.lon_deg
        else:
            image_id = image_id or image_of_number(order.number)
        return Command(
            command_id=record_id,
            kind=_COMMANDS[type(order)],
            vehicle_id=self.platform_id,
            image_id=image_id,
            lat_deg=lat_deg,
            lon_deg=lon_deg,
            issued_by=f"modem {source}",
            issued_utc_s=float(order.issued_utc_s),
        )

    def _decision(self, record_id: str, order: DecisionMessage, image_id: str | None) -> Decision:
        return Decision(
            decision_id=record_id,
            vessel_id=_VESSEL_BY_SOUND,
            vehicle_id=self.platform_id,
            image_id=image_id or image_of_number(order.number),
            image_version=order.version,
            verdict=order.verdict,
            confidence=order.confidence,
            mlo_class=order.mlo_class or None,
            operator="by sound",
            decided_utc_s=float(order.issued_utc_s),
        )

    def export(self) -> dict[str, object]:
        """Return the book as a map that msgpack can hold."""
        return {"known": [[source, order, int(outcome)] for (source, order), outcome in self.known.items()]}

    def restore(self, part: Mapping[str, object]) -> None:
        """Take up what `export` returned.

        Raises:
            FrameError: It is no such map.
        """
        known = from_plain(list[tuple[int, bytes, CommandOutcome]], part.get("known"), "uuv_modem state", "known")
        self.known = {(source, order): outcome for source, order, outcome in known}


_COMMANDS: Final[dict[type, CommandKind]] = {
    RefineMessage: "refine",
    ResendMessage: "resend",
    RevisitMessage: "revisit",
    ExpandMessage: "wider",
}


def kind_of(order: DownlinkCommand) -> str:
    """Return the last part of the key that an order is handed on with."""
    return "decision" if isinstance(order, DecisionMessage) else _COMMANDS[type(order)]
