"""Objects of the simulated seabed: kinds and dimensions of sea mines, of clutter that resembles them, of structures.

Dimensions follow published ones of the classes used in mine hunting: a cylinder like a bomb-shaped ground mine (about
2 m by 0.5 m), a truncated cone like the Manta (0.98 m at the base, 0.44 m high), a wedge like the Rockan (1.0 m by
0.8 m, 0.38 m high), and the sphere of a moored mine (0.8 to 1.0 m) on the bottom or above its anchor.
"""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np


class ObjectKind(StrEnum):
    """Shape of an object."""

    CYLINDER = "cylinder"
    TRUNCATED_CONE = "truncated_cone"
    SPHERE = "sphere"
    WEDGE = "wedge"
    BOULDER = "boulder"
    DEBRIS = "debris"
    RIDGE = "ridge"
    FINNED_CYLINDER = "finned_cylinder"
    FLUTED_CONE = "fluted_cone"
    MOORED_SPHERE = "moored_sphere"
    LOG = "log"
    TYRE = "tyre"
    CRAB_POT = "crab_pot"
    VEGETATION = "vegetation"
    DEBRIS_FIELD = "debris_field"
    FISH_SCHOOL = "fish_school"
    WRECK = "wreck"
    OUTCROP = "outcrop"


MINE_LIKE_KINDS: Final = (ObjectKind.CYLINDER, ObjectKind.TRUNCATED_CONE, ObjectKind.SPHERE, ObjectKind.WEDGE)
"""Kinds from which a survey with a number of targets chooses."""
CLUTTER_KINDS: Final = (ObjectKind.BOULDER, ObjectKind.DEBRIS, ObjectKind.RIDGE)
"""Kinds from which a survey with a number of other objects chooses."""
FURTHER_MINE_LIKE_KINDS: Final = (ObjectKind.FINNED_CYLINDER, ObjectKind.FLUTED_CONE, ObjectKind.MOORED_SPHERE)
"""Mine-like kinds that a survey contains only when they are named."""
FURTHER_CLUTTER_KINDS: Final = (
    ObjectKind.LOG,
    ObjectKind.TYRE,
    ObjectKind.CRAB_POT,
    ObjectKind.VEGETATION,
    ObjectKind.DEBRIS_FIELD,
    ObjectKind.FISH_SCHOOL,
)
"""Other kinds that a survey contains only when they are named."""
STRUCTURE_KINDS: Final = (ObjectKind.WRECK, ObjectKind.OUTCROP)
"""Kinds much larger than a mine; a survey contains them only when they are named."""
SUSPENDED_KINDS: Final = (ObjectKind.MOORED_SPHERE, ObjectKind.FISH_SCHOOL)
"""Kinds above the seabed; `SeabedObject.height_m` is the height of their upper edge."""

_NEVER_SETTLED: Final = (*SUSPENDED_KINDS, ObjectKind.RIDGE, ObjectKind.VEGETATION, ObjectKind.OUTCROP)
_SCHOOL_ASPECT: Final = 0.35
"""Height of a fish school as a fraction of its diameter."""


@dataclass(frozen=True, slots=True)
class SeabedObject:
    """An object and its position.

    Attributes:
        kind: Shape.
        along_m: Along-track coordinate of its centre.
        across_m: Across-track coordinate of its centre, starboard positive.
        length_m: Along its long axis.
        width_m: Across its long axis.
        height_m: Height above the seabed, less than its full height when it is partly buried.
        orientation_deg: Long axis, clockwise from along-track.
        seed: Seed of an irregular shape.
        buried_m: Height of its part below the seabed; its full height is `height_m + buried_m`.
        tilt_deg: Inclination of its long axis; positive raises the end in the direction of `orientation_deg`.
        scour: Depth of the pit around it: 0 none, 1 typical.
        current_deg: Direction from which the current comes that made the pit, clockwise from along-track.
    """

    kind: ObjectKind
    along_m: float
    across_m: float
    length_m: float
    width_m: float
    height_m: float
    orientation_deg: float = 0.0
    seed: int = 0
    buried_m: float = 0.0
    tilt_deg: float = 0.0
    scour: float = 0.0
    current_deg: float = 0.0

    @property
    def is_mine_like(self) -> bool:
        """Whether it has the shape and size of a sea mine."""
        return self.kind in MINE_LIKE_KINDS or self.kind in FURTHER_MINE_LIKE_KINDS

    @property
    def is_structure(self) -> bool:
        """Whether it is much larger than a mine."""
        return self.kind in STRUCTURE_KINDS

    @property
    def can_settle(self) -> bool:
        """Whether it can be partly buried, tilted and surrounded by a scour pit."""
        return self.kind not in _NEVER_SETTLED

    @property
    def thickness_m(self) -> float:
        """Vertical distance between its lower and upper edge, for a kind above the seabed; else `height_m`."""
        if self.kind is ObjectKind.MOORED_SPHERE:
            return self.width_m
        return _SCHOOL_ASPECT * self.width_m if self.kind is ObjectKind.FISH_SCHOOL else self.height_m

    @property
    def centre_height_m(self) -> float:
        """Height of its centre above the seabed."""
        return self.height_m - self.thickness_m / 2


def random_object(kind: ObjectKind, along_m: float, across_m: float, rng: np.random.Generator) -> SeabedObject:
    """Return an object with random dimensions typical of its kind, random orientation, and slight or no burial."""
    size_m, orientation_deg = _random_size(kind, rng), float(rng.uniform(0, 360))
    return SeabedObject(kind, along_m, across_m, *size_m, orientation_deg, seed=int(rng.integers(0, 2**31)))


