"""JPEG 2000 (ISO/IEC 15444-1) through OpenJPEG: one of the four codecs the paper compares.

Two codecs with the same coder: single tile, one layer, irreversible 9/7 transform, code-blocks of 64 x 64, resolution
after resolution.

* `jpeg2000` sends the raw codestream, markers and all: about 100 bytes before the first coded bit. Any JPEG 2000
  software reads it. Only OpenJPEG's comment is taken out.
* `jpeg2000-packets` sends the packets alone. Main header, tile header and end follow from the picture's size and the
  parameters above, so the decoder writes them itself. One byte before the packets says how many decompositions
  there are and by how much the picture was brightened: OpenJPEG wants unsigned samples and takes 128 off them, so a
  dark picture would waste its first bits on its mean.

OpenJPEG's target rate does not go below 30 bytes of packets, so the budget is met by a search over its target
quality, in each number of decompositions; the picture nearest to the original is sent.

Nothing in a cut codestream can be relied upon: it is refused, unless the cut is where OpenJPEG finds all packets whole.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from PIL import Image as Pillow

from sonarpost.codec.interface import DecodedImage, Image, Mask, StreamHeader, check_image, received_body, to_uint8
from sonarpost.errors import ConfigError, StreamError

RAW_CODEC_ID = 0x02
PACKETS_CODEC_ID = 0x03
NATURAL_QUALITY_DB = 22.0
MIN_DECOMPOSITIONS = 3
MAX_DECOMPOSITIONS = 6

_SHIFT_STEP = 4
_SEARCH_STEPS = 12
_SEARCH_DB = (1.0, 60.0)
_MANY_PIXELS = 200 * 200  # from here on fewer decompositions than five gain nothing

# Step sizes of the irreversible transform, from the norms of its bands: the lowest band for 3 to 6 decompositions, and
# (HL, LH, HH) of each decomposition, finest first. The standard leaves them to the encoder; these are OpenJPEG's.
_LOWEST_STEPS = {3: 0x6738, 4: 0x6F20, 5: 0x7720, 6: 0x7F20}
_DETAIL_STEPS = (
    (0x57D3, 0x57D3, 0x5762),
    (0x5005, 0x5005, 0x5047),
    (0x6750, 0x6750, 0x6768),
    (0x6F00, 0x6F00, 0x6EE0),
    (0x76F0, 0x76F0, 0x76C0),
    (0x7EE0, 0x7EE0, 0x7EA0),
)
_SOT, _SOD, _EOC = b"\xff\x90", b"\xff\x93", b"\xff\xd9"


def main_header(height_px: int, width_px: int, decompositions: int) -> bytes:
    """Return SOC, SIZ, COD and QCD of every codestream of this module (ISO/IEC 15444-1, annex A)."""
    width, height = width_px.to_bytes(4, "big"), height_px.to_bytes(4, "big")
    origin = bytes(8)
    siz = b"\0\0" + width + height + origin + width + height + origin + b"\0\1" + b"\x07\1\1"  # one component, 8 bits
    cod = b"\0" + b"\0" + b"\0\1" + b"\0" + bytes([decompositions, 4, 4, 0, 0])  # LRCP, one layer, 64 x 64, 9/7
    steps = [_LOWEST_STEPS[decompositions]]
    for detail in reversed(_DETAIL_STEPS[:decompositions]):
        steps += detail
    qcd = b"\x42" + b"".join(step.to_bytes(2, "big") for step in steps)  # two guard bits, a step for each band
    return b"\xff\x4f" + _segment(0x51, siz) + _segment(0x52, cod) + _segment(0x5C, qcd)


def codestream(height_px: int, width_px: int, decompositions: int, packets: bytes) -> bytes:
    """Return the whole codestream around the packets of its one tile."""
    tile = _SOT + b"\0\x0a" + b"\0\0" + (len(packets) + 14).to_bytes(4, "big") + b"\0\1" + _SOD
    return main_header(height_px, width_px, decompositions) + tile + packets + _EOC


def packets_of(stream: bytes, height_px: int, width_px: int) -> tuple[int, bytes]:
    """Return the number of decompositions and the packets of a codestream; the inverse of `codestream`.

    Raises:
        StreamError: It is not a whole codestream of this module's parameters.
    """
    for decompositions in range(MIN_DECOMPOSITIONS, MAX_DECOMPOSITIONS + 1):
        start = len(main_header(height_px, width_px, decompositions)) + 14
        packets = stream[start : -len(_EOC)]
        if stream == codestream(height_px, width_px, decompositions, packets):
            return decompositions, packets
    expected = f"a whole codestream of one tile, {height_px} x {width_px} px, 9/7, 64 x 64 blocks"
    raise StreamError("jpeg2000 body", "codestream", stream, expected)


@dataclass(frozen=True)
class _Candidate:
    """An encoded picture: packets, and how they were made."""

    decompositions: int
    shift: int
    packets: bytes
    error: int


@dataclass(frozen=True)
class Jpeg2000Codec:
    """JPEG 2000, with or without its headers. Satisfies `sonarpost.codec.interface.Codec`.

    Attributes:
        packets_only: Whether only the packets are sent.
        quality_db: PSNR that OpenJPEG aims at when no budget is given.

    Raises:
        ConfigError: `quality_db` is out of bounds.
    """

    packets_only: bool = False
    quality_db: float = NATURAL_QUALITY_DB

    def __post_init__(self) -> None:
        low, high = _SEARCH_DB
        if not low <= self.quality_db <= high:
            raise ConfigError(f"codec {self.name}", "quality_db", self.quality_db, f"{low}..{high}")

    @property
    def name(self) -> str:
        """Name in the registry."""
        return "jpeg2000-packets" if self.packets_only else "jpeg2000"

    @property
    def codec_id(self) -> int:
        """Number in the stream header."""
        return PACKETS_CODEC_ID if self.packets_only else RAW_CODEC_ID

    @property
    def model_hash(self) -> str:
        """Empty: there is no model."""
        return ""

    def encode(self, image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16], budget_bytes: int | None = None) -> bytes:
        """Return the stream.

        Args:
            image: Shape (16..512, 16..512), uint8 or uint16 (uint16 is mapped to 8 bits by `to_uint8`).
            budget_bytes: Most bytes of the whole stream; None for what `quality_db` takes.

        Raises:
            StreamError: Size or dtype is not supported, or the budget cannot be met.
        """
        check_image(image)
        grey = to_uint8(image)
        header = StreamHeader(self.codec_id, 0, grey.shape[0], grey.shape[1]).pack()
        best = min(self._candidates(grey, header, budget_bytes), key=lambda c: c.error, default=None)
        if best is None:
            needed = "a larger budget: not even the coarsest quality fits"
            raise StreamError(f"codec {self.name}", "budget_bytes", budget_bytes, needed)
        return header + self._body(best, grey.shape)

    def decode(self, stream: bytes, received: Mask | None = None) -> DecodedImage:
        """Rebuild the picture.

        Args:
            stream: Header and body.
            received: Shape (body bytes in `stream`,), False where a body byte did not arrive. If what precedes the
                first gap does not decode, the whole picture is black and missing.

        Raises:
            StreamError: The header is wrong, the stream is another codec's, or the codestream is cut or damaged so that
                OpenJPEG refuses it.
        """
        header, body, notes = received_body(stream, received, self.codec_id, self.name)
        shape = (header.height_px, header.width_px)
        try:
            image = self._decode_body(body, shape)
        except StreamError as error:
            if received is None or received.all():
                raise
            notes.append(f"nothing can be decoded: {error}")
            return DecodedImage(np.zeros(shape, np.uint8), np.ones(shape, np.bool_), tuple(notes))
        return DecodedImage(image, np.zeros(shape, np.bool_), tuple(notes))

    def _decode_body(self, body: bytes, shape: tuple[int, int]) -> Image:
        if not self.packets_only:
            packets_of(body, *shape)  # its size is the header's before OpenJPEG makes room for it
            return _decode(body)
        if not body:
            raise StreamError("jpeg2000 body", "length", 0, "at least 1 B")
        decompositions, shift = MIN_DECOMPOSITIONS + (body[0] >> 6), _SHIFT_STEP * ((body[0] & 0x3F) - 32)
        return _shifted(_decode(codestream(*shape, decompositions, body[1:])), -shift)

    def _body(self, chosen: _Candidate, shape: tuple[int, ...]) -> bytes:
        if not self.packets_only:
            return codestream(shape[0], shape[1], chosen.decompositions, chosen.packets)
        parameters = (chosen.decompositions - MIN_DECOMPOSITIONS) << 6 | (chosen.shift // _SHIFT_STEP + 32)
        return bytes([parameters]) + chosen.packets

    def _candidates(self, grey: Image, header: bytes, budget_bytes: int | None) -> Iterator[_Candidate]:
        """Return the best that fits the budget for each way to encode."""
        height_px, width_px = grey.shape
        shifts = {0}
        if self.packets_only:
            centre = (128 - int(grey.sum(dtype=np.int64)) // grey.size) // _SHIFT_STEP
            shifts.add(_SHIFT_STEP * min(max(centre, -32), 31))
        wanted = (5,) if grey.size >= _MANY_PIXELS else (3, 4, 5)
        # OpenJPEG refuses to divide a side below one sample.
        for decompositions in (number for number in wanted if 1 << number <= min(grey.shape)):
            for shift in sorted(shifts):
                around = len(header) + len(self._body(_Candidate(decompositions, shift, b"", 0), grey.shape))
                shifted = _shifted(grey, shift)
                if budget_bytes is None:
                    packets: bytes | None = _encode(shifted, decompositions, self.quality_db)
                else:
                    packets = _search(shifted, decompositions, budget_bytes - around)
                if packets is not None:
                    rebuilt = _shifted(_decode(codestream(height_px, width_px, decompositions, packets)), -shift)
                    error = int(((rebuilt.astype(np.int64) - grey) ** 2).sum())
                    yield _Candidate(decompositions, shift, packets, error)


def _segment(marker: int, content: bytes) -> bytes:
    return bytes([0xFF, marker]) + (len(content) + 2).to_bytes(2, "big") + content


def _shifted(image: Image, shift: int) -> Image:
    return np.asarray(np.clip(image.astype(np.int16) + shift, 0, 255), dtype=np.uint8)


def _search(image: Image, decompositions: int, limit_bytes: int) -> bytes | None:
    """Return the packets of the best quality found that take at most so many bytes, or None."""
    best = None
    low, high = _SEARCH_DB
    for step in range(_SEARCH_STEPS + 1):
        quality_db = low if step == 0 else (low + high) / 2  # the coarsest first: if that does not fit, nothing does
        packets = _encode(image, decompositions, quality_db)
        if len(packets) <= limit_bytes:
            best = packets
            low = quality_db
        elif step == 0:
            return None
        else:
            high = quality_db
    return best


def _encode(image: Image, decompositions: int, quality_db: float) -> bytes:
    """Return the packets that OpenJPEG makes.

    Raises:
        ConfigError: This OpenJPEG writes other parameters than the ones the decoder will assume.
    """
    file = io.BytesIO()
    Pillow.fromarray(image).save(
        file,
        "JPEG2000",
        no_jp2=True,
        irreversible=True,
        num_resolutions=decompositions + 1,
        quality_mode="dB",
        quality_layers=[quality_db],
    )
    stream = _without_comments(file.getvalue())
    try:
        written, packets = packets_of(stream, image.shape[0], image.shape[1])
    except StreamError as error:
        raise ConfigError("OpenJPEG", "codestream", stream[:120].hex(), "the parameters of version 2.5") from error
    if written != decompositions:
        raise ConfigError("OpenJPEG", "decompositions", written, str(decompositions))
    return packets


def _without_comments(stream: bytes) -> bytes:
    """Return the codestream without the comment segments (COM) of its main header."""
    kept, at = [stream[:2]], 2
    while stream[at : at + 2] not in (_SOT, b""):
        end = at + 2 + int.from_bytes(stream[at + 2 : at + 4], "big")
        if stream[at : at + 2] != b"\xff\x64":
            kept.append(stream[at:end])
        at = end
    return b"".join(kept) + stream[at:]


def _decode(stream: bytes) -> Image:
    """Return the picture of a codestream whose main header is this module's.

    Raises:
        StreamError: OpenJPEG refuses it.
    """
    try:
        with Pillow.open(io.BytesIO(stream), formats=["JPEG2000"]) as picture:
            return np.array(picture, dtype=np.uint8)
    except Exception as error:  # Pillow raises many types on damaged data, and means one thing
        raise StreamError("jpeg2000 body", "packets", repr(error), "packets that OpenJPEG decodes") from error
