"""Evaluation of the detector on simulated surveys that were not used for training."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.detection.detector import STRUCTURE, Detection, detect
from sonarpost.detection.settings import DetectorSettings
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, TruthObject, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.survey import Side, Survey

Floats = npt.NDArray[np.float64]

FIRST_SEED: Final = 5000
"""Training uses seeds from 20,000 on (research/training/detection)."""
MAX_FILES: Final = 1000
NEAR_M: Final = 1.5
"""A contact within this distance of the centre of an object, along and across, is that object; for objects that are
not mine-like, half the length of the object is added."""
_ALL_CONTACTS: Final = DetectorSettings(confidence_threshold=0.01)


@dataclass(frozen=True, slots=True)
class Scale:
    """Distance between two pings along-track, and between two samples across-track."""

    row_m: float
    sample_m: float


def object_at(truth: Sequence[TruthObject], side: Side, row: int, sample: float, scale: Scale) -> int | None:
    """Return the index of the nearest object at a ping and sample; None if there is none."""
    nearest, nearest_m = None, float("inf")
    for index, target in enumerate(truth):
        if target.side is not side:
            continue
        limit_m = NEAR_M + (0.0 if target.is_mine_like else target.length_m / 2)
        along_m = abs(row - target.ping) * scale.row_m
        across_m = abs(sample - target.sample_index) * scale.sample_m
        if along_m < limit_m and across_m < limit_m and max(along_m, across_m) < nearest_m:
            nearest, nearest_m = index, max(along_m, across_m)
    return nearest


@dataclass(frozen=True, slots=True)
class EvaluatedContact:
    """A contact and its object.

    Attributes:
        confidence: Confidence of the contact.
        target: The object; None for a false alarm.
        is_first: Whether it is the most confident contact of its object (True for a false alarm).
        is_structure: Whether it is of class "structure", whose confidence is not a probability.
    """

    confidence: float
    target: TruthObject | None
    is_first: bool
    is_structure: bool = False


@dataclass(frozen=True)
class EvaluatedFile:
    """A simulated file with its detections.

    Attributes:
        seabed: Kind of seabed.
        survey: The file.
        detections: Every contact with a confidence of at least 0.01, most confident first.
        contacts: The same contacts, evaluated.
        truth: The objects.
        seconds: Processor time of the detection.
    """

    seabed: SeabedKind
    survey: Survey
    detections: tuple[Detection, ...]
    contacts: tuple[EvaluatedContact, ...]
    truth: tuple[TruthObject, ...]
    seconds: float


def evaluate_file(seabed: SeabedKind, seed: int, settings: DetectorSettings = _ALL_CONTACTS) -> EvaluatedFile:
    """Simulate a file of 1000 pings with four mine-like and six other objects, detect, and evaluate each contact.

    Args:
        seabed: Kind of seabed.
        seed: Seed of the survey.
        settings: Settings of the detector; contacts with a confidence of at least 0.01 are evaluated.
    """
    settings = settings.model_copy(update={"confidence_threshold": _ALL_CONTACTS.confidence_threshold})
    simulated = simulate_survey(SurveySpec(seed=seed, seabed=seabed, targets=4, clutter=6))
    survey = simulated.survey
    started_s = time.process_time()
    detections = detect(survey, settings)
    seconds = time.process_time() - started_s
    assigned: set[int] = set()
    contacts = []
    for d in detections:
        scale = Scale(d.pixel_along_m or _ALL_CONTACTS.assumed_row_along_m, d.pixel_across_m)
        index = object_at(simulated.truth, d.side, d.ping_index, d.sample, scale)
        target = None if index is None else simulated.truth[index]
        contacts.append(EvaluatedContact(d.confidence, target, index not in assigned, d.atd_class == STRUCTURE))
        if index is not None:
            assigned.add(index)
    return EvaluatedFile(seabed, survey, detections, tuple(contacts), simulated.truth, seconds)


@dataclass(frozen=True, slots=True)
class OperatingPoint:
    """Performance at one confidence threshold.

    A false alarm is a contact without an object. Other objects of the simulator (boulders, debris) are counted
    separately, because an operator should see them.

    Attributes:
        pd: Probability of detection of mine-like objects.
        false_alarms_per_file: Contacts without an object.
        others_per_file: Detected objects that are not mine-like.
    """

    pd: float
    false_alarms_per_file: float
    others_per_file: float


def operating_point(files: Sequence[EvaluatedFile], confidence: float) -> OperatingPoint:
    """Return the performance at a confidence threshold, over files of any seabed."""
    mines = sum(t.is_mine_like for f in files for t in f.truth)
    hits = alarms = others = 0
    for contact in (c for f in files for c in f.contacts if c.confidence >= confidence):
        if contact.target is None:
            alarms += 1
        elif contact.is_first:
            hits += contact.target.is_mine_like
            others += not contact.target.is_mine_like
    return OperatingPoint(hits / mines if mines else 0.0, alarms / len(files), others / len(files))


def roc(files: Sequence[EvaluatedFile], kind: str | None = None) -> tuple[Floats, Floats]:
    """Return false alarms a file (rising) and probability of detection, shape (contacts + 1,) each.

    Args:
        files: The files.
        kind: A mine-like shape, or None for all of them.
    """
    objects = sum(t.is_mine_like and (kind is None or t.kind == kind) for f in files for t in f.truth)
    contacts = sorted((c for f in files for c in f.contacts), key=lambda c: -c.confidence)
    hit = [
        c.is_first and c.target is not None and c.target.is_mine_like and (kind is None or c.target.kind == kind)
        for c in contacts
    ]
    alarms = np.cumsum([0.0, *(float(c.target is None) for c in contacts)]) / max(len(files), 1)
    return alarms, np.cumsum([0.0, *map(float, hit)]) / max(objects, 1)


def pd_at(curve: tuple[Floats, Floats], false_alarms_per_file: float) -> float:
    """Return the maximum probability of detection up to a number of false alarms a file."""
    alarms, pd = curve
    return float(pd[alarms <= false_alarms_per_file + 1e-9].max())


@dataclass(frozen=True, slots=True)
class ReliabilityBin:
    """Contacts within a range of confidence.

    Attributes:
        contacts: Their number.
        claimed: Their mean confidence / 2.
        true_share: Share of them that are mine-like objects.
    """

    contacts: int
    claimed: float
    true_share: float


def reliability(files: Sequence[EvaluatedFile], bins: int = 10) -> tuple[ReliabilityBin, ...]:
    """Return claimed and true share of mine-like objects by confidence, without structures and empty bins."""
    contacts = [c for f in files for c in f.contacts if c.is_first and not c.is_structure]
    return reliability_bins(
        [(c.confidence / 2, c.target is not None and c.target.is_mine_like) for c in contacts], bins
    )


def reliability_bins(pairs: Sequence[tuple[float, bool]], bins: int) -> tuple[ReliabilityBin, ...]:
    """Return claimed and true share of pairs of a claimed probability and the truth, without empty bins."""
    found = []
    for number in range(bins):
        inside = [p for p in pairs if number <= min(p[0] * bins, bins - 1e-9) < number + 1]
        if inside:
            claimed = float(np.mean([p[0] for p in inside]))
            found.append(ReliabilityBin(len(inside), claimed, float(np.mean([p[1] for p in inside]))))
    return tuple(found)


def mine_like_share(files: Sequence[EvaluatedFile], contacts_per_file: int) -> float:
    """Return the share of mine-like objects among the most confident contacts of all files.

    Args:
        files: The files.
        contacts_per_file: Number of contacts, on average over the files.
    """
    contacts = sorted((c for f in files for c in f.contacts), key=lambda c: -c.confidence)
    chosen = contacts[: contacts_per_file * len(files)]
    mines = sum(c.is_first and c.target is not None and c.target.is_mine_like for c in chosen)
    return mines / (contacts_per_file * len(files))


def share_interval(hits: float, count: int) -> tuple[float, float]:
    """Return the 95 % Wilson score interval of a share of `hits` in `count` (Wilson, JASA 22, 1927)."""
    if count == 0:
        return 0.0, 1.0
    z, share = 1.96, hits / count
    centre = (share + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * (share * (1 - share) / count + z * z / (4 * count * count)) ** 0.5
    return max(0.0, centre - half), min(1.0, centre + half)
