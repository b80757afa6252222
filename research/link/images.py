"""Pictures of the link bench: coded once, decoded and judged at any length, each length once."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.codec.interface import Image, Mask
from sonarpost.codec.quality import psnr_db, ssim
from sonarpost.codec.vq.codebook import DEFAULT_TILE_PX, load_default
from sonarpost.codec.vq.codec import IndexPacking, VqCodec
from sonarpost.link.frames.contact_record import ContactSummary

PSNR_LIMIT_DB: Final = 60.0
GREY: Final = 128
"""What is shown, and judged, where nothing of a picture arrived."""


@dataclass(frozen=True, slots=True)
class Quality:
    """How good a picture is.

    Attributes:
        psnr: In dB, 60 at most.
        ssim: -1..1.
    """

    psnr: float
    ssim: float


def judge(original: Image, shown: Image) -> Quality:
    """Compare what is shown with the original."""
    return Quality(min(psnr_db(original, shown), PSNR_LIMIT_DB), ssim(original, shown))


@dataclass(eq=False)
class LinkPicture:
    """A picture to send.

    Attributes:
        pixels: The original.
        contact: The record that goes with it.
        stream: Embedded stream, long enough for every scheme.
        mean_square_error: The codec's estimate by length.
        paper_stream: The paper's codec's stream, 10 x 10 px tiles in 14-bit indices.
    """

    pixels: Image
    contact: ContactSummary
    stream: bytes
    mean_square_error: npt.NDArray[np.float64]
    paper_stream: bytes
    _known: dict[int, Quality] = field(default_factory=dict)

    def quality(self, codec: EmbCodec, length: int) -> Quality:
        """Return how good the picture is that the first `length` bytes give."""
        length = min(length, len(self.stream))
        if length not in self._known:
            is_picture = np.isfinite(self.mean_square_error[length])
            shown = codec.decode(self.stream[:length]).image if is_picture else np.full_like(self.pixels, GREY)
            self._known[length] = judge(self.pixels, shown)
        return self._known[length]


@dataclass(frozen=True, eq=False)
class Codecs:
    """The codecs of the bench."""

    emb: EmbCodec
    paper: VqCodec

    @classmethod
    def shipped(cls) -> Codecs:
        """Make both with what comes with the package."""
        return cls(EmbCodec(), VqCodec(load_default(DEFAULT_TILE_PX[0]).tiles, IndexPacking.BITS14))

    def code(self, pixels: Image, number: int, stream_bytes: int) -> LinkPicture:
        """Encode a picture with both."""
        encoded = self.emb.encode_with_estimate(pixels, stream_bytes)
        height_px, width_px = pixels.shape
        contact = ContactSummary(
            height_px=int(height_px),
            width_px=int(width_px),
            lat_deg=44.0 + number * 1e-4,
            lon_deg=-63.0,
            time_utc_s=1.6e9 + number,
            confidence=1.0,
        )
        return LinkPicture(pixels, contact, encoded.stream, encoded.mean_square_error, self.paper.encode(pixels))

    def paper_quality(self, picture: LinkPicture, stream: bytes, received: Mask | None) -> Quality:
        """Return how good the picture is that the paper's decoder makes: black where a half is missing."""
        return judge(picture.pixels, self.paper.decode(stream, received).image)
