"""Surfaces of the objects of the simulated seabed: height above the seabed and backscatter of their material."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.extensions.simulation.seabed.objects import (
    CLUTTER_KINDS,
    MINE_LIKE_KINDS,
    STRUCTURE_KINDS,
    ObjectKind,
    SeabedObject,
)

FloatMap = npt.NDArray[np.float32]

_BACKSCATTER: Final = {
    ObjectKind.CYLINDER: 1.1,
    ObjectKind.TRUNCATED_CONE: 0.9,
    ObjectKind.SPHERE: 1.2,
    ObjectKind.WEDGE: 0.9,
    ObjectKind.BOULDER: 0.6,
    ObjectKind.DEBRIS: 0.9,
    ObjectKind.FINNED_CYLINDER: 1.1,
    ObjectKind.FLUTED_CONE: 0.9,
    ObjectKind.MOORED_SPHERE: 0.8,
    ObjectKind.LOG: 0.5,
    ObjectKind.TYRE: 0.6,
    ObjectKind.CRAB_POT: 0.9,
    ObjectKind.VEGETATION: 0.7,
    ObjectKind.DEBRIS_FIELD: 0.9,
    ObjectKind.FISH_SCHOOL: 0.0,
    ObjectKind.WRECK: 1.0,
    ObjectKind.OUTCROP: 0.6,
}
"""Lambert coefficient of the material; a ridge has that of the seabed. For a moored sphere: that of its anchor."""
_ROUGHNESS: Final = {ObjectKind.VEGETATION: 0.35, ObjectKind.WRECK: 0.35, ObjectKind.OUTCROP: 0.3}
"""Standard deviation of the logarithm of the backscatter of large objects."""
_ROPE_M: Final = 6.0
_WAVES: Final = 20


def reach_m(item: SeabedObject) -> float:
    """Return the radius around its centre that an object, without its scour pit, can occupy."""
    extent_m = math.hypot(item.length_m, item.width_m) / 2 + 0.5
    if item.kind is ObjectKind.CRAB_POT:
        return extent_m + _ROPE_M
    return 1.15 * extent_m + 0.5 if item.kind in _WIDER else extent_m


def surface_height_m(item: SeabedObject, u_m: FloatMap, v_m: FloatMap) -> FloatMap:
    """Return the height of an object's surface above the seabed.

    Args:
        item: The object.
        u_m: Distance from its centre along its long axis, metres, any array shape.
        v_m: Distance across that axis, same array shape.

    Returns:
        float32 of that shape; 0 outside the object. For a moored sphere: the surface of its anchor.
    """
    surface = _SURFACES[item.kind]
    if item.kind in _EXACT and item.buried_m == 0 and item.tilt_deg == 0:
        return np.asarray(np.clip(surface(item, u_m, v_m), 0, None), dtype=np.float32)
    # The seeded details of large shapes are computed only near the object.
    near = (np.abs(u_m) <= 0.6 * item.length_m + _margin_m(item)) & (
        np.abs(v_m) <= 0.6 * item.width_m + _margin_m(item)
    )
    u, v = u_m[near], v_m[near]
    top = surface(replace(item, height_m=item.height_m + item.buried_m), u, v)
    top = np.where(top > 0, top + u * math.tan(math.radians(item.tilt_deg)) - item.buried_m, 0)
    out = np.zeros(u_m.shape, dtype=np.float32)
    out[near] = np.clip(top, 0, None)
    return out


def surface_backscatter(item: SeabedObject, u_m: FloatMap, v_m: FloatMap) -> FloatMap | float:
    """Return the Lambert coefficient of an object's surface, linear: one value, or float32 of the shape of `u_m`."""
    level = _BACKSCATTER[item.kind]
    roughness = _ROUGHNESS.get(item.kind)
    if roughness is None:
        return level
    texture = _texture(u_m, v_m, np.random.default_rng([item.seed, 1]), 3.0, 0.3)
    return np.asarray(level * np.exp(roughness * texture), dtype=np.float32)


def _margin_m(item: SeabedObject) -> float:
    return _ROPE_M + 0.5 if item.kind is ObjectKind.CRAB_POT else 0.5


def _texture(
    u_m: npt.NDArray[np.floating],
    v_m: npt.NDArray[np.floating],
    rng: np.random.Generator,
    longest_m: float,
    shortest_m: float,
) -> npt.NDArray[np.floating]:
    """Return smooth noise of approximately unit variance: plane waves of random direction and wavelength."""
    total = np.zeros(u_m.shape, dtype=np.float32)
    squared = 0.0
    for _ in range(_WAVES):
        wavelength_m = math.exp(rng.uniform(math.log(shortest_m), math.log(longest_m)))
        direction, phase = rng.uniform(0, 2 * math.pi, 2)
        weight = math.sqrt(wavelength_m)
        k = 2 * math.pi / wavelength_m
        total += np.float32(weight) * np.cos(
            np.float32(k * math.cos(direction)) * u_m + np.float32(k * math.sin(direction)) * v_m + np.float32(phase)
        )
        squared += weight**2 / 2
    return total / np.float32(math.sqrt(squared))


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


