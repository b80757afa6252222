"""Records for tests of short messages, and the writer of their golden file.

`PYTHONPATH=tests python -m extensions.satellite.records` prints the golden file. It is added to, never changed.
"""

import binascii
import json

from sonarpost.codec.interface import StreamHeader
from sonarpost.extensions.satellite.short_message import (
    Item,
    ItemType,
    ShortAcknowledgement,
    ShortMessage,
    decision_fragments,
    pack_contact,
    pack_decision,
)
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.receiver import ImageUpdate, received_image
from sonarpost.messages import Decision, ReceivedImage
from sonarpost.sonar.survey import Side

SUMMARY = ContactSummary(
    height_px=80,
    width_px=140,
    lat_deg=50.1234,
    lon_deg=-1.2345,
    time_utc_s=1_700_000_000.0,
    confidence=1.5,
    heading_deg=120.0,
    altitude_m=8.0,
    depth_m=22.5,
    side=Side.PORT,
    ground_range_m=31.2,
    pixel_along_m=0.05,
    pixel_across_m=0.05,
    position_sigma_m=4.0,
    atd_class="mine_like",
    p_mine_like=0.8,
    p_other_object=0.15,
)


def received(
    number: int = 1, stream_bytes: int = 200, *, contact: bool = True, version: int = 1, vehicle: str = "uuv-1"
) -> ReceivedImage:
    """Return an image of vessel-1 with a valid stream header and a body of counting bytes."""
    header = StreamHeader(0x20, 1, 80, 140).pack()
    stream = (header + bytes(n % 251 for n in range(stream_bytes)))[:stream_bytes]
    update = ImageUpdate(
        source=3,
        image_id=f"{number:04d}",
        version=version,
        contact=SUMMARY.rounded() if contact else None,
        stream=stream,
        missing=(),
        complete=True,
        received_bytes=len(stream),
        total_bytes=len(stream),
        frames=3,
        conflicts=0,
        first_frame_s=1_700_000_100.25 + number,
        last_frame_s=1_700_000_160.5 + number,
    )
    return received_image(update, "vessel-1", vehicle, authenticated=True)


def decision(decision_id: str = "d1", **changes: object) -> Decision:
    """Return a decision of vessel-1; `changes` override fields."""
    fields: dict[str, object] = {
        "decision_id": decision_id,
        "vessel_id": "vessel-1",
        "vehicle_id": "uuv-1",
        "image_id": "0001",
        "image_version": 1,
        "verdict": "mine_like",
        "confidence": 0.75,
        "mlo_class": "moored",
        "operator": "Lt. Example",
        "decided_utc_s": 1_700_000_300.0,
    }
    return Decision.model_validate(fields | changes)


def with_crc(body: bytes) -> bytes:
    """Return a message with its CRC."""
    return body + binascii.crc_hqx(body, 0xFFFF).to_bytes(2, "big")


def golden() -> dict[str, str]:
    """Return the messages of the golden file, hexadecimal."""
    contact = Item(ItemType.CONTACT, pack_contact(received()))
    other = Item(ItemType.CONTACT, pack_contact(received(2, 0, contact=False)))
    verdict = Item(ItemType.DECISION, pack_decision(decision()))
    long = decision_fragments(pack_decision(decision("d2", remark="r" * 600)), 7)
    return {
        "contact with preview": ShortMessage(0x01020304, 0, 0, (contact,)).pack().hex(),
        "decision and image without contact record": ShortMessage(0x01020304, 5, 3, (verdict, other)).pack().hex(),
        **{f"fragment {n}": ShortMessage(9, n, 0, (item,)).pack().hex() for n, item in enumerate(long)},
        "acknowledgement": ShortAcknowledgement(0x01020304, 17, frozenset({18, 25, 40})).pack().hex(),
    }


if __name__ == "__main__":
    print(json.dumps(golden(), indent=1))
