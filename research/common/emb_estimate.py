"""What `emb` knows of a stream beyond its image: the error of each prefix, and the image before the enhancer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb import transform
from sonarpost.codec.emb.codec import EmbCodec, model_of_stream
from sonarpost.codec.emb.decode import DecodedCoefficients, image_before_enhancer, read_body
from sonarpost.codec.emb.kernel import I64
from sonarpost.codec.emb.side_info import RegionOfInterest
from sonarpost.codec.emb.transform import layout_of
from sonarpost.codec.interface import Image
from sonarpost.errors import StreamError


@dataclass(frozen=True, eq=False)
class Encoded:
    """A stream with an estimate of the error of each of its prefixes.

    Attributes:
        stream: Header and body.
        mean_square_error: Shape (len(stream) + 1,), float64: estimated mean squared error, in grey levels squared, of
            the image that the first n bytes decode to; infinite for prefixes without an image. It is computed from the
            coefficients: clipping and the enhancer reduce the true error by some per cent. The reference is the
            despeckled image if the codec despeckles. With a region of interest, the error in it weighs 9/4.
    """

    stream: bytes
    mean_square_error: npt.NDArray[np.float64]


def encode_with_estimate(
    codec: EmbCodec, image: Image, budget_bytes: int, *, region: RegionOfInterest | None = None
) -> Encoded:
    """Encode an image, and estimate the error of each prefix; with a region of interest, see `EmbCodec.best_trial`."""
    header, best = codec.best_trial(image, budget_bytes, region=region)
    estimate = error_by_length(best.curve, len(best.body), header.size, image.size)
    return Encoded(header.pack() + best.body, estimate)


def error_by_length(curve: I64, body_bytes: int, header_bytes: int, pixels: int) -> npt.NDArray[np.float64]:
    """Return the mean squared error by stream length, from the squared error by number of bytes.

    The squared error is `Coder.curve`.

    Returns:
        Shape (header_bytes + body_bytes + 1,), grey squared; infinite for lengths without an image.
    """
    out = np.full(header_bytes + body_bytes + 1, np.inf)
    error = np.inf
    for length in range(body_bytes + 1):
        # Record n + 1 of the curve is for the byte started after the first n.
        if 0 < length < len(curve) - 1 and curve[length] >= 0:
            error = float(curve[length]) / transform.UNIT**2 / pixels
        out[header_bytes + length] = error
    return out


def decode_before_enhancer(codec: EmbCodec, stream: bytes) -> DecodedCoefficients:
    """Return the image before the enhancer, the input for its training.

    Raises:
        StreamError: As for `decode`, or the stream is too short for an image.
    """
    model, header = model_of_stream(stream, codec.network)
    state, side = read_body(stream[header.size :], layout_of(header.height_px, header.width_px), model)
    if side.mean_index < 0:
        raise StreamError("stream", "length", len(stream), "enough bytes for a mean level")
    return image_before_enhancer(state, side, model)
