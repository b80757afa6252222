"""The record of an image that the receiver of a vessel has assembled."""

from __future__ import annotations

from typing import Any, Final

from sonarpost.errors import FrameError
from sonarpost.link.frames.contact_record import ContactSummary, summary_of
from sonarpost.link.receiver import ImageUpdate
from sonarpost.messages import Contact, ReceivedImage

_UNKNOWN_FIELDS: Final = {name: field.default for name, field in Contact.model_fields.items()}


def received_image(
    update: ImageUpdate, vessel_id: str, vehicle_id: str, *, authenticated: bool | None = None
) -> ReceivedImage:
    """Return the record of an image's received content.

    The link does not carry the detector's contact identifier: the record has vehicle and image identifier instead.

    Args:
        update: The content.
        vessel_id: Name of the vessel.
        vehicle_id: Name of the vehicle.
        authenticated: Whether all frames of the image were authenticated; None if that is not known.

    Raises:
        ValidationError: A value does not fit the record.
    """
    summary = update.contact
    contact = None if summary is None else contact_of(summary, vehicle_id, update.image_id)
    return ReceivedImage(
        vessel_id=vessel_id,
        vehicle_id=vehicle_id,
        image_id=update.image_id,
        version=update.version,
        contact=contact,
        height_px=None if summary is None else summary.height_px,
        width_px=None if summary is None else summary.width_px,
        stream=update.stream,
        missing=update.missing,
        missing_halves=update.missing_halves,
        complete=update.complete,
        bytes_received=update.received_bytes,
        bytes_total=update.total_bytes,
        frames_received=update.frames,
        conflicts=update.conflicts,
        first_frame_utc_s=update.first_frame_s,
        last_frame_utc_s=update.last_frame_s,
        authenticated=authenticated,
    )


def contact_of(summary: ContactSummary, vehicle_id: str, image_id: str) -> Contact:
    """Return the contact that a contact record describes.

    Raises:
        ValidationError: A value does not fit the record.
    """
    return Contact(**_contact_fields(summary, vehicle_id, image_id))


def _contact_fields(summary: ContactSummary, vehicle_id: str, image_id: str) -> dict[str, Any]:
    return {
        "contact_id": f"{vehicle_id}/{image_id}",
        "vehicle_id": vehicle_id,
        "channel": summary.side.value if summary.side else None,
        "time_utc_s": summary.time_utc_s,
        "lat_deg": summary.lat_deg,
        "lon_deg": summary.lon_deg,
        "position_sigma_m": summary.position_sigma_m,
        "depth_m": summary.depth_m,
        "altitude_m": summary.altitude_m,
        "heading_deg": summary.heading_deg,
        "ground_range_m": summary.ground_range_m,
        "atd_class": summary.atd_class,
        "atd_confidence": summary.confidence,
        "pixel_along_m": summary.pixel_along_m,
        "pixel_across_m": summary.pixel_across_m,
        "p_mine_like": summary.p_mine_like,
        "p_other_object": summary.p_other_object,
    }


def contact_record(contact: Contact, height_px: int | None, width_px: int | None, image_id: str) -> bytes:
    """Return the contact record of 25 bytes if it represents exactly this contact and size, otherwise no bytes."""
    try:
        summary = summary_of(contact, height_px, width_px)
    except FrameError:
        return b""
    has_size = (summary.height_px, summary.width_px) == (height_px, width_px)
    # Dictionaries are compared: making and comparing a second `Contact` takes twice as long.
    fields = _UNKNOWN_FIELDS | _contact_fields(summary, contact.vehicle_id, image_id)
    return summary.pack_exact() if has_size and fields == vars(contact) else b""
