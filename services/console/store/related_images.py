"""Images that answer a request about another contact: more seabed, a region, or the image without despeckling.

The acoustic link does not carry the identifier of the contact that a requested image belongs to. Both images have the
same contact record, except for image and pixel sizes, because the vehicle makes them from one detection.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping, Sequence
from typing import Final, Literal

import numpy as np
import numpy.typing as npt
from scipy import fft

from sonarpost import wire
from sonarpost.codec.region import RegionBox
from sonarpost.limits import limit
from sonarpost.messages import Command, Contact, ReconstructedImage
from sonarpost.modem.interface import RateInfo
from sonarpost.services.console.store.serialisers import Json, find_image, versions_json

EXPAND_FACTOR: Final = 2
"""Ratio of the pixel sizes."""
MIN_CORRELATION: Final = 0.4
"""Normalised cross-correlation below which the place counts as unknown."""

GreyImage = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


def place_in_expanded(image: GreyImage, expanded: GreyImage) -> tuple[int, int] | None:
    """Return (row, column) of the upper left corner of an image in the expanded image, None if it is not found.

    Both windows are shifted at the borders of a recording, so that their centres can differ. The place is the maximum
    of the normalised cross-correlation.

    Args:
        image: Shape (height_px, width_px).
        expanded: Any shape of at least half of these sides, with pixels of twice the size.
    """
    rows, columns = image.shape[0] // EXPAND_FACTOR, image.shape[1] // EXPAND_FACTOR
    if rows < 1 or columns < 1 or rows > expanded.shape[0] or columns > expanded.shape[1]:
        return None
    cut = image[: rows * EXPAND_FACTOR, : columns * EXPAND_FACTOR].astype(np.float64)
    template = cut.reshape(rows, EXPAND_FACTOR, columns, EXPAND_FACTOR).mean(axis=(1, 3))
    template -= template.mean()
    scene = expanded.astype(np.float64)
    scene -= scene.mean()
    window = np.ones_like(template)
    sums = _convolve_valid(scene, window)
    squares = _convolve_valid(scene**2, window)
    power = np.maximum(squares - sums**2 / template.size, 0.0) * float((template**2).sum())
    products = _convolve_valid(scene, template[::-1, ::-1])
    correlation = products / np.sqrt(np.maximum(power, 1e-9 * max(1.0, float(power.max()))))
    best = int(np.argmax(correlation))
    if correlation.flat[best] < MIN_CORRELATION:
        return None
    row, column = divmod(best, correlation.shape[1])
    return row, column


def _convolve_valid(scene: npt.NDArray[np.float64], kernel: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the convolution where the kernel lies inside the scene; without scipy.signal, which is large."""
    full = [rows + kernel_rows - 1 for rows, kernel_rows in zip(scene.shape, kernel.shape, strict=True)]
    shape = [fft.next_fast_len(size, real=True) for size in full]
    product = fft.irfft2(fft.rfft2(scene, shape) * fft.rfft2(kernel, shape), shape)
    rows, columns = scene.shape
    valid: npt.NDArray[np.float64] = product[kernel.shape[0] - 1 : rows, kernel.shape[1] - 1 : columns]
    return valid


Relation = Literal["expand", "original", "region"]
"""Kind of the request that the image answers."""

SIZE_TOLERANCE: Final = 0.06
"""Relative deviation of a ratio of pixel sizes; the link transmits them in steps of 2.5 %."""

MAX_RELATED: Final = limit(20, "images", "claims", "contacts of the console", "vehicle", "related", "the newest")
MAX_COMPARED: Final = 20
"""Contacts of one detection that are compared with a new image."""

_NOT_COMPARED: Final = {"contact_id", "pixel_along_m", "pixel_across_m"}


def relation_of(image: ReconstructedImage, parent: ReconstructedImage) -> Relation | None:
    """Return which request about `parent` an image answers; None if it answers none.

    A record without time, or without position and range, does not identify a detection.
    """
    record, other = image.contact, parent.contact
    if record is None or other is None or not _is_same_detection(record, other):
        return None
    ratios = _size_ratios(record, other)
    if ratios is None:
        return None
    if all(abs(ratio / EXPAND_FACTOR - 1.0) <= SIZE_TOLERANCE for ratio in ratios):
        return "expand"
    is_same_size = all(abs(ratio - 1.0) <= SIZE_TOLERANCE for ratio in ratios)
    if is_same_size and parent.despeckle_strength and image.despeckle_strength == 0.0:
        return "original"
    (height_px, width_px), (whole_height_px, whole_width_px) = (
        (each.pixels.height_px, each.pixels.width_px) for each in (image, parent)
    )
    is_part = height_px <= whole_height_px and width_px <= whole_width_px
    if is_same_size and is_part and (height_px, width_px) != (whole_height_px, whole_width_px):
        return "region"
    return None


