"""Limits on the images that the vessel accepts from each vehicle and hour.

A frame of 60 bytes can announce an image of 512 x 512 pixels, which is a record of 262 kB for the radio link. So each
vehicle has an allowance of images and of bytes, which is refilled continuously and holds one hour's worth. What exceeds
it waits here, in its latest version, until the allowance suffices.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Final

from sonarpost.codec.interface import StreamHeader
from sonarpost.errors import StreamError
from sonarpost.limits import limit
from sonarpost.link.state import Bounds, Errors, PartReader, Parts, SavedCount, pack_part
from sonarpost.messages import ReceivedImage

MAX_HELD_IMAGES: Final = limit(
    1000, "images", "shares", "acoustic link", "vehicle", "images above the allowance", "further ones are dropped"
)
MAX_HELD_BYTES: Final = limit(
    4 * 1024 * 1024, "bytes", "shares", "acoustic link", "vehicle", "bytes above the allowance", "further are dropped"
)
UNLISTED: Final = "unlisted vehicles"
"""Allowance that all vehicles without a configured name share: a forger can choose any of 128 addresses."""

_HOUR_S: Final = 3600.0
_UNKNOWN_SIDE_PX: Final = 16


@dataclass(frozen=True, slots=True)
class Allowance:
    """What a vehicle may still send.

    Attributes:
        name: The vehicle, or `UNLISTED`.
        images: Number of new images.
        image_bytes: Bytes of decoded pixels and of coded streams.
        updated_s: Time of this state, UTC in seconds.
    """

    name: str
    images: Annotated[float, Bounds(0, 1e12)]
    image_bytes: Annotated[float, Bounds(0, 1e15)]
    updated_s: float


@dataclass(frozen=True, slots=True)
class HeldImage:
    """A coded image that waits.

    Attributes:
        name: The allowance that it counts against.
        vehicle_id: Vehicle that sent it.
        image_id: Its identifier.
        first_frame_s: Arrival of its first frame; with the identifier it names the image.
        order: Rises with every new image that waits.
        is_new: No version of it has been sent on.
        cost_bytes: Bytes that it counts.
        payload: The encoded `received_image`.
    """

    name: str
    vehicle_id: str
    image_id: str
    first_frame_s: float
    order: SavedCount
    is_new: bool
    cost_bytes: SavedCount
    payload: bytes


class ImageLimiter:
    """Passes images on as the allowance of their vehicle permits, the oldest first.

    Args:
        images_per_hour: New images of each vehicle and hour.
        bytes_per_hour: Decoded pixels and coded bytes of each vehicle and hour.
        vehicles: Names of the vehicles that have an allowance of their own.
    """

    def __init__(self, images_per_hour: int, bytes_per_hour: int, vehicles: frozenset[str]) -> None:
        self._images_per_hour = images_per_hour
        self._bytes_per_hour = bytes_per_hour
        self._vehicles = vehicles
        self._allowances: dict[str, Allowance] = {}
        # Oldest first. A newer version takes the place of the one that waits.
        self._held: dict[tuple[str, str, float], HeldImage] = {}
        self._order = 0
        # The saved state, kept up to date so that a frame does not pack everything that waits.
        self._parts: dict[str, bytes] = {}

    @property
    def held(self) -> int:
        """Number of images that wait."""
        return len(self._held)

    @property
    def held_names(self) -> tuple[str, ...]:
        """The allowances that are used up, by the name of their vehicle."""
        return tuple(sorted({image.name for image in self._held.values()}))

    def add(self, image: ReceivedImage, payload: bytes) -> bool:
        """Add an image, or its next version; `release` returns it when the allowance suffices.

        Args:
            image: The record.
            payload: The same, encoded.

        Returns:
            False if too much waits already; the image is dropped.
        """
        name = image.vehicle_id if image.vehicle_id in self._vehicles else UNLISTED
        key = (image.vehicle_id, image.image_id, image.first_frame_utc_s)
        earlier = self._held.get(key)
        images = [held for held in self._held.values() if held.name == name and held is not earlier]
        if len(images) >= MAX_HELD_IMAGES or sum(len(i.payload) for i in images) + len(payload) > MAX_HELD_BYTES:
            return False
        cost_bytes = decoded_pixels(image) + len(image.stream)
        if earlier is not None:
            held = replace(earlier, cost_bytes=cost_bytes, payload=payload)
        else:
            self._order += 1
            held = HeldImage(name, *key, self._order, image.version == 1, cost_bytes, payload)
        self._held[key] = held
        self._parts[f"held/{held.order}"] = pack_part(held)
        return True

    def can_release(self, now: float) -> bool:
        """Whether `release` would return an image."""
        oldest = {image.name: image for image in reversed(self._held.values())}
        return any(_suffices(self._allowance(name, now), image) for name, image in oldest.items())

    def release(self, now: float) -> list[bytes]:
        """Return the images that may be sent on now, encoded, the oldest first, and count them.

        Args:
            now: UTC in seconds.
        """
        released: list[bytes] = []
        exhausted: set[str] = set()
        for key, image in list(self._held.items()):
            allowance = self._allowance(image.name, now)
            if image.name in exhausted or not _suffices(allowance, image):
                exhausted.add(image.name)  # keeps the order of a vehicle's images
                continue
            spent = replace(
                allowance,
                images=allowance.images - image.is_new,
                image_bytes=allowance.image_bytes - image.cost_bytes,
            )
            self._allowances[image.name] = spent
            self._parts[f"allowance/{image.name}"] = pack_part(spent)
            del self._held[key], self._parts[f"held/{image.order}"]
            released.append(image.payload)
        return released

    def _allowance(self, name: str, now: float) -> Allowance:
        """Return the allowance at `now`. After the clock was set back it grows from then on."""
        saved = self._allowances.get(name)
        if saved is None:
            return Allowance(name, float(self._images_per_hour), float(self._bytes_per_hour), now)
        hours = max(0.0, now - saved.updated_s) / _HOUR_S
        return Allowance(
            name,
            min(saved.images + hours * self._images_per_hour, float(self._images_per_hour)),
            min(saved.image_bytes + hours * self._bytes_per_hour, float(self._bytes_per_hour)),
            now,
        )

    def parts(self) -> dict[str, bytes]:
        """Return the state to save, see `sonarpost.link.state`: each allowance, and each image that waits."""
        return dict(self._parts)

    def restore(self, parts: Parts) -> Errors:
        """Replace the state by saved parts; return why parts were skipped."""
        reader = PartReader(parts, "image limits")
        self._allowances = {each.name: each for each in reader.read_group("allowance", Allowance)}
        held = sorted(reader.read_group("held", HeldImage), key=lambda image: image.order)
        self._held = {(image.vehicle_id, image.image_id, image.first_frame_s): image for image in held}
        self._order = held[-1].order if held else 0
        self._parts = {name: data for name, data in parts.items() if name not in reader.errors}
        return reader.errors


def decoded_pixels(image: ReceivedImage) -> int:
    """Return the number of pixels that the decompressor makes of an image, by its stream header or contact record."""
    try:
        header = StreamHeader.unpack(image.stream)
    except StreamError:
        return (image.height_px or _UNKNOWN_SIDE_PX) * (image.width_px or _UNKNOWN_SIDE_PX)
    return header.height_px * header.width_px


def _suffices(allowance: Allowance, image: HeldImage) -> bool:
    return allowance.images >= image.is_new and allowance.image_bytes >= image.cost_bytes
