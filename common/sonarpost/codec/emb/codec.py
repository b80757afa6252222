"""The embedded codec: a stream that is a picture at every length.

Body: flags, start step and mean level, then the wavelet coefficients plane by plane, all through one range coder.
Cut anywhere, it decodes to the picture that its bytes determine, and to nothing that they do not.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb import kernel, transform
from sonarpost.codec.emb.layout import Layout, layout
from sonarpost.codec.emb.model import Model, shipped
from sonarpost.codec.emb.planes import STEPS, Coder, State, code_planes, known_plane
from sonarpost.codec.interface import Decoded, Image, Mask, StreamHeader, check_image, model_tag, to_uint8
from sonarpost.errors import StreamError

CODEC_ID: Final = 0x20
NAME: Final = "emb"
MEAN_STEP: Final = 4
MIN_BODY_BYTES: Final = 3
MAX_BODY_BYTES: Final = 0xFFFF
_TRY_STEPS: Final = (0, 2, 4, 6)
_PRICES: Final = (20,)


@dataclass(frozen=True, eq=False)
class Encoded:
    """A stream and how good each of its prefixes is.

    Attributes:
        stream: Header and body.
        mean_square_error: Shape (len(stream) + 1,), float64: estimated mean squared error in grey values of the picture
            that the first n bytes decode to. From the coefficients; clipping to 0..255 makes the true one a little
            smaller. Infinite where there is no picture yet.
    """

    stream: bytes
    mean_square_error: npt.NDArray[np.float64]


@dataclass(frozen=True)
class EmbCodec:
    """The embedded codec. Satisfies `sonarpost.codec.interface.Codec`."""

    model: Model = field(default_factory=shipped)
    prices: tuple[int, ...] = _PRICES
    steps: tuple[int, ...] = _TRY_STEPS

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
        self, image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16], budget_bytes: int | None = None
    ) -> Encoded:
        """Encode like `encode`, and say what each prefix is worth (for the choice of what to protect how well)."""
        check_image(image)
        picture = to_uint8(image)
        height_px, width_px = (int(n) for n in picture.shape)
        header = StreamHeader(CODEC_ID, model_tag(CODEC_ID, self.model.identity), height_px, width_px)
        budget = max(64, height_px * width_px // 25) if budget_bytes is None else budget_bytes
        limit = min(budget - header.size, MAX_BODY_BYTES)
        if limit < MIN_BODY_BYTES:
            raise StreamError("codec emb", "budget_bytes", budget, f"at least {header.size + MIN_BODY_BYTES} B")
        lay = layout(height_px, width_px)
        mean_index = min(max((int(picture.astype(np.int64).sum()) // picture.size + 2) // MEAN_STEP, 0), 63)
        plane = (picture.astype(np.int64) - mean_index * MEAN_STEP) * transform.UNIT
        targets = transform.to_flat(transform.forward(plane, lay), lay)
        written = [self._write(targets, lay, s, mean_index, p, limit) for p in self.prices for s in self.steps]
        body, curve = min(written, key=lambda found: int(found[1][0]))
        stream = header.pack() + body
        return Encoded(stream, _estimate(curve, len(body), header.size, picture.size))

    def _write(
        self, targets: npt.NDArray[np.int32], lay: Layout, step: int, mean_index: int, price: int, limit: int
    ) -> tuple[bytes, npt.NDArray[np.int64]]:
        """Encode with one choice of parameters: return the body, and the squared error that stays by bytes."""
        coder, state = Coder.writer(limit), State(lay)
        coder.curve[0] = int((targets.astype(np.int64) ** 2).sum())
        _code_start(coder, self.model, step, mean_index)
        coder.curve[1 + (int(coder.words[kernel.CODER_COST]) >> 11)] = coder.curve[0]
        code_planes(coder, state, self.model, targets, step, mean_index * MEAN_STEP, price)
        kernel.finish_writing(coder.words, coder.data, coder.good)
        length = int(coder.words[kernel.CODER_GOOD_LENGTH])
        return coder.good[:length].tobytes(), coder.curve

    def decode(self, stream: bytes, received: Mask | None = None) -> Decoded:
        """Rebuild the picture from as much of the stream as is there.

        Args:
            stream: Header and body; a body that ends early gives a coarser picture.
            received: Shape (body bytes in `stream`,), False where a body byte did not arrive; what follows the first
                of them cannot be used.

        Raises:
            StreamError: The header is wrong, or the stream is of another codec or model.
        """
        header = self._check_header(stream)
        body, notes = _usable(stream[header.size :], received)
        state, _, mean_index = self._read(body, layout(header.height_px, header.width_px))
        if mean_index < 0:
            blank = np.zeros((header.height_px, header.width_px), np.uint8)
            return Decoded(blank, np.ones(blank.shape, np.bool_), (*notes, "too little arrived for any picture"))
        picture = self._picture(state, mean_index)
        return Decoded(picture, np.zeros(picture.shape, np.bool_), notes)

    def read_state(self, stream: bytes) -> tuple[State, int, int]:
        """Return what a stream says of the coefficients, the start step and the mean index (-1 where unknown).

        Raises:
            StreamError: As `decode`.
        """
        header = self._check_header(stream)
        return self._read(stream[header.size :], layout(header.height_px, header.width_px))

    def _check_header(self, stream: bytes) -> StreamHeader:
        header = StreamHeader.unpack(stream)
        if header.codec_id != CODEC_ID:
            raise StreamError("stream", "codec_id", f"{header.codec_id:#04x}", f"{CODEC_ID:#04x} (emb)")
        tag = model_tag(CODEC_ID, self.model.identity)
        if header.model_tag != tag:
            expected = f"{tag:#04x}: the stream was made with another model"
            raise StreamError("stream", "model_tag", f"{header.model_tag:#04x}", expected)
        return header

    def _read(self, body: bytes, lay: Layout) -> tuple[State, int, int]:
        coder, state = Coder.reader(body), State(lay)
        step, mean_index = _code_start(coder, self.model, 0, 0)
        if step >= 0:
            code_planes(coder, state, self.model, np.zeros(lay.cells, np.int32), step, mean_index * MEAN_STEP)
        return state, step, mean_index

    def _picture(self, state: State, mean_index: int) -> Image:
        plane, _ = transform.inverse(known_plane(state, self.model), state.lay)
        grey = (plane + transform.UNIT // 2) // transform.UNIT + mean_index * MEAN_STEP
        return np.clip(grey, 0, 255).astype(np.uint8)


def _estimate(
    curve: npt.NDArray[np.int64], body_bytes: int, header_bytes: int, pixels: int
) -> npt.NDArray[np.float64]:
    """Mean squared error by stream length, from the coder's record of squared error by bytes begun."""
    out = np.full(header_bytes + body_bytes + 1, np.inf)
    last = np.inf
    for n in range(body_bytes + 1):
        # What was coded within the first n bytes; the coder's record n + 1 is of the byte begun after them.
        if n < len(curve) - 1 and n > 0 and curve[n] >= 0:
            last = float(curve[n]) / transform.UNIT**2 / pixels
        out[header_bytes + n] = last
    return out


def _code_start(coder: Coder, model: Model, step: int, mean_index: int) -> tuple[int, int]:
    """Write or read mean level and start step. Returns (step, mean index), -1 for what the bytes do not tell."""
    node = 1
    for place in range(5, -1, -1):
        bit = coder.plain(mean_index >> place & 1, int(model.mean_tree[node]))
        if bit < 0:
            return -1, -1
        node = 2 * node + bit
    found = 0
    for place in (2, 1, 0):
        bit = coder.plain(step >> place & 1)
        if bit < 0:
            return -1, node - 64
        found = 2 * found + bit
    return found, node - 64


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
