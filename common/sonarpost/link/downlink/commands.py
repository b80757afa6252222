"""Commands of the vessel: each is repeated until its vehicle confirms it, or it expires.

`now` is UTC in seconds, because commands outlive the process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import count
from typing import Annotated, Final

from sonarpost.errors import FrameError
from sonarpost.limits import limit
from sonarpost.link.downlink.messages import CommandOutcome, token_of
from sonarpost.link.state import Bounds, Errors, PartReader, Parts, SavedCount, pack_part

MAX_PENDING: Final = limit(
    500, "commands", "shares", "acoustic link, vessel", "vehicle", "open commands", "further ones are refused"
)
_MAX_CLOSED: Final = 1000
_MAX_RETRY_DOUBLINGS: Final = 3
_QUICK_RETRIES: Final = 2
_WHERE: Final = "commands"


class CommandState(StrEnum):
    """State of a command. `CONFIRMED`, `REFUSED` and `EXPIRED` are final."""

    ASKED = "asked"
    SENT = "sent"
    CONFIRMED = "confirmed"
    REFUSED = "refused"
    EXPIRED = "expired"

    @property
    def is_open(self) -> bool:
        """Whether the command is still to be sent or confirmed."""
        return self in (CommandState.ASKED, CommandState.SENT)


@dataclass(frozen=True, slots=True)
class PendingCommand:
    """A command and its state.

    Attributes:
        kind: Kind of the record `command`, or `decision`.
        record_id: Identifier of its record.
        vehicle: Name of the vehicle.
        address: Modem address of the vehicle.
        token: As in the message.
        message: The bytes to send.
        added_s: Time when it was added.
        expires_s: Time when it becomes useless.
        state: The state.
        times_sent: Number of transmissions.
        due_s: Time of the next transmission.
        reason: The vehicle's reason to refuse it.
        order: Rises with every command.
    """

    kind: str
    record_id: str
    vehicle: str
    address: Annotated[int, Bounds(0, 127)]
    token: Annotated[int, Bounds(0, 2**32 - 1)]
    message: bytes
    added_s: float
    expires_s: float
    state: CommandState = CommandState.ASKED
    times_sent: SavedCount = 0
    due_s: float = 0.0
    reason: str = ""
    order: SavedCount = 0


def retry_factor(repetitions: int, max_doublings: float) -> float:
    """Return the factor of the wait before the next repetition: 1 for the first three, then doubled each time.

    Lost packets are repeated soon; a vehicle out of range costs little air time.

    Args:
        repetitions: Repetitions that were sent.
        max_doublings: Base-2 logarithm of the greatest factor.
    """
    return float(2.0 ** min(max(0, repetitions - _QUICK_RETRIES), max_doublings))


@dataclass
class CommandTracker:
    """All open commands, and the last 1000 closed ones.

    Attributes:
        retry_s: Wait before a command is sent again; see `retry_factor`.
    """

    retry_s: float
    _commands: dict[int, PendingCommand] = field(default_factory=dict)

    @property
    def open_commands(self) -> tuple[PendingCommand, ...]:
        """The commands that are not confirmed, refused or expired, the oldest first."""
        # `list` copies in one step: other threads call this while a command is added.
        return tuple(command for command in list(self._commands.values()) if command.state.is_open)

    def is_full(self, address: int) -> bool:
        """Return whether a vehicle has the maximum number of open commands."""
        return sum(command.address == address for command in self.open_commands) >= MAX_PENDING

    def find(self, kind: str, record_id: str) -> PendingCommand | None:
        """Return the command of a record, None for a new record."""
        same = (c for c in self._commands.values() if (c.kind, c.record_id) == (kind, record_id))
        return next(same, None)

    def free_token(self, kind: str, record_id: str) -> int:
        """Return the token for a new record: the first of `token_of` that no other command has."""
        tokens = (token_of(record_id, "decision" if kind == "decision" else "command", n) for n in count())
        return next(token for token in tokens if token not in self._commands)

    def add(self, command: PendingCommand, now: float) -> PendingCommand:
        """Add a command with a `free_token`; return it with its state. A late command expires at once.

        Raises:
            FrameError: Too many commands are open, or the token is in use.
        """
        if self.is_full(command.address):
            raise FrameError(_WHERE, "open", MAX_PENDING, f"at most {MAX_PENDING}")
        if command.token in self._commands:
            raise FrameError(_WHERE, "token", command.token, "one that is free")
        state = CommandState.EXPIRED if command.expires_s <= now else CommandState.ASKED
        order = 1 + max((c.order for c in self._commands.values()), default=0)
        added = replace(command, state=state, due_s=float(now), order=order)
        self._commands[command.token] = added
        closed = [token for token, each in self._commands.items() if not each.state.is_open]
        for token in closed[: max(0, len(closed) - _MAX_CLOSED)]:
            del self._commands[token]
        return added

    def due(self, now: float) -> tuple[PendingCommand, ...]:
        """Return the commands to send now, the longest due first."""
        waiting = [command for command in self.open_commands if command.due_s <= now < command.expires_s]
        return tuple(sorted(waiting, key=lambda command: command.due_s))

    def sent(self, tokens: Iterable[int], now: float) -> tuple[PendingCommand, ...]:
        """Record that commands have been sent; return those that changed."""

        def after(command: PendingCommand) -> PendingCommand:
            if not command.state.is_open:
                return command
            wait_s = self.retry_s * retry_factor(command.times_sent, _MAX_RETRY_DOUBLINGS)
            return replace(
                command, state=CommandState.SENT, times_sent=command.times_sent + 1, due_s=float(now + wait_s)
            )

        return self._change(tokens, after)

    def confirm(self, address: int, outcomes: Iterable[tuple[int, CommandOutcome]]) -> tuple[PendingCommand, ...]:
        """Process the outcomes that a vehicle reports; return the commands that it closes.

        A command that expired here but was accepted by the vehicle becomes confirmed.
        """
        changed: list[PendingCommand] = []
        for token, outcome in outcomes:
            command = self._commands.get(token)
            if (
                command is None
                or command.address != address
                or command.state in (CommandState.CONFIRMED, CommandState.REFUSED)
            ):
                continue
            if outcome is CommandOutcome.ACCEPTED:
                closed = replace(command, state=CommandState.CONFIRMED)
            else:
                closed = replace(command, state=CommandState.REFUSED, reason=outcome.name.lower().replace("_", " "))
            self._commands[token] = closed
            changed.append(closed)
        return tuple(changed)

    def expire(self, now: float) -> tuple[PendingCommand, ...]:
        """Close and return the commands that have expired."""
        late = [command.token for command in self.open_commands if command.expires_s <= now]
        return self._change(late, lambda command: replace(command, state=CommandState.EXPIRED))

    def _change(
        self, tokens: Iterable[int], change: Callable[[PendingCommand], PendingCommand]
    ) -> tuple[PendingCommand, ...]:
        changed: list[PendingCommand] = []
        for token in tokens:
            before = self._commands.get(token)
            if before is not None and (after := change(before)) != before:
                self._commands[token] = after
                changed.append(after)
        return tuple(changed)

    def parts(self) -> dict[str, bytes]:
        """Return the state to save, see `sonarpost.link.state`: a part for each command."""
        return {f"command/{token}": pack_part(command) for token, command in self._commands.items()}

    def restore(self, parts: Parts) -> Errors:
        """Replace the state by saved parts; return why parts were skipped."""
        reader = PartReader(parts, "command state")
        commands = sorted(reader.read_group("command", PendingCommand), key=lambda command: command.order)
        self._commands = {command.token: command for command in commands}
        return reader.errors
