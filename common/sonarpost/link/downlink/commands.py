"""Orders of the vessel to its vehicles: each is repeated until the vehicle has confirmed it, or it expires.

Pure: `now` in seconds UTC, because orders outlive the process; the state can be saved and taken up by another one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Final

from sonarpost.errors import FrameError
from sonarpost.link.downlink.messages import CommandOutcome, token_of
from sonarpost.link.receiver_state import read_field, read_list, read_number, read_time

MAX_PENDING: Final = 500
"""Orders that may be open at a time."""
_REMEMBERED: Final = 1000
_SLOWEST: Final = 8
_WHERE: Final = "orders"
_STATE_FORMAT: Final = 1


class CommandState(StrEnum):
    """How far an order has come. `CONFIRMED`, `REFUSED` and `EXPIRED` are final."""

    ASKED = "asked"
    SENT = "sent"
    CONFIRMED = "confirmed"
    REFUSED = "refused"
    EXPIRED = "expired"

    @property
    def is_open(self) -> bool:
        """Whether it is still to be sent or confirmed."""
        return self in (CommandState.ASKED, CommandState.SENT)


@dataclass(frozen=True, slots=True)
class PendingCommand:
    """An order and what became of it.

    Attributes:
        kind: `refine`, `resend`, `revisit`, `wider` or `decision`.
        record_id: Identifier of the record it comes from.
        vehicle: Name of the vehicle.
        address: Its modem's.
        token: As in the message.
        message: The bytes that are sent.
        asked_at: When it was asked.
        expires_at: When it is worth nothing any more.
        state: How far it has come.
        times_sent: How often it has gone into the water.
        due_at: When it is to be sent next.
        reason: Of a refusal, the vehicle's.
    """

    kind: str
    record_id: str
    vehicle: str
    address: int
    token: int
    message: bytes
    asked_at: float
    expires_at: float
    state: CommandState = CommandState.ASKED
    times_sent: int = 0
    due_at: float = 0.0
    reason: str = ""


@dataclass
class CommandTracker:
    """All orders that are open, and the last 1000 that are not.

    Attributes:
        retry_s: Wait before an order is sent again; doubled each time, up to eight times as long.
    """

    retry_s: float
    _orders: dict[int, PendingCommand] = field(default_factory=dict)

    @property
    def open_orders(self) -> tuple[PendingCommand, ...]:
        """What is not confirmed, refused or expired, the oldest first."""
        # A copy first, made in one go: others may ask how many there are while one is added.
        return tuple(order for order in list(self._orders.values()) if order.state.is_open)

    def known(self, kind: str, record_id: str) -> PendingCommand | None:
        """Return the order that a record has led to, None for a new one."""
        same = (o for o in self._orders.values() if (o.kind, o.record_id) == (kind, record_id))
        return next(same, None)

    def free_token(self, kind: str, record_id: str) -> int:
        """Return the token for a new record: the first of `downlink.token_of` that no other order has."""
        attempt = 0
        while (token := token_of(record_id, "decision" if kind == "decision" else "command", attempt)) in self._orders:
            attempt += 1
        return token

    def ask(self, order: PendingCommand, now: float) -> PendingCommand:
        """Take an order with a `free_token`; return it as it is now: late ones are expired at once.

        Raises:
            FrameError: As many as are allowed are open, or the token is taken.
        """
        if len(self.open_orders) >= MAX_PENDING:
            raise FrameError(_WHERE, "open", MAX_PENDING, f"at most {MAX_PENDING}")
        if order.token in self._orders:
            raise FrameError(_WHERE, "token", order.token, "one that is free")
        state = CommandState.EXPIRED if order.expires_at <= now else CommandState.ASKED
        self._orders[order.token] = taken = replace(order, state=state, due_at=now)
        closed = [token for token, each in self._orders.items() if not each.state.is_open]
        for token in closed[: max(0, len(closed) - _REMEMBERED)]:
            del self._orders[token]
        return taken

    def due(self, now: float) -> tuple[PendingCommand, ...]:
        """Return what is to be sent now, what waits longest first."""
        waiting = [order for order in self.open_orders if order.due_at <= now < order.expires_at]
        return tuple(sorted(waiting, key=lambda order: order.due_at))

    def sent(self, tokens: Iterable[int], now: float) -> tuple[PendingCommand, ...]:
        """Note that these have gone into the water; return them as they are now."""

        def after(order: PendingCommand) -> PendingCommand:
            wait_s = self.retry_s * min(2**order.times_sent, _SLOWEST)
            return replace(order, state=CommandState.SENT, times_sent=order.times_sent + 1, due_at=now + wait_s)

        return self._change(tokens, lambda order: after(order) if order.state.is_open else order)

    def confirm(self, address: int, outcomes: Iterable[tuple[int, CommandOutcome]]) -> tuple[PendingCommand, ...]:
        """Take what a vehicle says of its orders; return those that are closed by it.

        An order that expired here and was taken there all the same is confirmed: that is what happened.
        """
        changed: list[PendingCommand] = []
        for token, outcome in outcomes:
            order = self._orders.get(token)
            if (
                order is None
                or order.address != address
                or order.state in (CommandState.CONFIRMED, CommandState.REFUSED)
            ):
                continue
            if outcome is CommandOutcome.TAKEN:
                closed = replace(order, state=CommandState.CONFIRMED)
            else:
                closed = replace(order, state=CommandState.REFUSED, reason=outcome.name.lower().replace("_", " "))
            self._orders[token] = closed
            changed.append(closed)
        return tuple(changed)

    def expire(self, now: float) -> tuple[PendingCommand, ...]:
        """Close what is too old; return it."""
        late = [order.token for order in self.open_orders if order.expires_at <= now]
        return self._change(late, lambda order: replace(order, state=CommandState.EXPIRED))

    def _change(
        self, tokens: Iterable[int], change: Callable[[PendingCommand], PendingCommand]
    ) -> tuple[PendingCommand, ...]:
        changed: list[PendingCommand] = []
        for token in tokens:
            before = self._orders.get(token)
            if before is not None and (after := change(before)) != before:
                self._orders[token] = after
                changed.append(after)
        return tuple(changed)

    def snapshot(self) -> dict[str, object]:
        """Return the state as maps, lists, numbers, strings and bytes (msgpack can hold it)."""
        return {"format": _STATE_FORMAT, "orders": [_export(order) for order in self._orders.values()]}

    def restore(self, state: Mapping[str, object]) -> None:
        """Take up a state that `snapshot` returned.

        Raises:
            FrameError: It did not return this; the book is then as before.
        """
        if state.get("format") != _STATE_FORMAT:
            raise FrameError(_WHERE, "format", state.get("format"), str(_STATE_FORMAT))
        orders = [_import(entry) for entry in read_list(state, "orders")]
        self._orders = {order.token: order for order in orders}


def _export(order: PendingCommand) -> dict[str, object]:
    fields: dict[str, object] = {name: getattr(order, name) for name in PendingCommand.__dataclass_fields__}
    return fields | {"state": str(order.state)}


def _import(entry: object) -> PendingCommand:
    state = read_field(entry, "state", str)
    if state not in tuple(CommandState):
        raise FrameError(_WHERE, "state", state, ", ".join(CommandState))
    return PendingCommand(
        kind=read_field(entry, "kind", str),
        record_id=read_field(entry, "record_id", str),
        vehicle=read_field(entry, "vehicle", str),
        address=read_number(entry, "address", 0, 127),
        token=read_number(entry, "token", 0, 2**32 - 1),
        message=read_field(entry, "message", bytes),
        asked_at=read_time(entry, "asked_at"),
        expires_at=read_time(entry, "expires_at"),
        state=CommandState(state),
        times_sent=read_number(entry, "times_sent", 0, 2**62),
        due_at=read_time(entry, "due_at"),
        reason=read_field(entry, "reason", str),
    )
