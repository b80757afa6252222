"""The paper's Table II and Fig. 2, measured with the codecs of this package at the paper's sizes."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from research.common.measurement import CodecUnderTest, CodedImage, code_image
from research.common.quality import ssim
from research.common.scene_measures import clipped_psnr_db
from sonarpost.codec.interface import Image
from sonarpost.detection.detector import detect
from sonarpost.detection.snippets import cut_snippet
from sonarpost.errors import SurveyFileError
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.readers import read_survey
from sonarpost.sonar.survey import Survey

HEIGHT_PX: Final = 49
WIDTH_PX: Final = 113
PIXELS: Final = HEIGHT_PX * WIDTH_PX
_FIRST_SEED: Final = 920_000
_CONTACTS_PER_LINE: Final = 6


@dataclass(frozen=True)
class PaperFigure:
    """One entry of the paper's Table II or Fig. 2.

    Attributes:
        title: Name in tables.
        codec: The corresponding codec of this package.
        variant: Beginning of the variant, for vq.
        paper_bytes: Bytes of the paper for 113 x 49 px.
        paper_psnr: PSNR of the paper, dB.
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
# Table II gives ratios; its images are not described, so the bytes are those of an image of the size of Fig. 2.
TABLE2: Final = (
    PaperFigure("JPEG 2000", "jpeg2000", round(PIXELS / 9.449), 29.52),
    PaperFigure("Huffman", "huffman", round(PIXELS / 8.916), 21.66),
    PaperFigure("VQ", "vq", round(PIXELS / 251.682), 18.19, "nominal-20"),
    PaperFigure("SPIHT", "spiht", round(PIXELS / 25.924), 21.94),
)
EMB: Final = "emb"


@dataclass(frozen=True)
class Reproduced:
    """A figure of the paper with the measured values: means over `images`, None without any.

    Attributes:
        figure: The figure of the paper.
        sent_bytes: Mean length of the streams, headers included.
        psnr: Mean PSNR, dB.
        ssim: Mean SSIM.
        emb_psnr: Mean PSNR of emb with at most as many bytes.
        images: Number of images that the codec coded at this size.
        reason: Reason for missing values.
    """

    figure: PaperFigure
    sent_bytes: float | None
    psnr: float | None
    ssim: float | None
    emb_psnr: float | None
    images: int
    reason: str = ""


def contact_images(survey: Survey, count: int = _CONTACTS_PER_LINE) -> list[Image]:
    """Cut the most confident contacts of a survey to the paper's size, shape (49, 113) each.

    Raises:
        SurveyFileError: There is no contact, or the survey is smaller than the image.
    """
    cut = [cut_snippet(survey, contact, HEIGHT_PX, WIDTH_PX).image for contact in detect(survey)[:count]]
    images = [image for image in cut if image.shape == (HEIGHT_PX, WIDTH_PX)]
    if not images:
        expected = f"a survey with a contact and at least {HEIGHT_PX} pings of {WIDTH_PX} samples"
        raise SurveyFileError(str(survey.path), "contacts", len(cut), expected)
    return images


def paper_images(survey_file: Path | None) -> tuple[list[Image], str]:
    """Return images of the paper's size and a description of their origin.

    Args:
        survey_file: A survey with contacts; None for simulated surveys over every kind of seabed.

    Raises:
        SurveyFileError: The survey cannot be read or has no contact.
    """
    if survey_file is not None:
        return contact_images(read_survey(survey_file), 4 * _CONTACTS_PER_LINE), f"contacts of {survey_file.name}"
    images: list[Image] = []
    for number, kind in enumerate(SeabedKind):
        spec = SurveySpec(seed=_FIRST_SEED + number, pings=600, seabed=kind, targets=6, clutter=3)
        images += contact_images(simulate_survey(spec).survey)
    return images, f"contacts of {len(SeabedKind)} simulated lines, one over each kind of bottom"


def reproduce(
    figures: Sequence[PaperFigure], tested: Sequence[CodecUnderTest], images: Sequence[Image]
) -> list[Reproduced]:
    """Measure each figure of the paper with the same budget (vq: with its natural size)."""
    return [_reproduce(figure, tested, images) for figure in figures]


def code_figure(figure: PaperFigure, tested: Sequence[CodecUnderTest], image: Image) -> CodedImage | str:
    """Code one image for a figure of the paper; return the reason if it cannot be coded."""
    codec = _find_codec(tested, figure.codec, figure.variant)
    if codec is None:
        return f"codec {figure.codec} is not in this run"
    return code_image(codec, image, [figure.paper_bytes])[0]


def code_emb(tested: Sequence[CodecUnderTest], image: Image, budget_bytes: int) -> CodedImage | str:
    """Code one image with emb; return the reason if it cannot be coded."""
    codec = _find_codec(tested, EMB, "")
    return f"codec {EMB} is not in this run" if codec is None else code_image(codec, image, [budget_bytes])[0]


def _find_codec(tested: Sequence[CodecUnderTest], name: str, variant: str) -> CodecUnderTest | None:
    return next((t for t in tested if t.codec.name == name and t.variant.startswith(variant)), None)


def _reproduce(figure: PaperFigure, tested: Sequence[CodecUnderTest], images: Sequence[Image]) -> Reproduced:
    sizes, psnrs, ssims, emb_psnrs = [], [], [], []
    reason = ""
    for image in images:
        coded = code_figure(figure, tested, image)
        if isinstance(coded, str):
            reason = coded
            continue
        sizes.append(float(len(coded.stream)))
        psnrs.append(clipped_psnr_db(image, coded.decoded))
        ssims.append(ssim(image, coded.decoded))
        with_emb = code_emb(tested, image, len(coded.stream))
        if isinstance(with_emb, CodedImage):
            emb_psnrs.append(clipped_psnr_db(image, with_emb.decoded))
    means = [float(np.mean(values)) if values else None for values in (sizes, psnrs, ssims, emb_psnrs)]
    return Reproduced(figure, means[0], means[1], means[2], means[3], len(sizes), reason)
