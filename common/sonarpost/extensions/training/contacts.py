"""Simulated contacts for training: objects of a simulated survey, encoded with the real codecs."""

import math
import random
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from sonarpost.codec import emb
from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.codec.interface import Codec, DecodedImage, StreamHeader
from sonarpost.codec.region import RegionBox
from sonarpost.codec.vq.codebook import open_codebook
from sonarpost.codec.vq.codec import VqCodec
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, TruthObject, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.link.frames.paper.frame import format_image_id
from sonarpost.messages import Contact, Pixels, ReconstructedImage
from sonarpost.review.positions import destination
from sonarpost.services.console.store.truth import Truth
from sonarpost.sonar.survey import Survey

HEIGHT_PX, WIDTH_PX = 80, 140
VEHICLES: Final = ("uuv-1", "uuv-2")
_STREAM_BYTES: Final = 192
_VERSION_BYTES: Final = (24, 64, 128, _STREAM_BYTES)
"""Received bytes of the versions of an image with the codec emb."""
_LINES: Final = 5
"""Simulated survey lines. Later contacts reuse their images at other positions."""

Grey = npt.NDArray[np.uint8]


class ImageVersion(NamedTuple):
    """One received state of an image."""

    bytes_received: int
    bytes_total: int
    frames: int
    decoded: DecodedImage


@dataclass(frozen=True, slots=True)
class SimulatedContact:
    """A contact with the versions of its image.

    Attributes:
        contact: Contact record.
        image_id: Identifier of the image.
        versions: Received states of the image, in the order of arrival.
        codec: Codec of the image.
        snippet: Original pixels, shape (80, 140).
        target: The object at the centre.
        expanded_snippet: Pixels of twice the ground in each direction, same shape; None for an expanded image.
    """

    contact: Contact
    image_id: str
    versions: tuple[ImageVersion, ...]
    codec: Codec
    snippet: Grey
    target: TruthObject
    expanded_snippet: Grey | None = None

    @property
    def truth(self) -> Truth:
        """The object of the contact."""
        return Truth(self.target.is_mine_like, self.target.kind.value.replace("_", " "), sealed=False)

    def expanded(self, image_id: str) -> "SimulatedContact | None":
        """Return an image of more seabed around the contact; None if this image is already expanded.

        Args:
            image_id: Identifier of the new image.
        """
        if self.expanded_snippet is None:
            return None
        pixel_sizes = {
            name: None if (size_m := getattr(self.contact, name)) is None else 2 * size_m
            for name in ("pixel_along_m", "pixel_across_m")
        }
        return replace(
            self,
            contact=self.contact.model_copy(update=pixel_sizes),
            image_id=image_id,
            versions=_versions(self.codec, self.expanded_snippet, incomplete=False),
            snippet=self.expanded_snippet,
            expanded_snippet=None,
        )

    def unfiltered(self, image_id: str) -> "SimulatedContact | None":
        """Return an image of the contact without despeckling; None if this image is not despeckled.

        Args:
            image_id: Identifier of the new image.
        """
        if not self.versions[-1].decoded.despeckle_strength:
            return None
        codec = EmbCodec(strength=0.0)
        return replace(self, image_id=image_id, versions=_versions(codec, self.snippet, incomplete=False), codec=codec)

    def region(self, image_id: str, box: RegionBox, stream_bytes: int) -> "SimulatedContact":
        """Return an image of a part of the contact.

        Args:
            image_id: Identifier of the new image.
            box: The part.
            stream_bytes: Length of the stream, for a codec with a budget.
        """
        top, left, bottom, right = box.pixels(*self.snippet.shape)
        part = self.snippet[top:bottom, left:right]
        stream = self.codec.encode(part, stream_bytes if isinstance(self.codec, EmbCodec) else None)
        version = ImageVersion(len(stream), len(stream), 1, self.codec.decode(stream))
        return replace(self, image_id=image_id, versions=(version,), snippet=part, expanded_snippet=None)

    def with_next_version(self, *, refine: bool) -> "SimulatedContact":
        """Return the contact with one more, complete version; with `refine`, of a stream of twice the length."""
        last = self.versions[-1]
        budget = None
        if isinstance(self.codec, EmbCodec):
            budget = 2 * last.bytes_total if refine else last.bytes_total
        stream = self.codec.encode(self.snippet, budget)
        version = ImageVersion(len(stream), len(stream), last.frames + 1, self.codec.decode(stream))
        return replace(self, versions=(*self.versions, version))

    def record(self, vessel_id: str, index: int, first_utc_s: float, now_utc_s: float) -> ReconstructedImage:
        """Return the record of the version with an index, from 0."""
        received, total, frames, decoded = self.versions[index]
        pixels = Pixels.from_array(decoded.image)
        missing = decoded.missing
        return ReconstructedImage(
            vessel_id=vessel_id,
            vehicle_id=self.contact.vehicle_id,
            image_id=self.image_id,
            version=index + 1,
            contact=self.contact,
            codec=self.codec.name,
            model=self.codec.model_hash,
            pixels=pixels,
            pixels_sha256=pixels.sha256,
            complete=received == total and not missing.any(),
            missing_fraction=float(missing.mean()),
            missing_mask=np.packbits(missing).tobytes() if missing.any() else b"",
            missing_halves=("bottom",) if missing.any() else (),
            bytes_received=received,
            bytes_total=total,
            frames_received=frames,
            first_frame_utc_s=first_utc_s,
            last_frame_utc_s=max(first_utc_s, now_utc_s),
            notes=("simulated, for training", *decoded.notes),
            despeckle_strength=decoded.despeckle_strength,
        )


