"""One codec over pictures: streams, rebuilt pictures, figures. A picture that does not fit a budget is a miss."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final, TypeVar

import numpy as np
import numpy.typing as npt

from research.common.images import BenchPicture
from sonarpost.codec.interface import Codec, Image
from sonarpost.codec.quality import ms_ssim, psnr_db, ssim
from sonarpost.codec.registry import CodecRegistry, CodecResources
from sonarpost.codec.vq.codebook import DEFAULT_TILE_PX, open_codebook
from sonarpost.codec.vq.codec import IndexPacking
from sonarpost.errors import ConfigError, StreamError

Values = npt.NDArray[np.float64]
T = TypeVar("T")

PSNR_LIMIT_DB: Final = 60.0
"""A picture rebuilt without error has an infinite PSNR, which no mean survives; it counts as this."""
SHIPPED_CODEBOOKS: Final = tuple(f"nominal-{tile_px}" for tile_px in DEFAULT_TILE_PX)


@dataclass(frozen=True)
class Subject:
    """A codec as it is measured.

    Attributes:
        codec: The codec.
        variant: What tells several of one name apart (for vq codebook and packing); empty for the only one.
        is_embedded: Whether one stream, made for the largest budget, is cut for the others; else each budget has a
            stream of its own.
        is_natural: Whether its size follows from the picture alone, so that it is one point, whatever the budgets.
    """

    codec: Codec
    variant: str = ""
    is_embedded: bool = False
    is_natural: bool = False

    @property
    def label(self) -> str:
        """Name for people."""
        return f"{self.codec.name} {self.variant}".strip()


@dataclass(frozen=True)
class Coded:
    """One picture, coded and rebuilt."""

    stream: bytes
    rebuilt: Image
    encode_ms: float
    decode_ms: float


@dataclass
class Point:
    """One codec at one budget over all pictures; arrays of shape (pictures,), NaN where the picture was missed.

    Attributes:
        subject: The codec.
        budget_bytes: Most bytes of a stream; None for a natural size.
        stream_bytes: Real length of each stream, its header included.
        psnr: PSNR in dB, at most `PSNR_LIMIT_DB`.
        ssim: SSIM.
        msssim: MS-SSIM over three scales.
        encode_ms: Time to encode; of an embedded codec the time for the largest budget.
        decode_ms: Time to decode.
        reasons: Why pictures were missed, and how many each.
    """

    subject: Subject
    budget_bytes: int | None
    stream_bytes: Values
    psnr: Values
    ssim: Values
    msssim: Values
    encode_ms: Values
    decode_ms: Values
    reasons: Counter[str] = field(default_factory=Counter)

    @property
    def hits(self) -> npt.NDArray[np.bool_]:
        """Which pictures were coded, shape (pictures,)."""
        return np.isfinite(self.stream_bytes)

    @property
    def misses(self) -> int:
        """How many were not."""
        return int(np.count_nonzero(~self.hits))

    @property
    def shown_budget(self) -> int:
        """The budget; for a natural size the longest stream, the budget that every picture would have fitted."""
        if self.budget_bytes is not None:
            return self.budget_bytes
        return int(np.nanmax(self.stream_bytes)) if self.hits.any() else 0


def subjects(
    registry: CodecRegistry,
    names: Sequence[str] | None,
    *,
    all_packings: bool = True,
    cut: bool = False,
    codebooks: Sequence[str] = SHIPPED_CODEBOOKS,
) -> tuple[list[Subject], list[str]]:
    """Make the codecs to measure.

    Args:
        registry: Where they are from.
        names: Which; None for every one that can be made here.
        all_packings: Whether vq is measured with every packing of an index, or the tightest only.
        cut: Whether embedded codecs make one stream, cut for each budget.
        codebooks: Names of shipped codebooks, or paths of others, that vq is measured with.

    Returns:
        The codecs, and one line for each that cannot be made here (only with `names` None).

    Raises:
        ConfigError: A codec asked for by name is unknown or cannot be made.
        CodebookError: A codebook cannot be read.
    """
    packings = tuple(IndexPacking) if all_packings else (IndexPacking.BITS14,)
    found: list[Subject] = []
    absent: list[str] = []
    for name in registry.names() if names is None else dict.fromkeys(names):
        try:
            if registry.spec(name).needs_tiles:
                found += _with_tiles(registry, name, packings, codebooks)
            else:
                codec = registry.create(name, CodecResources())
                found.append(Subject(codec, is_embedded=cut and registry.is_embedded(name)))
        except ConfigError as error:
            if names is not None:
                raise
            absent.append(str(error))
    return found, absent


def _with_tiles(
    registry: CodecRegistry, name: str, packings: Sequence[IndexPacking], codebooks: Sequence[str]
) -> list[Subject]:
    made = []
    for codebook in codebooks:
        tiles = open_codebook(codebook).tiles
        for packing in packings:
            codec = registry.create(name, CodecResources(tiles, packing))
            made.append(Subject(codec, f"{codebook} {packing.value}", is_natural=True))
    return made


def code(subject: Subject, picture: Image, budgets: Sequence[int]) -> list[Coded | str]:
    """Encode and decode one picture at every budget (once, for a codec of natural size).

    Returns:
        For each budget the coded picture, or in words why there is none.
    """
    if subject.is_natural:
        return [_code_once(subject.codec, picture, None)]
    if not subject.is_embedded:
        return _code_each(subject.codec, picture, budgets)
    most = max(budgets)
    try:
        stream, encode_ms = _timed(lambda: subject.codec.encode(picture, most))
    except StreamError as error:
        return [_reason(error)] * len(budgets)
    return [_decoded(subject.codec, stream[:budget], budget, encode_ms) for budget in budgets]


def _code_each(codec: Codec, picture: Image, budgets: Sequence[int]) -> list[Coded | str]:
    """Code at each budget, the largest first: a picture that missed one budget misses every smaller one.

    A budget is an upper bound, so a stream within the smaller would have been within the larger. Some codecs search
    half a second in vain.
    """
    found: dict[int, Coded | str] = {}
    missed: str | None = None
    for budget in sorted(budgets, reverse=True):
        found[budget] = _code_once(codec, picture, budget) if missed is None else missed
        result = found[budget]
        missed = result if isinstance(result, str) else None
    return [found[budget] for budget in budgets]


def _code_once(codec: Codec, picture: Image, budget: int | None) -> Coded | str:
    try:
        stream, encode_ms = _timed(lambda: codec.encode(picture, budget))
    except StreamError as error:
        return _reason(error)
    return _decoded(codec, stream, budget, encode_ms)


def _decoded(codec: Codec, stream: bytes, budget: int | None, encode_ms: float) -> Coded | str:
    if budget is not None and len(stream) > budget:
        return "the stream is longer than its budget"
    try:
        decoded, decode_ms = _timed(lambda: codec.decode(stream))
    except StreamError as error:
        return _reason(error)
    return Coded(stream, decoded.image, encode_ms, decode_ms)


def _reason(error: StreamError) -> str:
    return f"{error.field}: expected {error.expected}" if error.field else f"expected {error.expected}"


def _timed(work: Callable[[], T]) -> tuple[T, float]:
    start_s = time.perf_counter()
    result = work()
    return result, (time.perf_counter() - start_s) * 1000.0


def measure(
    subject: Subject,
    pictures: Sequence[BenchPicture],
    budgets: Sequence[int],
    progress: Callable[[str], None] | None = None,
) -> list[Point]:
    """Measure one codec over all pictures.

    The first picture is coded once beforehand: what a codec loads or compiles on first use is not its speed.

    Returns:
        One point a budget, in their order; a single one for a codec of natural size.
    """
    code(subject, pictures[0].pixels, budgets)
    wanted: tuple[int | None, ...] = (None,) if subject.is_natural else tuple(budgets)
    points = [_empty(subject, budget, len(pictures)) for budget in wanted]
    for number, picture in enumerate(pictures):
        for point, coded in zip(points, code(subject, picture.pixels, budgets), strict=True):
            if isinstance(coded, str):
                point.reasons[coded] += 1
                continue
            point.stream_bytes[number] = len(coded.stream)
            point.psnr[number] = min(psnr_db(picture.pixels, coded.rebuilt), PSNR_LIMIT_DB)
            point.ssim[number] = ssim(picture.pixels, coded.rebuilt)
            point.msssim[number] = ms_ssim(picture.pixels, coded.rebuilt)
            point.encode_ms[number], point.decode_ms[number] = coded.encode_ms, coded.decode_ms
    if progress is not None:
        progress(f"{subject.label}: {len(pictures)} pictures")
    return points


def best_that_fit(variants: Sequence[Point], budgets: Sequence[int]) -> list[Point]:
    """Return what a codec of natural sizes gives within each budget: of each picture the best variant that fits.

    Args:
        variants: Points of one codec, each of a natural size; at least one.
        budgets: Most bytes of a stream.

    Returns:
        One point a budget; a picture that no variant squeezes into it is a miss.
    """
    lengths = np.stack([point.stream_bytes for point in variants])
    quality = np.stack([point.psnr for point in variants])
    others = [
        np.stack(each) for each in zip(*((p.ssim, p.msssim, p.encode_ms, p.decode_ms) for p in variants), strict=True)
    ]
    pictures = np.arange(lengths.shape[1])
    found = []
    for budget in budgets:
        fits = lengths <= budget  # False where a variant missed the picture
        # Of equal quality the shortest, which is the first of the stably sorted.
        order = np.argsort(np.where(fits, lengths, np.inf), axis=0, kind="stable")
        ranked = np.where(fits, quality, -np.inf)[order, pictures]
        chosen = order[np.argmax(ranked, axis=0), pictures]
        some = np.asarray(fits.any(axis=0), dtype=np.bool_)
        size, psnr, ssim_, msssim, encode_ms, decode_ms = (
            np.where(some, measured[chosen, pictures], np.nan) for measured in (lengths, quality, *others)
        )
        subject = Subject(variants[0].subject.codec)
        point = Point(subject, budget, size, psnr, ssim_, msssim, encode_ms, decode_ms)
        missed = int(np.count_nonzero(~some))
        if missed:
            point.reasons[f"budget_bytes: expected at least {int(np.nanmin(lengths))}"] = missed
        found.append(point)
    return found


def _empty(subject: Subject, budget: int | None, count: int) -> Point:
    def unknown() -> Values:
        return np.full(count, np.nan)

    return Point(subject, budget, unknown(), unknown(), unknown(), unknown(), unknown(), unknown())