def _finned_cylinder(item: SeabedObject, u_m: FloatMap, v_m: FloatMap) -> FloatMap:
    """Return a body with a round nose (positive u), a tapered tail and four diagonal fins at its end."""
    radius_m, axis_m = item.width_m / 2, item.height_m - item.width_m / 2
    nose_m, shoulder_m, fins_m = item.length_m / 2 - radius_m, -0.2 * item.length_m, -0.36 * item.length_m
    rounded = np.sqrt(np.clip(1 - (np.clip(u_m - nose_m, 0, None) / radius_m) ** 2, 0, None))
    tapered = np.clip(1 - 0.65 * (shoulder_m - u_m) / (0.3 * item.length_m), 0.35, 1)
    local_m = radius_m * np.minimum(rounded, tapered)
    inside = (np.abs(u_m) <= item.length_m / 2) & (np.abs(v_m) < local_m)
    body = np.where(inside, axis_m + np.sqrt(np.clip(local_m**2 - v_m**2, 0, None)), 0)
    finned = (u_m >= -item.length_m / 2) & (u_m <= fins_m) & (np.abs(v_m) <= 0.8 * radius_m)
    return np.asarray(np.maximum(body, np.where(finned, axis_m + 0.25 * radius_m + 0.75 * np.abs(v_m), 0)))


def _fluted_cone(item: SeabedObject, u_m: FloatMap, v_m: FloatMap) -> FloatMap:
    """Return a truncated cone with ten flutes in its flank and a raised ring on its flat top."""
    base_m, radius_m = item.length_m / 2, np.hypot(u_m, v_m)
    fluted_m = base_m * (1 - 0.09 * (1 + np.cos(10 * np.arctan2(v_m, u_m) + item.seed % 7)))
    flank = np.clip((fluted_m - radius_m) / (0.4 * base_m), 0, 0.93)
    ring = np.abs(radius_m - 0.3 * base_m) < 0.12 * base_m
    return np.asarray(item.height_m * np.where(ring, 1.0, flank))


def _anchor(item: SeabedObject, u_m: FloatMap, v_m: FloatMap) -> FloatMap:
    """Return the anchor block of a moored sphere; the current moves the sphere a little from above it."""
    rng = np.random.default_rng(item.seed)
    offset_m = rng.uniform(-0.15, 0.15, 2) * (item.height_m - item.width_m)
    half_m, block_m = rng.uniform(0.2, 0.35), rng.uniform(0.15, 0.3)
    inside = (np.abs(u_m - offset_m[0]) <= half_m) & (np.abs(v_m - offset_m[1]) <= half_m)
    return np.asarray(np.where(inside, block_m, 0))


def _fish_school(_item: SeabedObject, u_m: FloatMap, _v_m: FloatMap) -> FloatMap:
    return np.zeros_like(u_m)


def _log(item: SeabedObject, u_m: FloatMap, v_m: FloatMap) -> FloatMap:
    """Return a tapered trunk, straight or bent, with up to two stubs of branches."""
    rng = np.random.default_rng(item.seed)
    bend_m = rng.choice([0.0, rng.uniform(-0.08, 0.08)]) * item.length_m
    centred = v_m - bend_m * (0.5 - (2 * u_m / item.length_m) ** 2)
    radius_m = item.width_m / 2 * (0.85 - 0.3 * u_m / item.length_m)
    across = np.clip(1 - (centred / radius_m) ** 2, 0, None)
    top = np.where(np.abs(u_m) <= item.length_m / 2, item.height_m * np.sqrt(across), 0)
    for _ in range(int(rng.integers(0, 3))):
        root_m, side = rng.uniform(-0.4, 0.4) * item.length_m, rng.choice([-1, 1])
        reach = side * centred
        stub = (np.abs(u_m - root_m - 0.5 * reach) < 0.06) & (reach > 0) & (reach < rng.uniform(0.3, 0.6))
        top = np.maximum(top, np.where(stub, 0.6 * item.height_m, 0))
    return np.asarray(top)


def _tyre(item: SeabedObject, u_m: FloatMap, v_m: FloatMap) -> FloatMap:
    tube_m = 0.16 * item.length_m
    off = (np.hypot(u_m, v_m) - (item.length_m / 2 - tube_m)) / tube_m
    return np.asarray(item.height_m * np.clip(1 - off**4, 0, None))


