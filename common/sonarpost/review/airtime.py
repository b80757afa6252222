"""Expected gain of certainty of an image per second of air time.

The verdict on a contact has two outcomes, mine-like with probability p from the detector. What is seen in an image of b
bytes is modelled as one normal observation with unit variance, whose means under the two outcomes differ by d'(b). The
expected entropy of the verdict after it is

    H(p, d') = E[h(s(logit p + log-likelihood ratio))], h the binary entropy in bits, s the logistic function,

and the gain of the bytes that are left is H(p, d'(received)) - H(p, d'(received + left)). d'(b) = sqrt(2) *
Phi^-1(AUC(b)) is that of the binormal model. AUC(b) is the recognition of targets in images of 80 x 80 px decoded from
b bytes, codec emb, default grain: docs/research/codecs.md, "Recognition" (`python -m research.recognition`). The
measured differences above 64 bytes are within the intervals, so the gain of a second there is small.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Final

import numpy as np

RECOGNITION: Final = ((0.0, 0.5), (22.0, 0.914), (64.0, 0.940), (128.0, 0.942), (256.0, 0.9425), (1024.0, 0.945))
"""(bytes, area under the ROC curve); the last value is that of the originals."""
_D_PRIME: Final = tuple(math.sqrt(2.0) * NormalDist().inv_cdf(auc) for _, auc in RECOGNITION)
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(41)
_LEAST_P: Final = 0.01
UNKNOWN_P: Final = 0.5
"""Probability of a contact without a detector's value."""


@dataclass(frozen=True, slots=True)
class WaitingImage:
    """An image of which something is still to be sent.

    Attributes:
        key: Name for the caller.
        bytes_received: Bytes of the stream that have arrived.
        bytes_left: Bytes that are still to be sent.
        cost_s: Air time of these in seconds.
        p_mine_like: Probability that the contact is mine-like, 0..1; None if unknown.
        is_decided: Whether there is a final verdict. Its image has no gain.
    """

    key: str
    bytes_received: int
    bytes_left: int
    cost_s: float
    p_mine_like: float | None
    is_decided: bool = False


def d_prime(bytes_received: float) -> float:
    """Return the distance of the means for an image of this many bytes, in standard deviations."""
    positions = np.log1p([each for each, _ in RECOGNITION])
    return float(np.interp(math.log1p(max(0.0, bytes_received)), positions, _D_PRIME))


def expected_entropy_bits(p: float, distance: float) -> float:
    """Return the expected entropy of the verdict in bits after an observation.

    Args:
        p: Probability of mine-like before it, 0..1; limited to 0.01..0.99.
        distance: Distance of the means of the observation, see `d_prime`.
    """
    p = min(1.0 - _LEAST_P, max(_LEAST_P, p))
    log_odds = math.log(p / (1.0 - p))
    total = 0.0
    for probability, mean in ((p, distance / 2.0), (1.0 - p, -distance / 2.0)):
        after = 1.0 / (1.0 + np.exp(-(log_odds + distance * (mean + _NODES))))
        after = np.clip(after, 1e-12, 1.0 - 1e-12)
        entropy = -after * np.log2(after) - (1.0 - after) * np.log2(1.0 - after)
        total += probability * float((_WEIGHTS * entropy).sum() / _WEIGHTS.sum())
    return total


def gain_bits(image: WaitingImage) -> float:
    """Return the expected reduction of the entropy of the verdict in bits by the rest of an image."""
    if image.is_decided:
        return 0.0
    p = UNKNOWN_P if image.p_mine_like is None else image.p_mine_like
    before = expected_entropy_bits(p, d_prime(image.bytes_received))
    return max(0.0, before - expected_entropy_bits(p, d_prime(image.bytes_received + image.bytes_left)))


def gain_per_s(image: WaitingImage) -> float:
    """Return the gain in bits per second of air time; 0 without a cost."""
    return gain_bits(image) / image.cost_s if image.cost_s > 0 else 0.0


def proposal(images: Sequence[WaitingImage], horizon_s: float) -> list[str]:
    """Return the keys of the images to send in the next seconds, the greatest gain per second first.

    The last image may need more time than is left. Images without a gain are left out.
    """
    ordered = sorted(images, key=gain_per_s, reverse=True)
    chosen: list[str] = []
    used_s = 0.0
    for image in ordered:
        if used_s >= horizon_s or gain_per_s(image) <= 0:
            break
        chosen.append(image.key)
        used_s += image.cost_s
    return chosen
