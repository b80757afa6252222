"""Measurement of one codec over images: streams, decoded images, quality, time. An image over budget is a miss."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, TypeVar

import numpy as np
import numpy.typing as npt

from research.codecs.baselines import comparison_registry
from research.common.images import SampleImage
from research.common.nonlocal_means import reference_filtered
from research.common.quality import ms_ssim, ssim
from research.common.scene_measures import (
    ObjectMeasurement,
    clipped_psnr_db,
    count_dots,
    measure_object,
    object_errors,
)
from sonarpost.codec import emb
from sonarpost.codec.interface import Codec, Image
from sonarpost.codec.registry import CodecRegistry, CodecResources
from sonarpost.codec.vq.codebook import DEFAULT_TILE_PX, open_codebook
from sonarpost.codec.vq.codec import IndexPacking
from sonarpost.errors import ConfigError, StreamError

Values = npt.NDArray[np.float64]
T = TypeVar("T")

SCENE_MEASURES: Final = ("clean_psnr", "dots", "highlight_error", "shadow_error_px", "height_error", "despeckled_psnr")
"""Names of the measures against the scene, see `scene_measures`."""
SHIPPED_CODEBOOKS: Final = tuple(f"nominal-{tile_px}" for tile_px in DEFAULT_TILE_PX)


@dataclass(frozen=True)
class CodecUnderTest:
    """A codec with the way it is measured.

    Attributes:
        codec: The codec.
        variant: Distinguishes several of one name (for vq codebook and packing); empty for a single one.
        is_embedded: Whether one stream, coded for the largest budget, is truncated for the others.
        is_natural: Whether the size follows from the image alone, so that there is one result for all budgets.
        model: Name of the codec's model; empty for the default model.
    """

    codec: Codec
    variant: str = ""
    is_embedded: bool = False
    is_natural: bool = False
    model: str = ""

    @property
    def name(self) -> str:
        """Name of the codec, with its model if that is not the default, as in `emb:structure`."""
        return f"{self.codec.name}:{self.model}" if self.model else self.codec.name

    @property
    def label(self) -> str:
        """Name in tables."""
        return f"{self.name} {self.variant}".strip()


@dataclass(frozen=True)
class CodedImage:
    """One image, coded and decoded."""

    stream: bytes
    decoded: Image
    encode_ms: float
    decode_ms: float


@dataclass
class BudgetResult:
    """One codec at one budget over all images; arrays of shape (images,), NaN where the image was missed.

    Attributes:
        tested: The codec.
        budget_bytes: Maximum length of a stream; None for a natural size.
        stream_bytes: Length of each stream, header included.
        psnr: PSNR in dB, at most `PSNR_LIMIT_DB`.
        ssim: SSIM.
        msssim: MS-SSIM over three scales.
        encode_ms: Time to encode; for an embedded codec the time for the largest budget.
        decode_ms: Time to decode.
        reasons: Reasons of the misses with their counts.
        scene: Measures of `scene_measures` by name, each of shape (images,), NaN where a measure does not apply; empty
            if they were not measured.
    """

    tested: CodecUnderTest
    budget_bytes: int | None
    stream_bytes: Values
    psnr: Values
    ssim: Values
    msssim: Values
    encode_ms: Values
    decode_ms: Values
    reasons: Counter[str] = field(default_factory=Counter)
    scene: Mapping[str, Values] = field(default_factory=dict)

    @property
    def hits(self) -> npt.NDArray[np.bool_]:
        """Which images were coded, shape (images,)."""
        return np.isfinite(self.stream_bytes)

    @property
    def misses(self) -> int:
        """Number of images that were not coded."""
        return int(np.count_nonzero(~self.hits))

    @property
    def effective_budget(self) -> int:
        """The budget; for a natural size the length of the longest stream."""
        if self.budget_bytes is not None:
            return self.budget_bytes
        return int(np.nanmax(self.stream_bytes)) if self.hits.any() else 0


def create_codecs(
    registry: CodecRegistry,
    names: Sequence[str] | None,
    *,
    all_packings: bool = True,
    cut: bool = False,
    codebooks: Sequence[str] = SHIPPED_CODEBOOKS,
    strength: float | None = None,
) -> tuple[list[CodecUnderTest], list[str]]:
    """Create the codecs to measure.

    Args:
        registry: Registry of the codecs.
        names: Names of the codecs, or `NAME:MODEL`; None for all codecs and models that are available.
        all_packings: Whether vq is measured with every packing of an index, or with the shortest only.
        cut: Whether embedded codecs code one stream that is truncated for each budget.
        codebooks: Names of shipped codebooks, or paths of others, for vq.
        strength: Strength of despeckling of emb, 0..1; None for the default.

    Returns:
        The codecs, and one line for each that is not available (only with `names` None).

    Raises:
        ConfigError: A codec of `names` is unknown or not available.
        CodebookError: A codebook cannot be read.
    """
    packings = tuple(IndexPacking) if all_packings else (IndexPacking.BITS14,)
    found: list[CodecUnderTest] = []
    unavailable: list[str] = []
    for name in _names_with_models(registry) if names is None else dict.fromkeys(names):
        codec_name, _, model = name.partition(":")
        try:
            if registry.spec(codec_name).needs_tiles:
                found += _with_codebooks(registry, codec_name, packings, codebooks)
            else:
                is_embedded = cut and registry.is_embedded(codec_name)
                found.append(
                    CodecUnderTest(create_codec(name, registry, strength), is_embedded=is_embedded, model=model)
                )
        except ConfigError as error:
            if names is not None:
                raise
            unavailable.append(str(error))
    return found, unavailable


def create_codec(name: str, registry: CodecRegistry | None = None, strength: float | None = None) -> Codec:
    """Create a codec from `NAME` or `NAME:MODEL`.

    Args:
        name: Name of the codec, with its model if that is not the default.
        registry: Registry of the codecs; None for `comparison_registry`.
        strength: Strength of despeckling of emb, 0..1; None for the default.

    Raises:
        ConfigError: No codec or model has this name, the codec needs a codebook, or the strength is out of range.
    """
    codec_name, _, model = name.partition(":")
    resources = CodecResources(model=model or None, strength=strength)
    return (registry or comparison_registry()).create(codec_name, resources)


def _names_with_models(registry: CodecRegistry) -> list[str]:
    names = list(registry.names())
    if emb.NAME in names:
        names += [f"{emb.NAME}:{model}" for model in emb.MODEL_FILES if model != emb.DEFAULT_MODEL]
    return sorted(names)


def _with_codebooks(
    registry: CodecRegistry, name: str, packings: Sequence[IndexPacking], codebooks: Sequence[str]
) -> list[CodecUnderTest]:
    found = []
    for codebook in codebooks:
        tiles = open_codebook(codebook).tiles
        for packing in packings:
            codec = registry.create(name, CodecResources(tiles, packing))
            found.append(CodecUnderTest(codec, f"{codebook} {packing.value}", is_natural=True))
    return found


def code_image(tested: CodecUnderTest, image: Image, budgets: Sequence[int]) -> list[CodedImage | str]:
    """Encode and decode one image at every budget (once for a codec of natural size).

    Returns:
        For each budget the coded image, or the reason of the miss.
    """
    if tested.is_natural:
        return [_code_once(tested.codec, image, None)]
    if not tested.is_embedded:
        return _code_each(tested.codec, image, budgets)
    largest = max(budgets)
    try:
        stream, encode_ms = _timed(lambda: tested.codec.encode(image, largest))
    except StreamError as error:
        return [_reason(error)] * len(budgets)
    return [_decode(tested.codec, stream[:budget], budget, encode_ms) for budget in budgets]


def _code_each(codec: Codec, image: Image, budgets: Sequence[int]) -> list[CodedImage | str]:
    """Code at each budget, the largest first.

    An image that misses one budget misses every smaller one as well, so those are not tried: some codecs search for
    half a second.
    """
    results: dict[int, CodedImage | str] = {}
    missed: str | None = None
    for budget in sorted(budgets, reverse=True):
        results[budget] = _code_once(codec, image, budget) if missed is None else missed
        result = results[budget]
        missed = result if isinstance(result, str) else None
    return [results[budget] for budget in budgets]


def _code_once(codec: Codec, image: Image, budget: int | None) -> CodedImage | str:
    try:
        stream, encode_ms = _timed(lambda: codec.encode(image, budget))
    except StreamError as error:
        return _reason(error)
    return _decode(codec, stream, budget, encode_ms)


def _decode(codec: Codec, stream: bytes, budget: int | None, encode_ms: float) -> CodedImage | str:
    if budget is not None and len(stream) > budget:
        return "the stream is longer than its budget"
    try:
        decoded, decode_ms = _timed(lambda: codec.decode(stream))
    except StreamError as error:
        return _reason(error)
    return CodedImage(stream, decoded.image, encode_ms, decode_ms)


def _reason(error: StreamError) -> str:
    return f"{error.field}: expected {error.expected}" if error.field else f"expected {error.expected}"


def _timed(work: Callable[[], T]) -> tuple[T, float]:
    start_s = time.perf_counter()
    result = work()
    return result, (time.perf_counter() - start_s) * 1000.0


def measure_codec(
    tested: CodecUnderTest,
    images: Sequence[SampleImage],
    budgets: Sequence[int],
    progress: Callable[[str], None] | None = None,
    references: Sequence[SceneReference] = (),
) -> list[BudgetResult]:
    """Measure one codec over all images.

    The first image is coded once in advance, so that loading and compiling on first use are not counted.

    Args:
        tested: The codec.
        images: At least one.
        budgets: Maximum lengths of a stream.
        progress: Receives a line at the end.
        references: One for each image, for the measures against the scene; empty: these are not measured.

    Returns:
        One result a budget, in their order; a single one for a codec of natural size.
    """
    code_image(tested, images[0].pixels, budgets)
    result_budgets: tuple[int | None, ...] = (None,) if tested.is_natural else tuple(budgets)
    results = [_empty_result(tested, budget, len(images)) for budget in result_budgets]
    scenes = [{name: np.full(len(images), np.nan) for name in SCENE_MEASURES} for _ in results] if references else []
    for result, scene in zip(results, scenes, strict=bool(references)):
        result.scene = scene
    for number, image in enumerate(images):
        for result, coded in zip(results, code_image(tested, image.pixels, budgets), strict=True):
            if isinstance(coded, str):
                result.reasons[coded] += 1
                continue
            result.stream_bytes[number] = len(coded.stream)
            result.psnr[number] = clipped_psnr_db(image.pixels, coded.decoded)
            result.ssim[number] = ssim(image.pixels, coded.decoded)
            result.msssim[number] = ms_ssim(image.pixels, coded.decoded)
            result.encode_ms[number], result.decode_ms[number] = coded.encode_ms, coded.decode_ms
            if references:
                for name, value in scene_measures(image, references[number], coded.decoded).items():
                    result.scene[name][number] = value
    if progress is not None:
        progress(f"{tested.label}: {len(images)} images")
    return results


@dataclass(frozen=True)
class SceneReference:
    """What the decoded versions of an image are compared with.

    Attributes:
        despeckled: The image after `reference_filtered`, if its speckle-free scene is unknown, else None.
        object: Measurement of the object in the speckle-free scene; None without scene or object.
    """

    despeckled: Image | None
    object: ObjectMeasurement | None


def scene_reference(image: SampleImage) -> SceneReference:
    """Return the reference of an image."""
    if image.clean is None:
        return SceneReference(reference_filtered(image.pixels), None)
    return SceneReference(None, None if image.place is None else measure_object(image.clean, image.place))


def scene_measures(image: SampleImage, reference: SceneReference, decoded: Image) -> dict[str, float]:
    """Compare a decoded image with the scene; NaN for a measure that does not apply.

    Returns:
        By name: `clean_psnr`, PSNR in dB against the speckle-free scene; `dots`, see `count_dots`; `highlight_error`,
        `shadow_error_px` and `height_error`, see `ObjectErrors`, against the speckle-free scene; `despeckled_psnr`,
        PSNR in dB against the image after `reference_filtered`, for an image without known scene.
    """
    found = dict.fromkeys(SCENE_MEASURES, math.nan)
    found["dots"] = float(count_dots(decoded))
    if image.clean is not None:
        found["clean_psnr"] = clipped_psnr_db(image.clean, decoded)
    if reference.despeckled is not None:
        found["despeckled_psnr"] = clipped_psnr_db(reference.despeckled, decoded)
    if reference.object is not None and image.place is not None:
        errors = object_errors(measure_object(decoded, image.place), reference.object)
        found |= {
            "highlight_error": errors.highlight,
            "shadow_error_px": errors.shadow_px,
            "height_error": errors.height,
        }
    return found


def best_within_budgets(variants: Sequence[BudgetResult], budgets: Sequence[int]) -> list[BudgetResult]:
    """Return the results of a codec of natural size within each budget: for each image the best variant that fits.

    Args:
        variants: Results of one codec, each of a natural size; at least one.
        budgets: Maximum lengths of a stream.

    Returns:
        One result a budget; an image for which no variant fits is a miss.
    """
    lengths = np.stack([result.stream_bytes for result in variants])
    quality = np.stack([result.psnr for result in variants])
    others = [
        np.stack(each) for each in zip(*((r.ssim, r.msssim, r.encode_ms, r.decode_ms) for r in variants), strict=True)
    ]
    scenes = {name: np.stack([result.scene[name] for result in variants]) for name in variants[0].scene}
    images = np.arange(lengths.shape[1])
    found = []
    for budget in budgets:
        fits = lengths <= budget  # False where a variant missed the image
        # The stable sort selects the shortest stream among those of equal quality.
        order = np.argsort(np.where(fits, lengths, np.inf), axis=0, kind="stable")
        ranked = np.where(fits, quality, -np.inf)[order, images]
        chosen = order[np.argmax(ranked, axis=0), images]
        coded = np.asarray(fits.any(axis=0), dtype=np.bool_)
        size, psnr, ssim_, msssim, encode_ms, decode_ms = (
            np.where(coded, measured[chosen, images], np.nan) for measured in (lengths, quality, *others)
        )
        tested = CodecUnderTest(variants[0].tested.codec)
        result = BudgetResult(tested, budget, size, psnr, ssim_, msssim, encode_ms, decode_ms)
        result.scene = {name: np.where(coded, values[chosen, images], np.nan) for name, values in scenes.items()}
        misses = int(np.count_nonzero(~coded))
        if misses:
            result.reasons[f"budget_bytes: expected at least {int(np.nanmin(lengths))}"] = misses
        found.append(result)
    return found


def _empty_result(tested: CodecUnderTest, budget: int | None, count: int) -> BudgetResult:
    def unknown() -> Values:
        return np.full(count, np.nan)

    return BudgetResult(tested, budget, unknown(), unknown(), unknown(), unknown(), unknown(), unknown())
