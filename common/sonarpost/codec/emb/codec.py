"""The embedded codec: a stream that is a picture at every length.

Body: side information, then the wavelet coefficients plane by plane, all through one range coder. Cut anywhere, it
decodes to the picture that its bytes determine, and to nothing that they do not.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb import CODEC_ID, NAME, STRUCTURE_ID, STRUCTURE_NAME, transform
from sonarpost.codec.emb.bitplanes import held
from sonarpost.codec.emb.coder import State, error_by_length
from sonarpost.codec.emb.decode import DecodedCoefficients, picture_of, plain_of, read_body, usable
from sonarpost.codec.emb.layout import layout
from sonarpost.codec.emb.model import Model, all_shipped, all_structure, shipped
from sonarpost.codec.emb.rate_distortion_opt import target_coefficients
from sonarpost.codec.emb.region import fill_unknown, weights
from sonarpost.codec.emb.search import MAX_BODY_BYTES, TrialEncoder
from sonarpost.codec.emb.side_info import MEAN_STEP, Box, SideInfo
from sonarpost.codec.emb.speckle_synthesis import measure_speckle, synthesise_speckle
from sonarpost.codec.interface import DecodedImage, Image, Mask, StreamHeader, check_image, model_tag, to_uint8
from sonarpost.errors import StreamError

MIN_BODY_BYTES: Final = 3
_PRICE: Final = 20
"""Least error, in 1/256 of the squared threshold, that a bit must take away; see `kernel.code_band`."""


@dataclass(frozen=True, eq=False)
class Encoded:
    """A stream and how good each of its prefixes is.

    Attributes:
        stream: Header and body.
        mean_square_error: Shape (len(stream) + 1,), float64: estimated mean squared error in grey values of the picture
            that the first n bytes decode to. From the coefficients: clipping to 0..255 and the enhancer make the true
            one some per cent smaller; with a region of interest its error weighs 9/4. Infinite where there is no
            picture yet.
    """

    stream: bytes
    mean_square_error: npt.NDArray[np.float64]


@dataclass(frozen=True)
class EmbCodec:
    """The embedded codec. Satisfies `sonarpost.codec.interface.Codec`.

    Attributes:
        model: The networks that encode; those that the package encodes with if not given. Streams of the package's
            earlier models are decoded with theirs.
        grain: Whether streams say how strong the picture's texture is (4 bytes); see `decode_grain`.
        steps: Start steps to try; none: as many as the time allows, see `search.SEARCHES`.
        price: See `kernel.code_band`.
    """

    model: Model = field(default_factory=shipped)
    grain: bool = False
    steps: tuple[int, ...] = ()
    price: int = _PRICE

    @property
    def name(self) -> str:
        """Name in the registry."""
        return NAME if self.model.aim is None else STRUCTURE_NAME

    @property
    def codec_id(self) -> int:
        """Number in the stream header."""
        return CODEC_ID if self.model.aim is None else STRUCTURE_ID

    @property
    def model_hash(self) -> str:
        """Sha256 of the model file."""
        return self.model.identity

    def encode(self, image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16], budget_bytes: int | None = None) -> bytes:
        """Return header and body.

        Args:
            image: Shape (16..512, 16..512), uint8 or uint16 (uint16 is mapped to 8 bits by `to_uint8`).
            budget_bytes: Length of the whole stream; None for a twenty-fifth of a byte a pixel, at least 64 bytes.

        Raises:
            StreamError: Size or dtype is not supported, or the budget leaves less than 3 bytes of body.
        """
        return self.encode_with_estimate(image, budget_bytes).stream

    def encode_with_estimate(
        self,
        image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16],
        budget_bytes: int | None = None,
        *,
        box: Box | None = None,
        known: Mask | None = None,
    ) -> Encoded:
        """Encode, and say what each prefix is worth (for the choice of what to protect how well).

        Args:
            image: As `encode`.
            budget_bytes: As `encode`.
            box: Region of interest, which gets more of the bits; costs 2 bytes.
            known: Same shape as the image, False where the survey has no data: what is there is not sent.

        Raises:
            StreamError: As `encode`, or `known` has another shape.
        """
        check_image(image)
        picture = to_uint8(image)
        if known is not None:
            picture = fill_unknown(picture, known)
        height_px, width_px = (int(n) for n in picture.shape)
        header = StreamHeader(self.codec_id, model_tag(self.codec_id, self.model.identity), height_px, width_px)
        budget = max(64, height_px * width_px // 25) if budget_bytes is None else budget_bytes
        limit = min(budget - header.size, MAX_BODY_BYTES)
        if limit < MIN_BODY_BYTES:
            raise StreamError("codec emb", "budget_bytes", budget, f"at least {header.size + MIN_BODY_BYTES} B")
        lay = layout(height_px, width_px)
        mean_index = min((int(picture.astype(np.int64).sum()) // picture.size + MEAN_STEP // 2) // MEAN_STEP, 63)
        plane = (picture.astype(np.int64) - mean_index * MEAN_STEP) * transform.UNIT
        wanted = target_coefficients(plane, lay, weights(lay, box), limit, self.model.aim)
        grain = measure_speckle(picture, lay) if self.grain else None
        written = TrialEncoder(self.model, limit, self.price).best(wanted, mean_index, box, grain, self.steps)
        estimate = error_by_length(written.curve, len(written.body), header.size, picture.size)
        return Encoded(header.pack() + written.body, estimate)

    def extend(
        self,
        stream: bytes,
        image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16],
        budget_bytes: int,
        *,
        known: Mask | None = None,
    ) -> bytes:
        """Return a longer stream of the picture that begins as `stream` does, but for its last byte.

        Args:
            stream: Of this picture.
            image: The picture, as `encode` had it.
            budget_bytes: Length of the longer stream.
            known: As `encode_with_estimate` had it.

        Returns:
            The longer stream; `stream` itself where there is none: it said all there is to say.

        Raises:
            StreamError: As `encode` and `decode`; the picture has another size than the stream says.
        """
        check_image(image)
        model, header = self._model_of(stream)
        picture = to_uint8(image) if known is None else fill_unknown(to_uint8(image), known)
        if picture.shape != (header.height_px, header.width_px):
            raise StreamError("image", "shape", picture.shape, f"the stream's {(header.height_px, header.width_px)}")
        state, side = read_body(stream[header.size :], layout(header.height_px, header.width_px), model)
        limit = min(budget_bytes - header.size, MAX_BODY_BYTES)
        if side.step < 0 or limit < len(stream) - header.size:
            return stream
        plane = (picture.astype(np.int64) - side.mean) * transform.UNIT
        wanted = target_coefficients(plane, state.lay, weights(state.lay, side.box), limit, model.aim)
        wanted = replace(wanted, targets=held(wanted.targets, state, side))
        longer = header.pack() + TrialEncoder(model, limit, 0, stream[header.size : -1]).write(wanted, side).body
        return longer if len(longer) > len(stream) and longer.startswith(stream[:-1]) else stream

    def decode(self, stream: bytes, received: Mask | None = None) -> DecodedImage:
        """Rebuild the picture from as much of the stream as is there.

        Args:
            stream: Header and body; a body that ends early gives a coarser picture.
            received: Shape (body bytes in `stream`,), False where a body byte did not arrive; what follows the first
                of them cannot be used.

        Raises:
            StreamError: The header is wrong, or the stream is of another codec or model.
        """
        model, header = self._model_of(stream)
        body, notes = usable(stream[header.size :], received)
        state, side = read_body(body, layout(header.height_px, header.width_px), model)
        if side.mean_index < 0:
            blank = np.zeros((header.height_px, header.width_px), np.uint8)
            return DecodedImage(blank, np.ones(blank.shape, np.bool_), (*notes, "too little arrived for any picture"))
        picture = picture_of(state, side, model)
        return DecodedImage(picture, np.zeros(picture.shape, np.bool_), notes)

    def decode_grain(self, stream: bytes) -> npt.NDArray[np.int16]:
        """Return the layer of invented speckle that the picture lacks, in grey to be added; see `grain.make_grain`.

        Raises:
            StreamError: As `decode`, or the stream carries no grain.
        """
        model, state, side = self._known(stream)
        if side.grain is None:
            raise StreamError("stream", "grain", None, "a stream made by a codec with grain on")
        return synthesise_speckle(picture_of(state, side, model), state.lay, side.grain)

    def decode_with_grain(self, stream: bytes) -> Image:
        """Return the picture with grain at half strength: a view for the eye, not to be measured on.

        Raises:
            StreamError: As `decode_grain`.
        """
        layer = self.decode_grain(stream).astype(np.int32)
        return np.clip(self.decode(stream).image + (layer >> 1), 0, 255).astype(np.uint8)

    def decode_plain(self, stream: bytes) -> DecodedCoefficients:
        """Return the picture as the coefficients say, before the enhancer: what that is trained on.

        Raises:
            StreamError: As `decode`, or the stream is too short for any picture.
        """
        model, state, side = self._known(stream)
        if side.mean_index < 0:
            raise StreamError("stream", "length", len(stream), "enough bytes for a mean level")
        return plain_of(state, side, model)

    def read_state(self, stream: bytes) -> tuple[State, SideInfo]:
        """Return what a stream says of the coefficients, and its side information.

        Raises:
            StreamError: As `decode`.
        """
        _, state, side = self._known(stream)
        return state, side

    def _known(self, stream: bytes) -> tuple[Model, State, SideInfo]:
        model, header = self._model_of(stream)
        return model, *read_body(stream[header.size :], layout(header.height_px, header.width_px), model)

    def _model_of(self, stream: bytes) -> tuple[Model, StreamHeader]:
        """The model that a stream was made with, and the stream's header."""
        header = StreamHeader.unpack(stream)
        if header.codec_id != self.codec_id:
            expected = f"{self.codec_id:#04x} ({self.name})"
            raise StreamError("stream", "codec_id", f"{header.codec_id:#04x}", expected)
        others = all_shipped() if self.model.aim is None else all_structure()
        for model in (self.model, *others):
            if header.model_tag == model_tag(self.codec_id, model.identity):
                return model, header
        tag = model_tag(self.codec_id, self.model.identity)
        expected = f"{tag:#04x}: the stream was made with a model that is not at hand"
        raise StreamError("stream", "model_tag", f"{header.model_tag:#04x}", expected)
