"""Statistics: bootstrap intervals, the Bjøntegaard rate difference, the area under a ROC curve."""

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.interpolate import PchipInterpolator

Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Interval = tuple[float, float]

RESAMPLES: Final = 1000


def bootstrap_weights(sources: Sequence[str], resamples: int = RESAMPLES, seed: int = 0) -> Values:
    """Draw bootstrap samples of images as weights, the same for all codecs (paired bootstrap).

    Sources are drawn with replacement, together with all their images, because the crops of one tile are correlated
    (cluster bootstrap; Davison and Hinkley, "Bootstrap Methods and their Application", 1997, section 3.8).

    Args:
        sources: Source of each of the n images.
        resamples: Number of samples, R.
        seed: The same values give the same samples.

    Returns:
        Shape (R, n), number of times each image is in each sample.
    """
    names = sorted(set(sources))
    rng = np.random.default_rng(seed)
    counts = rng.multinomial(len(names), np.full(len(names), 1 / len(names)), size=resamples)
    column = {name: number for number, name in enumerate(names)}
    return np.asarray(counts[:, [column[source] for source in sources]], dtype=np.float64)


def finite_mean(values: Values) -> float:
    """Return the mean of the finite values; NaN if there is none."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else float("nan")


def weighted_means(values: Values, weights: Values) -> Values:
    """Return the mean over the finite values in each bootstrap sample, shape (R,); NaN for a sample without any.

    Args:
        values: Shape (n,), NaN if unknown.
        weights: Shape (R, n), from `bootstrap_weights`.
    """
    known = np.isfinite(values)
    total = weights[:, known].sum(axis=1)
    sums = weights[:, known] @ values[known]
    return np.asarray(np.divide(sums, total, out=np.full(total.shape, np.nan), where=total > 0))


def interval(draws: Values) -> Interval | None:
    """Return the 2.5th and 97.5th percentile of the finite draws; None if fewer than 5 % or 20 are finite."""
    known = draws[np.isfinite(draws)]
    if known.size < max(20, draws.size // 20):
        return None
    low, high = np.percentile(known, (2.5, 97.5))
    return float(low), float(high)


def bd_rate_percent(rates: Values, quality: Values, other_rates: Values, other_quality: Values) -> float | None:
    """Return the additional rate of the first codec over the other for the same quality, in percent.

    G. Bjøntegaard, "Calculation of average PSNR differences between RD-curves", ITU-T VCEG-M33, 2001, with log10(rate)
    as a function of PSNR, with monotone piecewise cubic interpolation (PCHIP; Fritsch and Carlson 1980) in place of a
    single cubic, as in VCEG-AI11 and later practice: a cubic through few points overshoots. The difference of the
    logarithms is averaged over the common PSNR range; -50 means half the rate.

    Only the efficient points of each curve are used: in order of rate, those with a higher quality than every point of
    lower rate.

    Args:
        rates: Shape (n,), positive (bytes).
        quality: Shape (n,), dB.
        other_rates: Shape (m,).
        other_quality: Shape (m,).

    Returns:
        The difference, or None if a curve has fewer than two points or the ranges do not overlap.
    """
    first, second = _efficient(rates, quality), _efficient(other_rates, other_quality)
    if len(first[0]) < 2 or len(second[0]) < 2:
        return None
    low, high = max(first[1][0], second[1][0]), min(first[1][-1], second[1][-1])
    if not high > low:
        return None
    means = [
        float(PchipInterpolator(dB, np.log10(rate)).integrate(low, high)) / (high - low) for rate, dB in (first, second)
    ]
    return float((10.0 ** (means[0] - means[1]) - 1.0) * 100.0)


def overlap_db(quality: Values, other_quality: Values) -> Interval | None:
    """Return the common PSNR range of two curves, or None."""
    low, high = max(quality.min(), other_quality.min()), min(quality.max(), other_quality.max())
    return (float(low), float(high)) if high > low else None


def _efficient(rates: Values, quality: Values) -> tuple[Values, Values]:
    known = np.isfinite(rates) & np.isfinite(quality)
    rates, quality = rates[known], quality[known]
    order = np.lexsort((-quality, rates))
    rates, quality = rates[order], quality[order]
    best_below = np.concatenate(([-np.inf], np.maximum.accumulate(quality)[:-1]))
    efficient = quality > best_below
    return rates[efficient], quality[efficient]


def auc(scores: Values, is_target: Flags, weights: Values | None = None) -> Values:
    """Return the area under the ROC curve: the probability that a target scores above a non-target (ties count half).

    Args:
        scores: Shape (n,).
        is_target: Shape (n,); at least one True and one False.
        weights: Shape (R, n) of bootstrap weights; None to count every image once.

    Returns:
        Shape (R,), or (1,) without weights; NaN for samples without targets or without non-targets.
    """
    if weights is None:
        weights = np.ones((1, scores.shape[0]))
    targets, others = scores[is_target], scores[~is_target]
    above = (targets[:, None] > others).astype(np.float64) + 0.5 * (targets[:, None] == others)
    of_targets, of_others = weights[:, is_target], weights[:, ~is_target]
    won = np.einsum("rt,to,ro->r", of_targets, above, of_others, optimize=True)
    pairs = of_targets.sum(axis=1) * of_others.sum(axis=1)
    return np.asarray(np.divide(won, pairs, out=np.full(pairs.shape, np.nan), where=pairs > 0))
