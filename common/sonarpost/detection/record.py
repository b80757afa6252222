"""The contact record of a detection."""

from __future__ import annotations

from sonarpost.detection.detector import Detection
from sonarpost.detection.stream import FileOrigin
from sonarpost.messages import Contact


def contact_record(detection: Detection, origin: FileOrigin, vehicle_id: str, sonar_id: str) -> Contact:
    """Return the contact record of a detection. A height is set only if the shadow was recorded to its end.

    Args:
        detection: The detection.
        origin: The file of its ping.
        vehicle_id: Vehicle of the record.
        sonar_id: Sonar, as the file names it.
    """
    d = detection
    return Contact(
        contact_id=origin.contact_id(d),
        vehicle_id=vehicle_id,
        sonar_id=sonar_id,
        line_name=origin.line_name,
        ping_number=d.ping_number,
        channel=d.side.value,
        time_utc_s=d.time_utc_s,
        lat_deg=d.position.lat_deg if d.position else None,
        lon_deg=d.position.lon_deg if d.position else None,
        position_sigma_m=d.position_sigma_m,
        position_note=d.position_note,
        depth_m=d.depth_m,
        altitude_m=d.altitude_m,
        heading_deg=d.heading_deg,
        speed_mps=d.speed_mps,
        slant_range_m=d.slant_range_m,
        ground_range_m=d.ground_range_m,
        atd_class=d.atd_class,
        atd_confidence=d.confidence,
        length_m=d.length_m,
        width_m=d.width_m,
        shadow_m=d.shadow_m,
        height_m=None if d.shadow_is_cut else d.height_m,
        pixel_along_m=d.pixel_along_m,
        pixel_across_m=d.pixel_across_m,
        p_mine_like=d.p_mine_like,
        p_other_object=d.p_other_object,
    )
