"""The embedded codec `emb`: every prefix of a stream decodes to an image.

Body: side information, then the wavelet coefficients plane by plane, all through one range coder. A truncated stream
decodes to the image that its bytes determine.

The encoder tries several start steps and sends the body with the smallest squared error of the image. A perceptual
model uses structural similarity instead: Wang, Simoncelli, Bovik, "Multiscale structural similarity for image quality
assessment" (2003), at a half and a quarter of the size, which have nearly all of the weight, with a binomial window in
place of the Gaussian one. Before, the encoder estimates the scene without speckle (`despeckle`); all of this is then
against the estimate. Only integers are added up, so that all machines write the same stream.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Final

import numpy as np

from sonarpost.codec.emb import CODEC_IDS, DEFAULT_MODEL, DESPECKLED_CODEC_IDS, NAME, transform
from sonarpost.codec.emb.bitplanes import (
    START_THRESHOLDS,
    code_planes,
    constrained_targets,
    extra_planes,
    reconstructed_coefficients,
)
from sonarpost.codec.emb.coder import Coder, CoefficientState
from sonarpost.codec.emb.decode import decoded_image, grey_of, read_body
from sonarpost.codec.emb.despeckle import STRENGTH_STEPS, check_strength, despeckled
from sonarpost.codec.emb.kernel import I64
from sonarpost.codec.emb.model import Model, shipped_model
from sonarpost.codec.emb.rate_distortion_opt import TargetCoefficients, target_coefficients
from sonarpost.codec.emb.side_info import MEAN_STEP, RegionOfInterest, SideInfo, code_side_info, region_weights
from sonarpost.codec.emb.transform import layout_of
from sonarpost.codec.interface import (
    MAX_SIDE_PX,
    DecodedImage,
    Image,
    Mask,
    SnippetPixels,
    StreamHeader,
    before_gap,
    encoder_input,
    model_tag,
)
from sonarpost.errors import StreamError

MAX_BODY_BYTES: Final = 0xFFFF
MAX_PIXELS: Final = MAX_SIDE_PX * MAX_SIDE_PX
_SMALL_PX: Final = 8000
SEARCHES: Final[tuple[tuple[int, int, tuple[int, ...], int], ...]] = (
    (96, MAX_PIXELS, (0, 2, 4, 6), 1),
    (319, _SMALL_PX, (0, 2, 4, 6), 0),
    (319, MAX_PIXELS, (0, 4), 1),
    (MAX_BODY_BYTES, _SMALL_PX, (0, 4), 2),
    (MAX_BODY_BYTES, MAX_PIXELS, (0, 4), 1),
)
"""Maximum body length and image size, start steps to try, and number of further trials next to the best of them
(`next_step`). The trials take about 100 ms for 140 x 80 px."""
PERCEPTUAL_SEARCHES: Final = (*SEARCHES[:-2], SEARCHES[-1])
"""The same for perceptual models, whose long streams have more planes."""
DESPECKLED_SEARCHES: Final = (
    (40, MAX_PIXELS, (0, 2, 4, 6), 1),
    (96, MAX_PIXELS, (0, 4), 1),
    (223, MAX_PIXELS, (0, 4), 0),
    (MAX_BODY_BYTES, MAX_PIXELS, (0,), 0),
)
"""The same for despeckled images: further trials gain 0.01 to 0.03 dB, and despeckling needs the time."""
# (0.01 * 255)^2 and (0.03 * 255)^2, times 2^16.
_SSIM_C1: Final = 426148
_SSIM_C2: Final = 3835331
_TAPS: Final = (1, 8, 28, 56, 70, 56, 28, 8, 1)


@dataclass(frozen=True, eq=False)
class EncodedTrial:
    """A body and its error.

    Attributes:
        error: The value to minimise. With a region of interest: squared error of the weighted coefficients. Otherwise:
            squared error of the image in the transform's units, or minus the similarity for a perceptual model.
        body: The bytes.
        curve: See `Coder.curve`.
    """

    error: int
    body: bytes
    curve: I64


@dataclass(frozen=True)
class TrialEncoder:
    """Writes bodies within a budget.

    Attributes:
        model: The networks.
        limit: Maximum length of a body.
        price: See `kernel.code_band`.
        prefix: Start of the bodies: all but the last byte of a body with the same first bits.
    """

    model: Model
    limit: int
    price: int
    prefix: bytes = b""

    def write(self, targets: TargetCoefficients, side: SideInfo) -> EncodedTrial:
        """Write a body with the start step of `side`."""
        coder, state = Coder.writer(self.limit, self.prefix), CoefficientState(targets.layout)
        coder.curve[0] = int((targets.originals.astype(np.int64) ** 2).sum())
        code_side_info(coder, self.model, side)
        coder.record_error()
        code_planes(coder, state, self.model, targets.targets, side, self.price, originals=targets.originals)
        if side.region is not None:
            return EncodedTrial(int(coder.curve[0]), coder.finish(), coder.curve)
        plane, _ = transform.inverse(reconstructed_coefficients(state, self.model), targets.layout)
        if self.model.perceptual is None:
            error = int(((targets.plane - plane) ** 2).sum())
        else:
            original, decoded = (grey_of(one, side.mean).astype(np.int64) for one in (targets.plane, plane))
            error = -structural_similarity(original, decoded)
        return EncodedTrial(error, coder.finish(), coder.curve)

    def best(
        self,
        targets: TargetCoefficients,
        sent: SideInfo,
        start_steps: tuple[int, ...] = (),
    ) -> EncodedTrial:
        """Write bodies with several start steps and return the one with the smallest error.

        `sent` is the side information but for the start step and the extra planes. Without `start_steps`, those of
        `SEARCHES`, or of the table for the model, are tried.
        """
        pixels = targets.plane.size
        searches = SEARCHES if self.model.perceptual is None else PERCEPTUAL_SEARCHES
        if self.model.sends_strength:
            searches = DESPECKLED_SEARCHES
        first, further = next(
            (first, further)
            for longest, largest, first, further in searches
            if self.limit <= longest and pixels <= largest
        )
        if start_steps:
            first, further = start_steps, 0
        trials: dict[int, EncodedTrial] = {}
        for i in range(len(first) + further):
            step = first[i] if i < len(first) else next_step({tried: trial.error for tried, trial in trials.items()})
            side = replace(sent, start_step=step, extra_planes=extra_planes(targets.targets, step))
            trials[step] = self.write(targets, side)
        return min(trials.values(), key=lambda trial: trial.error)


def next_step(errors: dict[int, int]) -> int:
    """Return the start step to try next: a neighbour of the best one, on the side with the smaller error if known.

    The steps form a circle: eight of them halve the threshold. The error is similar to a wave over them.
    """
    count = len(START_THRESHOLDS)
    by_error = sorted(errors, key=lambda step: (errors[step], step))
    for step in by_error:
        untried = [side for side in ((step - 1) % count, (step + 1) % count) if side not in errors]
        if untried:
            return min(untried, key=lambda side: _mean_of_neighbours(errors, side, count))
    return by_error[0]


def _mean_of_neighbours(errors: dict[int, int], step: int, count: int) -> int:
    values = [errors[n] for n in ((step - 1) % count, (step + 1) % count) if n in errors]
    return sum(values) // len(values)


def structural_similarity(original: I64, decoded: I64) -> int:
    """Return the structural similarity at a half and a quarter of the size, weighted about as by MS-SSIM.

    Both images: shape (height_px, width_px), int64, grey 0..255.
    """
    a, b = _block_sums(original), _block_sums(decoded)
    half = _mean_similarity(a, b, 4)
    quarter = _mean_similarity(_block_sums(a), _block_sums(b), 16, with_luminance=True)
    return max(half, 1) * max(quarter, 1)


def _block_sums(plane: I64) -> I64:
    height, width = plane.shape[0] // 2, plane.shape[1] // 2
    return np.asarray(plane[: 2 * height, : 2 * width].reshape(height, 2, width, 2).sum((1, 3)), np.int64)


def _blurred(plane: I64) -> I64:
    """Apply a binomial window of 9 x 9 taps, standard deviation 1.4, gain 65536; edges repeat."""
    for _ in range(2):  # along the columns, then along the rows
        length = plane.shape[0]
        padded = np.pad(plane, ((4, 4), (0, 0)), mode="edge")
        plane = sum((tap * padded[k : k + length] for k, tap in enumerate(_TAPS)), np.zeros_like(plane)).T
    return plane


def _mean_similarity(a: I64, b: I64, unit: int, *, with_luminance: bool = False) -> int:
    """Return the mean structural similarity, times 2^14, of images in 1/`unit` grey."""
    p, q = _blurred(a), _blurred(b)
    # In units of a squared mean (weights of 2^16, see below) and of 2^32 times a variance.
    c1, c2 = (_SSIM_C1 * unit * unit) >> 2, (_SSIM_C2 * unit * unit) << 16
    variances = (_blurred(a * a + b * b) << 16) - p * p - q * q
    covariance = 2 * ((_blurred(a * b) << 16) - p * q)
    similarity = (covariance + c2) // (((variances + c2) >> 14) + 1)
    if with_luminance:
        p, q = p >> 9, q >> 9
        similarity = similarity * ((2 * p * q + c1) // (((p * p + q * q + c1) >> 14) + 1)) >> 14
    return int(similarity.sum() // similarity.size)


MIN_BODY_BYTES: Final = 3
_PRICE: Final = 20
"""Least squared error, in 1/256 of the squared threshold, that a bit must remove; see `kernel.code_band`."""


@dataclass(frozen=True)
class EmbCodec:
    """The embedded codec. Implements `sonarpost.codec.Codec`. Decodes the streams of all shipped models.

    Attributes:
        model: Model that encodes: "standard" (least squared error), "structure" (structural similarity), or a trained
            model.
        strength: Strength of despeckling, 0..1, rounded to 1/16; 0 codes the image as it is (see `despeckle`).
        start_steps: Start steps to try; empty: see `SEARCHES`.

    Raises:
        ConfigError: No model has this name, or the strength is outside 0..1.
    """

    model: str | Model = DEFAULT_MODEL
    strength: float = 0.0
    start_steps: tuple[int, ...] = ()
    name: ClassVar[str] = NAME

    def __post_init__(self) -> None:
        object.__setattr__(self, "strength", check_strength(self.strength))
        _ = self.network  # rejects an unknown name at once

    @cached_property
    def network(self) -> Model:
        """The model that encodes."""
        if isinstance(self.model, str):
            return shipped_model(self.model, despeckled=self.strength > 0)
        return replace(self.model, sends_strength=self.strength > 0)

    @property
    def codec_id(self) -> int:
        """Codec id in the stream header."""
        return _codec_id_of(self.network)

    @property
    def model_hash(self) -> str:
        """SHA-256 of the model file."""
        return self.network.identity

    def encode(self, image: SnippetPixels, budget_bytes: int | None = None) -> bytes:
        """Return the stream (see `Codec.encode`); without a budget, 1/25 byte a pixel and at least 64 bytes."""
        header, best = self.best_trial(image, budget_bytes)
        return header.pack() + best.body

    def best_trial(
        self,
        image: SnippetPixels,
        budget_bytes: int | None = None,
        *,
        region: RegionOfInterest | None = None,
        texture: tuple[int, ...] | None = None,
    ) -> tuple[StreamHeader, EncodedTrial]:
        """Return header and body of the stream of a snippet.

        Args:
            image: As for `encode`.
            budget_bytes: As for `encode`.
            region: Region of interest, which gets more of the bits. Costs 2 bytes.
            texture: Strength of the image's texture in each band, 0..15. Costs 4 bytes.

        Raises:
            StreamError: As for `encode`.
        """
        original, header = encoder_input(self, image)
        grey = despeckled(original, self.strength)
        budget = max(64, grey.size // 25) if budget_bytes is None else budget_bytes
        limit = min(budget - header.size, MAX_BODY_BYTES)
        if limit < MIN_BODY_BYTES:
            raise StreamError("codec emb", "budget_bytes", budget, f"at least {header.size + MIN_BODY_BYTES} B")
        mean_index = min((int(grey.astype(np.int64).sum()) // grey.size + MEAN_STEP // 2) // MEAN_STEP, 63)
        targets = _targets(grey, mean_index * MEAN_STEP, region, limit, self.network)
        encoder = TrialEncoder(self.network, limit, _PRICE)
        sent = SideInfo(mean_index, 0, region, texture, strength=round(self.strength * STRENGTH_STEPS))
        return header, encoder.best(targets, sent, self.start_steps)

    def extend(self, stream: bytes, image: SnippetPixels, budget_bytes: int) -> bytes:
        """Return a longer stream of the same snippet (see `ExtensibleCodec.extend`)."""
        grey, _ = encoder_input(self, image)
        model, header = model_of_stream(stream, self.network)
        if grey.shape != (header.height_px, header.width_px):
            raise StreamError("image", "shape", grey.shape, f"the stream's {(header.height_px, header.width_px)}")
        state, side = read_body(stream[header.size :], layout_of(header.height_px, header.width_px), model)
        limit = min(budget_bytes - header.size, MAX_BODY_BYTES)
        if side.start_step < 0 or limit < len(stream) - header.size:
            return stream
        grey = despeckled(grey, side.strength / STRENGTH_STEPS)
        targets = _targets(grey, side.mean, side.region, limit, model)
        targets = replace(targets, targets=constrained_targets(targets.targets, state, side))
        encoder = TrialEncoder(model, limit, price=0, prefix=stream[header.size : -1])
        longer = header.pack() + encoder.write(targets, side).body
        return longer if len(longer) > len(stream) and longer.startswith(stream[:-1]) else stream

    def decode(self, stream: bytes, received: Mask | None = None) -> DecodedImage:
        """Reconstruct the image from the bytes before the first gap (see `Codec.decode`).

        A truncated body gives a coarser image without missing pixels.
        """
        model, header = model_of_stream(stream, self.network)
        body, notes = before_gap(stream[header.size :], received)
        state, side = read_body(body, layout_of(header.height_px, header.width_px), model)
        if side.mean_index < 0:
            return DecodedImage.all_missing(header, [*notes, "too few bytes arrived for an image"])
        known = side.start_step >= 0 or not model.sends_strength
        strength = side.strength / STRENGTH_STEPS if known else None
        return DecodedImage.without_gaps(decoded_image(state, side, model), notes, strength)


def _codec_id_of(model: Model) -> int:
    codec_ids = DESPECKLED_CODEC_IDS if model.sends_strength else CODEC_IDS
    return codec_ids["standard" if model.perceptual is None else "structure"]


def _targets(grey: Image, mean: int, region: RegionOfInterest | None, limit: int, model: Model) -> TargetCoefficients:
    layout = layout_of(*grey.shape)
    plane = (grey.astype(np.int64) - mean) * transform.UNIT
    return target_coefficients(plane, layout, region_weights(layout, region), limit, model.perceptual)


def model_of_stream(stream: bytes, own: Model) -> tuple[Model, StreamHeader]:
    """Return the model of a stream and the stream's header.

    Raises:
        StreamError: The header is invalid, or the stream belongs to another codec or an unknown model.
    """
    header = StreamHeader.unpack(stream)
    despeckled_stream = header.codec_id in DESPECKLED_CODEC_IDS.values()
    codec_ids = DESPECKLED_CODEC_IDS if despeckled_stream else CODEC_IDS
    name = next((name for name, codec_id in codec_ids.items() if codec_id == header.codec_id), None)
    if name is None:
        known = (*CODEC_IDS.values(), *DESPECKLED_CODEC_IDS.values())
        expected = " or ".join(f"{codec_id:#04x}" for codec_id in known)
        raise StreamError("stream", "codec_id", f"{header.codec_id:#04x}", f"{expected} ({NAME})")
    models = [shipped_model(name, despeckled=despeckled_stream)]
    if header.codec_id == _codec_id_of(own):
        models.insert(0, own)
    for model in models:
        if header.model_tag == model_tag(header.codec_id, model.identity):
            return model, header
    tags = ", ".join(f"{model_tag(header.codec_id, model.identity):#04x}" for model in models)
    expected = f"{tags}: the stream was made with a model that this release does not have"
    raise StreamError("stream", "model_tag", f"{header.model_tag:#04x}", expected)
