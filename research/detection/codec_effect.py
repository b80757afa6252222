"""The paper's measure of a codec: the detector's confidence in a contact before and after, at each budget.

A contact's picture is cut from its survey as the vehicle cuts it, coded and decoded, put back where it was cut from,
and the detector looks at the survey again: the confidence is that of the same place among the same seabed, and only
what the codec did differs. Before: the picture put back as it was cut, which already has lost what grey levels lose.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from research.common.measurement import Subject, code
from research.detection.simulated import JudgedFile
from sonarpost.codec.interface import Image
from sonarpost.detection.detector import Detection, detect
from sonarpost.detection.settings import DetectorSettings
from sonarpost.detection.snippets import HIGH_PERCENTILE, LOW_PERCENTILE, SurveySnippet, cut_snippet
from sonarpost.sonar.survey import ChannelPing, Survey

HEIGHT_PX: Final = 80
WIDTH_PX: Final = 140
_AROUND_PINGS: Final = 200
_LEAST_CONFIDENCE: Final = 1.0
_EVERYTHING: Final = DetectorSettings(confidence_threshold=0.01)
_NEAR_M: Final = 1.5


@dataclass(frozen=True)
class Shot:
    """A contact's picture and the survey around it.

    Attributes:
        survey: The pings around the contact.
        found: The contact, in its indices.
        cut: The picture.
        confidence: Of the contact, with its picture put back.
    """

    survey: Survey
    found: Detection
    cut: SurveySnippet
    confidence: float


@dataclass(frozen=True, slots=True)
class CodecEffect:
    """What a codec leaves of the confidence.

    Attributes:
        label: Codec and variant.
        budget_bytes: Most bytes of a stream; None for a codec of natural size.
        pictures: How many were coded.
        misses: How many were not.
        before: Mean confidence of the originals of those coded, 0 to 2.
        after: Mean confidence of the same pictures decoded; NaN where there is none.
        kept: Share of the originals of at least 1.0 that still reach 1.0; NaN where there is none.
    """

    label: str
    budget_bytes: int | None
    pictures: int
    misses: int
    before: float
    after: float
    kept: float


def shots(files: Sequence[JudgedFile], most: int) -> list[Shot]:
    """Cut the pictures of mine-like objects that were found, evenly over the files, at most `most`."""
    chosen = [
        (file.survey, found)
        for file in files
        for found, judged in zip(file.found, file.contacts, strict=True)
        if judged.thing is not None
        and judged.thing.is_mine_like
        and judged.is_first
        and found.confidence >= _LEAST_CONFIDENCE
    ]
    step = max(len(chosen) / most, 1.0)
    return [shot(*chosen[int(i * step)]) for i in range(min(most, len(chosen)))]


def shot(survey: Survey, found: Detection) -> Shot:
    """Cut a contact's picture and the pings around it."""
    first = max(0, found.ping_index - _AROUND_PINGS)
    around = replace(survey, pings=survey.pings[first : found.ping_index + _AROUND_PINGS])
    there = replace(found, ping_index=found.ping_index - first)
    cut = cut_snippet(around, there, HEIGHT_PX, WIDTH_PX)
    return Shot(around, there, cut, confidence_with(around, there, cut, cut.image))


def effects(pictures: Sequence[Shot], subject: Subject, budgets: Sequence[int]) -> list[CodecEffect]:
    """Code every picture at every budget (once, for a codec of natural size) and judge it again."""
    coded = [code(subject, one.cut.image, budgets) for one in pictures]
    found = []
    for place in range(len(coded[0]) if coded else 0):
        before, after = [], []
        for one, results in zip(pictures, coded, strict=True):
            result = results[place]
            if not isinstance(result, str):
                before.append(one.confidence)
                after.append(confidence_with(one.survey, one.found, one.cut, result.rebuilt))
        still = [a >= _LEAST_CONFIDENCE for a, b in zip(after, before, strict=True) if b >= _LEAST_CONFIDENCE]
        found.append(
            CodecEffect(
                label=subject.label,
                budget_bytes=None if subject.is_natural else budgets[place],
                pictures=len(after),
                misses=len(pictures) - len(after),
                before=float(np.mean(before)) if before else math.nan,
                after=float(np.mean(after)) if after else math.nan,
                kept=float(np.mean(still)) if still else math.nan,
            )
        )
    return found


def confidence_with(survey: Survey, found: Detection, cut: SurveySnippet, picture: Image) -> float:
    """Return the greatest confidence at a contact's place with `picture` in its snippet's place; 0 without contact.

    Args:
        survey: The survey the snippet was cut from.
        found: The contact.
        cut: The snippet, for where it lies and how its greys were made.
        picture: Of the snippet's shape, uint8.
    """
    samples = _unmapped(picture, cut)
    pings = list(survey.pings)
    for row, line in enumerate(samples):
        ping = pings[cut.first_ping_index + row]
        shown = ping.channel(found.side)
        channels = tuple(_with(c, cut.first_sample, line) if c is shown else c for c in ping.channels)
        pings[cut.first_ping_index + row] = replace(ping, channels=channels)
    along_m = found.pixel_along_m or _EVERYTHING.assumed_row_along_m
    return max(
        (
            d.confidence
            for d in detect(replace(survey, pings=tuple(pings)), _EVERYTHING)
            if d.side is found.side
            and abs(d.ping_index - found.ping_index) * along_m < _NEAR_M
            and abs(d.sample - found.sample) * found.pixel_across_m < _NEAR_M
        ),
        default=0.0,
    )


def _unmapped(picture: Image, cut: SurveySnippet) -> npt.NDArray[np.float64]:
    """Return the sample values that a picture's greys stand for, by the snippet's own mapping, backwards."""
    root = np.sqrt(cut.image16.astype(np.float64) * cut.divisor16)
    low, high = np.percentile(root, (LOW_PERCENTILE, HIGH_PERCENTILE))
    return np.asarray((low + picture.astype(np.float64) / 255.0 * (high - low)) ** 2)


def _with(channel: ChannelPing, first: int, line: npt.NDArray[np.float64]) -> ChannelPing:
    samples = channel.samples.copy()
    room = len(samples) - first
    limit = np.iinfo(samples.dtype).max
    samples[first : first + len(line)] = np.clip(np.rint(line[:room]), 0, limit).astype(samples.dtype)
    return replace(channel, samples=samples)