def _is_same_detection(record: Contact, other: Contact) -> bool:
    if record.time_utc_s is None or (record.lat_deg is None and record.ground_range_m is None):
        return False
    return record.model_dump(exclude=_NOT_COMPARED) == other.model_dump(exclude=_NOT_COMPARED)


def _size_ratios(record: Contact, other: Contact) -> tuple[float, float] | None:
    sizes = (record.pixel_along_m, record.pixel_across_m), (other.pixel_along_m, other.pixel_across_m)
    (along_m, across_m), (other_along_m, other_across_m) = sizes
    if along_m is None or across_m is None or not other_along_m or not other_across_m:
        return None
    return along_m / other_along_m, across_m / other_across_m


def link_related_images(db: sqlite3.Connection, contact_id: str, image: ReconstructedImage) -> None:
    """Store which image answers a request about another contact.

    The image can be the answer, or the contact of an answer that has arrived earlier. An image with a decision stays a
    contact.
    """
    row = db.execute("SELECT * FROM contact WHERE id = ?", (contact_id,)).fetchone()
    if row["parent"] is not None or row["seen_utc_s"] is None:
        return
    others = db.execute(
        "SELECT id, review FROM contact"
        " WHERE vehicle_id = ? AND seen_utc_s = ? AND vessel_id = ? AND id <> ? AND parent IS NULL"
        " AND lat_deg IS ? AND lon_deg IS ? AND range_m IS ? AND atd_confidence IS ? LIMIT ?",
        (
            *(row[name] for name in ("vehicle_id", "seen_utc_s", "vessel_id", "id")),
            *(row[name] for name in ("lat_deg", "lon_deg", "range_m", "atd_confidence")),
            MAX_COMPARED,
        ),
    ).fetchall()
    for other in others:
        other_image = find_image(db, other["id"])
        if row["review"] == "unreviewed" and (relation := relation_of(image, other_image)):
            _link(db, contact_id, other["id"], relation)
            return
        if other["review"] == "unreviewed" and (relation := relation_of(other_image, image)):
            _link(db, other["id"], contact_id, relation)


def _link(db: sqlite3.Connection, contact_id: str, parent: str, relation: Relation) -> None:
    db.execute(
        "UPDATE contact SET parent = ?, relation = ?, group_id = NULL WHERE id = ?", (parent, relation, contact_id)
    )


def related_images_json(db: sqlite3.Connection, contact_id: str, rates: Mapping[int, RateInfo]) -> list[Json]:
    """Return the newest images that answer requests about a contact, latest last; `rates` are those of the modem."""
    rows = db.execute(
        "SELECT id, relation, image_id FROM contact WHERE parent = ? ORDER BY arrived_utc_s DESC, id DESC LIMIT ?",
        (contact_id, MAX_RELATED),
    ).fetchall()[::-1]
    found: list[Json] = []
    for row in rows:
        box: Sequence[int] | None = None
        if row["relation"] == "expand":
            box = _box_in_expanded(find_image(db, contact_id), find_image(db, row["id"]))
        elif row["relation"] == "region":
            box = _box_of_region(db, contact_id, row["id"])
        images = versions_json(db, row["id"], rates)
        found.append({**{name: row[name] for name in ("id", "relation", "image_id")}, "box": box, "versions": images})
    return found


def _box_of_region(db: sqlite3.Connection, contact_id: str, region_id: str) -> Sequence[int] | None:
    """Return first row and column, last row + 1 and column + 1 of a region in its contact; None if unknown."""
    row = db.execute(
        "SELECT r.payload, c.height_px, c.width_px FROM request r JOIN contact c ON c.id = r.contact_id"
        " WHERE r.contact_id = ? AND r.result_contact = ?",
        (contact_id, region_id),
    ).fetchone()
    command = None if row is None else wire.decode(Command, bytes(row["payload"]), f"request about {contact_id}")
    if command is None or command.box is None:
        return None
    return RegionBox(*command.box).pixels(row["height_px"], row["width_px"])


def _box_in_expanded(image: ReconstructedImage, expanded: ReconstructedImage) -> Sequence[int] | None:
    """Return the box of a contact's image in the expanded image, as that of a region; None if it is not found."""
    if not image.codec or not expanded.codec:
        return None
    place = place_in_expanded(image.pixels.to_array(), expanded.pixels.to_array())
    if place is None:
        return None
    height, width = (size // EXPAND_FACTOR for size in (image.pixels.height_px, image.pixels.width_px))
    return [*place, place[0] + height, place[1] + width]
