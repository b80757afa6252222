"""Association of looks: which looks at one place are one object, and the position of that object.

The result depends on the set of looks, not on the order of their arrival.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

from sonarpost.review.positions import LocalFrame

PASS_S: Final = 60.0
"""Maximum duration of one pass over an object. A vehicle that turns needs more time to return."""

GATE_CHI2: Final = 9.21
"""99 % quantile of the chi-square distribution with two degrees of freedom: the two axes of a position."""

_SIZE_CHI2: Final = 6.63
"""99 % quantile with one degree of freedom: one extent."""

_SIZE_SIGMA: Final = 0.35
"""Assumed standard deviation of the logarithm of an extent: extents depend on the aspect."""

_SIZE_TOLERANCE_M: Final = 0.5
"""Extents that differ by less are compatible: the difference is within a few pixels."""

_MIN_SIGMA_M: Final = 0.1

_MAX_SIGMA: Final = 8.0
"""Largest standard deviation of a gate, in units of the smallest. It limits the search, and prevents that an
inaccurate position joins a whole field of objects."""

Pair = tuple[str, str]
"""Two looks, in alphabetical order."""


def ordered_pair(one: str, other: str) -> Pair:
    """Return two looks in alphabetical order."""
    return (one, other) if one < other else (other, one)


@dataclass(frozen=True, slots=True)
class Look:
    """One look at an object.

    Attributes:
        contact_id: Identifier.
        lat_deg: Latitude, WGS 84.
        lon_deg: Longitude, WGS 84.
        sigma_m: Standard deviation of the position along each axis; None if unknown.
        vehicle_id: Vehicle.
        seen_utc_s: Time of detection; None if unknown.
        length_m: Extent along the track; None if unknown.
        width_m: Extent across the track; None if unknown.
        height_m: Height above the seabed; None if unknown.
    """

    contact_id: str
    lat_deg: float
    lon_deg: float
    sigma_m: float | None = None
    vehicle_id: str = ""
    seen_utc_s: float | None = None
    length_m: float | None = None
    width_m: float | None = None
    height_m: float | None = None


@dataclass(frozen=True, slots=True)
class AssociationRule:
    """Limits of the association.

    Attributes:
        radius_m: Distance limit of two accurate positions. For looks of one pass, whose navigation error is common,
            the limit is a quarter of it.
        mission_gap_s: Looks of different missions: their times differ by more.
    """

    radius_m: float
    mission_gap_s: float

    @property
    def floor_m(self) -> float:
        """Smallest standard deviation of a gate: two such positions have their limit at `radius_m`."""
        return self.radius_m / math.sqrt(2.0 * GATE_CHI2)

    @property
    def search_m(self) -> float:
        """Largest distance of two looks at one object."""
        return _MAX_SIGMA * self.radius_m

    def gate_sigma_m(self, sigma_m: float | None) -> float:
        """Return the standard deviation of a position as the gate uses it."""
        return min(max(sigma_m or 0.0, self.floor_m), _MAX_SIGMA * self.floor_m)


@dataclass(frozen=True, slots=True)
class FusedPosition:
    """Position of several looks, weighted by their inverse variances.

    Attributes:
        x_m: East of the origin of the local frame.
        y_m: North of it.
        sigma_m: Standard deviation along each axis: the looks of one pass have one navigation error, passes are
            independent. None if no look has one.
        scatter: Square root of the reduced chi-square of the looks' positions, at least 1. Above about 2 the looks
            lie further apart than their standard deviations explain.
    """

    x_m: float
    y_m: float
    sigma_m: float | None
    scatter: float


def is_same_pass(one: Look, other: Look) -> bool:
    """Return whether one vehicle made both looks on one pass. Its navigation error is then common to both."""
    if one.vehicle_id != other.vehicle_id or one.seen_utc_s is None or other.seen_utc_s is None:
        return False
    return abs(one.seen_utc_s - other.seen_utc_s) < PASS_S


def is_other_mission(one: Look, other: Look, gap_s: float) -> bool:
    """Return whether two looks are of different missions."""
    if one.seen_utc_s is None or other.seen_utc_s is None:
        return False
    return abs(one.seen_utc_s - other.seen_utc_s) > gap_s


def fuse_positions(
    looks: Sequence[Look], points: Sequence[tuple[float, float]], rule: AssociationRule
) -> FusedPosition:
    """Return the inverse-variance weighted mean of positions.

    Args:
        looks: The looks.
        points: Their (x_m, y_m) in a local frame.
        rule: Standard deviation of looks whose own is unknown.
    """
    passes: list[list[int]] = []
    for index in sorted(range(len(looks)), key=lambda i: (looks[i].seen_utc_s or 0.0, looks[i].contact_id)):
        known = next((one for one in passes if is_same_pass(looks[one[-1]], looks[index])), None)
        if known is None:
            passes.append([index])
        else:
            known.append(index)
    sigmas = [max(rule.floor_m if look.sigma_m is None else look.sigma_m, _MIN_SIGMA_M) for look in looks]
    sum_x = sum_y = weight = 0.0
    for one in passes:
        # Repeated looks of a pass do not reduce its error.
        share = 1.0 / min(sigmas[i] for i in one) ** 2
        sum_x += share * sum(points[i][0] for i in one) / len(one)
        sum_y += share * sum(points[i][1] for i in one) / len(one)
        weight += share
    x_m, y_m = sum_x / weight, sum_y / weight
    chi2 = sum(
        ((point[0] - x_m) ** 2 + (point[1] - y_m) ** 2) / sigma**2 for point, sigma in zip(points, sigmas, strict=True)
    )
    scatter = math.sqrt(chi2 / (2 * (len(looks) - 1))) if len(looks) > 1 else 1.0
    known_sigma = any(look.sigma_m is not None for look in looks)
    return FusedPosition(x_m, y_m, weight**-0.5 if known_sigma else None, max(1.0, scatter))


_Member = tuple[Look, tuple[float, float]]
"""A look and its (x_m, y_m) in the local frame."""


class _Cluster:
    """Looks that are one object so far.

    Args:
        members: The looks, in alphabetical order of their identifiers.
        rule: Limits.
        joined: Whether a person joined some of them.
    """

    def __init__(self, members: Sequence[_Member], rule: AssociationRule, *, joined: bool) -> None:
        self.members = tuple(members)
        self.joined = joined
        self.position = fuse_positions([look for look, _ in members], [point for _, point in members], rule)
        # Looks that a person joined may lie far apart. Their scatter then widens the gate.
        scale = self.position.scatter if joined else 1.0
        self.sigma_m = rule.gate_sigma_m((self.position.sigma_m or rule.floor_m) * scale)
        self.extents = (
            _mean_extent(max(look.length_m, look.width_m) for look, _ in members if look.length_m and look.width_m),
            _mean_extent(look.height_m for look, _ in members if look.height_m),
        )

    @property
    def name(self) -> str:
        """First identifier."""
        return self.members[0][0].contact_id


def _mean_extent(extents_m: Iterable[float]) -> float | None:
    logs = [math.log(extent) for extent in extents_m]
    return math.exp(math.fsum(logs) / len(logs)) if logs else None


def _size_distance(one: _Cluster, other: _Cluster) -> float | None:
    """Return the chi-square distance of the sizes; an unknown extent counts 1. None if they are incompatible.

    The greater of length and width is compared: which of them it is depends on the aspect.
    """
    total = 0.0
    for a_m, b_m in zip(one.extents, other.extents, strict=True):
        if a_m is None or b_m is None:
            total += 1.0
            continue
        chi2 = math.log(a_m / b_m) ** 2 / (2.0 * _SIZE_SIGMA**2)
        if chi2 > _SIZE_CHI2 and abs(a_m - b_m) > _SIZE_TOLERANCE_M:
            return None
        total += chi2
    return total


def _are_two_objects(one: Look, other: Look, apart_m: float, rule: AssociationRule) -> bool:
    """Return whether time and pass of two looks exclude one object.

    A vehicle records an object once on a pass. Looks of one pass that are further apart than their relative error are
    therefore two objects, however large the navigation error is.
    """
    if is_other_mission(one, other, rule.mission_gap_s):
        return True
    return is_same_pass(one, other) and apart_m > rule.radius_m / 4


def _distance(one: _Cluster, other: _Cluster, rule: AssociationRule, apart: Collection[Pair]) -> float | None:
    """Return the chi-square distance of two clusters; None if they are not one object."""
    dx, dy = one.position.x_m - other.position.x_m, one.position.y_m - other.position.y_m
    chi2 = (dx * dx + dy * dy) / (one.sigma_m**2 + other.sigma_m**2)
    if chi2 > GATE_CHI2:
        return None
    for a, (ax, ay) in one.members:
        for b, (bx, by) in other.members:
            if ordered_pair(a.contact_id, b.contact_id) in apart:
                return None
            if _are_two_objects(a, b, math.hypot(ax - bx, ay - by), rule):
                return None
    size = _size_distance(one, other)
    return None if size is None else chi2 + size


def looks_within_gate(look: Look, others: Sequence[Look], rule: AssociationRule) -> list[Look]:
    """Return the looks whose positions agree with that of a look, regardless of time and size."""
    return [other for other, _ in _within_gate(look, others, rule)]


def possible_partners(look: Look, others: Sequence[Look], rule: AssociationRule) -> list[Look]:
    """Return the looks that can be of the same object, judged by position, time and pass."""
    found = _within_gate(look, others, rule)
    return [other for other, apart_m in found if not _are_two_objects(look, other, apart_m, rule)]


def _within_gate(look: Look, others: Sequence[Look], rule: AssociationRule) -> list[tuple[Look, float]]:
    """Return the looks whose positions agree with that of a look, with their distances in metres."""
    frame = LocalFrame(look.lat_deg, look.lon_deg)
    points = frame.to_local([other.lat_deg for other in others], [other.lon_deg for other in others])
    sigma_m = rule.gate_sigma_m(look.sigma_m)
    found: list[tuple[Look, float]] = []
    for other, point in zip(others, points, strict=True):
        apart_m = math.hypot(*point)
        if apart_m <= math.hypot(sigma_m, rule.gate_sigma_m(other.sigma_m)) * math.sqrt(GATE_CHI2):
            found.append((other, apart_m))
    return found


def associate(
    looks: Sequence[Look],
    rule: AssociationRule,
    together: Collection[Pair] = (),
    apart: Collection[Pair] = (),
) -> list[tuple[str, ...]]:
    """Divide looks into objects. The order of `looks` does not change the result.

    The two nearest clusters become one while their positions agree: Mahalanobis distance of the fused positions within
    `GATE_CHI2`, compatible sizes, one mission, and no two distant looks of one pass.

    Args:
        looks: Looks of one area.
        rule: Limits.
        together: Looks that a person has joined.
        apart: Looks that a person has separated.

    Returns:
        Contact identifiers of each object, in alphabetical order.
    """
    if not looks:
        return []
    looks = sorted(looks, key=lambda look: look.contact_id)
    points = LocalFrame(looks[0].lat_deg, looks[0].lon_deg).to_local(
        [look.lat_deg for look in looks], [look.lon_deg for look in looks]
    )
    clusters: dict[int, _Cluster] = {}
    for number, group in enumerate(_joined_looks([look.contact_id for look in looks], together)):
        clusters[number] = _Cluster([(looks[i], points[i]) for i in group], rule, joined=len(group) > 1)
    distances: dict[tuple[int, int], float] = {}
    for i, j in combinations(clusters, 2):
        distance = _distance(clusters[i], clusters[j], rule, apart)
        if distance is not None:
            distances[i, j] = distance
    number = len(looks)
    while distances:
        _, _, (i, j) = min((d, sorted((clusters[i].name, clusters[j].name)), (i, j)) for (i, j), d in distances.items())
        one, other = clusters.pop(i), clusters.pop(j)
        distances = {pair: d for pair, d in distances.items() if not {i, j} & set(pair)}
        members = sorted((*one.members, *other.members), key=lambda member: member[0].contact_id)
        merged = _Cluster(members, rule, joined=one.joined or other.joined)
        for k, cluster in clusters.items():
            distance = _distance(cluster, merged, rule, apart)
            if distance is not None:
                distances[k, number] = distance
        clusters[number] = merged
        number += 1
    return sorted(tuple(look.contact_id for look, _ in cluster.members) for cluster in clusters.values())


def _joined_looks(names: Sequence[str], together: Collection[Pair]) -> list[list[int]]:
    """Return the indices of the looks that belong together, directly or through others."""
    root = {name: name for name in names}

    def find(name: str) -> str:
        while root[name] != name:
            name = root[name]
        return name

    for a, b in together:
        if a in root and b in root:
            first, second = sorted((find(a), find(b)))
            root[second] = first
    members: dict[str, list[int]] = {}
    for index, name in enumerate(names):
        members.setdefault(find(name), []).append(index)
    return list(members.values())
