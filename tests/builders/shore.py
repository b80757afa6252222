"""Records of a vessel as c2 receives them, and a subscriber that reads its archive."""

import threading
import time
from collections.abc import Iterable
from typing import Any

import msgpack
import zenoh

from builders.common import eventually
from builders.records import reconstructed_image
from sonarpost import keys, wire
from sonarpost.archive.shore_archive import Batch
from sonarpost.bus.catch_up import AcceptedRecord, CatchUpSubscriber
from sonarpost.errors import BadInputError, QueryRefusedError
from sonarpost.messages import Decision, Pixels, ReconstructedImage, Record, Relayed, TaskingState
from sonarpost.services.c2.accepted import image_entry
from sonarpost.services.c2.service import C2Service

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


def number_images(service: C2Service, images: Iterable[ReconstructedImage]) -> None:
    """Number images of c2 without their files and their publication."""
    entries = [image_entry(each, "", service.config.site) for each in images]
    service._archive.index().write(Batch(numbered=[entry.columns(time.time()) for entry in entries]))


def identity(payload: bytes) -> str:
    """Return the identifier of a decision, or of an image."""
    fields = msgpack.unpackb(payload)
    return str(fields.get("decision_id", fields["image_id"]))


class Site:
    """Numbers records, publishes them and answers queries, as c2 does. It has no files.

    Args:
        session: A session at the router of the site.
        records: Records that were accepted before.
        archive: Identity of the archive.
    """

    def __init__(self, session: zenoh.Session, *records: Record, archive: str = "0000000a") -> None:
        self._session = session
        self._archive = archive
        self._accepted: list[tuple[str, bytes]] = []
        self.accept(*records, publish=False)
        for key in (keys.shore_contact_all(), keys.tasking_state_all()):
            session.declare_queryable(key, self._answer, complete=True)

    def accept(self, *records: Record, publish: bool = True) -> None:
        """Accept images, decisions and tasking states; `publish` is false for a publication that is lost."""
        for record in records:
            key = {
                ReconstructedImage: keys.shore_image,
                Decision: keys.shore_decision,
                TaskingState: keys.tasking_state,
            }[type(record)](record.vessel_id)
            accepted = {"archive": self._archive, "seq": len(self._accepted) + 1, "utc_s": 1.0}
            payload = msgpack.packb({**wire.map_of(record), "accepted": accepted}, use_bin_type=True)
            self._accepted.append((key, payload))
            if publish:
                self._session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)

    def _answer(self, query: zenoh.Query) -> None:
        parameters = dict(pair.split("=", 1) for pair in str(query.parameters).split(";"))
        archive, _, after = parameters.get("after", "").partition(".")
        if archive not in ("", self._archive):
            query.reply_err(f"{query.key_expr}: after: got {archive}".encode(), encoding=zenoh.Encoding.TEXT_PLAIN)
        else:
            found = [
                (number, key, payload)
                for number, (key, payload) in enumerate(self._accepted, 1)
                if number > int(after or 0) and query.key_expr.intersects(zenoh.KeyExpr(key))
            ]
            sent = [] if "_time" in parameters else found[: int(parameters["limit"])]
            for _, key, payload in sent:
                query.reply(key, payload)
            more = bool(sent) and len(sent) < len(found)
            end = sent[-1][0] if more else len(self._accepted)
            page = {"type": "page", "v": 1, "records": len(sent), "unreadable": 0, "more": more}
            query.reply(query.key_expr, msgpack.packb({**page, "next": f"{self._archive}.{end}"}))
        query.drop()


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
