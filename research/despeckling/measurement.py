"""Measurement of a despeckling filter: the filtered image, and the images that emb decodes after it."""

import math
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from research.common.images import SampleImage
from research.common.measurement import CodecUnderTest, code_image, create_codec
from research.common.scene_measures import (
    ObjectMeasurement,
    clipped_psnr_db,
    count_dots,
    finite_median,
    measure_object,
    object_errors,
)
from research.common.speckle import SpecklePair
from research.common.statistics import finite_mean
from research.despeckling.filters import FILTERS, SpeckleFilter
from sonarpost.codec import emb
from sonarpost.codec.emb.despeckle import despeckled
from sonarpost.codec.interface import Image

STRENGTHS: Final = (0.25, 0.5, 0.75, 1.0)
NONE: Final = "none"
ORACLE: Final = "oracle"
MEAN_FIGURES: Final = ("clean_psnr", "original_psnr", "dots")
"""Figures of a row that are means over the images."""
MEDIAN_FIGURES: Final = (
    "highlight_error",
    "highlight_shift_px",
    "shadow_error_px",
    "height_error",
    "highlight_error_original",
    "highlight_shift_original_px",
    "shadow_error_original_px",
    "height_error_original",
)
"""Figures of a row that are medians over the objects."""


@dataclass(frozen=True)
class FilterUnderTest:
    """A way to despeckle an image before emb codes it.

    Attributes:
        name: Name in the report: `none`, `network S` with the strength S, a name of `FILTERS`, or `oracle`.
        function: Maps an image to its estimate without speckle; None for the oracle, the scene itself.
        strength: Strength with which emb despeckles the image itself; 0 if `function` is applied before.
    """

    name: str
    function: SpeckleFilter | None
    strength: float = 0.0


@dataclass(frozen=True)
class ImageRow:
    """Figures of one filter, of the filtered images or of those that emb decodes at one budget.

    Attributes:
        budget_bytes: Maximum length of a stream; None for the filtered images.
        misses: Number of images that do not fit into the budget.
        figures: By the names of `MEAN_FIGURES` and `MEDIAN_FIGURES`; NaN where there is none. Those that end in
            `original` or `original_px`, and `original_psnr`, are against the image with speckle, the others against the
            scene without.
    """

    budget_bytes: int | None
    misses: int
    figures: dict[str, float]


@dataclass(frozen=True)
class FilterResult:
    """One filter over all pairs.

    Attributes:
        name: Name of the filter.
        filter_ms: Median processor time to filter an image; NaN for the oracle.
        rows: The filtered images first, then each budget.
    """

    name: str
    filter_ms: float
    rows: tuple[ImageRow, ...]


@dataclass(frozen=True)
class RecordingRow:
    """Isolated dots on crops of recordings, mean of an image.

    Attributes:
        name: Name of the filter.
        budget_bytes: Maximum length of a stream; None for the filtered images.
        dots_with_target: On crops with a target; NaN without any.
        dots_without_target: On the other crops.
        original_psnr: PSNR in dB against the crop.
    """

    name: str
    budget_bytes: int | None
    dots_with_target: float
    dots_without_target: float
    original_psnr: float


def create_filters(names: Sequence[str]) -> list[FilterUnderTest]:
    """Return the image as it is, the network at each strength, the classical filters of these names, and the oracle."""
    network = [
        FilterUnderTest(f"network {strength:g}", partial(despeckled, strength=strength), strength)
        for strength in STRENGTHS
    ]
    classical = [FilterUnderTest(name, FILTERS[name]) for name in names]
    return [FilterUnderTest(NONE, np.copy), *network, *classical, FilterUnderTest(ORACLE, None)]


def coded_images(
    tested: FilterUnderTest, image: Image, budgets: Sequence[int], filtered: Image | None = None
) -> list[Image | None]:
    """Return an image as emb decodes it at each budget; None where it does not fit.

    Args:
        tested: The filter.
        image: Shape (height, width), uint8.
        budgets: Maximum lengths of a stream.
        filtered: The filtered image, if it is known.
    """
    if tested.strength == 0:
        if filtered is None:
            filtered = image if tested.function is None else tested.function(image)
        image = filtered
    codec = CodecUnderTest(create_codec(emb.NAME, strength=tested.strength))
    return [None if isinstance(coded, str) else coded.decoded for coded in code_image(codec, image, budgets)]


