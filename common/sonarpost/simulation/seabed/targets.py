"""Objects on the seabed: shapes of sea mines, and clutter that resembles them.

Dimensions follow published ones of the classes used in mine hunting: a cylinder like a bomb-shaped ground mine (about
2 m by 0.5 m), a truncated cone like the Manta (0.98 m at the base, 0.44 m high), a wedge like the Rockan (1.0 m by
0.8 m, 0.38 m high), and the sphere of a moored mine that lies on the bottom (0.8 to 1.0 m).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.simulation.seabed.terrain import Seabed

FloatMap = npt.NDArray[np.float32]


class ObjectKind(StrEnum):
    """Shape of an object."""

    CYLINDER = "cylinder"
    TRUNCATED_CONE = "truncated_cone"
    SPHERE = "sphere"
    WEDGE = "wedge"
    BOULDER = "boulder"
    DEBRIS = "debris"
    RIDGE = "ridge"


MINE_LIKE_KINDS: Final = (ObjectKind.CYLINDER, ObjectKind.TRUNCATED_CONE, ObjectKind.SPHERE, ObjectKind.WEDGE)
CLUTTER_KINDS: Final = (ObjectKind.BOULDER, ObjectKind.DEBRIS, ObjectKind.RIDGE)

_BACKSCATTER: Final = {
    ObjectKind.CYLINDER: 1.1,
    ObjectKind.TRUNCATED_CONE: 0.9,
    ObjectKind.SPHERE: 1.2,
    ObjectKind.WEDGE: 0.9,
    ObjectKind.BOULDER: 0.6,
    ObjectKind.DEBRIS: 0.9,
}
"""Lambert coefficient of the material; a ridge has that of the seabed."""


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
    """

    kind: ObjectKind
    along_m: float
    across_m: float
    length_m: float
    width_m: float
    height_m: float
    orientation_deg: float = 0.0
    seed: int = 0

    @property
    def is_mine_like(self) -> bool:
        """Whether it has the shape and size of a sea mine."""
        return self.kind in MINE_LIKE_KINDS


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
    return size


def surface_height_m(item: SeabedObject, u_m: FloatMap, v_m: FloatMap) -> FloatMap:
    """Return the height of an object's surface above the seabed.

    Args:
        item: The object.
        u_m: Distance from its centre along its long axis, metres, any array shape.
        v_m: Distance across that axis, same array shape.

    Returns:
        float32 of that shape; 0 outside the object.
    """
    return np.asarray(np.clip(_SURFACES[item.kind](item, u_m, v_m), 0, None), dtype=np.float32)


def _cylinder(item: SeabedObject, u_m: FloatMap, v_m: FloatMap) -> FloatMap:
    radius_m = item.width_m / 2
    inside = (np.abs(u_m) <= item.length_m / 2) & (np.abs(v_m) <= radius_m)
    top = np.sqrt(np.clip(radius_m**2 - v_m**2, 0, None)) + item.height_m - radius_m
    return np.asarray(np.where(inside, top, 0))


def _truncated_cone(item: SeabedObject, u_m: FloatMap, v_m: FloatMap) -> FloatMap:
    base_m = item.length_m / 2
    return np.asarray(item.height_m * np.clip((base_m - np.hypot(u_m, v_m)) / (0.45 * base_m), 0, 1))


def _sphere(item: SeabedObject, u_m: FloatMap, v_m: FloatMap) -> FloatMap:
    radius_m = item.length_m / 2
    squared = radius_m**2 - u_m**2 - v_m**2
    top = np.sqrt(np.clip(squared, 0, None)) + item.height_m - radius_m
    return np.asarray(np.where(squared >= 0, top, 0))


def _wedge(item: SeabedObject, u_m: FloatMap, v_m: FloatMap) -> FloatMap:
    inside = (np.abs(u_m) <= item.length_m / 2) & (np.abs(v_m) <= item.width_m / 2)
    return np.asarray(np.where(inside, item.height_m * (0.6 + 0.8 * u_m / item.length_m), 0))


def _boulder(item: SeabedObject, u_m: FloatMap, v_m: FloatMap) -> FloatMap:
    rng = np.random.default_rng(item.seed)
    angle = np.arctan2(v_m / item.width_m, u_m / item.length_m)
    outline = np.ones_like(angle)
    for harmonic in range(2, 7):
        outline += rng.normal(0, 0.22 / harmonic) * np.cos(harmonic * angle + rng.uniform(0, 2 * math.pi))
    inner = 2 * np.hypot(u_m / item.length_m, v_m / item.width_m) / outline
    facets = 1 + 0.2 * np.cos(6 * u_m / item.length_m + rng.uniform(0, 6)) * np.cos(
        6 * v_m / item.width_m + rng.uniform(0, 6)
    )
    return np.asarray(item.height_m * np.clip(1 - inner**3, 0, None) * facets / 1.1)


