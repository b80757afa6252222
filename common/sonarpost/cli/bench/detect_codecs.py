"""The paper's measure of a codec: the detector's confidence in a contact before and after, at each budget."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sonarpost.cli.bench.detect_simulated import JudgedFile
from sonarpost.cli.bench.measure import Subject, code
from sonarpost.detect.piece import Picture, Piece
from sonarpost.detect.pieces import best_of_piece
from sonarpost.detect.settings import DetectorSettings
from sonarpost.detect.snippet import cut_snippet
from sonarpost.sonar.survey import Side

HEIGHT_PX: Final = 80
WIDTH_PX: Final = 140
_LEAST_CONFIDENCE: Final = 1.0
_SETTINGS: Final = DetectorSettings()


@dataclass(frozen=True, slots=True)
class Shot:
    """A contact's picture, as the vehicle cuts it, and its confidence as a picture."""

    piece: Piece
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
    cut = []
    for file in files:
        for found, judged in zip(file.found, file.contacts, strict=True):
            is_mine = judged.thing is not None and judged.thing.is_mine_like and judged.is_first
            if not is_mine or found.confidence < _LEAST_CONFIDENCE or found.pixel_along_m is None:
                continue
            picture = cut_snippet(file.survey, found, HEIGHT_PX, WIDTH_PX).image
            cut.append(Piece(picture, found.pixel_along_m, found.pixel_across_m))
    step = max(len(cut) / most, 1.0) if most > 0 else math.inf
    chosen = [cut[int(i * step)] for i in range(min(most, len(cut)))]
    return [Shot(piece, _confidence(piece, piece.picture)) for piece in chosen]


def effects(pictures: Sequence[Shot], subject: Subject, budgets: Sequence[int]) -> list[CodecEffect]:
    """Code every picture at every budget (once, for a codec of natural size) and judge it again."""
    coded = [code(subject, np.asarray(shot.piece.picture, dtype=np.uint8), budgets) for shot in pictures]
    found = []
    for place in range(len(coded[0]) if coded else 0):
        before, after = [], []
        for shot, results in zip(pictures, coded, strict=True):
            result = results[place]
            if not isinstance(result, str):
                before.append(shot.confidence)
                after.append(_confidence(shot.piece, result.rebuilt))
        sure = [b >= _LEAST_CONFIDENCE for b in before]
        found.append(
            CodecEffect(
                label=subject.label,
                budget_bytes=None if subject.is_natural else budgets[place],
                pictures=len(after),
                misses=len(pictures) - len(after),
                before=float(np.mean(before)) if before else math.nan,
                after=float(np.mean(after)) if after else math.nan,
                kept=float(np.mean([a >= _LEAST_CONFIDENCE for a, s in zip(after, sure, strict=True) if s]))
                if any(sure)
                else math.nan,
            )
        )
    return found


def _confidence(like: Piece, picture: Picture) -> float:
    """Return the confidence of a picture of the piece's scale; snippets lead away from the vehicle to the right."""
    best = best_of_piece(Piece(picture, like.pixel_along_m, like.pixel_across_m), _SETTINGS, Side.STARBOARD)
    return 0.0 if best is None else best.confidence
