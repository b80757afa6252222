"""JSON messages for Foxglove: image, position and map of contacts, with their schemas.

The schemas have the names and fields of `foxglove.CompressedImage`, `foxglove.LocationFix` and `foxglove.GeoJSON`
(https://docs.foxglove.dev/docs/sdk/schemas).
"""

import base64
import json
from collections.abc import Iterable, Mapping
from typing import Final

from sonarpost.export.contacts import ExportContact
from sonarpost.export.geo.kml import COLOURS
from sonarpost.export.tables import geojson_feature
from sonarpost.messages import ReconstructedImage
from sonarpost.review.rendering import eight_bits, encode_png

Document = Mapping[str, object]

COMPRESSED_IMAGE: Final = "foxglove.CompressedImage"
LOCATION_FIX: Final = "foxglove.LocationFix"
GEOJSON: Final = "foxglove.GeoJSON"

_TIME: Final[Document] = {
    "type": "object",
    "title": "time",
    "properties": {
        "sec": {"type": "integer", "minimum": 0},
        "nsec": {"type": "integer", "minimum": 0, "maximum": 999_999_999},
    },
}
_TEXT: Final[Document] = {"type": "string"}
_NUMBER: Final[Document] = {"type": "number"}


def _schema(name: str, properties: Document) -> Document:
    return {"title": name, "type": "object", "properties": properties}


SCHEMAS: Final[Mapping[str, Document]] = {
    COMPRESSED_IMAGE: _schema(
        COMPRESSED_IMAGE,
        {
            "timestamp": _TIME,
            "frame_id": _TEXT,
            "data": {"type": "string", "contentEncoding": "base64"},
            "format": _TEXT,
        },
    ),
    LOCATION_FIX: _schema(
        LOCATION_FIX,
        {
            "timestamp": _TIME,
            "frame_id": _TEXT,
            "latitude": _NUMBER,
            "longitude": _NUMBER,
            "altitude": _NUMBER,
            "position_covariance": {"type": "array", "items": _NUMBER, "minItems": 9, "maxItems": 9},
            "position_covariance_type": {
                "title": "foxglove.PositionCovarianceType",
                "oneOf": [
                    {"title": title, "const": value}
                    for value, title in enumerate(("UNKNOWN", "APPROXIMATED", "DIAGONAL_KNOWN", "KNOWN"))
                ],
            },
        },
    ),
    GEOJSON: _schema(GEOJSON, {"geojson": _TEXT}),
}
"""Name -> JSON schema."""

_UNKNOWN, _APPROXIMATED = 0, 1


def compressed_image(image: ReconstructedImage, time_ns: int) -> Document:
    """Return the pixels as PNG of 8 bits; `frame_id` is `{vehicle}/{image}`."""
    png = encode_png(eight_bits(image.pixels.to_array()))
    return {
        "timestamp": _time(time_ns),
        "frame_id": f"{image.vehicle_id}/{image.image_id}",
        "data": base64.b64encode(png).decode("ascii"),
        "format": "png",
    }


def location_fix(image: ReconstructedImage, time_ns: int) -> Document | None:
    """Return the position of the contact, None if it is unknown.

    The covariance is approximated by the worse axis of the error ellipse. The altitude is 0: depth is measured from the
    surface, not from the ellipsoid.
    """
    contact = image.contact
    if contact is None or contact.lat_deg is None or contact.lon_deg is None:
        return None
    sigma_m = contact.position_sigma_m
    variance = 0.0 if sigma_m is None else sigma_m**2
    return {
        "timestamp": _time(time_ns),
        "frame_id": f"{image.vehicle_id}/{image.image_id}",
        "latitude": contact.lat_deg,
        "longitude": contact.lon_deg,
        "altitude": 0.0,
        "position_covariance": [variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, 0.0],
        "position_covariance_type": _UNKNOWN if sigma_m is None else _APPROXIMATED,
    }


def contact_map(contacts: Iterable[ExportContact]) -> Document:
    """Return all given contacts with a position as one message, coloured by their review state as in KML."""
    features = []
    for contact in contacts:
        if contact.position is not None:
            feature = geojson_feature(contact)
            known = {name: value for name, value in feature["properties"].items() if value is not None}
            features.append({**feature, "properties": known | {"style": {"color": COLOURS[contact.review]}}})
    document = {"type": "FeatureCollection", "features": features}
    return {"geojson": json.dumps(document, ensure_ascii=False, allow_nan=False)}


def _time(time_ns: int) -> Document:
    return {"sec": time_ns // 1_000_000_000, "nsec": time_ns % 1_000_000_000}
