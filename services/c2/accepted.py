"""Records as c2 numbers and publishes them: their keys, subjects and payloads."""

from __future__ import annotations

from collections.abc import Mapping

import msgpack

from sonarpost import keys
from sonarpost.archive.journal import Accepted, JournalEntry
from sonarpost.messages import CodedImage, Decision, ReconstructedImage
from sonarpost.services.c2.tasking import Tasking


def image_entry(image: ReconstructedImage, name: str, site: str, payload: bytes = b"") -> JournalEntry:
    """Return the entry of an image with its payload, if known; `name` is that of its files without suffix."""
    return _entry_of_image(keys.shore_image(image.vessel_id, site), image, name, payload)


def coded_entry(image: CodedImage, site: str) -> JournalEntry:
    """Return the entry of an image in coded form; it has no files."""
    return _entry_of_image(keys.shore_coded(image.vessel_id, site), image, "", b"")


def _entry_of_image(key: str, image: ReconstructedImage | CodedImage, name: str, payload: bytes) -> JournalEntry:
    names = (image.vessel_id, image.vehicle_id, image.image_id)
    subject = f"{image.vehicle_id}/{image.image_id}/{image.first_frame_utc_s!r}"
    return JournalEntry(key, image, *names, subject, image.version, image.contact, name, payload)


def decision_entry(decision: Decision, site: str) -> JournalEntry:
    """Return the entry of a decision."""
    key, subject = keys.shore_decision(decision.vessel_id, site), decision.decision_id
    return JournalEntry(key, decision, decision.vessel_id, decision.vehicle_id, decision.image_id, subject)


def state_entry(item: Tasking, site: str) -> JournalEntry:
    """Return the entry of the state of a comment or command."""
    record, state = item.record, item.state_record()
    key, subject = keys.tasking_state(item.vessel_id, site), f"{state.kind}/{state.record_id}"
    return JournalEntry(key, state, item.vessel_id, record.vehicle_id, record.image_id or "", subject)


def accepted_fields(fields: Mapping[str, object], accepted: Accepted) -> dict[str, object]:
    """Return the map of a record with its number, as c2 publishes it and sends it as a reply.

    The number is a field and no attachment: consumers ignore publications with an attachment.
    """
    return {**fields, "accepted": {"archive": accepted.archive, "seq": accepted.seq, "utc_s": accepted.utc_s}}


def payload_of(fields: Mapping[str, object]) -> bytes:
    """Return the payload of a record's map, as `wire.encode` does."""
    packed: bytes = msgpack.packb(fields, use_bin_type=True)
    return packed


def accepted_payload(entry: JournalEntry, accepted: Accepted) -> bytes:
    """Return the payload of `accepted_fields`, from the bytes of the record."""
    count, number = len(entry.fields), accepted_fields({}, accepted)
    header = payload_header(count)
    assert entry.payload.startswith(header)
    return payload_header(count + 1) + entry.payload[len(header) :] + payload_of(number)[1:]


def payload_header(count: int) -> bytes:
    """Return the first bytes of a msgpack map with so many fields."""
    packed: bytes = msgpack.Packer().pack_map_header(count)
    return packed
