"""Records for the tests of several services: a reconstructed image, a decision, a command."""

from __future__ import annotations

from sonarpost.messages import Command, Decision, Pixels, ReconstructedImage

FIRST_S = 1_700_000_000.0


def reconstructed_image(picture: Pixels, **changes: object) -> ReconstructedImage:
    """Return a complete image of vessel-1; `changes` override fields."""
    fields: dict[str, object] = {
        "vessel_id": "vessel-1",
        "vehicle_id": "uuv-1",
        "image_id": "AAAA",
        "version": 1,
        "contact": None,
        "codec": "vq",
        "model": "",
        "picture": picture,
        "picture_sha256": picture.sha256,
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


def command_record(kind: str, image_id: str) -> Command:
    """Return a command of the vessel's operator for one of its images."""
    return Command(
        command_id=f"{kind}-{image_id}",
        kind=kind,
        vehicle_id="uuv-1",
        image_id=image_id,
        issued_by="modem 1",
        issued_utc_s=1476262800.0,
    )
