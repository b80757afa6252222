"""SPIHT: set partitioning in hierarchical trees, one of the four codecs the paper compares.

A. Said, W. A. Pearlman, "A new, fast, and efficient image codec based on set partitioning in hierarchical trees", IEEE
Trans. Circuits and Systems for Video Technology 6(3), 1996, without arithmetic coding. The stream is embedded: cut at
any bit, it decodes to the best picture those bits can give.

The transform is the 9/7 wavelet by lifting (Daubechies and Sweldens, 1998), whole-sample symmetric at the edges, in
fixed-point integers: two machines agree to the last bit. A picture of any size is transformed as it is, unpadded, so
that no bit is spent on pixels nobody sees; trees of odd bands hang their last row and column below the last parent.

Body, most significant bit first: mean grey level / 8 (5 bits); phase (2 bits); highest plane (5 bits); then the
passes, and zero bits to a whole byte. In plane k a coefficient is significant from (4 + phase) * 2**k / 8 grey levels
on. The four phases divide the octave between two planes; with a budget, the encoder takes the one whose picture has the
smallest error, which gains about 0.1 dB.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sonarpost.codec.baselines.spiht_passes import MAX_PLANES, DecoderTests, EncoderTests, EndOfBits, run_passes
from sonarpost.codec.baselines.spiht_wavelet import Forest, Integers, forest_of, inverse, transform
from sonarpost.codec.interface import DecodedImage, Image, Mask, StreamHeader, check_image, received_body, to_uint8
from sonarpost.errors import ConfigError, StreamError

CODEC_ID = 0x04
NATURAL_MAXLOOP = 7  # the paper's larger SPIHT picture in its Fig. 2
_PREFIX_BITS = 12
_MEAN_STEP = 8


@dataclass(frozen=True)
class SpihtCodec:
    """SPIHT without arithmetic coding. Satisfies `sonarpost.codec.interface.Codec`.

    Attributes:
        maxloop: Most bit-plane passes, the paper's option of that name; None for 7 without a budget and for no bound
            with one.

    Raises:
        ConfigError: `maxloop` is out of bounds.
    """

    maxloop: int | None = None

    def __post_init__(self) -> None:
        if self.maxloop is not None and not 1 <= self.maxloop <= MAX_PLANES:
            raise ConfigError("codec spiht", "maxloop", self.maxloop, f"1..{MAX_PLANES}, or none")

    @property
    def name(self) -> str:
        """Name in the registry."""
        return "spiht"

    @property
    def codec_id(self) -> int:
        """Number in the stream header."""
        return CODEC_ID

    @property
    def model_hash(self) -> str:
        """Empty: there is no model."""
        return ""

    def encode(self, image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16], budget_bytes: int | None = None) -> bytes:
        """Return the stream; it may be cut anywhere behind its 12 leading bits of body.

        Args:
            image: Shape (16..512, 16..512), uint8 or uint16 (uint16 is mapped to 8 bits by `to_uint8`).
            budget_bytes: Most bytes of the whole stream. All of them are used unless `maxloop` or the last plane, half
                a grey level, comes first.

        Raises:
            StreamError: Size or dtype is not supported, or the budget leaves the body less than 2 bytes.
        """
        check_image(image)
        grey = to_uint8(image)
        header = StreamHeader(CODEC_ID, 0, grey.shape[0], grey.shape[1]).pack()
        if budget_bytes is not None and budget_bytes < len(header) + 2:
            raise StreamError("codec spiht", "budget_bytes", budget_bytes, f"at least {len(header) + 2} B")
        forest = forest_of(*grey.shape)
        mean = (int(grey.sum(dtype=np.int64)) // grey.size) // _MEAN_STEP
        flat = transform(grey, _MEAN_STEP * mean + _MEAN_STEP // 2, forest)
        if budget_bytes is None:
            return header + _write_body(flat, mean, 0, forest, self.maxloop or NATURAL_MAXLOOP, None)
        loops, length = self.maxloop or MAX_PLANES, budget_bytes - len(header)
        bodies = [_write_body(flat, mean, phase, forest, loops, length) for phase in range(4)]
        errors = [int(((_read_body(body, forest).astype(np.int64) - grey) ** 2).sum()) for body in bodies]
        return header + bodies[errors.index(min(errors))]

    def decode(self, stream: bytes, received: Mask | None = None) -> DecodedImage:
        """Rebuild the picture from the bytes up to the first that did not arrive.

        Every coefficient bears on a wide neighbourhood and the coarse ones come first, so a cut stream gives the whole
        picture, only less sharp: nothing is missing, unless not even the leading 12 bits arrived.

        Args:
            stream: Header and body, cut anywhere.
            received: Shape (body bytes in `stream`,), False where a body byte did not arrive.

        Raises:
            StreamError: The header is wrong, the stream is another codec's, or its highest plane cannot be right.
        """
        header, body, notes = received_body(stream, received, CODEC_ID, self.name)
        if 8 * len(body) < _PREFIX_BITS:
            shape = (header.height_px, header.width_px)
            notes.append(f"{len(body)} B of the body arrived, at least 2 are needed")
            return DecodedImage(np.zeros(shape, np.uint8), np.ones(shape, np.bool_), tuple(notes))
        image = _read_body(body, forest_of(header.height_px, header.width_px))
        return DecodedImage(image, np.zeros(image.shape, np.bool_), tuple(notes))


def _write_body(flat: Integers, mean: int, phase: int, forest: Forest, loops: int, length: int | None) -> bytes:
    """Return a body of at most `length` bytes, of at most `loops` planes."""
    picture = EncoderTests(flat, phase, forest, None if length is None else 8 * length - _PREFIX_BITS)
    top = picture.planes - 1
    with suppress(EndOfBits):
        run_passes(forest, range(top, max(top - loops, -1), -1), picture.tests())
    prefix = f"{mean:05b}{phase:02b}{top:05b}".encode()
    bits = np.concatenate((np.frombuffer(prefix, np.uint8) - ord("0"), np.frombuffer(picture.bits, np.uint8)))
    return np.packbits(bits).tobytes()


def _read_body(body: bytes, forest: Forest) -> Image:
    """Return the picture of a body of at least 2 bytes."""
    bits = np.unpackbits(np.frombuffer(body, np.uint8)).tobytes()
    mean, phase, top = (body[0] >> 3), (body[0] >> 1) & 3, (body[0] & 1) << 4 | body[1] >> 4
    if top >= MAX_PLANES:
        raise StreamError("spiht body", "highest plane", top, f"0..{MAX_PLANES - 1}")
    stream = DecoderTests(bits[_PREFIX_BITS:], forest)
    with suppress(EndOfBits):
        run_passes(forest, range(top, -1, -1), stream.tests())
    return inverse(stream.coefficients(phase), _MEAN_STEP * mean + _MEAN_STEP // 2, forest)
