"""Accepts once each frame that several vessels received of the same vehicle.

A vehicle authenticates every frame with its own counter: two vessels that receive the same frame receive the same
counter. Each vessel has its own replay window, because its frames arrive in order but late. A second, longer window
over all of them detects duplicates.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, auto
from typing import Annotated, Final

from sonarpost.errors import FrameError
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import MAX_ADDRESS
from sonarpost.link.state import Bounds, Errors, PartReader, Parts, below, pack_part, prefixed

MERGE_WINDOW: Final = 2048
"""A frame that arrives late by fewer counters than this, from any vessel, is still accepted."""

_WINDOW_BYTES: Final = MERGE_WINDOW // 8
_MASK: Final = (1 << MERGE_WINDOW) - 1


class Arrival(Enum):
    """What a verified frame is to a receiver that merges the frames of several vessels."""

    NEW = auto()
    DUPLICATE = auto()
    """Another vessel has delivered it before."""
    LATE = auto()
    """More than `MERGE_WINDOW` counters behind the newest frame."""


@dataclass(slots=True)
class MergedWindow:
    """The counters that were received of one vehicle, from any vessel.

    Attributes:
        key: Fingerprint of the key.
        source: Modem address of the vehicle.
        newest: The highest counter, -1 before the first.
        seen: 256 bytes, big-endian; bit i is set if counter newest - i was received.
    """

    key: str
    source: Annotated[int, Bounds(0, MAX_ADDRESS)]
    newest: Annotated[int, Bounds(-1, 2**62)] = -1
    seen: bytes = bytes(_WINDOW_BYTES)

    def arrive(self, counter: int) -> Arrival:
        """Record a verified counter; return whether its frame is new."""
        seen, ahead = int.from_bytes(self.seen, "big"), counter - self.newest
        if ahead > 0:
            # A shift by a large distance would first make a number of a million bits.
            seen = seen << ahead & _MASK if ahead < MERGE_WINDOW else 0
            self.newest = counter
        behind = self.newest - counter
        if behind >= MERGE_WINDOW:
            return Arrival.LATE
        if seen >> behind & 1:
            return Arrival.DUPLICATE
        self.seen = (seen | 1 << behind).to_bytes(_WINDOW_BYTES, "big")
        return Arrival.NEW


class FrameMerger:
    """Verifies frames of other vessels, and detects frames that arrived before by another way.

    Memory: 300 bytes for each vehicle, and the replay windows of each vessel.

    Args:
        own: Verifies the frames that this vessel received.
        others: Verifies the frames of each other vessel, by its name. They must have the key of `own`.
    """

    def __init__(self, own: FrameAuthenticator, others: Mapping[str, FrameAuthenticator]) -> None:
        self._fingerprint = own.fingerprint
        self._others = dict(others)
        self._windows: dict[int, MergedWindow] = {}

    def verifier(self, vessel: str) -> FrameAuthenticator | None:
        """Return what verifies the frames of another vessel, None if no such vessel is configured."""
        return self._others.get(vessel)

    def arrive(self, source: int, counter: int) -> Arrival:
        """Record a verified frame of a vehicle; return whether it is new."""
        if source not in self._windows:
            self._windows[source] = MergedWindow(self._fingerprint, source)
        return self._windows[source].arrive(counter)

    def is_newest(self, source: int, counter: int) -> bool:
        """Whether no frame of a vehicle with a higher counter has arrived."""
        return source not in self._windows or counter >= self._windows[source].newest

    def parts(self) -> dict[str, bytes]:
        """Return the state to save, see `sonarpost.link.state`."""
        parts = {f"window/{source}": pack_part(window) for source, window in self._windows.items()}
        for vessel, verifier in self._others.items():
            parts |= prefixed(f"vessel/{vessel}/", verifier.parts())
        return parts

    def restore(self, parts: Parts) -> Errors:
        """Replace the state by saved parts; return why parts were skipped. The state of another key has no effect."""
        reader = PartReader(parts, "merging state")

        def check(saved: MergedWindow) -> None:
            if len(saved.seen) != _WINDOW_BYTES:
                raise FrameError("merging state", "seen", f"{len(saved.seen)} bytes", f"{_WINDOW_BYTES} bytes")

        windows = reader.read_group("window", MergedWindow, apply=check)
        self._windows = {window.source: window for window in windows if window.key == self._fingerprint}
        errors = dict(reader.errors)
        for vessel, verifier in self._others.items():
            prefix = f"vessel/{vessel}/"
            errors |= prefixed(prefix, verifier.restore(below(prefix, parts)))
        return errors
