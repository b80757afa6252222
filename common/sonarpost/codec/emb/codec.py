"""The embedded codec `emb`: every prefix of a stream decodes to an image.

Body: side information, then the wavelet coefficients plane by plane, all through one range coder. A truncated stream
decodes to the image that its bytes determine.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb import CODEC_IDS, DEFAULT_MODEL, NAME, transform
from sonarpost.codec.emb.bitplanes import constrained_targets
from sonarpost.codec.emb.coder import CoefficientState
from sonarpost.codec.emb.decode import DecodedCoefficients, decoded_image, image_before_enhancer, read_body
from sonarpost.codec.emb.encode import MAX_BODY_BYTES, TrialEncoder, error_by_length
from sonarpost.codec.emb.model import Model, shipped_models
from sonarpost.codec.emb.rate_distortion_opt import TargetCoefficients, target_coefficients
from sonarpost.codec.emb.side_info import MEAN_STEP, RegionOfInterest, SideInfo, region_weights
from sonarpost.codec.emb.speckle_synthesis import measure_speckle, synthesise_speckle
from sonarpost.codec.emb.transform import layout_of
from sonarpost.codec.interface import (
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

MIN_BODY_BYTES: Final = 3
_PRICE: Final = 20
"""Least squared error, in 1/256 of the squared threshold, that a bit must remove; see `kernel.code_band`."""


@dataclass(frozen=True, eq=False)
class Encoded:
    """A stream with an estimate of the error of each of its prefixes.

    Attributes:
        stream: Header and body.
        mean_square_error: Shape (len(stream) + 1,), float64: estimated mean squared error, in grey levels squared, of
            the image that the first n bytes decode to; infinite for prefixes without an image. It is computed from the
            coefficients: clipping and the enhancer reduce the true error by some per cent. With a region of interest,
            the error in it weighs 9/4.
    """

    stream: bytes
    mean_square_error: npt.NDArray[np.float64]


@dataclass(frozen=True)
class EmbCodec:
    """The embedded codec. Implements `sonarpost.codec.Codec`. Decodes the streams of all shipped models.

    Attributes:
        model: Model that encodes: "standard" (least squared error), "structure" (structural similarity), or a trained
            model.
        send_texture: Whether streams carry the strength of the image's texture (4 bytes); see `speckle_layer`.
        start_steps: Start steps to try; empty: see `encode.SEARCHES`.
        price: See `kernel.code_band`.

    Raises:
        ConfigError: No model has this name.
    """

    model: str | Model = DEFAULT_MODEL
    send_texture: bool = False
    start_steps: tuple[int, ...] = ()
    price: int = _PRICE
    name: ClassVar[str] = NAME

    def __post_init__(self) -> None:
        _ = self.network  # rejects an unknown name at once

    @cached_property
    def network(self) -> Model:
        """The model that encodes."""
        return shipped_models(self.model)[0] if isinstance(self.model, str) else self.model

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
        return self.encode_with_estimate(image, budget_bytes).stream

    def encode_with_estimate(
        self, image: SnippetPixels, budget_bytes: int | None = None, *, region: RegionOfInterest | None = None
    ) -> Encoded:
        """Encode and estimate the error of each prefix, from which the link computes its redundancy.

        Args:
            image: As for `encode`.
            budget_bytes: As for `encode`.
            region: Region of interest, which gets more of the bits. Costs 2 bytes.

        Raises:
            StreamError: As for `encode`.
        """
        grey, header = encoder_input(self, image)
        budget = max(64, grey.size // 25) if budget_bytes is None else budget_bytes
        limit = min(budget - header.size, MAX_BODY_BYTES)
        if limit < MIN_BODY_BYTES:
            raise StreamError("codec emb", "budget_bytes", budget, f"at least {header.size + MIN_BODY_BYTES} B")
        mean_index = min((int(grey.astype(np.int64).sum()) // grey.size + MEAN_STEP // 2) // MEAN_STEP, 63)
        targets = _targets(grey, mean_index * MEAN_STEP, region, limit, self.network)
        texture = measure_speckle(grey, targets.layout) if self.send_texture else None
        encoder = TrialEncoder(self.network, limit, self.price)
        best = encoder.best(targets, mean_index, region, texture, self.start_steps)
        estimate = error_by_length(best.curve, len(best.body), header.size, grey.size)
        return Encoded(header.pack() + best.body, estimate)

    def extend(self, stream: bytes, image: SnippetPixels, budget_bytes: int) -> bytes:
        """Return a longer stream of the same snippet (see `ExtensibleCodec.extend`)."""
        grey, _ = encoder_input(self, image)
        model, header = _model_of(stream, self.network)
        if grey.shape != (header.height_px, header.width_px):
            raise StreamError("image", "shape", grey.shape, f"the stream's {(header.height_px, header.width_px)}")
        state, side = read_body(stream[header.size :], layout_of(header.height_px, header.width_px), model)
        limit = min(budget_bytes - header.size, MAX_BODY_BYTES)
        if side.start_step < 0 or limit < len(stream) - header.size:
            return stream
        targets = _targets(grey, side.mean, side.region, limit, model)
        targets = replace(targets, targets=constrained_targets(targets.targets, state, side))
        encoder = TrialEncoder(model, limit, price=0, prefix=stream[header.size : -1])
        longer = header.pack() + encoder.write(targets, side).body
        return longer if len(longer) > len(stream) and longer.startswith(stream[:-1]) else stream

    def decode(self, stream: bytes, received: Mask | None = None) -> DecodedImage:
        """Reconstruct the image from the bytes before the first gap (see `Codec.decode`).

        A truncated body gives a coarser image without missing pixels.
        """
        model, header = _model_of(stream, self.network)
        body, notes = before_gap(stream[header.size :], received)
        state, side = read_body(body, layout_of(header.height_px, header.width_px), model)
        if side.mean_index < 0:
            return DecodedImage.all_missing(header, [*notes, "too few bytes arrived for an image"])
        return DecodedImage.without_gaps(decoded_image(state, side, model), notes)

    def speckle_layer(self, stream: bytes) -> npt.NDArray[np.int16]:
        """Return the synthetic speckle that the decoded image lacks, as grey levels to add, shape of the image, int16.

        For viewing, add half of it and clip. Do not measure on the result.

        Raises:
            StreamError: As for `decode`, or the stream carries no texture levels.
        """
        model, state, side = self._read(stream)
        if side.texture is None:
            raise StreamError("stream", "texture", None, "a stream encoded with send_texture")
        return synthesise_speckle(decoded_image(state, side, model), state.layout, side.texture)

    def decode_before_enhancer(self, stream: bytes) -> DecodedCoefficients:
        """Return the image before the enhancer, the input for its training.

        Raises:
            StreamError: As for `decode`, or the stream is too short for an image.
        """
        model, state, side = self._read(stream)
        if side.mean_index < 0:
            raise StreamError("stream", "length", len(stream), "enough bytes for a mean level")
        return image_before_enhancer(state, side, model)

    def _read(self, stream: bytes) -> tuple[Model, CoefficientState, SideInfo]:
        model, header = _model_of(stream, self.network)
        return model, *read_body(stream[header.size :], layout_of(header.height_px, header.width_px), model)


def _codec_id_of(model: Model) -> int:
    return CODEC_IDS["standard" if model.perceptual is None else "structure"]


def _targets(grey: Image, mean: int, region: RegionOfInterest | None, limit: int, model: Model) -> TargetCoefficients:
    layout = layout_of(*grey.shape)
    plane = (grey.astype(np.int64) - mean) * transform.UNIT
    return target_coefficients(plane, layout, region_weights(layout, region), limit, model.perceptual)


def _model_of(stream: bytes, own: Model) -> tuple[Model, StreamHeader]:
    """Return the model of a stream and the stream's header.

    Raises:
        StreamError: The header is invalid, or the stream belongs to another codec or an unknown model.
    """
    header = StreamHeader.unpack(stream)
    name = next((name for name, codec_id in CODEC_IDS.items() if codec_id == header.codec_id), None)
    if name is None:
        expected = " or ".join(f"{codec_id:#04x}" for codec_id in CODEC_IDS.values())
        raise StreamError("stream", "codec_id", f"{header.codec_id:#04x}", f"{expected} ({NAME})")
    models = shipped_models(name)
    if header.codec_id == _codec_id_of(own):
        models = (own, *models)
    for model in models:
        if header.model_tag == model_tag(header.codec_id, model.identity):
            return model, header
    tags = ", ".join(f"{model_tag(header.codec_id, model.identity):#04x}" for model in models)
    expected = f"{tags}: the stream was made with a model that this release does not have"
    raise StreamError("stream", "model_tag", f"{header.model_tag:#04x}", expected)
