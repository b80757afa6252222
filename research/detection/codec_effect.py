"""Effect of a codec on the detector: confidence of a contact before and after coding, at each budget (paper's measure).

The snippet of a contact is cut from its survey, coded, decoded and put back, and the detector processes the survey
again. Place and seabed are the same, so only the coding differs. The confidence before coding is that with the snippet
put back uncoded, which includes the loss of the mapping to grey levels.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from research.common.measurement import CodecUnderTest, code_image
from research.detection.simulated import EvaluatedFile
from sonarpost.codec.interface import Image
from sonarpost.detection.detector import Detection, detect
from sonarpost.detection.settings import DetectorSettings
from sonarpost.detection.snippets import HIGH_PERCENTILE, LOW_PERCENTILE, SurveySnippet, cut_snippet
from sonarpost.sonar.survey import ChannelPing, Survey

HEIGHT_PX: Final = 80
WIDTH_PX: Final = 140
_PINGS_AROUND: Final = 200
_MIN_CONFIDENCE: Final = 1.0
_ALL_CONTACTS: Final = DetectorSettings(confidence_threshold=0.01)
_NEAR_M: Final = 1.5


@dataclass(frozen=True)
class ContactSnippet:
    """The snippet of a contact with the survey around it.

    Attributes:
        survey: The pings around the contact.
        detection: The contact, with indices of `survey`.
        snippet: The snippet.
        confidence: Confidence of the contact with the uncoded snippet put back.
    """

    survey: Survey
    detection: Detection
    snippet: SurveySnippet
    confidence: float


@dataclass(frozen=True, slots=True)
class CodecEffect:
    """Confidence after a codec.

    Attributes:
        label: Codec and variant.
        budget_bytes: Maximum bytes of a stream; None for a codec of natural size.
        coded: Number of coded snippets.
        misses: Number of others.
        before: Mean confidence of the coded snippets before coding, 0 to 2.
        after: Mean confidence after decoding; NaN without coded snippets.
        kept: Share of the confidences of at least 1.0 that remain at least 1.0; NaN without any.
    """

    label: str
    budget_bytes: int | None
    coded: int
    misses: int
    before: float
    after: float
    kept: float


def contact_snippets(files: Sequence[EvaluatedFile], limit: int) -> list[ContactSnippet]:
    """Cut the snippets of detected mine-like objects, evenly distributed over the files, at most `limit`."""
    found = [
        (file.survey, detection)
        for file in files
        for detection, contact in zip(file.detections, file.contacts, strict=True)
        if contact.target is not None
        and contact.target.is_mine_like
        and contact.is_first
        and detection.confidence >= _MIN_CONFIDENCE
    ]
    step = max(len(found) / limit, 1.0)
    return [contact_snippet(*found[int(i * step)]) for i in range(min(limit, len(found)))]


def contact_snippet(survey: Survey, detection: Detection) -> ContactSnippet:
    """Cut the snippet of a contact and the pings around it."""
    first = max(0, detection.ping_index - _PINGS_AROUND)
    around = replace(survey, pings=survey.pings[first : detection.ping_index + _PINGS_AROUND])
    shifted = replace(detection, ping_index=detection.ping_index - first)
    snippet = cut_snippet(around, shifted, HEIGHT_PX, WIDTH_PX)
    return ContactSnippet(around, shifted, snippet, confidence_with(around, shifted, snippet, snippet.image))


def codec_effects(
    snippets: Sequence[ContactSnippet], tested: CodecUnderTest, budgets: Sequence[int]
) -> list[CodecEffect]:
    """Code every snippet at every budget (once for a codec of natural size) and detect again."""
    coded = [code_image(tested, one.snippet.image, budgets) for one in snippets]
    effects = []
    for column in range(len(coded[0]) if coded else 0):
        before, after = [], []
        for one, results in zip(snippets, coded, strict=True):
            result = results[column]
            if not isinstance(result, str):
                before.append(one.confidence)
                after.append(confidence_with(one.survey, one.detection, one.snippet, result.decoded))
        kept = [a >= _MIN_CONFIDENCE for a, b in zip(after, before, strict=True) if b >= _MIN_CONFIDENCE]
        effects.append(
            CodecEffect(
                label=tested.label,
                budget_bytes=None if tested.is_natural else budgets[column],
                coded=len(after),
                misses=len(snippets) - len(after),
                before=float(np.mean(before)) if before else math.nan,
                after=float(np.mean(after)) if after else math.nan,
                kept=float(np.mean(kept)) if kept else math.nan,
            )
        )
    return effects


def confidence_with(survey: Survey, detection: Detection, snippet: SurveySnippet, image: Image) -> float:
    """Return the maximum confidence at a contact's place with `image` in place of its snippet; 0 without contact.

    Args:
        survey: The survey from which the snippet was cut.
        detection: The contact.
        snippet: The snippet: its place and its mapping to grey.
        image: Shape of the snippet, uint8.
    """
    samples = _sample_values(image, snippet)
    pings = list(survey.pings)
    for row, line in enumerate(samples):
        ping = pings[snippet.first_ping_index + row]
        used = ping.channel(detection.side)
        channels = tuple(_with_samples(c, snippet.first_sample, line) if c is used else c for c in ping.channels)
        pings[snippet.first_ping_index + row] = replace(ping, channels=channels)
    along_m = detection.pixel_along_m or _ALL_CONTACTS.assumed_row_along_m
    return max(
        (
            d.confidence
            for d in detect(replace(survey, pings=tuple(pings)), _ALL_CONTACTS)
            if d.side is detection.side
            and abs(d.ping_index - detection.ping_index) * along_m < _NEAR_M
            and abs(d.sample - detection.sample) * detection.pixel_across_m < _NEAR_M
        ),
        default=0.0,
    )


def _sample_values(image: Image, snippet: SurveySnippet) -> npt.NDArray[np.float64]:
    """Return the sample values of an image: the inverse of the snippet's mapping to grey."""
    root = np.sqrt(snippet.image16.astype(np.float64) * snippet.divisor16)
    low, high = np.percentile(root, (LOW_PERCENTILE, HIGH_PERCENTILE))
    return np.asarray((low + image.astype(np.float64) / 255.0 * (high - low)) ** 2)


def _with_samples(channel: ChannelPing, first: int, line: npt.NDArray[np.float64]) -> ChannelPing:
    samples = channel.samples.copy()
    limit = np.iinfo(samples.dtype.name).max
    inside = line[: len(samples) - first]
    samples[first : first + len(line)] = np.clip(np.rint(inside), 0, limit).astype(samples.dtype)
    return replace(channel, samples=samples)
