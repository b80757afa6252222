"""JSON form of records, for clients without msgpack: fields as in msgpack, bytes as base64."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from pathlib import Path

from sonarpost.messages import Pixels
from sonarpost.services.c2.query_parameters import Picture
from sonarpost.sonar.image_files import png_bytes

ENCODING = "application/json"
"""Without a schema: Zenoh's REST interface inserts values of exactly this encoding into its replies."""


def json_payload(fields: Mapping[str, object], picture: Picture) -> bytes:
    """Return a record as JSON.

    Args:
        fields: The map of the record's payload.
        picture: Form of `picture`: `raw` has `data` (base64), `png` has `png` (base64 of a PNG file) instead, `none`
            neither.
    """
    changed: dict[str, object] = {}
    pixels = fields.get("picture")
    if isinstance(pixels, dict) and picture != "raw":
        without = {name: value for name, value in pixels.items() if name != "data"}
        if picture == "png":
            array = Pixels.model_validate(pixels).to_array()
            without["png"] = png_bytes(Path("picture.png"), array)
        changed["picture"] = without
    return json.dumps({**fields, **changed}, default=_base64, ensure_ascii=False, allow_nan=False).encode()


def _base64(value: object) -> str:
    if isinstance(value, bytes):
        return base64.b64encode(value).decode("ascii")
    raise TypeError(type(value).__name__)
