"""Commands from the vessel: each becomes one record for its consumers, however often it is received."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from operator import itemgetter
from typing import Final

from sonarpost import keys
from sonarpost.limits import limit, oldest_of_largest
from sonarpost.link.downlink.messages import (
    CommandOutcome,
    DecisionMessage,
    DownlinkCommand,
    ExpandMessage,
    MessageKind,
    OriginalMessage,
    PrioritiseMessage,
    RefineMessage,
    RegionMessage,
    ResendMessage,
    RevisitMessage,
    image_of_number,
    pack,
    record_id_of,
    unpack,
)
from sonarpost.link.state import from_plain
from sonarpost.messages import Command, CommandKind, Decision
from sonarpost.services.uuv_modem.config import UuvModemConfig

_MAX_KNOWN: Final = limit(
    512, "commands", "shares", "acoustic link", "modem address", "commands to recognise", "the oldest is forgotten"
)
_KINDS: Final[dict[type, CommandKind]] = {
    RefineMessage: "refine",
    ResendMessage: "resend",
    RevisitMessage: "revisit",
    ExpandMessage: "expand",
    OriginalMessage: "original",
    RegionMessage: "region",
    PrioritiseMessage: "prioritise",
}


@dataclass(frozen=True, slots=True)
class CommandRecord:
    """The record of a command, its key and its consumers."""

    key: str
    record: Command | Decision
    consumers: tuple[str, ...]


class ReceivedCommands:
    """The last 512 commands of all modems and their outcomes.

    Args:
        platform_id: The vehicle.
        config: Names the consumers.
    """

    def __init__(self, platform_id: str, config: UuvModemConfig) -> None:
        self._platform_id = platform_id
        self._config = config
        # By modem address and content, oldest first.
        self._known: dict[tuple[int, bytes], CommandOutcome] = {}

    def accept(
        self, source: int, command: DownlinkCommand, image_id: str | None
    ) -> tuple[CommandOutcome, CommandRecord | None]:
        """Return the outcome of a command, and its record if it is new and this vehicle executes it.

        Args:
            source: Address of the modem that sent it.
            command: The command.
            image_id: Identifier of its image, None if the queue does not have this image.
        """
        name = (source, pack(command, 255))
        if name in self._known:
            return self._known[name], None
        received = self._record(source, command, image_id)
        is_executed = bool(received.consumers) or self._is_executed_by_the_queue(command)
        outcome = CommandOutcome.ACCEPTED if is_executed else CommandOutcome.UNSUPPORTED
        self._known[name] = outcome
        while len(self._known) > _MAX_KNOWN:
            del self._known[oldest_of_largest(self._known, itemgetter(0))]
        return outcome, received if is_executed else None

    def _is_executed_by_the_queue(self, command: DownlinkCommand) -> bool:
        return isinstance(command, PrioritiseMessage) or (
            isinstance(command, DecisionMessage) and self._config.stop_on_decision
        )

    def is_latest_decision(self, decision: DecisionMessage) -> bool:
        """Return whether no known decision on the same image was issued after this one: copies can arrive late."""
        known = [unpack(content) for _, content in self._known if content[0] == MessageKind.DECISION]
        return all(
            other.issued_utc_s <= decision.issued_utc_s
            for other in known
            if isinstance(other, DecisionMessage) and other.number == decision.number
        )

    def _record(self, source: int, command: DownlinkCommand, image_id: str | None) -> CommandRecord:
        record_id = record_id_of(source, command.token)
        if isinstance(command, DecisionMessage):
            decision = Decision(
                decision_id=record_id,
                vessel_id="vessel",
                vehicle_id=self._platform_id,
                image_id=image_id or image_of_number(command.number),
                image_version=command.version,
                verdict=command.verdict,
                confidence=command.confidence,
                mlo_class=command.mlo_class or None,
                operator="acoustic link",
                decided_utc_s=float(command.issued_utc_s),
            )
            key = keys.command(self._platform_id, "decision")
            return CommandRecord(key, decision, self._config.decision_consumers)
        kind, lat_deg, lon_deg = _KINDS[type(command)], None, None
        consumers = self._config.refine_consumers
        if isinstance(command, RevisitMessage):
            lat_deg, lon_deg = command.lat_deg, command.lon_deg
            consumers = self._config.revisit_consumers
        elif isinstance(command, PrioritiseMessage):
            consumers = ()
        if not isinstance(command, RevisitMessage):
            image_id = image_id or image_of_number(command.number)
        record = Command(
            command_id=record_id,
            kind=kind,
            vehicle_id=self._platform_id,
            image_id=image_id,
            lat_deg=lat_deg,
            lon_deg=lon_deg,
            issued_by=f"modem {source}",
            issued_utc_s=float(command.issued_utc_s),
            box=command.box.as_tuple() if isinstance(command, RegionMessage) else None,
            stream_bytes=command.stream_bytes if isinstance(command, RegionMessage) else None,
            place=command.place if isinstance(command, PrioritiseMessage) else None,
        )
        return CommandRecord(keys.command(self._platform_id, kind), record, consumers)

    def export(self) -> dict[str, object]:
        """Return the state to save, as a map for msgpack."""
        return {"known": [[source, content, int(outcome)] for (source, content), outcome in self._known.items()]}

    def restore(self, state: Mapping[str, object]) -> None:
        """Replace the state by what `export` returned.

        Raises:
            FrameError: Not such a map.
        """
        known = from_plain(list[tuple[int, bytes, CommandOutcome]], state.get("known"), "uuv_modem state", "known")
        self._known = {(source, content): outcome for source, content, outcome in known}
