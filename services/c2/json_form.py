"""JSON form of records, for clients without msgpack: fields as in msgpack, bytes as base64."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from pathlib import Path

from sonarpost.messages import Pixels
from sonarpost.services.c2.query_parameters import PixelForm
from sonarpost.sonar.image_files import png_bytes

ENCODING = "application/json"
"""Without a schema: Zenoh's REST interface inserts values of exactly this encoding into its replies."""


def json_payload(fields: Mapping[str, object], form: PixelForm) -> bytes:
    """Return a record as JSON.

    Args:
        fields: The map of the record's payload.
        form: Form of `pixels`: `raw` has `data` (base64), `png` has `png` (base64 of a PNG file) instead, `none`
            neither.
    """
    changed: dict[str, object] = {}
    pixels = fields.get("pixels")
    if isinstance(pixels, dict) and form != "raw":
        without = {name: value for name, value in pixels.items() if name != "data"}
        if form == "png":
            array = Pixels.model_validate(pixels).to_array()
            without["png"] = png_bytes(Path("image.png"), array)
        changed["pixels"] = without
    return json.dumps({**fields, **changed}, default=_base64, ensure_ascii=False, allow_nan=False).encode()


def _base64(value: object) -> str:
    if isinstance(value, bytes):
        return base64.b64encode(value).decode("ascii")
    raise TypeError(type(value).__name__)
