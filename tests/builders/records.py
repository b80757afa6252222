"""Records for the tests of several services: images, a message, a decision, a command."""

import time

import numpy as np

from sonarpost.link.frames.paper.frame import format_image_id
from sonarpost.messages import Command, Contact, Decision, EncodedImage, OutgoingMessage, Pixels, ReconstructedImage

FIRST_S = 1_700_000_000.0


def reconstructed_image(pixels: Pixels, **changes: object) -> ReconstructedImage:
    """Return a complete image of vessel-1; `changes` override fields."""
    fields: dict[str, object] = {
        "vessel_id": "vessel-1",
        "vehicle_id": "uuv-1",
        "image_id": "AAAA",
        "version": 1,
        "contact": None,
        "codec": "vq",
        "model": "",
        "pixels": pixels,
        "pixels_sha256": pixels.sha256,
        "complete": True,
        "missing_fraction": 0.0,
        "missing_mask": b"",
        "missing_halves": (),
        "bytes_received": 42,
        "bytes_total": 42,
        "frames_received": 2,
        "first_frame_utc_s": FIRST_S,
        "last_frame_utc_s": FIRST_S + 1.0,
    }
    return ReconstructedImage.model_validate(fields | changes)


def decision_record(decision_id: str = "d1", **changes: object) -> Decision:
    """Return an operator's decision on that image; `changes` override fields."""
    fields: dict[str, object] = {
        "decision_id": decision_id,
        "vessel_id": "vessel-1",
        "vehicle_id": "uuv-1",
        "image_id": "AAAA",
        "image_version": 1,
        "verdict": "mine_like",
        "operator": "op",
        "decided_utc_s": 1.0,
    }
    return Decision.model_validate(fields | changes)


def command_record(kind: str, image_id: str, **changes: object) -> Command:
    """Return a command of the vessel's operator for one of its images; `changes` override fields."""
    fields = {
        "command_id": f"{kind}-{image_id}",
        "kind": kind,
        "vehicle_id": "uuv-1",
        "image_id": image_id,
        "issued_by": "modem 1",
        "issued_utc_s": 1476262800.0,
    }
    return Command.model_validate(fields | changes)


def encoded_image(number: int, length: int = 300) -> EncodedImage:
    """Return the image of contact c<number>; its stream has a valid header and a random body."""
    return EncodedImage(
        vehicle_id="uuv-1",
        image_id=format_image_id(number),
        contact=Contact(contact_id=f"c{number}", vehicle_id="uuv-1", lat_deg=56.4, lon_deg=-5.6, atd_confidence=1.5),
        codec="emb",
        model="",
        height_px=80,
        width_px=80,
        stream=b"\x00\x00\x33" + np.random.default_rng(number).bytes(length - 3),
        original_sha256="0" * 64,
    )


def outgoing_message(message_id: str, **changes: object) -> OutgoingMessage:
    """Return a message whose data is its identifier; `changes` override fields."""
    fields: dict[str, object] = {
        "message_id": message_id,
        "source": "autonomy",
        "priority": 3,
        "created_utc_s": time.time(),
        "lifetime_s": 600.0,
        "data": message_id.encode(),
    }
    return OutgoingMessage.model_validate(fields | changes)
