"""Authentication of acoustic frames: a short tag, a counter against replays, and optional encryption.

AES-256-CCM (NIST SP 800-38C, RFC 3610). A protected frame ends with the low bytes of its counter and the tag. The whole
counter is the nonce, so the tag authenticates it although only its low bytes are sent.
docs/specifications/acoustic-v1.md has the specification and the security analysis.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Final

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESCCM

from sonarpost.errors import ConfigError, FrameError
from sonarpost.link.auth.key import MAX_ADDRESS, AcousticKey, AuthenticationSettings, Direction
from sonarpost.link.state import Bounds, Errors, PartReader, Parts, SavedCount, pack_part

WINDOW: Final = 64
"""A frame that arrives late by fewer counters than this is still accepted."""
RESERVED: Final = 64
"""Counters reserved at a time. A crash skips at most so many, far fewer than a receiver can bridge."""

_WHERE: Final = "acoustic authentication"
_NONCE_BYTES: Final = 13
_LOOK_BACK: Final = 64


@dataclass(slots=True)
class AuthenticationCounts:
    """Counters since the first start; they continue over restarts.

    Attributes:
        protected: Frames protected.
        genuine: Frames verified.
        forged: Undamaged frames with a tag of another key: forged, or of a station with another key.
        replayed: Frames with a correct tag and a counter that was accepted before, or is too old to decide.
        unconfirmed: Frames with a correct tag so far ahead that a second frame must confirm it.
    """

    protected: SavedCount = 0
    genuine: SavedCount = 0
    forged: SavedCount = 0
    replayed: SavedCount = 0
    unconfirmed: SavedCount = 0


@dataclass(slots=True)
class ReplayWindow:
    """The accepted counters of one transmitter (the sliding window of IPsec, RFC 4303, appendix A2).

    Attributes:
        newest: The highest accepted counter, -1 before the first.
        seen: Bit i is set if counter newest - i was accepted, for i below 64.
    """

    newest: Annotated[int, Bounds(-1, 2**62)] = -1
    seen: Annotated[int, Bounds(0, 2**WINDOW - 1)] = 0

    def nearest(self, low: int, step: int) -> int:
        """Return the counter that ends with `low` and lies from newest - 63 to newest - 64 + `step`.

        Args:
            low: The counter modulo `step`, as in a frame.
            step: A power of two above 64.

        Returns:
            A negative number if no past counter can end so.
        """
        base = self.newest - (WINDOW - 1)
        return base + (low - base) % step

    def is_new(self, counter: int) -> bool:
        """Whether a frame with this counter can be accepted."""
        behind = self.newest - counter
        return behind < 0 or (behind < WINDOW and not self.seen >> behind & 1)

    def accept(self, counter: int) -> None:
        """Record a counter that `is_new`."""
        ahead = counter - self.newest
        if ahead > 0:
            # A shift by a large distance would first make a number of a million bits.
            self.seen = self.seen << ahead & (1 << WINDOW) - 1 if ahead < WINDOW else 0
            self.newest = counter
        self.seen |= 1 << self.newest - counter


@dataclass(frozen=True, slots=True)
class AuthenticationState:
    """Saved state without the windows.

    Attributes:
        key: Fingerprint of the key.
        limit: Limit of the counters granted so far.
        counts: The counters.
    """

    key: str
    limit: SavedCount
    counts: AuthenticationCounts


@dataclass(frozen=True, slots=True)
class SavedWindow:
    """Saved window of one transmitter."""

    source: Annotated[int, Bounds(0, MAX_ADDRESS)]
    window: ReplayWindow


class FrameAuthenticator:
    """Protects the frames of this station and verifies those of others.

    Counters must be reserved before they are used, so that no crash leads to the same counter twice:

        if (limit := authenticator.requested_limit) is not None:
            ...save `limit` durably...
            authenticator.grant(limit)

    Memory: a window of two numbers for each of at most 256 transmitters, created after the first genuine frame.

    Attributes:
        counts: The counters.
        last_counter: Counter of the frame that was verified last, -1 before the first.

    Args:
        key: The common key.
        address: Modem address of this station, 0..255. Stations that send in the same direction need different ones.
        sends: Direction of this station's frames; it verifies frames of the other direction.
        settings: As agreed with the other station.
        first_counter: The last limit that was saved, 0 with a new key.

    Raises:
        ConfigError: An address or a counter out of range.
    """

    def __init__(
        self,
        key: AcousticKey,
        address: int,
        sends: Direction,
        settings: AuthenticationSettings | None = None,
        *,
        first_counter: int = 0,
    ) -> None:
        self.settings = settings or AuthenticationSettings()
        for name, value, high in (
            ("address", address, MAX_ADDRESS),
            ("first_counter", first_counter, self.settings.lifetime_frames),
        ):
            if not 0 <= value <= high:
                raise ConfigError(_WHERE, name, value, f"0..{high}")
        self._key = key
        self._receives = sends.opposite
        self._own = key.cipher(address, sends, self.settings)
        self._ciphers: dict[int, AESCCM] = {}
        self._windows: dict[int, ReplayWindow] = {}
        self._ahead: dict[int, int] = {}
        self._next = self._limit = first_counter
        self.counts = AuthenticationCounts()
        self.last_counter = -1

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the key."""
        return self._key.fingerprint

    @property
    def overhead_bytes(self) -> int:
        """Bytes that protection adds to a frame."""
        return self.settings.overhead_bytes

    @property
    def frames_left(self) -> int:
        """Number of frames that can still be protected with this key."""
        return self.settings.lifetime_frames - self._next

    @property
    def requested_limit(self) -> int | None:
        """The limit to save and to `grant`, None while half of a reservation is left."""
        limit = min(self._next + RESERVED, self.settings.lifetime_frames)
        return limit if self._limit - self._next < RESERVED // 2 and limit > self._limit else None

    def grant(self, limit: int) -> None:
        """Allow counters below `limit`, which must be saved before.

        Raises:
            ConfigError: Lower than before, or beyond the lifetime of the key.
        """
        if not self._limit <= limit <= self.settings.lifetime_frames:
            raise ConfigError(_WHERE, "limit", limit, f"{self._limit}..{self.settings.lifetime_frames}")
        self._limit = limit

    def protect(self, covered: bytes) -> bytes:
        """Return a frame (after its checksum) with its counter and tag; the first byte is never encrypted.

        Raises:
            FrameError: No counter is reserved, or all counters of the key are used. No counter was used.
        """
        if self._next >= self._limit:
            expected = "a granted limit above it"
            if self._next >= self.settings.lifetime_frames:
                expected = f"a new key after {self.settings.lifetime_frames} frames"
            raise FrameError(_WHERE, "counter", self._next, expected)
        counter, self._next = self._next, self._next + 1
        head, data = self._split(covered)
        encrypted = self._own.encrypt(_nonce(counter), data, head)
        cut = len(encrypted) - self.settings.tag_bytes
        low = (counter % self.settings.counter_step).to_bytes(self.settings.counter_bytes, "big")
        self.counts.protected += 1
        return head + encrypted[:cut] + low + encrypted[cut:]

    def verify(self, source: int, protected: bytes, where: str = "acoustic frame") -> bytes:
        """Return what the sender passed to `protect`.

        Args:
            source: Modem address of the sender.
            protected: The frame after its checksum.
            where: Name of the frame in errors.

        Raises:
            FrameError: Field `tag`: this source did not protect it with this key. Field `counter`: a replay, or so far
                ahead that another frame must confirm it.
        """
        if not (0 <= source <= MAX_ADDRESS and len(protected) > self.overhead_bytes):
            self.counts.forged += 1
            expected = f"more than {self.overhead_bytes} bytes from an address of 0..{MAX_ADDRESS}"
            raise FrameError(where, "tag", f"{len(protected)} bytes from {source}", expected)
        cut = len(protected) - self.overhead_bytes
        tag_at = len(protected) - self.settings.tag_bytes
        low, tag = int.from_bytes(protected[cut:tag_at], "big"), protected[tag_at:]
        head, data = self._split(protected[:cut])
        window = self._windows.get(source) or ReplayWindow()
        for counter in self._candidates(source, window, low):
            plain = self._decrypt(source, counter, head, data + tag)
            if plain is not None:
                self._check_counter(source, window, counter, where)
                self.counts.genuine += 1
                self.last_counter = counter
                return head + plain
        self.counts.forged += 1
        raise FrameError(where, "tag", tag, f"a tag of modem {source} with key {self._key.fingerprint}")

    def _candidates(self, source: int, window: ReplayWindow, low: int) -> Iterator[int]:
        """Yield the counters that a frame can have, the likely ones first.

        First one near the newest, then one near a counter that waits for confirmation. Then older ones, which
        distinguish replays from forgeries. Last all that are farther ahead, so that a receiver recovers after any
        silence.
        """
        step, lifetime = self.settings.counter_step, self.settings.lifetime_frames
        near = window.nearest(low, step)
        if 0 <= near < lifetime:
            yield near
        ahead = self._ahead.get(source)
        unconfirmed = near if ahead is None else ReplayWindow(ahead).nearest(low, step)
        if near < unconfirmed < lifetime:
            yield unconfirmed
        yield from range(near - step, max(-1, near - (_LOOK_BACK + 1) * step), -step)
        for counter in range(near + step, lifetime, step):
            if counter != unconfirmed:
                yield counter

    def _decrypt(self, source: int, counter: int, head: bytes, data: bytes) -> bytes | None:
        """Return the plain data if the tag is correct for this counter, otherwise None."""
        cipher = self._ciphers.get(source)
        if cipher is None:
            cipher = self._ciphers[source] = self._key.cipher(source, self._receives, self.settings)
        try:
            return cipher.decrypt(_nonce(counter), data, head)
        except InvalidTag:
            return None

    def _check_counter(self, source: int, window: ReplayWindow, counter: int, where: str) -> None:
        """Accept a counter with a correct tag, or raise FrameError."""
        if not window.is_new(counter):
            self.counts.replayed += 1
            expected = f"one not accepted before, above {max(-1, window.newest - WINDOW)}"
            raise FrameError(where, "counter", counter, expected)
        if counter > window.newest + self.settings.counter_step - WINDOW:
            # A false tag passes more easily, as thousands of counters were tried: a second frame must confirm it.
            before = self._ahead.get(source)
            if before is None or not 0 < counter - before <= self.settings.counter_step - WINDOW:
                self._ahead[source] = counter
                self.counts.unconfirmed += 1
                raise FrameError(where, "counter", counter, f"near {window.newest}, or a second frame like this one")
        window.accept(counter)
        self._windows[source] = window
        if self._ahead.get(source, counter + 1) <= counter:
            del self._ahead[source]

    def _split(self, covered: bytes) -> tuple[bytes, bytes]:
        """Return what is only authenticated, and what is also encrypted."""
        return (covered[:1], covered[1:]) if self.settings.encrypt else (covered, b"")

    def parts(self) -> dict[str, bytes]:
        """Return the state to save, see `sonarpost.link.state`.

        Save it in the transaction of what followed from the verified frames.
        """
        state = AuthenticationState(self._key.fingerprint, self._limit, self.counts)
        windows = {f"window/{source}": pack_part(SavedWindow(source, w)) for source, w in self._windows.items()}
        return {"authentication": pack_part(state), **windows}

    def restore(self, parts: Parts) -> Errors:
        """Replace the state by saved parts; return why parts were skipped.

        Reserved counters count as used. A limit that was saved later than this state must be passed as
        `first_counter`: the higher one applies. A state of another key has no effect.
        """
        reader = PartReader(parts, "authentication state")
        state = reader.read("authentication", AuthenticationState)
        if state is None or state.key != self._key.fingerprint:
            return reader.errors
        lifetime = self.settings.lifetime_frames

        def check(saved: SavedWindow) -> None:
            if not 0 <= saved.window.newest < lifetime:
                raise FrameError(_WHERE, "newest", saved.window.newest, f"0..{lifetime - 1}")

        self._next = self._limit = min(max(self._limit, state.limit), lifetime)
        self.counts = state.counts
        self._windows = {s.source: s.window for s in reader.read_group("window", SavedWindow, apply=check)}
        self._ahead.clear()
        return reader.errors


def _nonce(counter: int) -> bytes:
    return counter.to_bytes(_NONCE_BYTES, "big")