def _random_size(kind: ObjectKind, rng: np.random.Generator) -> tuple[float, float, float]:
    """Return length, width and visible height."""
    match kind:
        case ObjectKind.CYLINDER:
            diameter_m = rng.uniform(0.45, 0.6)
            size = rng.uniform(1.6, 2.6), diameter_m, diameter_m * rng.uniform(0.8, 1.0)
        case ObjectKind.TRUNCATED_CONE:
            base_m = rng.uniform(0.94, 1.05)
            size = base_m, base_m, 0.45 * base_m * rng.uniform(0.85, 1.0)
        case ObjectKind.SPHERE:
            diameter_m = rng.uniform(0.8, 1.0)
            size = diameter_m, diameter_m, diameter_m * rng.uniform(0.75, 0.95)
        case ObjectKind.WEDGE:
            size = rng.uniform(0.95, 1.1), rng.uniform(0.75, 0.85), 0.38 * rng.uniform(0.9, 1.0)
        case ObjectKind.BOULDER:
            length_m = rng.uniform(0.5, 1.6)
            size = length_m, length_m * rng.uniform(0.55, 0.95), length_m * rng.uniform(0.25, 0.6)
        case ObjectKind.DEBRIS:
            size = rng.uniform(2.0, 5.0), rng.uniform(0.8, 2.0), rng.uniform(0.12, 0.35)
        case ObjectKind.RIDGE:
            size = rng.uniform(4.0, 9.0), rng.uniform(0.7, 1.4), rng.uniform(0.18, 0.35)
        case _:
            size = _random_further_size(kind, rng)
    return size


def _random_further_size(kind: ObjectKind, rng: np.random.Generator) -> tuple[float, float, float]:
    """Return length, width and visible height of a kind outside `MINE_LIKE_KINDS` and `CLUTTER_KINDS`."""
    match kind:
        case ObjectKind.FINNED_CYLINDER:
            diameter_m = rng.uniform(0.4, 0.6)
            size = rng.uniform(1.8, 3.0), diameter_m, diameter_m * rng.uniform(0.85, 1.0)
        case ObjectKind.FLUTED_CONE:
            base_m = rng.uniform(0.94, 1.05)
            size = base_m, base_m, base_m * rng.uniform(0.38, 0.46)
        case ObjectKind.MOORED_SPHERE:
            diameter_m = rng.uniform(0.7, 1.0)
            size = diameter_m, diameter_m, diameter_m + rng.uniform(0.3, 2.0)
        case ObjectKind.LOG:
            thickness_m = rng.uniform(0.2, 0.5)
            size = rng.uniform(2.0, 8.0), thickness_m, thickness_m * rng.uniform(0.6, 1.0)
        case ObjectKind.TYRE:
            diameter_m = rng.uniform(0.6, 1.2)
            size = diameter_m, diameter_m, diameter_m * rng.uniform(0.2, 0.3)
        case ObjectKind.CRAB_POT:
            length_m = rng.uniform(0.6, 1.0)
            size = length_m, length_m * rng.uniform(0.65, 1.0), rng.uniform(0.3, 0.5)
        case ObjectKind.VEGETATION:
            length_m = rng.uniform(2.0, 8.0)
            size = length_m, length_m * rng.uniform(0.4, 0.9), rng.uniform(0.15, 0.45)
        case ObjectKind.DEBRIS_FIELD:
            length_m = rng.uniform(5.0, 14.0)
            size = length_m, length_m * rng.uniform(0.3, 0.8), rng.uniform(0.3, 1.0)
        case ObjectKind.FISH_SCHOOL:
            length_m = rng.uniform(2.0, 7.0)
            size = length_m, length_m, _SCHOOL_ASPECT * length_m + rng.uniform(0.3, 1.5)
        case ObjectKind.WRECK:
            length_m = rng.uniform(15.0, 60.0)
            size = length_m, length_m * rng.uniform(0.14, 0.22), rng.uniform(0.8, 4.0)
        case ObjectKind.OUTCROP:
            size = rng.uniform(5.0, 30.0), rng.uniform(2.0, 5.0), rng.uniform(0.4, 1.5)
        case _:
            raise ValueError(f"kind: got {kind}, expected one with a size")
    return size


def settled(
    item: SeabedObject, burial: float, tilt_deg: float, scour: float, current_deg: float, rng: np.random.Generator
) -> SeabedObject:
    """Return an object that is partly buried, tilted and in a scour pit, at random.

    Args:
        item: The object; one for which `can_settle` is False is returned unchanged, after the same draws.
        burial: Greatest fraction of its height below the seabed, 0 to 0.8.
        tilt_deg: Greatest inclination of its long axis; a long object rises by at most 0.6 of its height.
        scour: Mean depth of the pit: 0 none, 1 typical.
        current_deg: Direction from which the current comes, clockwise from along-track.
        rng: Random generator; four draws.
    """
    buried, inclination, depth = rng.uniform(0, burial), rng.uniform(-tilt_deg, tilt_deg), rng.uniform(0.4, 1.6)
    turn_deg = rng.normal(0, 15)
    if not item.can_settle:
        return item
    steepest_deg = math.degrees(math.atan(1.2 * item.height_m / item.length_m))
    return SeabedObject(
        item.kind,
        item.along_m,
        item.across_m,
        item.length_m,
        item.width_m,
        item.height_m * (1 - buried),
        item.orientation_deg,
        item.seed,
        buried_m=item.buried_m + item.height_m * buried,
        tilt_deg=min(max(inclination, -steepest_deg), steepest_deg),
        scour=scour * depth,
        current_deg=(current_deg + turn_deg) % 360,
    )
