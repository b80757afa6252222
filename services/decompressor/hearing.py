"""The receivers of both wire formats, and which of them a frame is for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import msgpack

from sonarpost.errors import FrameError
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.config import ReceiverConfig
from sonarpost.link.events import ContactUpdate, FrameRefused
from sonarpost.link.events import Event as V1Event
from sonarpost.link.frames.paper.events import Event as PaperEvent
from sonarpost.link.frames.paper.frame import parse_frame
from sonarpost.link.frames.paper.receiver import PaperReceiver
from sonarpost.link.receiver import LinkReceiver

LinkName = Literal["v1", "paper"]
Event = PaperEvent | ContactUpdate | FrameRefused

MEMORY_S = 6 * 3600.0
_PAPER, _V1, _SEAL = "receiver", "receiver-v1", "seal"


class FrameReceivers:
    """Hears vehicles that speak either format, each frame by itself.

    A frame is of `v1` if its checksum is right, and of `paper` if it is not and its fields have a meaning there. A
    frame of either is taken for the other once in 2^16, or less.

    Args:
        links: Formats that are taken, `v1` and `paper`, or one of them. With a seal the paper's is not: nobody vouches
            for its frames.
        pairing_timeout_s: Of the paper's format.
        seal: Of `v1`; see `v1_receiver.Receiver`.
    """

    STATES = (_PAPER, _V1, _SEAL)

    def __init__(
        self, links: Sequence[LinkName], pairing_timeout_s: float, seal: FrameAuthenticator | None = None
    ) -> None:
        memory_s = max(MEMORY_S, pairing_timeout_s)
        self._links = frozenset(links) - (frozenset() if seal is None else {"paper"})
        self.seal = seal
        self.paper = PaperReceiver(pairing_timeout_s, memory_s=memory_s)
        self.v1 = LinkReceiver(ReceiverConfig(contact_memory_s=memory_s), seal=seal)
        self._changed: set[str] = set()

    def accept(self, source: int, frame: bytes, now: float) -> list[Event]:
        """Take a frame; return what follows from it for pictures. Never raises because of `frame`."""
        if "v1" in self._links:
            events = self.v1.accept(source, frame, now)
            self._changed |= {_V1} if self.seal is None else {_V1, _SEAL}
            if not _is_foreign(events) or "paper" not in self._links or not _is_of_paper(frame):
                return [event for event in events if isinstance(event, (ContactUpdate, FrameRefused))]
        elif "paper" not in self._links:
            return []
        self._changed.add(_PAPER)
        return list(self.paper.accept(source, frame, now))

    def poll(self, now: float) -> list[Event]:
        """Return what the paper's format gives out because its time is up."""
        events: list[Event] = list(self.paper.poll(now))
        if events:
            self._changed.add(_PAPER)
        return events

    def changes(self) -> dict[str, bytes]:
        """Return the states that changed since the last call, by name, to be kept."""
        changed, self._changed = self._changed, set()
        kept: dict[str, PaperReceiver | LinkReceiver | FrameAuthenticator] = {_PAPER: self.paper, _V1: self.v1}
        if self.seal is not None:
            kept[_SEAL] = self.seal
        return {name: bytes(msgpack.packb(kept[name].snapshot())) for name in sorted(changed)}

    def restore(self, kept: Mapping[str, bytes | None]) -> None:
        """Take up what `changes` returned; names: `Hearing.STATES`.

        Raises:
            FrameError: It did not return this.
        """
        for name, receiver in ((_PAPER, self.paper), (_V1, self.v1)):
            state = kept.get(name)
            if state is not None:
                receiver.restore(msgpack.unpackb(state, strict_map_key=False))
        sealed = kept.get(_SEAL)
        if self.seal is not None and sealed is not None:
            windows = msgpack.unpackb(sealed, strict_map_key=False)
            if windows["key"] == self.seal.snapshot()["key"]:  # with another key everything begins anew
                self.seal.restore(windows)


def _is_foreign(events: Sequence[V1Event]) -> bool:
    """Whether a frame as a whole was refused: the one event says so."""
    return len(events) == 1 and isinstance(events[0], FrameRefused)


def _is_of_paper(frame: bytes) -> bool:
    try:
        parse_frame(frame)
    except FrameError:
        return False
    return True
