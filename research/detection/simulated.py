"""The detector on simulated surveys that nothing was fitted to: what it finds, what it takes for an object."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from research.detection.truth import Scale, object_at
from sonarpost.detection.detector import Detection, detect
from sonarpost.detection.settings import DetectorSettings
from sonarpost.simulation.seabed.survey import SurveySpec, TruthObject, simulate_survey
from sonarpost.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.survey import Survey

Floats = npt.NDArray[np.float64]

FIRST_SEED: Final = 5000
"""Training uses 1000 to 1007 (research/training/detection.py)."""
MOST_FILES: Final = 1000
_EVERYTHING: Final = DetectorSettings(confidence_threshold=0.01)


@dataclass(frozen=True, slots=True)
class JudgedContact:
    """A contact and the object it is; None when there is none."""

    confidence: float
    thing: TruthObject | None
    is_first: bool
    """Whether it is the most confident contact of its object (true where there is no object)."""


@dataclass(frozen=True)
class JudgedFile:
    """One simulated file after detection.

    Attributes:
        seabed: What lies on the bottom.
        survey: The file.
        found: Every contact down to a confidence of 0.01, most confident first.
        contacts: The same, judged.
        truth: The objects.
        seconds: Processor time that detection took.
    """

    seabed: SeabedKind
    survey: Survey
    found: tuple[Detection, ...]
    contacts: tuple[JudgedContact, ...]
    truth: tuple[TruthObject, ...]
    seconds: float


def judged_file(seabed: SeabedKind, seed: int) -> JudgedFile:
    """Simulate a file of 1000 pings with four mine-like and six other objects, detect, and judge each contact."""
    simulated = simulate_survey(SurveySpec(seed=seed, seabed=seabed, targets=4, clutter=6))
    survey = simulated.survey
    began = time.process_time()
    found = detect(survey, _EVERYTHING)
    seconds = time.process_time() - began
    met: set[int] = set()
    contacts = []
    for one in found:
        scale = Scale(one.pixel_along_m or _EVERYTHING.assumed_row_along_m, one.pixel_across_m)
        index = object_at(simulated.truth, one.side, one.ping_index, one.sample, scale)
        contacts.append(
            JudgedContact(one.confidence, None if index is None else simulated.truth[index], index not in met)
        )
        if index is not None:
            met.add(index)
    return JudgedFile(seabed, survey, found, tuple(contacts), simulated.truth, seconds)


@dataclass(frozen=True, slots=True)
class Operating:
    """Probability of detection of mine-like objects, false alarms and other objects a file, at one confidence.

    A false alarm is a contact where no object was put; the simulator's other objects are counted apart, because an
    operator is to see them.
    """

    pd: float
    false_alarms_per_file: float
    others_per_file: float


def operating(files: Sequence[JudgedFile], confidence: float) -> Operating:
    """Return how the detector does at a threshold, over files of any seabed."""
    mines = sum(t.is_mine_like for f in files for t in f.truth)
    hits = alarms = others = 0
    for contact in (c for f in files for c in f.contacts if c.confidence >= confidence):
        if contact.thing is None:
            alarms += 1
        elif contact.is_first:
            hits += contact.thing.is_mine_like
            others += not contact.thing.is_mine_like
    return Operating(hits / mines if mines else 0.0, alarms / len(files), others / len(files))


def roc(files: Sequence[JudgedFile], kind: str | None = None) -> tuple[Floats, Floats]:
    """Return false alarms a file (rising) and probability of detection, shape (contacts + 1,) each.

    Args:
        files: The files.
        kind: A mine-like shape, or None for all of them.
    """
    wanted = sum(t.is_mine_like and (kind is None or t.kind == kind) for f in files for t in f.truth)
    contacts = sorted((c for f in files for c in f.contacts), key=lambda c: -c.confidence)
    hit = [
        c.is_first and c.thing is not None and c.thing.is_mine_like and (kind is None or c.thing.kind == kind)
        for c in contacts
    ]
    alarms = np.cumsum([0.0, *(float(c.thing is None) for c in contacts)]) / max(len(files), 1)
    return alarms, np.cumsum([0.0, *map(float, hit)]) / max(wanted, 1)


def pd_at(curve: tuple[Floats, Floats], false_alarms_per_file: float) -> float:
    """Return the greatest probability of detection with at most that many false alarms a file."""
    alarms, pd = curve
    return float(pd[alarms <= false_alarms_per_file + 1e-9].max())


@dataclass(frozen=True, slots=True)
class ReliabilityBin:
    """Contacts of one range of confidence: how many, their mean confidence / 2, and the share that are objects."""

    contacts: int
    claimed: float
    true_share: float


def reliability(files: Sequence[JudgedFile], bins: int = 10) -> tuple[ReliabilityBin, ...]:
    """Return claimed and true shares of objects among contacts by confidence; empty ranges are left out."""
    pairs = [(c.confidence / 2, c.thing is not None) for f in files for c in f.contacts if c.is_first]
    found = []
    for number in range(bins):
        inside = [p for p in pairs if number <= min(p[0] * bins, bins - 1e-9) < number + 1]
        if inside:
            claimed = float(np.mean([p[0] for p in inside]))
            found.append(ReliabilityBin(len(inside), claimed, float(np.mean([p[1] for p in inside]))))
    return tuple(found)
