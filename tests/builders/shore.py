"""Records of a vessel as c2 receives them, and a subscriber that reads its archive."""

import threading
from typing import Any

import msgpack
import zenoh

from builders.common import eventually
from builders.records import reconstructed_image
from sonarpost import keys, wire
from sonarpost.bus.catch_up import AcceptedRecord, CatchUpSubscriber
from sonarpost.errors import BadInputError, QueryRefusedError
from sonarpost.messages import Decision, Pixels, ReconstructedImage, Relayed

CONTACTS = "sonarpost/v1/shore/contact/*/*"


def image(
    image_id: str = "AAAA", value: int = 1, start_s: float = 1_700_000_000.0, **changes: Any
) -> ReconstructedImage:
    """Return a small image of vessel-1; all pixels have one value."""
    pixels = Pixels(height_px=20, width_px=30, bits=8, data=bytes([value]) * 600)
    times = {"first_frame_utc_s": start_s, "last_frame_utc_s": start_s + 1}
    return reconstructed_image(pixels, image_id=image_id, **times | changes)


def relayed(record: ReconstructedImage | Decision, vessel: str = "", **changes: Any) -> Relayed:
    """Return a record in the envelope of its vessel's relay; `changes` override fields."""
    vessel = vessel or record.vessel_id
    is_image = isinstance(record, ReconstructedImage)
    key = keys.image_reconstructed(vessel) if is_image else keys.contact_decision(vessel)
    fields = {"vessel_id": vessel, "key": key, "payload": wire.encode(record), "relayed_utc_s": 5.0}
    return Relayed.model_validate(fields | changes)


def identity(payload: bytes) -> str:
    """Return the identifier of a decision, or of an image."""
    fields = msgpack.unpackb(payload)
    return str(fields.get("decision_id", fields["image_id"]))


class Reader:
    """A `CatchUpSubscriber` in a thread, with the records that it has received."""

    def __init__(self, session: zenoh.Session, cursor: str = "", refresh_s: float = 0.5) -> None:
        self.records: list[AcceptedRecord] = []
        self.error: Exception | None = None
        self.subscriber = CatchUpSubscriber(session, CONTACTS, cursor, refresh_s=refresh_s)
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        try:
            self.records.extend(self.subscriber)
        except (QueryRefusedError, BadInputError) as error:
            self.error = error

    def identities(self) -> list[str]:
        """Return the identifiers of the records so far."""
        return [identity(record.payload) for record in self.records]

    def wait_for(self, count: int) -> list[str]:
        """Wait for so many records and for a complete query after them; return what was received."""
        eventually(lambda: len(self.records) >= count, what=f"{count} records")
        eventually(lambda: self.subscriber.is_caught_up)
        return self.identities()

    def close(self) -> None:
        """End the subscription."""
        self.subscriber.close()
        self._thread.join()
