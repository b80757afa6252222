"""Images of known objects that look like those of a vehicle: simulated survey, the vehicle's detector and codec.

Imported only where the calibrated watch is switched on: it loads the simulation and the detector.
"""

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.detection.detector import Detection, detect
from sonarpost.detection.settings import DetectorSettings
from sonarpost.detection.snippets import cut_snippet, ground_projected_image
from sonarpost.extensions.simulation.seabed.survey import SimulatedSurvey, SurveySpec, TruthObject, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.messages import Contact, Pixels, ReconstructedImage

PINGS: Final = 1000
SAMPLES: Final = 1024
MATCH_M: Final = 1.0
"""Maximum distance of a detection from its object, along and across the track, beyond half the object's length."""

_OF_REFERENCE: Final = (
    "depth_m",
    "altitude_m",
    "heading_deg",
    "speed_mps",
    "position_sigma_m",
    "position_note",
    "pixel_along_m",
    "pixel_across_m",
)
_DETECTED: Final = Contact.model_fields.keys() & {field.name for field in fields(Detection)} - {*_OF_REFERENCE}
"""Fields of a contact that the detector finds; navigation, position and pixel size are those of the reference."""


@dataclass(frozen=True, slots=True)
class KnownObject:
    """A detection of a known object in a simulated survey.

    Attributes:
        detection: Result of the detector.
        target: The object.
        snippet: Pixels, shape (height_px, width_px) of the reference image.
    """

    detection: Detection
    target: TruthObject
    snippet: npt.NDArray[np.uint8]


def can_imitate(reference: ReconstructedImage) -> bool:
    """Return whether a contact can be imitated: codec `emb`, and a contact record with position and pixel size."""
    contact = reference.contact
    return (
        reference.codec == EmbCodec.name
        and contact is not None
        and contact.lat_deg is not None
        and contact.lon_deg is not None
        and bool(contact.pixel_along_m)
        and bool(contact.pixel_across_m)
    )


def known_objects(reference: ReconstructedImage, draws: random.Random) -> Iterator[KnownObject]:
    """Yield the detected objects of one simulated survey, each once, in random order.

    The survey has the pixel size and altitude of the reference.

    Args:
        reference: Image to imitate; see `can_imitate`.
        draws: Random draws.
    """
    simulated = simulate_survey(_survey_spec(reference, draws))
    matched: dict[int, Detection] = {}
    for detection in detect(simulated.survey, DetectorSettings()):
        index = _object_at(simulated.truth, detection)
        # The detector returns the most confident detection of an object first.
        if index is not None:
            matched.setdefault(index, detection)
    indices = list(matched)
    draws.shuffle(indices)
    for index in indices:
        yield KnownObject(matched[index], simulated.truth[index], _snippet(simulated, matched[index], reference))


def sealed_record(
    known: KnownObject, reference: ReconstructedImage, image_id: str, position: tuple[float, float], first_utc_s: float
) -> ReconstructedImage:
    """Return the record of a known object as a vehicle and its link would deliver it: version 1 of an image.

    Args:
        known: The object.
        reference: Image of the vehicle; the record has its codec, received bytes and navigation.
        image_id: Identifier of the image.
        position: Latitude and longitude of the contact.
        first_utc_s: Time of the first frame.
    """
    detected, real = known.detection, reference.contact
    assert real is not None
    values = {name: getattr(detected, name) for name in _DETECTED}
    offset_s = first_utc_s - reference.first_frame_utc_s
    contact = real.model_copy(
        update={
            **values,
            "contact_id": real.contact_id.replace(reference.image_id, image_id),
            "lat_deg": position[0],
            "lon_deg": position[1],
            "channel": detected.side.value,
            "ping_number": None if real.ping_number is None else real.ping_number + detected.ping_index,
            "time_utc_s": None if real.time_utc_s is None else real.time_utc_s + offset_s,
            "atd_confidence": detected.confidence,
            "height_m": None if detected.shadow_is_cut else detected.height_m,
        }
    )
    start = reference.model_copy(
        update={
            "image_id": image_id,
            "contact": Contact.model_validate(contact.model_dump()),
            "first_frame_utc_s": first_utc_s,
            "notes": (),
        }
    )
    total = reference.bytes_total or reference.bytes_received
    return next_version(start, known.snippet, 1, min(reference.bytes_received, total), total, first_utc_s)


