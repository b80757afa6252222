"""The record of an image that the receiver of a vessel has assembled."""

from __future__ import annotations

from sonarpost.link.frames.contact_record import contact_of
from sonarpost.link.receiver import ImageUpdate
from sonarpost.messages import ReceivedImage


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
