"""Simulated contacts to learn the console on: a simulated survey's objects, sent through a real codec."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.codec.interface import Codec, DecodedImage, StreamHeader
from sonarpost.codec.vq.codebook import open_codebook
from sonarpost.codec.vq.codec import VqCodec
from sonarpost.messages import Contact, Pixels, ReconstructedImage
from sonarpost.review.local import moved
from sonarpost.simulation.seabed.survey import SurveySpec, TruthObject, simulate_survey
from sonarpost.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.survey import Survey

HEIGHT_PX, WIDTH_PX = 80, 140
VEHICLES: Final = ("uuv-1", "uuv-2")
_BYTES: Final = 192
_STEPS: Final = (24, 64, 128, _BYTES)
"""After how many bytes a picture of the embedded codec is shown anew."""
_LINES: Final = 5
"""Simulated in full; what comes after them is of the same pictures."""
_ALPHABET: Final = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ"


@dataclass(frozen=True, slots=True)
class Simulated:
    """A contact that may be sent.

    Attributes:
        contact: Its record.
        image_id: Name on the acoustic link.
        versions: What of its picture is known after each packet: bytes received, of how many, frames, the picture.
        codec: That made it.
        model: Of that codec.
        original: What the vehicle has, shape (80, 140).
        wide: The same around twice the ground in each direction; None where it shows that already.
    """

    contact: Contact
    image_id: str
    versions: tuple[tuple[int, int, int, DecodedImage], ...]
    codec: str
    model: str
    original: npt.NDArray[np.uint8]
    wide: npt.NDArray[np.uint8] | None = None

    def wider(self, image_id: str) -> Simulated | None:
        """Return more of the seabed around it as a picture of its own, None where the vehicle has no more.

        Args:
            image_id: Of the new picture.
        """
        if self.wide is None:
            return None
        codec = self._codec()
        sizes = {
            name: None if pixel_m is None else 2 * pixel_m
            for name in ("pixel_along_m", "pixel_across_m")
            for pixel_m in [getattr(self.contact, name)]
        }
        return replace(
            self,
            contact=self.contact.model_copy(update=sizes),
            image_id=image_id,
            versions=_versions(codec, self.wide, lacking=False),
            original=self.wide,
            wide=None,
        )

    def _codec(self) -> Codec:
        return EmbCodec() if self.codec == EmbCodec().name else VqCodec(open_codebook("nominal-10").tiles)

    def more(self, *, refine: bool) -> Simulated:
        """Return it with one version more: what was lacking, or to refine a stream of twice the length."""
        total = self.versions[-1][1]
        codec = self._codec()
        stream = codec.encode(self.original, 2 * total if refine and isinstance(codec, EmbCodec) else None)
        if isinstance(codec, EmbCodec) and not refine:
            stream = codec.encode(self.original, total)
        last = (len(stream), len(stream), self.versions[-1][2] + 1, codec.decode(stream))
        return replace(self, versions=(*self.versions, last))

    def record(self, vessel_id: str, step: int, first_utc_s: float, now_utc_s: float) -> ReconstructedImage:
        """Return the record of a version, from 0, as a decompressor would give it out."""
        received, total, frames, decoded = self.versions[step]
        picture = Pixels.from_array(decoded.image)
        missing = decoded.missing
        return ReconstructedImage(
            vessel_id=vessel_id,
            vehicle_id=self.contact.vehicle_id,
            image_id=self.image_id,
            version=step + 1,
            contact=self.contact,
            codec=self.codec,
            model=self.model,
            picture=picture,
            picture_sha256=picture.sha256,
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
        )


def simulated_contacts(seed: int, first_utc_s: float) -> Iterator[Simulated]:
    """Yield contacts without end; the same seed gives the same ones.

    Two vehicles run lines to and fro over the same ground, so that some objects are seen twice.

    Args:
        seed: Source of every chance.
        first_utc_s: Time of the first ping.
    """
    chance = random.Random(seed)  # noqa: S311  nothing secret comes of it
    codecs: tuple[Codec, Codec] = (EmbCodec(), VqCodec(open_codebook("nominal-10").tiles))
    line = number = 0
    made: list[Simulated] = []
    while line < _LINES:
        seabed = (SeabedKind.SAND, SeabedKind.RIPPLES, SeabedKind.MIXED)[line % 3]
        simulated = simulate_survey(_spec(seed, line, seabed, first_utc_s))
        for thing in simulated.truth:
            # Every fourth by the paper's codec and format, of which halves may be lacking.
            codec = codecs[number % 4 == 3]
            for look in range(2 if chance.random() < 0.25 else 1):
                vehicle = VEHICLES[(line + look) % len(VEHICLES)]
                contact = _contact(simulated.survey, thing, vehicle, chance, number)
                image_id = _image_id(number)
                original, wide = (chip(simulated.survey, thing, look, times) for times in (1, 2))
                versions = _versions(codec, original, lacking=chance.random() < 0.5)
                made.append(Simulated(contact, image_id, versions, codec.name, codec.model_hash, original, wide))
                yield made[-1]
                number += 1
        line += 1
    yield from _more(made, number, chance)


def _more(made: list[Simulated], number: int, chance: random.Random) -> Iterator[Simulated]:
    """Yield the same pictures at other places, as fast as they are wanted."""
    while True:
        field, place = divmod(number, len(made))
        known = made[place]
        contact = known.contact
        assert contact.lat_deg is not None
        assert contact.lon_deg is not None
        # Fields of 300 m side by side, ten in a row.
        lat, lon = moved(contact.lat_deg, contact.lon_deg, 0.0, 300.0 * (field // 10))
        lat, lon = moved(lat, lon, 90.0, 300.0 * (field % 10))
        sure = round(min(2.0, max(0.1, (contact.atd_confidence or 1.0) + chance.gauss(0, 0.1))), 2)
        changes = {"contact_id": f"training-{number}", "lat_deg": lat, "lon_deg": lon, "atd_confidence": sure}
        copied = contact.model_copy(update=changes)
        yield replace(known, contact=copied, image_id=_image_id(number), versions=known.versions[-1:])
        number += 1


def _spec(seed: int, line: int, seabed: SeabedKind, first_utc_s: float) -> SurveySpec:
    spec = SurveySpec(seed=seed * 1000 + line, pings=900, samples=512, seabed=seabed, targets=5, clutter=5)
    # Lines 25 m apart, every second one back.
    lat, lon = moved(spec.start_lat_deg, spec.start_lon_deg, spec.heading_deg + 90.0, 25.0 * line)
    back = line % 2 == 1
    if back:
        lat, lon = moved(lat, lon, spec.heading_deg, spec.ping_spacing_m * spec.pings)
    heading = (spec.heading_deg + 180.0) % 360 if back else spec.heading_deg
    time_s = first_utc_s + 90.0 * line
    return replace(spec, start_lat_deg=lat, start_lon_deg=lon, heading_deg=heading, start_time_utc_s=time_s)


def chip(survey: Survey, thing: TruthObject, look: int = 0, times: int = 1) -> npt.NDArray[np.uint8]:
    """Return the picture of an object, shape (80, 140), nadir to the left.

    Args:
        survey: The simulated survey.
        thing: The object.
        look: Another look is shifted a little.
        times: So many times the ground in each direction, around the same middle; pixels are means.
    """
    height, width = times * HEIGHT_PX, times * WIDTH_PX
    centre = min(max(thing.ping + 7 * look, height // 2), len(survey.pings) - height // 2)
    middle = thing.sample_index - WIDTH_PX // 3 + WIDTH_PX // 2
    rows = []
    for ping in survey.pings[centre - height // 2 : centre + height // 2]:
        channel = ping.channel(thing.side)
        assert channel is not None  # every simulated ping has both
        left = min(max(middle - width // 2, 0), channel.samples.shape[0] - width)
        rows.append(channel.samples[left : left + width])
    amplitude = np.stack(rows).astype(np.float64).reshape(HEIGHT_PX, times, WIDTH_PX, times).mean(axis=(1, 3))
    root = np.sqrt(amplitude)
    low, high = np.percentile(root, (0.5, 99.5))
    grey: npt.NDArray[np.uint8] = np.clip(255 * (root - low) / max(high - low, 1e-9), 0, 255).astype(np.uint8)
    return grey


def _contact(survey: Survey, thing: TruthObject, vehicle: str, chance: random.Random, number: int) -> Contact:
    ping = survey.pings[thing.ping]
    lat, lon = moved(thing.lat_deg, thing.lon_deg, chance.uniform(0, 360), abs(chance.gauss(0, 1.2)))
    sure = chance.gauss(1.35 if thing.is_mine_like else 0.8, 0.3)
    shadow_m = None
    if ping.altitude_m is not None and ping.altitude_m > thing.height_m:
        shadow_m = thing.height_m * thing.ground_range_m / (ping.altitude_m - thing.height_m)
    return Contact(
        contact_id=f"training-{number}",
        vehicle_id=vehicle,
        sonar_id="simulated",
        ping_number=thing.ping,
        channel="port" if str(thing.side) == "port" else "starboard",
        time_utc_s=ping.time_utc_s,
        lat_deg=lat,
        lon_deg=lon,
        position_sigma_m=1.5,
        depth_m=ping.depth_m,
        altitude_m=ping.altitude_m,
        heading_deg=ping.heading_deg,
        speed_mps=ping.speed_mps,
        ground_range_m=thing.ground_range_m,
        atd_confidence=round(min(2.0, max(0.1, sure)), 2),
        length_m=round(thing.length_m, 2),
        width_m=round(thing.width_m, 2),
        shadow_m=shadow_m,
        height_m=round(thing.height_m, 2),
        pixel_along_m=0.1,
        pixel_across_m=30.0 / 512,
    )


def _versions(
    codec: Codec, picture: npt.NDArray[np.uint8], *, lacking: bool
) -> tuple[tuple[int, int, int, DecodedImage], ...]:
    if isinstance(codec, EmbCodec):
        stream = codec.encode(picture, _BYTES)
        # A picture that is refined with every packet; a few never get the last one.
        steps = [step for step in _STEPS if step < len(stream)] + ([] if lacking else [len(stream)])
        return tuple((step, len(stream), number + 1, codec.decode(stream[:step])) for number, step in enumerate(steps))
    stream = codec.encode(picture)
    half = np.zeros(len(stream) - StreamHeader.unpack(stream).size, np.bool_)
    half[: half.size // 2] = True
    first = (len(stream) // 2, len(stream), 2, codec.decode(stream, half))
    whole = (len(stream), len(stream), 4, codec.decode(stream))
    return (first,) if lacking else (first, whole)


def wider_image_id(count: int) -> str:
    """Return the identifier of a wider picture, counted from 0: from the last one down, as contacts count upwards."""
    return _image_id(len(_ALPHABET) ** 4 - 1 - count)


def _image_id(number: int) -> str:
    digits = ""
    for _ in range(4):
        number, digit = divmod(number, len(_ALPHABET))
        digits = _ALPHABET[digit] + digits
    return digits
