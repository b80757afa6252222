"""The embedded codec: a stream that is a picture at every length.

Body: side information, then the wavelet coefficients plane by plane, all through one range coder. Cut anywhere, it
decodes to the picture that its bytes determine, and to nothing that they do not.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb import transform
from sonarpost.codec.emb.coder import Coder, State, error_by_length
from sonarpost.codec.emb.enhance import enhanced
from sonarpost.codec.emb.fit import Wanted, wanted_of
from sonarpost.codec.emb.grain import make_grain, measure_grain
from sonarpost.codec.emb.layout import Layout, layout
from sonarpost.codec.emb.model import Model, all_shipped, shipped
from sonarpost.codec.emb.planes import STEPS, code_planes, extra_planes, held, known_plane, situation
from sonarpost.codec.emb.region import fill_unknown, weights
from sonarpost.codec.emb.side import MEAN_STEP, Box, Side, read_side, write_side
from sonarpost.codec.interface import Decoded, Image, Mask, StreamHeader, check_image, model_tag, to_uint8
from sonarpost.errors import StreamError

I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]

CODEC_ID: Final = 0x20
NAME: Final = "emb"
MIN_BODY_BYTES: Final = 3
MAX_BODY_BYTES: Final = 0xFFFF
_SEARCHES: Final = ((96, (0, 2, 4, 6), 1), (319, (0, 2, 4, 6), 0), (MAX_BODY_BYTES, (0, 4), 2))
"""Up to which budget which start steps are tried, and how many more beside the best of them (`_beside`): as many as
stay within 100 ms for 140 x 80 px."""
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


@dataclass(frozen=True, eq=False)
class Plain:
    """A picture before the enhancer.

    Attributes:
        plane: Shape (height_px, width_px), int64, 1/64 grey, without the mean.
        mean: Grey.
        situation: See `planes.situation`.
    """

    plane: npt.NDArray[np.int64]
    mean: int
    situation: tuple[int, int, int]


@dataclass(frozen=True)
class EmbCodec:
    """The embedded codec. Satisfies `sonarpost.codec.interface.Codec`.

    Attributes:
        model: The networks that encode; those that the package encodes with if not given. Streams of the package's
            earlier models are decoded with theirs.
        grain: Whether streams say how strong the picture's texture is (4 bytes); see `decode_grain`.
        steps: Start steps to try; none: as many as the time allows, see `_SEARCHES`.
        price: See `kernel.code_band`.
    """

    model: Model = field(default_factory=shipped)
    grain: bool = False
    steps: tuple[int, ...] = ()
    price: int = _PRICE

    @property
    def name(self) -> str:
        """Name in the registry."""
        return NAME

    @property
    def codec_id(self) -> int:
        """Number in the stream header."""
        return CODEC_ID

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
        header = StreamHeader(CODEC_ID, model_tag(CODEC_ID, self.model.identity), height_px, width_px)
        budget = max(64, height_px * width_px // 25) if budget_bytes is None else budget_bytes
        limit = min(budget - header.size, MAX_BODY_BYTES)
        if limit < MIN_BODY_BYTES:
            raise StreamError("codec emb", "budget_bytes", budget, f"at least {header.size + MIN_BODY_BYTES} B")
        lay = layout(height_px, width_px)
        mean_index = min((int(picture.astype(np.int64).sum()) // picture.size + MEAN_STEP // 2) // MEAN_STEP, 63)
        plane = (picture.astype(np.int64) - mean_index * MEAN_STEP) * transform.UNIT
        wanted = wanted_of(plane, lay, weights(lay, box), limit)
        grain = measure_grain(picture, lay) if self.grain else None
        steps, more = next((first, more) for most, first, more in _SEARCHES if limit <= most)
        if self.steps:
            steps, more = self.steps, 0
        found: dict[int, tuple[int, bytes, I64]] = {}
        for i in range(len(steps) + more):
            step = steps[i] if i < len(steps) else _beside({at: error for at, (error, _, _) in found.items()})
            side = Side(mean_index, step, box, grain, extra_planes(wanted.targets, step))
            found[step] = self._write(wanted, side, limit, self.price)
        _, body, curve = min(found.values(), key=lambda one: one[0])
        return Encoded(header.pack() + body, error_by_length(curve, len(body), header.size, picture.size))

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
            The longer stream; `stream` itself where there is none: it said all there is to say, or (seldom) the number
            that its bytes write is rounded up across more than a byte.

        Raises:
            StreamError: As `encode` and `decode`; the picture has another size than the stream says.
        """
        check_image(image)
        codec, header = self._reader(stream)
        picture = to_uint8(image) if known is None else fill_unknown(to_uint8(image), known)
        if picture.shape != (header.height_px, header.width_px):
            raise StreamError("image", "shape", picture.shape, f"the stream's {(header.height_px, header.width_px)}")
        state, side = codec._read(stream[header.size :], layout(header.height_px, header.width_px))
        limit = min(budget_bytes - header.size, MAX_BODY_BYTES)
        if side.step < 0 or limit < len(stream) - header.size:
            return stream
        plane = (picture.astype(np.int64) - side.mean) * transform.UNIT
        wanted = wanted_of(plane, state.lay, weights(state.lay, side.box), limit)
        wanted = replace(wanted, targets=held(wanted.targets, state, side))
        _, body, _ = codec._write(wanted, side, limit, price=0)
        longer = header.pack() + body
        return longer if len(longer) > len(stream) and longer.startswith(stream[:-1]) else stream

    def _write(self, wanted: Wanted, side: Side, limit: int, price: int) -> tuple[int, bytes, I64]:
        """Encode with one start step: return the error that stays, the body, and the squared error by bytes."""
        coder, state = Coder.writer(limit), State(wanted.lay)
        coder.curve[0] = int((wanted.plain.astype(np.int64) ** 2).sum())
        write_side(coder, self.model, side)
        coder.record()
        code_planes(coder, state, self.model, wanted.targets, side, price, plain=wanted.plain)
        if side.box is not None:  # its own error weighs more
            return int(coder.curve[0]), coder.finish(), coder.curve
        shown, _ = transform.inverse(known_plane(state, self.model), wanted.lay)
        return int(((wanted.plane - shown) ** 2).sum()), coder.finish(), coder.curve

    def decode(self, stream: bytes, received: Mask | None = None) -> Decoded:
        """Rebuild the picture from as much of the stream as is there.

        Args:
            stream: Header and body; a body that ends early gives a coarser picture.
            received: Shape (body bytes in `stream`,), False where a body byte did not arrive; what follows the first
                of them cannot be used.

        Raises:
            StreamError: The header is wrong, or the stream is of another codec or model.
        """
        codec, header = self._reader(stream)
        body, notes = _usable(stream[header.size :], received)
        state, side = codec._read(body, layout(header.height_px, header.width_px))
        if side.mean_index < 0:
            blank = np.zeros((header.height_px, header.width_px), np.uint8)
            return Decoded(blank, np.ones(blank.shape, np.bool_), (*notes, "too little arrived for any picture"))
        picture = codec._picture(state, side)
        return Decoded(picture, np.zeros(picture.shape, np.bool_), notes)

    def decode_grain(self, stream: bytes) -> npt.NDArray[np.int16]:
        """Return the layer of invented speckle that the picture lacks, in grey to be added; see `grain.make_grain`.

        Raises:
            StreamError: As `decode`, or the stream carries no grain.
        """
        codec, state, side = self._known(stream)
        if side.grain is None:
            raise StreamError("stream", "grain", None, "a stream made by a codec with grain on")
        return make_grain(codec._picture(state, side), state.lay, side.grain)

    def decode_with_grain(self, stream: bytes) -> Image:
        """Return the picture with grain at half strength: a view for the eye, not to be measured on.

        Raises:
            StreamError: As `decode_grain`.
        """
        layer = self.decode_grain(stream).astype(np.int32)
        return np.clip(self.decode(stream).image + (layer >> 1), 0, 255).astype(np.uint8)

    def decode_plain(self, stream: bytes) -> Plain:
        """Return the picture as the coefficients say, before the enhancer: what that is trained on.

        Raises:
            StreamError: As `decode`, or the stream is too short for any picture.
        """
        codec, state, side = self._known(stream)
        if side.mean_index < 0:
            raise StreamError("stream", "length", len(stream), "enough bytes for a mean level")
        return codec._plain(state, side)

    def read_state(self, stream: bytes) -> tuple[State, Side]:
        """Return what a stream says of the coefficients, and its side information.

        Raises:
            StreamError: As `decode`.
        """
        _, state, side = self._known(stream)
        return state, side

    def _known(self, stream: bytes) -> tuple[EmbCodec, State, Side]:
        codec, header = self._reader(stream)
        return codec, *codec._read(stream[header.size :], layout(header.height_px, header.width_px))

    def _reader(self, stream: bytes) -> tuple[EmbCodec, StreamHeader]:
        """The codec with the model that a stream was made with, and the stream's header."""
        header = StreamHeader.unpack(stream)
        if header.codec_id != CODEC_ID:
            raise StreamError("stream", "codec_id", f"{header.codec_id:#04x}", f"{CODEC_ID:#04x} (emb)")
        for model in (self.model, *all_shipped()):
            if header.model_tag == model_tag(CODEC_ID, model.identity):
                return (self if model is self.model else replace(self, model=model)), header
        tag = model_tag(CODEC_ID, self.model.identity)
        expected = f"{tag:#04x}: the stream was made with a model that is not at hand"
        raise StreamError("stream", "model_tag", f"{header.model_tag:#04x}", expected)

    def _read(self, body: bytes, lay: Layout) -> tuple[State, Side]:
        coder, state = Coder.reader(body), State(lay)
        side = read_side(coder, self.model)
        if side.step >= 0:
            code_planes(coder, state, self.model, np.zeros(lay.cells, np.int32), side)
        return state, side

    def _plain(self, state: State, side: Side) -> Plain:
        plane, _ = transform.inverse(known_plane(state, self.model, side.box), state.lay)
        return Plain(plane, side.mean, situation(state, side.mean))

    def _picture(self, state: State, side: Side) -> Image:
        plain = self._plain(state, side)
        plane = enhanced(plain.plane, plain.mean, plain.situation, self.model)
        grey = (plane + transform.UNIT // 2) // transform.UNIT + plain.mean
        return np.clip(grey, 0, 255).astype(np.uint8)


def _beside(errors: dict[int, int]) -> int:
    """The step to try next: beside the best so far, on the side where the error is less, as far as that is known.

    The error is much like a wave over the steps: eight of them halve the threshold, and so come back to the first.
    """
    count = len(STEPS)
    for step in sorted(errors, key=lambda tried: (errors[tried], tried)):
        sides = [(step + way) % count for way in (-1, 1) if (step + way) % count not in errors]
        if sides:
            return min(sides, key=lambda side: _mean([errors[n] for n in _neighbours(side, count) if n in errors]))
    raise StreamError("codec emb", "steps", sorted(errors), f"fewer than all {count}")


def _neighbours(step: int, count: int) -> tuple[int, int]:
    return (step - 1) % count, (step + 1) % count


def _mean(values: list[int]) -> int:
    return sum(values) // len(values)


def _usable(body: bytes, received: Mask | None) -> tuple[bytes, tuple[str, ...]]:
    """The bytes before the first that did not arrive."""
    if received is None:
        return body, ()
    if received.shape != (len(body),):
        raise StreamError("stream", "received", received.shape, f"one value for each of {len(body)} body bytes")
    lost = np.flatnonzero(~received)
    if not lost.size:
        return body, ()
    return body[: lost[0]], (f"{len(body) - int(lost[0])} of {len(body)} bytes are lost or follow a lost one",)
