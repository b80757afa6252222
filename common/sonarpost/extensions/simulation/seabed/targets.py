"""Placing objects into a simulated seabed: height, backscatter, scour pit, and parts above the seabed."""

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.extensions.simulation.seabed.objects import SUSPENDED_KINDS, ObjectKind, SeabedObject
from sonarpost.extensions.simulation.seabed.shapes import reach_m, surface_backscatter, surface_height_m
from sonarpost.extensions.simulation.seabed.terrain import Seabed, SuspendedBody

FloatMap = npt.NDArray[np.float32]

_ON_RELIEF: Final = (
    ObjectKind.RIDGE,
    ObjectKind.LOG,
    ObjectKind.VEGETATION,
    ObjectKind.DEBRIS_FIELD,
    ObjectKind.WRECK,
    ObjectKind.OUTCROP,
)
"""Long objects follow the relief of the seabed; the others stand on its median height."""
_BLEND_M: Final = 0.15
_PIT_DEPTH: Final = 0.4
"""Depth of a typical scour pit, as a fraction of the object's height."""
_DEEPEST_PIT_M: Final = 0.6


def place_object(seabed: Seabed, item: SeabedObject) -> float:
    """Add an object to the maps of a seabed, and its part above the seabed to `seabed.suspended`.

    Args:
        seabed: The strip; parts of the object outside it are cut off.
        item: The object.

    Returns:
        Height of the seabed under it, in metres; NaN when the whole object is outside the strip.
    """
    reach = math.ceil((reach_m(item) + (4 * _pit_width_m(item) if item.scour else 0)) / seabed.cell_m)
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
    if item.kind in SUSPENDED_KINDS:
        seabed.suspended.append(_suspended(item, ground_m))
    if item.scour:
        pit = _scour_pit(item, u_m, v_m)
        height -= pit
        # The object sinks into its own pit.
        ground_m -= 0.5 * float(pit.max())
    if item.kind is ObjectKind.RIDGE:
        height += top
        return ground_m
    inside = top > 0
    material = surface_backscatter(item, u_m[inside], v_m[inside])
    if item.kind in _ON_RELIEF:
        height += top
        # Thin parts, as the border of vegetation, show the seabed between them.
        share = np.clip(top[inside] / np.float32(_BLEND_M), 0, 1)
        backscatter[inside] += share * (material - backscatter[inside])
        return ground_m
    height[inside] = np.maximum(height, ground_m + top)[inside]
    backscatter[inside] = material
    return ground_m


def _suspended(item: SeabedObject, ground_m: float) -> SuspendedBody:
    """Return the part of an object above the seabed: a solid sphere, or a cloud of fish."""
    solid = item.kind is ObjectKind.MOORED_SPHERE
    return SuspendedBody(
        along_m=item.along_m,
        across_m=item.across_m,
        height_m=ground_m + item.centre_height_m,
        radius_m=item.width_m / 2,
        half_thickness_m=item.thickness_m / 2,
        backscatter=1.2 if solid else 1.0,
        fish=0 if solid else 30 + round(8 * item.width_m**2),
        seed=item.seed,
    )


def _pit_width_m(item: SeabedObject) -> float:
    return min(max(1.1 * item.height_m, 0.4), 2.0)


def _scour_pit(item: SeabedObject, u_m: FloatMap, v_m: FloatMap) -> FloatMap:
    """Return the depth of a crescent pit around an object: deepest towards the current, with a low deposit behind."""
    width_m = _pit_width_m(item)
    outside = np.hypot(
        np.clip(np.abs(u_m) - item.length_m / 2, 0, None), np.clip(np.abs(v_m) - item.width_m / 2, 0, None)
    )
    flow = math.radians(item.current_deg - item.orientation_deg)
    radius = np.hypot(u_m, v_m)
    facing = (u_m * math.cos(flow) + v_m * math.sin(flow)) / np.maximum(radius, 1e-3)
    depth_m = min(_PIT_DEPTH * item.scour * item.height_m, _DEEPEST_PIT_M)
    pit = (0.6 + 0.4 * facing) * np.exp(-((outside / width_m) ** 2))
    deposit = 0.25 * np.clip(-facing, 0, None) ** 2 * np.exp(-(((outside - 2.2 * width_m) / (0.8 * width_m)) ** 2))
    return np.asarray(depth_m * (pit - deposit), dtype=np.float32)
