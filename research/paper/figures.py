"""The paper's Table II and Fig. 2, measured again with this package's codecs at the paper's sizes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from research.common.measurement import PSNR_LIMIT_DB, Coded, Subject, code
from sonarpost.codec.interface import Image
from sonarpost.codec.quality import psnr_db, ssim
from sonarpost.detection.detector import detect
from sonarpost.detection.snippets import cut_snippet
from sonarpost.errors import SurveyFileError
from sonarpost.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.readers import read_survey
from sonarpost.sonar.survey import Survey

HEIGHT_PX: Final = 49
WIDTH_PX: Final = 113
PIXELS: Final = HEIGHT_PX * WIDTH_PX
_FIRST_SEED: Final = 920_000
_CONTACTS_A_LINE: Final = 6


@dataclass(frozen=True)
class PaperFigure:
    """One entry of the paper's Table II or Fig. 2.

    Attributes:
        title: As people know it.
        codec: The codec here that does the same.
        variant: Start of the variant, for vq.
        paper_bytes: What the paper spent on 49 x 113 px.
        paper_psnr: What it got, dB.
    """

    title: str
    codec: str
    paper_bytes: int
    paper_psnr: float
    variant: str = ""


FIG2: Final = (
    PaperFigure("JPEG 2000", "jpeg2000", 588, 29.65),
    PaperFigure("Huffman", "huffman", 671, 21.72),
    PaperFigure("SPIHT, maxloop 7", "spiht", 1110, 24.49),
    PaperFigure("SPIHT, maxloop 6", "spiht", 343, 21.96),
    PaperFigure("VQ, 10 x 10 px tiles", "vq", 88, 19.24, "nominal-10"),
    PaperFigure("VQ, 20 x 20 px tiles", "vq", 20, 18.19, "nominal-20"),
)
# Table II gives ratios; its pictures are not described, so the bytes are those of a picture of Fig. 2's size.
TABLE2: Final = (
    PaperFigure("JPEG 2000", "jpeg2000", round(PIXELS / 9.449), 29.52),
    PaperFigure("Huffman", "huffman", round(PIXELS / 8.916), 21.66),
    PaperFigure("VQ", "vq", round(PIXELS / 251.682), 18.19, "nominal-20"),
    PaperFigure("SPIHT", "spiht", round(PIXELS / 25.924), 21.94),
)
FLAGSHIP: Final = "emb"


@dataclass(frozen=True)
class Reproduced:
    """A figure of the paper with what came out here; numbers are means over `pictures`, None where nothing did.

    Attributes:
        figure: The paper's.
        sent_bytes: Mean length of the streams, headers included.
        psnr: Mean PSNR, dB.
        ssim: Mean SSIM.
        flagship_psnr: Mean PSNR of emb with at most as many bytes.
        pictures: How many pictures the codec could do at this size.
        reason: Why there is nothing, where there is nothing.
    """

    figure: PaperFigure
    sent_bytes: float | None
    psnr: float | None
    ssim: float | None
    flagship_psnr: float | None
    pictures: int
    reason: str = ""


def contact_pictures(survey: Survey, count: int = _CONTACTS_A_LINE) -> list[Image]:
    """Cut a survey's most confident contacts to the paper's size, shape (49, 113) each.

    Raises:
        SurveyFileError: There is no contact, or the survey is smaller than the picture.
    """
    cut = [cut_snippet(survey, contact, HEIGHT_PX, WIDTH_PX).image for contact in detect(survey)[:count]]
    pictures = [image for image in cut if image.shape == (HEIGHT_PX, WIDTH_PX)]
    if not pictures:
        expected = f"a survey with a contact and at least {HEIGHT_PX} pings of {WIDTH_PX} samples"
        raise SurveyFileError(str(survey.path), "contacts", len(cut), expected)
    return pictures


def chosen_pictures(survey_file: Path | None) -> tuple[list[Image], str]:
    """Return pictures of the paper's size and, in words, what they are of.

    Args:
        survey_file: A survey to cut contacts from; None for simulated ones over every kind of bottom.

    Raises:
        SurveyFileError: The survey cannot be read or shows no contact.
    """
    if survey_file is not None:
        return contact_pictures(read_survey(survey_file), 4 * _CONTACTS_A_LINE), f"contacts of {survey_file.name}"
    pictures: list[Image] = []
    for number, kind in enumerate(SeabedKind):
        spec = SurveySpec(seed=_FIRST_SEED + number, pings=600, seabed=kind, targets=6, clutter=3)
        pictures += contact_pictures(simulate_survey(spec).survey)
    return pictures, f"contacts of {len(SeabedKind)} simulated lines, one over each kind of bottom"


def reproduce(figures: Sequence[PaperFigure], tested: Sequence[Subject], pictures: Sequence[Image]) -> list[Reproduced]:
    """Measure each of the paper's figures again, with the same budget (vq: with its own size)."""
    return [_reproduce(figure, tested, pictures) for figure in figures]


def code_figure(figure: PaperFigure, tested: Sequence[Subject], picture: Image) -> Coded | str:
    """Code one picture as a figure of the paper was; in words why not, where it cannot be."""
    subject = _subject(tested, figure.codec, figure.variant)
    if subject is None:
        return f"codec {figure.codec} is not in this run"
    return code(subject, picture, [figure.paper_bytes])[0]


def code_flagship(tested: Sequence[Subject], picture: Image, budget_bytes: int) -> Coded | str:
    """Code one picture with the flagship codec; in words why not, where it cannot be."""
    subject = _subject(tested, FLAGSHIP, "")
    return f"codec {FLAGSHIP} is not in this run" if subject is None else code(subject, picture, [budget_bytes])[0]


def _subject(tested: Sequence[Subject], codec: str, variant: str) -> Subject | None:
    return next((s for s in tested if s.codec.name == codec and s.variant.startswith(variant)), None)


def _reproduce(figure: PaperFigure, tested: Sequence[Subject], pictures: Sequence[Image]) -> Reproduced:
    sizes, errors, likeness, flagship = [], [], [], []
    reason = ""
    for picture in pictures:
        coded = code_figure(figure, tested, picture)
        if isinstance(coded, str):
            reason = coded
            continue
        sizes.append(float(len(coded.stream)))
        errors.append(min(psnr_db(picture, coded.rebuilt), PSNR_LIMIT_DB))
        likeness.append(ssim(picture, coded.rebuilt))
        other = code_flagship(tested, picture, len(coded.stream))
        if isinstance(other, Coded):
            flagship.append(min(psnr_db(picture, other.rebuilt), PSNR_LIMIT_DB))
    means = [float(np.mean(values)) if values else None for values in (sizes, errors, likeness, flagship)]
    return Reproduced(figure, means[0], means[1], means[2], means[3], len(sizes), reason)
