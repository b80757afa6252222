"""GeoJSON (RFC 7946): one point a contact, longitude first, WGS 84."""

from __future__ import annotations

import json
from pathlib import Path

from sonarpost.export.accepted import Accepted
from sonarpost.export.properties import Value, properties
from sonarpost.export.text import xml_text
from sonarpost.files import write_atomically


def geojson(accepted: Accepted) -> dict[str, object]:
    """Return a FeatureCollection.

    Contacts without a position are no features: their properties stand in the foreign member `unlocated`, so that no
    map shows them anywhere.
    """
    features: list[dict[str, object]] = []
    for contact in accepted.located:
        values = _safe(properties(contact))
        point = {"type": "Point", "coordinates": [values["lon_deg"], values["lat_deg"]]}
        features.append({"type": "Feature", "id": contact.uid, "geometry": point, "properties": values})
    unlocated = [_safe(properties(contact)) for contact in accepted.unlocated]
    return {"type": "FeatureCollection", "features": features, "unlocated": unlocated}


def geojson_bytes(accepted: Accepted) -> bytes:
    """Return the FeatureCollection as UTF-8 text; the same contacts give the same bytes."""
    return (json.dumps(geojson(accepted), ensure_ascii=False, allow_nan=False, indent=1) + "\n").encode()


def write_geojson(path: Path, accepted: Accepted) -> None:
    """Write the FeatureCollection to `path`, whole or not at all.

    Raises:
        OSError: It cannot be written.
    """
    write_atomically(path, geojson_bytes(accepted))


def _safe(values: dict[str, Value]) -> dict[str, Value]:
    """Take out what UTF-8 cannot carry and what no reader shows."""
    return {name: xml_text(value) if isinstance(value, str) else value for name, value in values.items()}
