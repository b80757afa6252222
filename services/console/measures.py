"""Lines that people draw on pictures, measured where that is honest."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

from sonarpost.messages import ReconstructedImage
from sonarpost.review.measuring import NotMeasurableError, height_from_shadow, measure_length
from sonarpost.review.rendering import LAYERS
from sonarpost.services.console.store.serialisers import Json

Measure = Literal["length", "width", "shadow"]


@dataclass(frozen=True, slots=True)
class Line:
    """A line somebody drew on a picture, to be measured."""

    version: int
    layer: str
    kind: Measure
    start: tuple[float, float]
    end: tuple[float, float]


def measured(image: ReconstructedImage, line: Line) -> Json:
    """Return what a line on a picture measures.

    Raises:
        NotMeasurableError: It cannot be measured there.
    """
    layer = next((layer for layer in LAYERS if layer.name == line.layer), None)
    if layer is None:
        raise NotMeasurableError("picture", "layer", line.layer, " or ".join(layer.name for layer in LAYERS))
    if not layer.measurable:
        raise NotMeasurableError("picture", "layer", line.layer, f"the raw picture: {layer.reason}")
    if not image.codec:
        raise NotMeasurableError("picture", "version", line.version, "one of which something has arrived")
    length = measure_length(image.contact, image.missing(), line.start, line.end)
    body: Json = {
        "kind": line.kind,
        "version": line.version,
        "layer": line.layer,
        "from": list(line.start),
        "to": list(line.end),
        **asdict(length),
        "height_m": None,
        "height_sigma_m": None,
        "height_inputs": None,
        "note": "",
    }
    if line.kind != "shadow" or image.contact is None:
        return body
    height = height_from_shadow(image.contact, length)
    if height is None:
        return {**body, "note": "no height: the vehicle's altitude or the object's range is not known"}
    inputs = {
        "shadow_m": length.value_m,
        "altitude_m": height.altitude_m,
        "slant_range_m": height.slant_range_m,
    }
    return {**body, "height_m": height.height_m, "height_sigma_m": height.sigma_m, "height_inputs": inputs}