def _crab_pot(item: SeabedObject, u_m: FloatMap, v_m: FloatMap) -> FloatMap:
    """Return a frame with a mesh that lets part of the sound through, and often a rope on the seabed."""
    rng = np.random.default_rng(item.seed)
    half_u, half_v = item.length_m / 2, item.width_m / 2
    inside = (np.abs(u_m) <= half_u) & (np.abs(v_m) <= half_v)
    edge = (np.abs(u_m) > half_u - 0.06) | (np.abs(v_m) > half_v - 0.06) | (np.abs(u_m) < 0.04)
    mesh = _texture(u_m, v_m, rng, 0.3, 0.12)
    # Sound passes through the mesh: most of its cells are low.
    gaps = np.where(mesh > 0.9, 0.85, 0.22 + 0.12 * np.clip(mesh, -1, 1))
    side = np.where(_texture(u_m, v_m, rng, 0.4, 0.15) > -0.3, 1.0, 0.5)
    top = np.where(inside, item.height_m * np.where(edge, side, gaps), 0)
    if rng.random() < 0.6:
        length_m, amplitude_m, phase = rng.uniform(2.0, _ROPE_M), rng.uniform(0.1, 0.5), rng.uniform(0, 6)
        path = amplitude_m * (np.sin(1.3 * u_m + phase) - math.sin(1.3 * half_u + phase))
        rope = (np.abs(v_m - path) < 0.05) & (u_m > half_u) & (u_m < half_u + length_m)
        top = np.maximum(top, np.where(rope, 0.05, 0))
    return np.asarray(top)


def _vegetation(item: SeabedObject, u_m: FloatMap, v_m: FloatMap) -> FloatMap:
    """Return a canopy with small tufts within an irregular outline, lower towards its border."""
    rng = np.random.default_rng(item.seed)
    inner = 2 * np.hypot(u_m / item.length_m, v_m / item.width_m)
    border = np.clip(1.1 - inner + 0.25 * _texture(u_m, v_m, rng, 0.6 * item.length_m, 0.8), 0, 0.8) / 0.8
    tufts = np.clip(0.55 + 0.2 * _texture(u_m, v_m, rng, 3.0, 1.0) + 0.1 * _texture(u_m, v_m, rng, 0.5, 0.2), 0, 1)
    return np.asarray(item.height_m * border * tufts)


def _debris_field(item: SeabedObject, u_m: FloatMap, v_m: FloatMap) -> FloatMap:
    """Return separate plates, beams and pipes of different size and direction, densest in the middle."""
    rng = np.random.default_rng(item.seed)
    top = np.zeros_like(u_m)
    for piece in range(int(rng.integers(8, 18))):
        turn = rng.uniform(0, math.pi)
        spread = 0.42 * (1.0, rng.random())[piece > 1]
        around = math.pi * piece if piece < 2 else rng.uniform(0, 2 * math.pi)
        u0, v0 = spread * item.length_m * math.cos(around), spread * item.width_m * math.sin(around)
        along = (u_m - u0) * math.cos(turn) + (v_m - v0) * math.sin(turn)
        across = (v_m - v0) * math.cos(turn) - (u_m - u0) * math.sin(turn)
        long_m = rng.uniform(0.5, 3.0) if piece else min(2.5, item.length_m / 3)
        thick_m = rng.choice([0.15, 0.3, 0.8 * rng.uniform(0.5, 1.2)])
        raised = item.height_m * (1.0 if piece < 2 else rng.uniform(0.15, 0.9))
        inside = (np.abs(along) < long_m / 2) & (np.abs(across) < thick_m / 2)
        lean = 1 + rng.uniform(-0.5, 0.0) * (0.5 + along / long_m)
        top = np.maximum(top, np.where(inside, raised * lean, 0))
    return np.asarray(top)