def next_version(
    image: ReconstructedImage,
    snippet: npt.NDArray[np.uint8],
    version: int,
    bytes_received: int,
    bytes_total: int,
    now_utc_s: float,
) -> ReconstructedImage:
    """Return a record with another part of the stream of a snippet.

    Args:
        image: Record with codec, despeckling and contact.
        snippet: Original pixels.
        version: Version of the new record.
        bytes_received: Length of the received part of the stream.
        bytes_total: Length of the stream.
        now_utc_s: Time of the last frame.
    """
    codec = EmbCodec(strength=image.despeckle_strength or 0.0)
    stream = codec.encode(snippet, bytes_total)
    received = min(bytes_received, len(stream))
    decoded = codec.decode(stream[:received])
    pixels = Pixels.from_array(decoded.image)
    changes = {
        "version": version,
        "model": codec.model_hash,
        "pixels": pixels,
        "pixels_sha256": pixels.sha256,
        "complete": received == len(stream),
        "missing_mask": b"",
        "missing_fraction": 0.0,
        "missing_halves": (),
        "bytes_received": received,
        "bytes_total": len(stream),
        "last_frame_utc_s": now_utc_s,
    }
    return ReconstructedImage.model_validate(image.model_copy(update=changes).model_dump())


def _survey_spec(reference: ReconstructedImage, draws: random.Random) -> SurveySpec:
    contact = reference.contact
    assert contact is not None
    spec = SurveySpec()
    along_m, across_m = contact.pixel_along_m or 0.1, contact.pixel_across_m or 0.03
    is_projected = along_m == across_m
    range_m = spec.range_m if is_projected else min(max(across_m * SAMPLES, 10.0), 150.0)
    spacing_m = spec.ping_spacing_m if is_projected else along_m
    ping_rate_hz = min(spec.ping_rate_hz, 740.0 / range_m)
    return SurveySpec(
        seed=draws.getrandbits(32),
        pings=PINGS,
        samples=SAMPLES,
        range_m=range_m,
        altitude_m=min(max(contact.altitude_m or spec.altitude_m, 1.0), range_m / 3),
        speed_mps=min(max(spacing_m * ping_rate_hz, 0.2), 10.0),
        ping_rate_hz=ping_rate_hz,
        seabed=draws.choice(list(SeabedKind)),
        targets=4,
        clutter=8,
    )


def _object_at(truth: Sequence[TruthObject], detection: Detection) -> int | None:
    """Return the index of the object at a detection; None if there is none, as for a natural echo."""
    for index, target in enumerate(truth):
        limit_m = MATCH_M + target.length_m / 2
        along_m = abs(detection.ping_index - target.ping) * (detection.pixel_along_m or 0.1)
        across_m = abs(detection.sample - target.sample_index) * detection.pixel_across_m
        if target.side is detection.side and along_m < limit_m and across_m < limit_m:
            return index
    return None


def _snippet(simulated: SimulatedSurvey, detection: Detection, reference: ReconstructedImage) -> npt.NDArray[np.uint8]:
    """Return the pixels of a detection, cut and projected as the vehicle does."""
    contact, size = reference.contact, (reference.pixels.height_px, reference.pixels.width_px)
    assert contact is not None
    if contact.pixel_along_m is not None and contact.pixel_along_m == contact.pixel_across_m:
        ground = ground_projected_image(simulated.survey, detection, *size, contact.pixel_along_m)
        if ground is not None:
            return ground
    return cut_snippet(simulated.survey, detection, *size).image
