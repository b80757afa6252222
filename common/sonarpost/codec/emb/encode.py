"""The encoder: tries several start steps and returns the body with the smallest error.

The error is the squared error of the image. A perceptual model uses structural similarity instead: Wang, Simoncelli,
Bovik, "Multiscale structural similarity for image quality assessment" (2003), at a half and a quarter of the size,
which have nearly all of the weight, with a binomial window in place of the Gaussian one. Integer arithmetic only, so
that all machines write the same stream.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb import transform
from sonarpost.codec.emb.bitplanes import START_THRESHOLDS, code_planes, extra_planes, reconstructed_coefficients
from sonarpost.codec.emb.coder import Coder, CoefficientState
from sonarpost.codec.emb.decode import grey_of
from sonarpost.codec.emb.kernel import I64
from sonarpost.codec.emb.model import Model
from sonarpost.codec.emb.rate_distortion_opt import TargetCoefficients
from sonarpost.codec.emb.side_info import RegionOfInterest, SideInfo, code_side_info
from sonarpost.codec.interface import MAX_SIDE_PX

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
        mean_index: int,
        region: RegionOfInterest | None,
        texture: tuple[int, ...] | None,
        start_steps: tuple[int, ...] = (),
    ) -> EncodedTrial:
        """Write bodies with several start steps and return the one with the smallest error.

        Without `start_steps`, those of `SEARCHES` are tried.
        """
        pixels = targets.plane.size
        searches = SEARCHES if self.model.perceptual is None else PERCEPTUAL_SEARCHES
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
            side = SideInfo(mean_index, step, region, texture, extra_planes(targets.targets, step))
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
