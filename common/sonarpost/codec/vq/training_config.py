"""What a codebook is built from: training images, rounds, and the fingerprint by which a stopped build is known."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sonarpost.codec.vq.tiles import MAX_TILE_PX, MIN_TILE_PX, TileDatabase
from sonarpost.errors import ConfigError

MAX_TILES = 15_992
"""The paper's database; index + 1 fits 14 bits with room to spare."""


def rms_distance(grey_levels: float, tile_px: int) -> float:
    """Return the Euclidean distance of tiles that differ by `grey_levels` RMS (16 at 20 px is the paper's 320)."""
    return grey_levels * tile_px


@dataclass(frozen=True)
class Round:
    """One pass over the images.

    Attributes:
        fom_below: Images rebuilt with a figure of merit below this contribute tiles.
        distance_above: Only tiles farther than this from their nearest tile are added.
        max_images: How many images are looked at, spread evenly over the list; None for all.
    """

    fom_below: float
    distance_above: float
    max_images: int | None = None


@dataclass(frozen=True)
class TrainingImage:
    """One image to learn from.

    Attributes:
        name: Names it in messages and in the journal.
        load: Returns its pixels, shape (height, width), uint8; called anew each time they are needed.
    """

    name: str
    load: Callable[[], npt.NDArray[np.uint8]]


@dataclass(frozen=True)
class BuildProgress:
    """Told after every image: where the build stands.

    Attributes:
        round_number: From 0.
        rounds: How many there are.
        image_number: Which image of the list, from 0.
        done_in_round: Images of this round that are done, those of an earlier run included.
        images_in_round: How many it has.
        name: The image's.
        fom: Its figure of merit before; NaN for the very first image.
        added: Tiles it added.
        tiles: Tiles there are now.
    """

    round_number: int
    rounds: int
    image_number: int
    done_in_round: int
    images_in_round: int
    name: str
    fom: float
    added: int
    tiles: int


@dataclass(frozen=True)
class RefinementProgress:
    """Told after every image of a refinement pass, and once more, with the error, when the pass is done.

    Attributes:
        number: The pass, from 1.
        passes: How many there are.
        done_images: Images of this pass that are done.
        images: How many it has.
        rms: Error of the codebook as it was before the pass, grey levels RMS over all training tiles; NaN until the
            pass is done.
    """

    number: int
    passes: int
    done_images: int
    images: int
    rms: float


def pixels_hash(pixels: npt.NDArray[np.uint8]) -> bytes:
    """Return the sha256 of an image's size and pixels: two images with the same one teach the same."""
    digest = hashlib.sha256(f"{pixels.shape[0]} {pixels.shape[1]}\n".encode())
    digest.update(np.ascontiguousarray(pixels).data)
    return digest.digest()


def images_hash(images: Sequence[TrainingImage]) -> bytes:
    """Return the sha256 over the hashes of all images' pixels, in their order."""
    digest = hashlib.sha256()
    for image in images:
        digest.update(pixels_hash(image.load()))
    return digest.digest()


def spread(available: int, wanted: int | None) -> tuple[int, ...]:
    """Return at most `wanted` of the numbers 0..available-1, evenly spread, the first always among them."""
    if wanted is None or wanted >= available:
        return tuple(range(available))
    return tuple(i * available // wanted for i in range(wanted))


def check_plan(
    images: Sequence[TrainingImage], tile_px: int, rounds: Sequence[Round], max_tiles: int, core: TileDatabase | None
) -> None:
    """Refuse a plan that makes no sense.

    Raises:
        ConfigError: No images, no rounds, or a number out of range.
    """

    def refuse(field: str, value: object, expected: str) -> None:
        raise ConfigError("codebook build", field, value, expected)

    if not images:
        refuse("images", 0, "at least one image")
    if not rounds:
        refuse("rounds", 0, "at least one round")
    if not MIN_TILE_PX <= tile_px <= MAX_TILE_PX:
        refuse("tile_px", tile_px, f"{MIN_TILE_PX}..{MAX_TILE_PX} px")
    for number, settings in enumerate(rounds):
        if not settings.distance_above >= 0:
            refuse(f"rounds[{number}].distance_above", settings.distance_above, "zero or more")
        if settings.max_images is not None and settings.max_images < 1:
            refuse(f"rounds[{number}].max_images", settings.max_images, "at least 1, or none for all")
    if core is not None and core.tile_px != tile_px:
        refuse("core.tile_px", core.tile_px, f"{tile_px}, the tile size of this build")
    if max_tiles < (1 if core is None else len(core)):
        refuse("max_tiles", max_tiles, "at least 1 and no fewer than the core has")


def fingerprint(
    images: Sequence[TrainingImage], tile_px: int, rounds: Sequence[Round], max_tiles: int, core: TileDatabase | None
) -> str:
    """Return all that a resumed build must have in common with the one it goes on with, but for pixels, as text."""
    lines = [f"tile_px {tile_px}", f"max_tiles {max_tiles}", f"core {core.identity if core is not None else 'none'}"]
    lines += [f"round {r.fom_below!r} {r.distance_above!r} {r.max_images!r}" for r in rounds]
    lines += [f"image {image.name}" for image in images]
    return "\n".join(lines)
