"""Rate-distortion curves of measured codecs, compared pair by pair on the pictures both could code."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from research.common.measurement import Point
from research.common.statistics import Interval, Values, bd_rate_percent, interval, overlap_db

LEAST_SHARE: Final = 0.9
"""A budget counts for a curve if the codec could keep to it for this share of the pictures."""
BD_RESAMPLES: Final = 200

Curve = Sequence[Point]


@dataclass(frozen=True)
class RateDifference:
    """How two codecs' rates differ at equal PSNR.

    Attributes:
        percent: Bjøntegaard difference, negative where the first needs less; None where they cannot be compared.
        ci: 95 % bootstrap interval; None where too few samples could be compared.
        overlap: The PSNR range compared over, dB.
        pictures: How many pictures both curves rest on.
    """

    percent: float | None
    ci: Interval | None
    overlap: Interval | None
    pictures: int


def curves(points: Sequence[Point]) -> dict[str, list[Point]]:
    """Gather points by codec name, in the order of first appearance; variants of one codec lie on one curve."""
    found: dict[str, list[Point]] = {}
    for point in points:
        found.setdefault(point.subject.codec.name, []).append(point)
    return found


def rate_difference(first: Curve, second: Curve, weights: Values | None = None) -> RateDifference:
    """Compare two codecs by Bjøntegaard's rate difference (see `bd_rate_percent`).

    Curves join mean bytes and mean PSNR over the same pictures: those that both codecs coded at every budget that
    counts (`LEAST_SHARE`). A mean over whatever fitted would favour a codec that drops the hard pictures.

    Args:
        first: Points of one codec.
        second: Points of the other.
        weights: Bootstrap weights, shape (R, pictures), for the interval; None for no interval.
    """
    ours, theirs = _counting(first), _counting(second)
    if len(ours) < 2 or len(theirs) < 2:
        return RateDifference(None, None, None, 0)
    common = np.logical_and.reduce([point.hits for point in (*ours, *theirs)])
    pictures = int(np.count_nonzero(common))
    if pictures == 0:
        return RateDifference(None, None, None, 0)
    every = np.full((1, common.size), 1.0)
    (rates, quality), (other_rates, other_quality) = _means(ours, common, every), _means(theirs, common, every)
    percent = bd_rate_percent(rates[0], quality[0], other_rates[0], other_quality[0])
    if percent is None:
        return RateDifference(None, None, None, pictures)
    shared = overlap_db(quality[0], other_quality[0])
    return RateDifference(percent, _interval(ours, theirs, common, weights), shared, pictures)


def _counting(curve: Curve) -> list[Point]:
    return [point for point in curve if point.hits.mean() >= LEAST_SHARE]


def _means(points: Curve, common: npt.NDArray[np.bool_], weights: Values) -> tuple[Values, Values]:
    """Return mean bytes and mean PSNR in each sample, both shape (R, points)."""
    chosen = weights[:, common]
    total = chosen.sum(axis=1, keepdims=True)
    rates = np.stack([point.stream_bytes[common] for point in points], axis=1)
    quality = np.stack([point.psnr[common] for point in points], axis=1)
    return chosen @ rates / total, chosen @ quality / total


def _interval(
    ours: Curve, theirs: Curve, common: npt.NDArray[np.bool_], weights: Values | None
) -> tuple[float, float] | None:
    if weights is None:
        return None
    some = weights[:BD_RESAMPLES]
    some = some[some[:, common].sum(axis=1) > 0]
    (rates, quality), (other_rates, other_quality) = _means(ours, common, some), _means(theirs, common, some)
    draws = [bd_rate_percent(rates[i], quality[i], other_rates[i], other_quality[i]) for i in range(some.shape[0])]
    return interval(np.array([np.nan if draw is None else draw for draw in draws]))
