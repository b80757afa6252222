"""Delivery state of comments and commands for vessels; stored with the delivery itself, published afterwards."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, cast, get_args

import msgpack

from sonarpost import keys, wire
from sonarpost.archive.rows import TaskingRow
from sonarpost.errors import PayloadError
from sonarpost.link.state import unpack_value
from sonarpost.messages import Command, Comment, DeliveryState, TaskingKind, TaskingState

PREFIX = "tasking/"
_WHERE: Final = "tasking state"


@dataclass(frozen=True, slots=True)
class Tasking:
    """A comment or a command for a vessel, with its delivery state."""

    vessel_id: str
    kind: TaskingKind
    payload: bytes
    state: DeliveryState = "waiting"
    reason: str = ""
    changed_utc_s: float = 0.0

    @property
    def record(self) -> Comment | Command:
        """The record itself."""
        if self.kind == "comment":
            return wire.decode(Comment, self.payload, keys.comment(self.vessel_id))
        return wire.decode(Command, self.payload, keys.command_all(self.vessel_id))

    @property
    def record_id(self) -> str:
        """Identifier of the record."""
        return kind_and_id(self.record)[1]

    @property
    def name(self) -> str:
        """Name of its state in the store."""
        return state_name(self.vessel_id, self.kind, self.record_id)

    @property
    def key(self) -> str:
        """Key on which the vessel's relay receives it."""
        record = self.record
        if isinstance(record, Comment):
            return keys.comment(self.vessel_id)
        return keys.command(self.vessel_id, record.kind)

    def pack(self) -> bytes:
        """Return the bytes for the store."""
        fields = (self.vessel_id, self.kind, self.payload, self.state, self.reason, self.changed_utc_s)
        packed: bytes = msgpack.packb(fields)
        return packed

    @classmethod
    def unpack(cls, data: bytes) -> Tasking:
        """Parse the bytes of `pack`.

        Raises:
            BadInputError: They are not valid.
        """
        vessel_id, kind, payload, state, reason, changed_utc_s = unpack_value(
            tuple[str, str, bytes, str, str, float], data, _WHERE
        )
        if kind not in get_args(TaskingKind) or state not in get_args(DeliveryState):
            raise PayloadError(_WHERE, "kind and state", (kind, state), "those of a tasking state")
        item = cls(vessel_id, cast("TaskingKind", kind), payload, cast("DeliveryState", state), reason, changed_utc_s)
        item.row()  # checks the record
        return item

    def state_record(self) -> TaskingState:
        """Return the record for the shore's subscribers."""
        return TaskingState(
            vessel_id=self.vessel_id,
            kind=self.kind,
            record_id=self.record_id,
            state=self.state,
            reason=self.reason[:2000],
            changed_utc_s=self.changed_utc_s,
        )

    def row(self) -> TaskingRow:
        """Return the row of the index."""
        record = self.record
        if isinstance(record, Comment):
            summary, author, issued_utc_s = _comment_summary(record), record.author, record.commented_utc_s
        else:
            summary, author, issued_utc_s = _command_summary(record), record.issued_by, record.issued_utc_s
        return TaskingRow(
            vessel_id=self.vessel_id,
            kind=self.kind,
            record_id=self.record_id,
            vehicle_id=record.vehicle_id,
            image_id=record.image_id,
            summary=summary,
            author=author,
            issued_utc_s=issued_utc_s,
            state=self.state,
            reason=self.reason,
            changed_utc_s=self.changed_utc_s,
        )


def state_name(vessel: str, kind: TaskingKind, record_id: str) -> str:
    """Return the name of a record's state in the store."""
    return f"{PREFIX}{vessel}/{kind}/{record_id}"


def of_payload(vessel: str, key: str, payload: bytes) -> Tasking:
    """Return the tasking of a record that is queued for a vessel's relay."""
    kind: TaskingKind = "comment" if key == keys.comment(vessel) else "command"
    return Tasking(vessel, kind, payload)


def kind_and_id(record: Comment | Command) -> tuple[TaskingKind, str]:
    """Return kind and identifier of a record."""
    return ("comment", record.comment_id) if isinstance(record, Comment) else ("command", record.command_id)


def reject_conflict(known: Tasking, record: Comment | Command, key: str) -> None:
    """Reject a record with the identifier of a different one.

    Raises:
        PayloadError: The records differ.
    """
    if known.record != record:
        kind, record_id = kind_and_id(record)
        raise PayloadError(key, f"{kind}_id", record_id, "an identifier that no other record for this vessel has")


def _comment_summary(comment: Comment) -> str:
    parts = [f"v{comment.image_version}", comment.verdict or "", comment.mlo_class or "", comment.remark]
    return " ".join(part for part in parts if part)


def _command_summary(command: Command) -> str:
    if command.lat_deg is None or command.lon_deg is None:
        return command.kind
    return f"{command.kind} {command.lat_deg:.6f} {command.lon_deg:.6f}"