def simulated_contacts(seed: int, first_utc_s: float) -> Iterator[SimulatedContact]:
    """Yield an endless sequence of contacts; equal seeds give equal contacts.

    Two vehicles survey the same lines, so that some objects are seen twice.

    Args:
        seed: Seed of all random draws.
        first_utc_s: Time of the first ping.
    """
    draws = random.Random(seed)  # noqa: S311  not used for secrets
    codecs: tuple[Codec, Codec] = (EmbCodec(strength=emb.DEFAULT_STRENGTH), VqCodec(open_codebook("nominal-10").tiles))
    made: list[SimulatedContact] = []
    for line in range(_LINES):
        seabed = (SeabedKind.SAND, SeabedKind.RIPPLES, SeabedKind.MIXED)[line % 3]
        simulated = simulate_survey(_survey_spec(seed, line, seabed, first_utc_s))
        for target in simulated.truth:
            # Every fourth target uses the codec and wire format of the paper, where a half of the image may be missing.
            codec = codecs[len(made) % 4 == 3]
            for look in range(2 if draws.random() < 0.25 else 1):
                vehicle = VEHICLES[(line + look) % len(VEHICLES)]
                contact = _contact(simulated.survey, target, vehicle, draws, len(made))
                snippet, expanded = (cut_snippet(simulated.survey, target, look, scale) for scale in (1, 2))
                versions = _versions(codec, snippet, incomplete=draws.random() < 0.5)
                made.append(
                    SimulatedContact(contact, format_image_id(len(made)), versions, codec, snippet, target, expanded)
                )
                yield made[-1]
    yield from _repeated_contacts(made, draws)