def _wreck(item: SeabedObject, u_m: FloatMap, v_m: FloatMap) -> FloatMap:
    """Return a hull with bow (positive u), holds, superstructure and collapsed parts, and pieces beside it."""
    rng = np.random.default_rng(item.seed)
    x = 2 * u_m / item.length_m
    forward = np.clip((x - 0.45) / 0.55, 0, 1)
    aft = np.clip((-x - 0.8) / 0.2, 0, 1)
    beam_m = item.width_m / 2 * np.sqrt(np.clip(1 - forward**2, 0, None)) * (1 - 0.35 * aft**2)
    inside = (np.abs(x) <= 1) & (np.abs(v_m) < beam_m)
    heel = rng.uniform(-0.3, 0.3)
    deck = item.height_m * (rng.uniform(0.4, 0.6) + 0.12 * x**2 + heel * v_m / item.width_m)
    wall = beam_m - np.abs(v_m) < 0.25
    level = np.where(wall, deck + 0.08 * item.height_m, deck)
    # Open holds with frames across them.
    first, last = rng.uniform(-0.05, 0.1), rng.uniform(0.35, 0.55)
    hold = (x > first) & (x < last) & (np.abs(v_m) < 0.6 * beam_m) & (np.abs(x - (first + last) / 2) > 0.04)
    level = np.where(hold, 0.3 * deck, level)
    house = rng.uniform(-0.65, -0.35)
    cabin = (np.abs(x - house) < 0.14) & (np.abs(v_m) < 0.65 * beam_m)
    bridge = (np.abs(x - house) < 0.06) & (np.abs(v_m) < 0.5 * beam_m)
    level = np.where(cabin, np.maximum(level, 0.8 * item.height_m), level)
    level = np.where(bridge, item.height_m, level)
    collapse = _texture(u_m, v_m, rng, 0.5 * item.length_m, 0.12 * item.length_m)
    share = np.clip((collapse - rng.uniform(0.3, 0.9)) * 5, 0, 1) * ~cabin
    ribs = np.where(np.abs(np.mod(u_m, 1.2) - 0.6) < 0.12, 0.6, 0.25)
    level = level * (1 - share * (1 - ribs)) + 0.025 * item.height_m * _texture(u_m, v_m, rng, 4.0, 0.8)
    top = np.where(inside, np.clip(level, 0.05, item.height_m), 0)
    for _ in range(int(rng.integers(5, 14))):
        turn, u0 = rng.uniform(0, math.pi), rng.uniform(-0.5, 0.5) * item.length_m
        v0 = rng.choice([-1, 1]) * rng.uniform(0.4, 0.6) * item.width_m
        along = (u_m - u0) * math.cos(turn) + (v_m - v0) * math.sin(turn)
        across = (v_m - v0) * math.cos(turn) - (u_m - u0) * math.sin(turn)
        piece = (np.abs(along) < rng.uniform(0.3, 2.0)) & (np.abs(across) < rng.uniform(0.1, 0.5))
        top = np.maximum(top, np.where(piece, rng.uniform(0.05, 0.25) * item.height_m, 0))
    return np.asarray(top)


def _outcrop(item: SeabedObject, u_m: FloatMap, v_m: FloatMap) -> FloatMap:
    """Return a ledge: a steep, broken edge at negative v, and a slope down to the seabed at positive v."""
    rng = np.random.default_rng(item.seed)
    x = 2 * u_m / item.length_m
    still = np.zeros_like(u_m)
    edge_m = item.width_m * (0.15 * _texture(u_m, still, rng, 0.6 * item.length_m, 2.0) - 0.3)
    edge_m = edge_m + 0.15 * _texture(u_m, v_m, rng, 2.0, 0.4)
    behind = v_m - edge_m
    rise = np.clip(behind / 0.25, 0, 1)
    slope = np.clip(1 - behind / (0.85 * item.width_m), 0, 1)
    broken = np.clip(0.75 + 0.35 * _texture(u_m, still, rng, 0.5 * item.length_m, 1.5), 0.1, 1)
    taper = np.sqrt(np.clip(1 - np.abs(x) ** 3, 0, None))
    rough = 1 + 0.12 * _texture(u_m, v_m, rng, 2.5, 0.3)
    return np.asarray(item.height_m * taper * broken * rise * slope * rough)


_SURFACES: Final[dict[ObjectKind, Callable[[SeabedObject, FloatMap, FloatMap], FloatMap]]] = {
    ObjectKind.CYLINDER: _cylinder,
    ObjectKind.TRUNCATED_CONE: _truncated_cone,
    ObjectKind.SPHERE: _sphere,
    ObjectKind.WEDGE: _wedge,
    ObjectKind.BOULDER: _boulder,
    ObjectKind.DEBRIS: _debris,
    ObjectKind.RIDGE: _ridge,
    ObjectKind.FINNED_CYLINDER: _finned_cylinder,
    ObjectKind.FLUTED_CONE: _fluted_cone,
    ObjectKind.MOORED_SPHERE: _anchor,
    ObjectKind.FISH_SCHOOL: _fish_school,
    ObjectKind.LOG: _log,
    ObjectKind.TYRE: _tyre,
    ObjectKind.CRAB_POT: _crab_pot,
    ObjectKind.VEGETATION: _vegetation,
    ObjectKind.DEBRIS_FIELD: _debris_field,
    ObjectKind.WRECK: _wreck,
    ObjectKind.OUTCROP: _outcrop,
}
_EXACT: Final = frozenset((*MINE_LIKE_KINDS, *CLUTTER_KINDS))
_WIDER: Final = frozenset((ObjectKind.LOG, ObjectKind.VEGETATION, ObjectKind.DEBRIS_FIELD, *STRUCTURE_KINDS))