def _debris(item: SeabedObject, u_m: FloatMap, v_m: FloatMap) -> FloatMap:
    """Return overlapping beams and plates."""
    rng = np.random.default_rng(item.seed)
    top = np.zeros_like(u_m)
    for piece in range(int(rng.integers(3, 7))):
        turn = rng.normal(0, 0.4)
        centre = rng.uniform(-0.25, 0.25) * item.length_m, rng.uniform(-0.3, 0.3) * item.width_m
        along = (u_m - centre[0]) * math.cos(turn) + (v_m - centre[1]) * math.sin(turn)
        across = (v_m - centre[1]) * math.cos(turn) - (u_m - centre[0]) * math.sin(turn)
        long_m, thick_m = rng.uniform(0.2, 0.6) * item.length_m, rng.uniform(0.12, 0.3)
        if piece == 0:  # the first has the full length
            along, across, long_m = u_m, v_m, item.length_m
        inside = (np.abs(along) < long_m / 2) & (np.abs(across) < thick_m / 2)
        raised = item.height_m * (1.0 if piece == 0 else rng.uniform(0.4, 1.0))
        top = np.maximum(top, np.where(inside, raised * (0.8 + 0.4 * along / long_m), 0))
    return np.asarray(top)


def _ridge(item: SeabedObject, u_m: FloatMap, v_m: FloatMap) -> FloatMap:
    rng = np.random.default_rng(item.seed)
    bend = 0.12 * item.length_m * np.sin(2.2 * u_m / item.length_m * math.pi + rng.uniform(0, 6))
    taper = np.clip(1 - (2 * u_m / item.length_m) ** 4, 0, None)
    return np.asarray(item.height_m * taper * np.exp(-(((v_m - bend) / (0.35 * item.width_m)) ** 2)))


_SURFACES: Final[dict[ObjectKind, Callable[[SeabedObject, FloatMap, FloatMap], FloatMap]]] = {
    ObjectKind.CYLINDER: _cylinder,
    ObjectKind.TRUNCATED_CONE: _truncated_cone,
    ObjectKind.SPHERE: _sphere,
    ObjectKind.WEDGE: _wedge,
    ObjectKind.BOULDER: _boulder,
    ObjectKind.DEBRIS: _debris,
    ObjectKind.RIDGE: _ridge,
}


def place_object(seabed: Seabed, item: SeabedObject) -> float:
    """Add an object to the maps of a seabed.

    Args:
        seabed: The strip; parts of the object outside it are cut off.
        item: The object.

    Returns:
        Height of the seabed under it, in metres; NaN when the whole object is outside the strip.
    """
    reach = math.ceil((math.hypot(item.length_m, item.width_m) / 2 + 0.5) / seabed.cell_m)
    row = round((item.along_m - seabed.along_start_m) / seabed.cell_m)
    column = round((item.across_m - seabed.across_start_m) / seabed.cell_m)
    rows = slice(max(row - reach, 0), max(row + reach + 1, 0))
    columns = slice(max(column - reach, 0), max(column + reach + 1, 0))
    height, backscatter = seabed.height_m[rows, columns], seabed.backscatter[rows, columns]
    if not height.size:
        return math.nan
    along = seabed.along_start_m + seabed.cell_m * np.arange(rows.start, rows.start + height.shape[0]) - item.along_m
    across = seabed.across_start_m + seabed.cell_m * np.arange(columns.start, columns.start + height.shape[1])
    across = across - item.across_m
    turn = math.radians(item.orientation_deg)
    u_m = np.asarray(along[:, None] * math.cos(turn) + across[None, :] * math.sin(turn), dtype=np.float32)
    v_m = np.asarray(across[None, :] * math.cos(turn) - along[:, None] * math.sin(turn), dtype=np.float32)
    top = surface_height_m(item, u_m, v_m)
    ground_m = float(np.median(height))
    if item.kind is ObjectKind.RIDGE:
        height += top
        return ground_m
    inside = top > 0
    height[inside] = np.maximum(height, ground_m + top)[inside]
    backscatter[inside] = _BACKSCATTER[item.kind]
    return ground_m
