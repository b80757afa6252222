"""Score of operators on contacts whose object is known: probability of detection and false alarms."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from sonarpost.messages import Verdict

BYTE_LIMITS: Final = (32, 64, 128, 256, 512)
"""Upper limits of the groups of decisions by received bytes; the last group has no limit."""

_Z_95: Final = 1.959963984540054
"""Quantile of the standard normal distribution for an interval of 95 %."""


@dataclass(frozen=True, slots=True)
class ScoredDecision:
    """The decision of an operator on a contact whose object is known.

    Attributes:
        operator: Name of the operator.
        verdict: The operator's verdict.
        is_mine_like: Whether the object is mine-like.
        bytes_received: Received bytes of the image version that was displayed.
        shown_s: Time for which the image was displayed before the verdict; None if unknown.
    """

    operator: str
    verdict: Verdict
    is_mine_like: bool
    bytes_received: int
    shown_s: float | None


@dataclass(frozen=True, slots=True)
class Share:
    """A share with its interval of confidence.

    Attributes:
        count: Number of cases with the property.
        total: Number of cases.
        share: count / total; None without a case.
        low: Lower limit of the 95 % interval of Wilson; None without a case.
        high: Upper limit.
    """

    count: int
    total: int
    share: float | None
    low: float | None
    high: float | None


@dataclass(frozen=True, slots=True)
class Score:
    """Result of a set of decisions.

    Attributes:
        decided: Number of decisions.
        detected: Mine-like objects with the verdict mine-like; the share is the probability of detection.
        false_alarms: Other objects with the verdict mine-like.
        unsure: Decisions with the verdict unsure.
        median_shown_s: Median time from the display of the image to the verdict; None if unknown.
        median_bytes: Median received bytes of the displayed images; None without a decision.
    """

    decided: int
    detected: Share
    false_alarms: Share
    unsure: int
    median_shown_s: float | None
    median_bytes: float | None


def score(decisions: Sequence[ScoredDecision]) -> Score:
    """Return the score of a set of decisions."""
    shown_s = [one.shown_s for one in decisions if one.shown_s is not None]
    return Score(
        decided=len(decisions),
        detected=_mine_like_verdicts(one for one in decisions if one.is_mine_like),
        false_alarms=_mine_like_verdicts(one for one in decisions if not one.is_mine_like),
        unsure=sum(one.verdict == "unsure" for one in decisions),
        median_shown_s=statistics.median(shown_s) if shown_s else None,
        median_bytes=statistics.median(one.bytes_received for one in decisions) if decisions else None,
    )


def score_by_bytes(decisions: Sequence[ScoredDecision]) -> list[tuple[int, int | None, Score]]:
    """Return lower limit (exclusive), upper limit (inclusive, None: no limit) and score of the groups with decisions.

    The groups are those of `BYTE_LIMITS`.
    """
    found: list[tuple[int, int | None, Score]] = []
    for low, high in pairwise((0, *BYTE_LIMITS, None)):
        group = [
            one for one in decisions if one.bytes_received > (low or 0) and (high is None or one.bytes_received <= high)
        ]
        if group:
            found.append((low or 0, high, score(group)))
    return found


def _mine_like_verdicts(decisions: Iterable[ScoredDecision]) -> Share:
    verdicts = [one.verdict for one in decisions]
    return wilson_share(verdicts.count("mine_like"), len(verdicts))


def wilson_share(count: int, total: int) -> Share:
    """Return a share with the score interval of Wilson (1927), 95 %.

    Args:
        count: Number of cases with the property, 0 to `total`.
        total: Number of cases.
    """
    if total == 0:
        return Share(count, total, None, None, None)
    share, z2 = count / total, _Z_95**2
    centre = (share + z2 / (2 * total)) / (1 + z2 / total)
    half = _Z_95 / (1 + z2 / total) * math.sqrt(share * (1 - share) / total + z2 / (4 * total**2))
    return Share(count, total, share, max(0.0, centre - half), min(1.0, centre + half))
