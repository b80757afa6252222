"""When a metered bearer may be used: windows of the day and a budget of bytes a day."""

from dataclasses import dataclass
from datetime import UTC, datetime

import msgpack

from sonarpost.link.state import SavedCount, unpack_value

DAY_S = 86400.0


@dataclass(frozen=True, slots=True)
class Window:
    """A part of each day in UTC; one that ends before it starts includes midnight.

    Attributes:
        start_s: Start, seconds of the day (0..86400).
        end_s: End, seconds of the day (0..86400).
    """

    start_s: float
    end_s: float

    @classmethod
    def parse(cls, text: str) -> "Window":
        """Parse `HH:MM-HH:MM`.

        Raises:
            ValueError: Another text.
        """
        start, separator, end = text.partition("-")
        try:
            times = [datetime.strptime(part, "%H:%M").replace(tzinfo=UTC) for part in (start, end)]
        except ValueError as error:
            raise ValueError(f"HH:MM-HH:MM in UTC, not {text}") from error
        if not separator or start == end:
            raise ValueError(f"HH:MM-HH:MM with two different times, not {text}")
        start_s, end_s = (time.hour * 3600.0 + time.minute * 60.0 for time in times)
        return cls(start_s, end_s)

    def contains(self, utc_s: float) -> bool:
        """Return whether a time lies in the window."""
        second = utc_s % DAY_S
        if self.start_s < self.end_s:
            return self.start_s <= second < self.end_s
        return second >= self.start_s or second < self.end_s


@dataclass(slots=True)
class ByteBudget:
    """Bytes that were sent today, in UTC, and the limit.

    Attributes:
        bytes_per_day: Limit; None for none.
        windows: When sending is allowed; empty for always.
        day: Day of the count, days since 1970-01-01.
        used_bytes: Bytes sent on that day.
        total_bytes: Bytes ever sent.
        total_messages: Messages ever sent.
    """

    bytes_per_day: int | None = None
    windows: tuple[Window, ...] = ()
    day: int = 0
    used_bytes: int = 0
    total_bytes: int = 0
    total_messages: int = 0

    def is_open(self, utc_s: float) -> bool:
        """Return whether a window is open."""
        return not self.windows or any(window.contains(utc_s) for window in self.windows)

    def used_today(self, utc_s: float) -> int:
        """Return the bytes sent on the day of `utc_s`.

        A clock that was set back does not renew the budget: the later day counts.
        """
        return self.used_bytes if int(utc_s // DAY_S) <= self.day else 0

    def allows(self, size_bytes: int, utc_s: float) -> bool:
        """Return whether a message of this size may be sent now."""
        within = self.bytes_per_day is None or self.used_today(utc_s) + size_bytes <= self.bytes_per_day
        return within and self.is_open(utc_s)

    def charge(self, size_bytes: int, utc_s: float) -> None:
        """Count a sent message."""
        self.used_bytes = self.used_today(utc_s) + size_bytes
        self.day = max(self.day, int(utc_s // DAY_S))
        self.total_bytes += size_bytes
        self.total_messages += 1

    def refund(self, size_bytes: int) -> None:
        """Take back the count of a message that the terminal has not sent."""
        self.used_bytes = max(0, self.used_bytes - size_bytes)
        self.total_bytes -= size_bytes
        self.total_messages -= 1

    def pack(self) -> bytes:
        """Return the counts for the store."""
        packed: bytes = msgpack.packb((self.day, self.used_bytes, self.total_bytes, self.total_messages))
        return packed

    def restore(self, data: bytes) -> None:
        """Continue with stored counts.

        Raises:
            BadInputError: They are not valid.
        """
        counts = unpack_value(tuple[SavedCount, SavedCount, SavedCount, SavedCount], data, "state of the byte budget")
        self.day, self.used_bytes, self.total_bytes, self.total_messages = counts