def measure_pairs(tested: FilterUnderTest, pairs: Sequence[SpecklePair], budgets: Sequence[int]) -> FilterResult:
    """Measure a filter over simulated pairs.

    Args:
        tested: The filter.
        pairs: At least one.
        budgets: Maximum lengths of a stream.
    """
    columns: tuple[int | None, ...] = (None, *budgets)
    found: list[defaultdict[str, list[float]]] = [defaultdict(list) for _ in columns]
    misses = [0] * len(columns)
    times_ms = []
    if tested.function is not None:
        tested.function(pairs[0].noisy)  # loading on first use is not counted
    for pair in pairs:
        if tested.function is None:
            filtered = pair.clean
        else:
            filtered, filter_ms = _timed(tested.function, pair.noisy)
            times_ms.append(filter_ms)
        references = None
        if pair.place is not None:
            references = measure_object(pair.clean, pair.place), measure_object(pair.noisy, pair.place)
        for column, image in enumerate((filtered, *coded_images(tested, pair.noisy, budgets, filtered))):
            if image is None:
                misses[column] += 1
                continue
            for name, value in pair_figures(pair, references, image).items():
                found[column][name].append(value)
    rows = [
        ImageRow(
            budget,
            misses[column],
            {name: finite_mean(np.array(found[column][name])) for name in MEAN_FIGURES}
            | {name: finite_median(found[column][name]) for name in MEDIAN_FIGURES},
        )
        for column, budget in enumerate(columns)
    ]
    return FilterResult(tested.name, finite_median(times_ms), tuple(rows))


def pair_figures(
    pair: SpecklePair, references: tuple[ObjectMeasurement, ObjectMeasurement] | None, image: Image
) -> dict[str, float]:
    """Return the figures of one image; those of objects are absent without an object.

    Args:
        pair: The pair that the image was made from.
        references: Measurements of the object in the scene without speckle and in the image with speckle.
        image: The filtered or decoded image.
    """
    found = {
        "clean_psnr": clipped_psnr_db(pair.clean, image),
        "original_psnr": clipped_psnr_db(pair.noisy, image),
        "dots": float(count_dots(image)),
    }
    if references is None or pair.place is None:
        return found
    measured = measure_object(image, pair.place)
    for suffix, reference in zip(("", "_original"), references, strict=True):
        errors = object_errors(measured, reference)
        found |= {
            f"highlight_error{suffix}": errors.highlight,
            f"highlight_shift{suffix}_px": errors.position_px,
            f"shadow_error{suffix}_px": errors.shadow_px,
            f"height_error{suffix}": errors.height,
        }
    return found


def measure_recordings(
    tested: FilterUnderTest, crops: Sequence[SampleImage], budgets: Sequence[int]
) -> list[RecordingRow]:
    """Count isolated dots on crops of recordings; one row for the filtered crops and one for each budget.

    Args:
        tested: A filter with a function.
        crops: At least one.
        budgets: Maximum lengths of a stream.
    """
    assert tested.function is not None
    columns: tuple[int | None, ...] = (None, *budgets)
    dots = np.full((len(columns), len(crops)), math.nan)
    quality = np.full((len(columns), len(crops)), math.nan)
    has_target = np.array([bool(crop.is_target) for crop in crops])
    for number, crop in enumerate(crops):
        filtered = tested.function(crop.pixels)
        for column, image in enumerate((filtered, *coded_images(tested, crop.pixels, budgets, filtered))):
            if image is not None:
                dots[column, number] = count_dots(image)
                quality[column, number] = clipped_psnr_db(crop.pixels, image)
    return [
        RecordingRow(
            tested.name,
            budget,
            finite_mean(dots[column, has_target]),
            finite_mean(dots[column, ~has_target]),
            finite_mean(quality[column]),
        )
        for column, budget in enumerate(columns)
    ]


def _timed(function: Callable[[Image], Image], image: Image) -> tuple[Image, float]:
    """Return the result and the processor time in ms, all threads together."""
    start_s = time.process_time()
    result = function(image)
    return result, (time.process_time() - start_s) * 1000.0
