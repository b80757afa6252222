"""Seals of acoustic frames: a short tag, a counter against replays, and encryption where it is wanted.

AES-256-CCM (NIST SP 800-38C, RFC 3610). A sealed frame ends with the low bytes of its counter and the tag; the whole
counter is the nonce, so that it is authenticated without being sent. docs/specifications/acoustic-v1.md specifies it
and argues how safe it is. Pure: what must outlive a restart is handed out and taken back.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Final

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESCCM

from sonarpost.errors import ConfigError, FrameError
from sonarpost.link.auth.key import MAX_ADDRESS, AcousticKey, AuthenticationSettings, Direction
from sonarpost.link.auth.replay_window import WINDOW, ReplayWindow
from sonarpost.link.receiver_state import read_field, read_list, read_number

RESERVED: Final = 64
"""Counters reserved at a time; a crash skips at most so many, which is well within what a receiver bridges."""

_STATE_FORMAT: Final = 1
_NONCE_BYTES: Final = 13
_LOOK_BACK: Final = 64


@dataclass(frozen=True, slots=True)
class AuthenticationCounts:
    """Counters since the beginning, restarts included.

    Attributes:
        sealed: Frames sealed.
        genuine: Frames opened.
        forged: Undamaged, with a tag that this key did not make: forged, or of a station with another key.
        replayed: With a right tag and a counter that was taken before, or is too old to tell.
        unconfirmed: With a right tag, but so far ahead that a second frame must confirm it.
    """

    sealed: int = 0
    genuine: int = 0
    forged: int = 0
    replayed: int = 0
    unconfirmed: int = 0


class FrameAuthenticator:
    """Seals what this station sends and opens what others send: a `FrameSeal`.

    Before frames are sealed, counters must be reserved, so that none is used twice, whatever crashes when:

        if (limit := seal.wanted_limit) is not None:
            ...make `limit` durable...
            seal.grant(limit)

    Memory: a window of two numbers for each of at most 128 transmitters, and only after one of their frames was
    genuine.

    Args:
        key: The common key.
        address: This station's modem address, 0..127. No two stations that send in one direction may share one.
        sends: Direction of what this station sends; it opens what goes the other way.
        settings: As agreed with the other end.
        first_counter: The limit that was made durable last, 0 with a new key.

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
                raise ConfigError("acoustic seal", name, value, f"0..{high}")
        self._key = key
        self._hears = sends.opposite
        self._own = key.cipher(address, sends, self.settings)
        self._ciphers: dict[int, AESCCM] = {}
        self._windows: dict[int, ReplayWindow] = {}
        self._ahead: dict[int, int] = {}
        self._next = self._limit = first_counter
        self._counts = AuthenticationCounts()

    @property
    def size(self) -> int:
        """Bytes that a seal adds to a frame."""
        return self.settings.size

    @property
    def counts(self) -> AuthenticationCounts:
        """The counters."""
        return self._counts

    @property
    def frames_left(self) -> int:
        """How many frames may still be sealed with this key."""
        return self.settings.lifetime_frames - self._next

    @property
    def wanted_limit(self) -> int | None:
        """The limit to make durable and to `grant`, None while half a reservation is left."""
        limit = min(self._next + RESERVED, self.settings.lifetime_frames)
        return limit if self._limit - self._next < RESERVED // 2 and limit > self._limit else None

    def grant(self, limit: int) -> None:
        """Allow counters below `limit`, which must be durable by now.

        Raises:
            ConfigError: Lower than before, or beyond what the key is good for.
        """
        if not self._limit <= limit <= self.settings.lifetime_frames:
            raise ConfigError("acoustic seal", "limit", limit, f"{self._limit}..{self.settings.lifetime_frames}")
        self._limit = limit

    def seal(self, covered: bytes) -> bytes:
        """Return a frame (after its checksum) with its counter and tag; the first byte is never encrypted.

        Raises:
            FrameError: No counter is reserved, or the key is used up. Nothing was consumed.
        """
        if self._next >= self._limit:
            expected = "a limit granted above it"
            if self._next >= self.settings.lifetime_frames:
                expected = f"a new key after {self.settings.lifetime_frames} frames"
            raise FrameError("acoustic seal", "counter", self._next, expected)
        counter, self._next = self._next, self._next + 1
        head, data = self._parts(covered)
        sealed = self._own.encrypt(_nonce(counter), data, head)
        cut = len(sealed) - self.settings.tag_bytes
        low = (counter % self.settings.counter_step).to_bytes(self.settings.counter_bytes, "big")
        self._count(sealed=1)
        return head + sealed[:cut] + low + sealed[cut:]

    def open(self, source: int, sealed: bytes, where: str = "acoustic frame") -> bytes:
        """Return what `seal` was given.

        Args:
            source: Modem address it came from.
            sealed: The frame after its checksum.
            where: Names the frame in errors.

        Raises:
            FrameError: Field `tag`: not sealed with this key by this source. Field `counter`: a replay, or so far
                ahead that another frame must confirm it.
        """
        if not (0 <= source <= MAX_ADDRESS and len(sealed) > self.size):
            self._count(forged=1)
            expected = f"more than {self.size} bytes from an address of 0..{MAX_ADDRESS}"
            raise FrameError(where, "tag", f"{len(sealed)} bytes from {source}", expected)
        cut = len(sealed) - self.size
        tag_at = len(sealed) - self.settings.tag_bytes
        low, tag = int.from_bytes(sealed[cut:tag_at], "big"), sealed[tag_at:]
        head, data = self._parts(sealed[:cut])
        known = self._windows.get(source)
        window = ReplayWindow() if known is None else known
        for counter in self._candidates(source, window, low):
            opened = self._try(source, counter, head, data + tag)
            if opened is not None:
                self._judge(source, window, counter, where)
                self._count(genuine=1)
                return head + opened
        self._count(forged=1)
        raise FrameError(where, "tag", tag, f"a tag of modem {source} made with key {self._key.fingerprint}")

    def _candidates(self, source: int, window: ReplayWindow, low: int) -> Iterator[int]:
        """Yield the counters that a frame may have, likely ones first.

        One that is near; one near what waits to be confirmed; older ones, which tell replays from forgeries; and
        all that are farther ahead, so that a receiver finds back after any silence.
        """
        step, lifetime = self.settings.counter_step, self.settings.lifetime_frames
        near = window.nearest(low, step)
        if 0 <= near < lifetime:
            yield near
        ahead = self._ahead.get(source)
        waiting = near if ahead is None else ReplayWindow(ahead).nearest(low, step)
        if near < waiting < lifetime:
            yield waiting
        yield from range(near - step, max(-1, near - (_LOOK_BACK + 1) * step), -step)
        for counter in range(near + step, lifetime, step):
            if counter != waiting:
                yield counter

    def _try(self, source: int, counter: int, head: bytes, data: bytes) -> bytes | None:
        """Return the plain data if the tag is right for this counter, else None."""
        cipher = self._ciphers.get(source)
        if cipher is None:
            cipher = self._ciphers[source] = self._key.cipher(source, self._hears, self.settings)
        try:
            return cipher.decrypt(_nonce(counter), data, head)
        except InvalidTag:
            return None

    def _judge(self, source: int, window: ReplayWindow, counter: int, where: str) -> None:
        """Take a counter whose tag is right into the window, or raise FrameError."""
        if not window.is_new(counter):
            self._count(replayed=1)
            raise FrameError(where, "counter", counter, f"one not taken yet, above {max(-1, window.newest - WINDOW)}")
        if counter > window.newest + self.settings.counter_step - WINDOW:
            # Thousands of counters were tried for this one tag. A second frame right after it makes up for that.
            before = self._ahead.get(source)
            if before is None or not 0 < counter - before <= self.settings.counter_step - WINDOW:
                self._ahead[source] = counter
                self._count(unconfirmed=1)
                raise FrameError(where, "counter", counter, f"near {window.newest}, or a second frame like this one")
        window.take(counter)
        self._windows[source] = window
        if self._ahead.get(source, counter + 1) <= counter:
            del self._ahead[source]

    def _parts(self, covered: bytes) -> tuple[bytes, bytes]:
        """Return what is authenticated only, and what is encrypted too."""
        return (covered[:1], covered[1:]) if self.settings.encrypt else (covered, b"")

    def snapshot(self) -> dict[str, object]:
        """Return the state as maps, lists, numbers, strings and bytes (msgpack can hold it).

        Save it together with what followed from the frames that were opened. It belongs to this key: keep the states of
        different keys apart, by fingerprint, so that no counter of an old key is used again.
        """
        return {
            "format": _STATE_FORMAT,
            "key": self._key.fingerprint,
            "limit": self._limit,
            "windows": [[source, w.newest, w.seen.to_bytes(8, "big")] for source, w in self._windows.items()],
            "counts": asdict(self._counts),
        }

    def restore(self, state: Mapping[str, object]) -> None:
        """Take up a state that `snapshot` returned. What was reserved counts as used.

        A limit made durable later than this state must be given as `first_counter`: the higher one holds.

        Raises:
            FrameError: The state is not one that `snapshot` made, or of another key; the seal is then as before.
        """
        if state.get("format") != _STATE_FORMAT:
            raise FrameError("seal state", "format", state.get("format"), str(_STATE_FORMAT))
        if state.get("key") != self._key.fingerprint:
            raise FrameError("seal state", "key", state.get("key"), self._key.fingerprint)
        try:
            limit = read_number(state, "limit", 0, self.settings.lifetime_frames)
            windows = dict(self._import_window(entry) for entry in read_list(state, "windows"))
            counts = read_field(state, "counts", dict)
            restored = AuthenticationCounts(
                **{name: read_number(counts, name, 0, 2**62) for name in asdict(self._counts)}
            )
        except FrameError as error:
            raise FrameError("seal state", error.field, error.value, error.expected) from error
        self._next = self._limit = max(self._limit, limit)
        self._windows, self._counts = windows, restored
        self._ahead.clear()

    def _import_window(self, entry: object) -> tuple[int, ReplayWindow]:
        match entry:
            case [int(source), int(newest), bytes(seen)] if (
                0 <= source <= MAX_ADDRESS and 0 <= newest < self.settings.lifetime_frames and len(seen) == 8
            ):
                return source, ReplayWindow(newest, int.from_bytes(seen, "big"))
            case _:
                raise FrameError("seal state", "windows", entry, "[address, counter, 8 bytes]")

    def _count(self, **more: int) -> None:
        added = {name: getattr(self._counts, name) + number for name, number in more.items()}
        self._counts = replace(self._counts, **added)


def _nonce(counter: int) -> bytes:
    return counter.to_bytes(_NONCE_BYTES, "big")