def _repeated_contacts(made: list[SimulatedContact], draws: random.Random) -> Iterator[SimulatedContact]:
    """Yield the same images at other positions."""
    number = len(made)
    while True:
        field, index = divmod(number, len(made))
        known = made[index]
        contact = known.contact
        assert contact.lat_deg is not None
        assert contact.lon_deg is not None
        # Fields of 300 m x 300 m, ten in each row.
        lat, lon = destination(contact.lat_deg, contact.lon_deg, 0.0, 300.0 * (field // 10))
        lat, lon = destination(lat, lon, 90.0, 300.0 * (field % 10))
        confidence = round(min(2.0, max(0.1, (contact.atd_confidence or 1.0) + draws.gauss(0, 0.1))), 2)
        changes = {"contact_id": f"training-{number}", "lat_deg": lat, "lon_deg": lon, "atd_confidence": confidence}
        moved = contact.model_copy(update=changes)
        yield replace(known, contact=moved, image_id=format_image_id(number), versions=known.versions[-1:])
        number += 1


def _survey_spec(seed: int, line: int, seabed: SeabedKind, first_utc_s: float) -> SurveySpec:
    spec = SurveySpec(seed=seed * 1000 + line, pings=900, samples=512, seabed=seabed, targets=5, clutter=5)
    # Lines are 25 m apart and alternate in direction.
    lat, lon = destination(spec.start_lat_deg, spec.start_lon_deg, spec.heading_deg + 90.0, 25.0 * line)
    reverse = line % 2 == 1
    if reverse:
        lat, lon = destination(lat, lon, spec.heading_deg, spec.ping_spacing_m * spec.pings)
    heading = (spec.heading_deg + 180.0) % 360 if reverse else spec.heading_deg
    time_s = first_utc_s + 90.0 * line
    return replace(spec, start_lat_deg=lat, start_lon_deg=lon, heading_deg=heading, start_time_utc_s=time_s)


def cut_snippet(survey: Survey, target: TruthObject, look: int = 0, scale: int = 1) -> Grey:
    """Return the snippet of an object, shape (80, 140), nadir on the left.

    Args:
        survey: The simulated survey.
        target: The object.
        look: Number of the look; later looks are shifted along the track.
        scale: Ground per pixel in units of the survey's; pixels are means.
    """
    height, width = scale * HEIGHT_PX, scale * WIDTH_PX
    centre = min(max(target.ping + 2 * look, height // 2), len(survey.pings) - height // 2)
    middle = target.sample_index - WIDTH_PX // 3 + WIDTH_PX // 2
    rows = []
    for ping in survey.pings[centre - height // 2 : centre + height // 2]:
        channel = ping.channel(target.side)
        assert channel is not None  # Every simulated ping has both channels.
        left = min(max(middle - width // 2, 0), channel.samples.shape[0] - width)
        rows.append(channel.samples[left : left + width])
    amplitude = np.stack(rows).astype(np.float64).reshape(HEIGHT_PX, scale, WIDTH_PX, scale).mean(axis=(1, 3))
    root = np.sqrt(amplitude)
    low, high = np.percentile(root, (0.5, 99.5))
    grey: Grey = np.clip(255 * (root - low) / max(high - low, 1e-9), 0, 255).astype(np.uint8)
    return grey


def _contact(survey: Survey, target: TruthObject, vehicle: str, draws: random.Random, number: int) -> Contact:
    ping = survey.pings[target.ping]
    lat, lon = destination(target.lat_deg, target.lon_deg, draws.uniform(0, 360), abs(draws.gauss(0, 1.2)))
    confidence = draws.gauss(1.35 if target.is_mine_like else 0.8, 0.3)
    shadow_m = None
    if ping.altitude_m is not None and ping.altitude_m > target.height_m:
        slant_m = math.hypot(target.ground_range_m, ping.altitude_m)
        shadow_m = target.height_m * slant_m / (ping.altitude_m - target.height_m)
    return Contact(
        contact_id=f"training-{number}",
        vehicle_id=vehicle,
        sonar_id="simulated",
        ping_number=target.ping,
        channel="port" if str(target.side) == "port" else "starboard",
        time_utc_s=ping.time_utc_s,
        lat_deg=lat,
        lon_deg=lon,
        position_sigma_m=1.5,
        depth_m=ping.depth_m,
        altitude_m=ping.altitude_m,
        heading_deg=ping.heading_deg,
        speed_mps=ping.speed_mps,
        ground_range_m=target.ground_range_m,
        atd_confidence=round(min(2.0, max(0.1, confidence)), 2),
        length_m=round(target.length_m, 2),
        width_m=round(target.width_m, 2),
        shadow_m=shadow_m,
        height_m=round(target.height_m, 2),
        pixel_along_m=0.1,
        pixel_across_m=30.0 / 512,
    )


def _versions(codec: Codec, snippet: Grey, *, incomplete: bool) -> tuple[ImageVersion, ...]:
    """Return the versions of an image; with `incomplete`, without the last one."""
    if isinstance(codec, EmbCodec):
        stream = codec.encode(snippet, _STREAM_BYTES)
        sizes = [size for size in _VERSION_BYTES if size < len(stream)] + ([] if incomplete else [len(stream)])
        return tuple(
            ImageVersion(size, len(stream), number + 1, codec.decode(stream[:size]))
            for number, size in enumerate(sizes)
        )
    stream = codec.encode(snippet)
    first_half = np.zeros(len(stream) - StreamHeader.unpack(stream).size, np.bool_)
    first_half[: first_half.size // 2] = True
    half = ImageVersion(len(stream) // 2, len(stream), 2, codec.decode(stream, first_half))
    whole = ImageVersion(len(stream), len(stream), 4, codec.decode(stream))
    return (half,) if incomplete else (half, whole)
