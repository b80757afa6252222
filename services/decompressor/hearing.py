"""The receivers of both wire formats, with their state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sonarpost.errors import FrameError
from sonarpost.link import migration
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.config import ReceiverConfig
from sonarpost.link.frames.paper.receiver import PaperReceiver
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.receiver import CombinedReceiver, Event, FrameRejected, ImageUpdate, WireFormat
from sonarpost.link.state import Parts, below, prefixed

MEMORY_S = 6 * 3600.0
_PAPER, _V1, _AUTHENTICATION = "paper/", "v1/", "authentication/"
_OLD_PAPER, _OLD_V1, _OLD_SEAL = "receiver", "receiver-v1", "seal"


class FrameReceivers:
    """Receives vehicles of either format.

    Args:
        links: Formats to receive, `v1` and `paper`, or one of them. With authentication `paper` is rejected: its frames
            are not authenticated.
        pairing_timeout_s: Of the paper's format.
        seal: Verifies frames of `v1`.
    """

    OLD_STATES = (_OLD_PAPER, _OLD_V1, _OLD_SEAL)
    """Names of the states of version 0.1."""

    def __init__(
        self, links: Sequence[WireFormat], pairing_timeout_s: float, seal: FrameAuthenticator | None = None
    ) -> None:
        memory_s = max(MEMORY_S, pairing_timeout_s)
        self.seal = seal
        self.paper = PaperReceiver(pairing_timeout_s, memory_s=memory_s)
        self.v1 = V1Receiver(ReceiverConfig(contact_memory_s=memory_s), protection=seal)
        self._receiver = CombinedReceiver(
            self.v1 if "v1" in links else None, self.paper if "paper" in links and seal is None else None
        )

    def accept(self, source: int, frame: bytes, now: float) -> list[ImageUpdate | FrameRejected]:
        """Process a frame; return what follows from it for images. Never raises because of `frame`."""
        return _of_images(self._receiver.accept(source, frame, now))

    def poll(self, now: float) -> list[ImageUpdate | FrameRejected]:
        """Return the images that are due without a frame."""
        return _of_images(self._receiver.poll(now))

    def parts(self) -> dict[str, bytes]:
        """Return the state to save."""
        parts = {**prefixed(_PAPER, self.paper.parts()), **prefixed(_V1, self.v1.parts())}
        return parts if self.seal is None else {**parts, **prefixed(_AUTHENTICATION, self.seal.parts())}

    def restore(self, parts: Parts) -> dict[str, FrameError]:
        """Replace the state by saved parts; return why parts were skipped."""
        errors = {_PAPER + name: error for name, error in self.paper.restore(below(_PAPER, parts)).items()}
        errors |= {_V1 + name: error for name, error in self.v1.restore(below(_V1, parts)).items()}
        if self.seal is not None:
            skipped = self.seal.restore(below(_AUTHENTICATION, parts))
            errors |= {_AUTHENTICATION + name: error for name, error in skipped.items()}
        return errors

    def restore_old(self, states: Mapping[str, bytes]) -> dict[str, FrameError]:
        """Replace the state by that of version 0.1; names: `OLD_STATES`. Return why some was skipped."""
        parts: dict[str, bytes] = {}
        errors: dict[str, FrameError] = {}
        for name, prefix, convert in (
            (_OLD_PAPER, _PAPER, migration.paper_receiver_parts),
            (_OLD_V1, _V1, migration.v1_receiver_parts),
            (_OLD_SEAL, _AUTHENTICATION, migration.authentication_parts),
        ):
            if name in states:
                try:
                    parts |= prefixed(prefix, convert(states[name]))
                except FrameError as error:
                    errors[name] = error
        return {**errors, **self.restore(parts)}


def _of_images(events: Sequence[Event]) -> list[ImageUpdate | FrameRejected]:
    return [event for event in events if isinstance(event, (ImageUpdate, FrameRejected))]
