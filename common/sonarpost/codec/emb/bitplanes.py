"""Bit-plane coding of the coefficients, in the same order in encoder and decoder."""

from __future__ import annotations

from typing import Final

import numpy as np

from sonarpost.codec.emb import contexts, kernel, perceptual_weights, transform
from sonarpost.codec.emb.coder import UNIT_SCALE, Coder, CoefficientState
from sonarpost.codec.emb.kernel import I32, I64
from sonarpost.codec.emb.model import Model
from sonarpost.codec.emb.side_info import MAX_EXTRA_PLANES, UNIT_WEIGHT, RegionOfInterest, SideInfo, region_weights
from sonarpost.codec.emb.transform import HEIGHT, HL, LEVEL, LL, OFFSET, ORIENT, STRIDE, WIDTH

# First threshold in coefficient units (1/64 grey) for each start step: from 2880 grey down in steps of 2^(1/8),
# multiples of 2^10 so that halving them ten times is exact.
START_THRESHOLDS: Final = tuple(round(2880 * 64 / 1024 * 2 ** (-i / 8)) * 1024 for i in range(8))
PLANES: Final = 10
NO_MINIMUM: Final = -kernel.LOGIT_LIMIT - 1
PASSES: Final = ((kernel.NEAR, -560), (kernel.ALL, -930), (kernel.REFINE, NO_MINIMUM), (kernel.ALL, NO_MINIMUM))
"""Passes of a plane, with the minimum logit of significance (1/256) of each. Likely coefficients come first, because a
bit for them removes more error. A refinement removes as much as significance with a probability of 1/40."""
_FIRST_PLANE: Final = {1: 3, 2: 2, 3: 1}
"""First plane of a level. Its coefficients rarely exceed twice that threshold; larger ones are clipped to it."""
_FIRST_PLANE_PERCEPTUAL: Final = _FIRST_PLANE | {1: 4}
"""The same for perceptual models, which scale down the finest level."""


def code_planes(
    coder: Coder,
    state: CoefficientState,
    model: Model,
    targets: I32,
    side: SideInfo,
    price: int = 0,
    planes: int = PLANES,
    originals: I32 | None = None,
) -> None:
    """Write, read or collect plane after plane until the coder stops.

    Args:
        coder: The range coder.
        state: State of the coefficients; modified.
        model: The networks.
        targets: Coefficients to code, flat, int32; ignored when the coder reads.
        side: Side information.
        price: See `kernel.code_band`.
        planes: Maximum number of planes, without the extra ones.
        originals: Coefficients to which `Coder.curve` refers; None: `targets`.
    """
    layout, mean, weights = state.layout, side.mean, model.perceptual
    bands, widths = layout.bands.tolist(), layout.sides[:, 1].tolist()  # Python numbers are ten times faster here
    features = np.zeros(contexts.FEATURES, np.int32)
    insignificant = np.zeros(layout.cells, np.int32)
    originals = targets if originals is None else originals
    scaled = targets if weights is None else perceptual_weights.apply_initial_scales(weights, state, targets)
    arrays = (
        state.lower, state.widths, state.signs, state.sizes, state.signed, state.planes, state.logits, insignificant,
        state.scale,
    )  # fmt: skip
    nets = (model.w1, model.b1, model.w2, model.b2, _last_layer(model))
    sign_nets = (model.sign_w1, model.sign_b1, model.sign_w2)
    tables = (model.probabilities, model.costs, model.centres)
    stream = (coder.words, coder.data, coder.best, coder.curve, originals)
    examples, scratch = (coder.decisions, coder.sign_decisions), kernel.scratch_arrays()
    first_plane = _FIRST_PLANE if weights is None else _FIRST_PLANE_PERCEPTUAL
    for plane in range(-side.extra_planes, planes):
        number = plane + side.extra_planes
        state.threshold = threshold = (START_THRESHOLDS[side.start_step] << side.extra_planes) >> number
        state.update_sizes()
        insignificant[:] = 0
        rows = [i for i, band in enumerate(bands) if plane >= first_plane.get(band[LEVEL], -side.extra_planes)]
        finest = min(bands[i][LEVEL] for i in rows)
        lows = low_pass_images(state, model, side, finest)
        for pass_number, (kind, min_logit) in enumerate(PASSES):
            for row in rows:
                band = bands[row]
                starts_level = pass_number == 0 and band[ORIENT] == HL
                if weights is not None and starts_level and band[LEVEL] in perceptual_weights.ADAPTIVE_LEVELS:
                    perceptual_weights.adapt_scales(weights, state, row, lows, finest, targets, scaled)
                    state.update_sizes()
                if row == 1 and kind != kernel.REFINE:
                    lows = low_pass_images(state, model, side, finest)
                _set_band_features(features, band, threshold, mean, _density(state, band))
                low_width = widths[band[LEVEL]]
                end = kernel.code_band(
                    coder.mode, kind, number + 1, threshold, row, low_width, price, min_logit, layout.bands, scaled,
                    lows, features, arrays, nets, sign_nets, tables, stream, examples, scratch,
                )  # fmt: skip
                if end < 0:
                    return


def constrained_targets(targets: I32, state: CoefficientState, side: SideInfo) -> I32:
    """Return the targets, changed as little as necessary to give the decisions that a stream already holds."""
    first = START_THRESHOLDS[side.start_step] << side.extra_planes
    # The last plane with a decision: if a plane only evaluated the coefficient, the plane before it.
    planes = np.where(state.planes > 0, state.planes - 1, np.maximum(-state.planes - 2, 0))
    limit = np.where(state.planes == 0, first << 1, first >> planes)
    low, high = state.lower, np.where(state.lower > 0, state.lower + state.widths, limit) - 1
    scaled = np.abs(targets.astype(np.int64)) * state.scale // UNIT_SCALE
    clipped = np.clip(scaled, low, high)
    size = np.where(scaled == clipped, np.abs(targets), -(-clipped * UNIT_SCALE // state.scale))
    return (size * np.where(state.lower > 0, state.signs, np.sign(targets))).astype(np.int32)


def extra_planes(targets: I32, start_step: int) -> int:
    """Return the number of planes above the usual first one that the largest coefficient needs."""
    largest, extra = int(np.abs(targets).max()), 0
    while extra < MAX_EXTRA_PLANES and largest >= START_THRESHOLDS[start_step] << (extra + 1):
        extra += 1
    return extra


def low_pass_images(state: CoefficientState, model: Model, side: SideInfo, down_to: int) -> I32:
    """Return the low-pass images of the current reconstruction, in 1/64 grey times 2^level."""
    _, lows = transform.inverse(reconstructed_coefficients(state, model, side.region), state.layout, down_to)
    for level in range(down_to, state.layout.levels + 1):
        start = int(state.layout.low_offsets[level])
        height, width = (int(n) + 2 for n in state.layout.sides[level])
        lows[start : start + height * width] += side.mean * transform.UNIT << level
    return lows


def reconstructed_coefficients(state: CoefficientState, model: Model, region: RegionOfInterest | None = None) -> I64:
    """Return the reconstruction of every coefficient, in the square layout of the transform."""
    flat = np.zeros(state.layout.cells, np.int32)
    kernel.reconstruct(state.lower, state.widths, state.signs, state.logits, model.centres, flat)
    if model.perceptual is not None:
        flat = (flat.astype(np.int64) * UNIT_SCALE // state.scale).astype(np.int32)
    if region is not None:
        flat = (flat * UNIT_WEIGHT // region_weights(state.layout, region)).astype(np.int32)
    return transform.from_flat(flat, state.layout)


def image_features(state: CoefficientState, mean: int) -> tuple[int, int, int]:
    """Return the image features of the enhancer: threshold, mean level, share of significant coefficients."""
    share = 8192 * int(np.count_nonzero(state.lower)) // (state.layout.height_px * state.layout.width_px)
    threshold, level, amount = (contexts.log2_eighths(value) for value in (state.threshold, max(mean, 4), share + 16))
    return threshold - 96, level - 48, amount - 56


def _last_layer(model: Model) -> I64:
    """Return weights and bias of the last layer, 1/2^28, which the kernel adapts."""
    return np.concatenate([model.w3.astype(np.int64) << 16, model.b3[:, None].astype(np.int64) << 8], 1)


def _density(state: CoefficientState, band: list[int]) -> int:
    """Return 8 log2 of the share of significant coefficients of the band, in 1/1024, shifted to about zero."""
    cells = band[HEIGHT] * band[WIDTH]
    start = band[OFFSET] - 2 * band[STRIDE] - 2
    stop = start + (band[HEIGHT] + 4) * band[STRIDE]
    significant = int(np.count_nonzero(state.lower[start:stop]))
    return contexts.log2_eighths((2048 * significant + 512) // (cells + 1) + 1) - 40


def _set_band_features(features: I32, band: list[int], threshold: int, mean: int, density: int) -> None:
    values = [0] * (contexts.FEATURES - contexts.BAND_FEATURES)
    if band[ORIENT] != LL:
        values[min(band[LEVEL], 4) - 1] = 32
        values[3 + band[ORIENT]] = 32
    values[7] = min(contexts.log2_eighths(threshold) - 104, 36)
    values[8] = contexts.log2_eighths(max(mean, 4)) - 48
    values[9] = density
    features[contexts.BAND_FEATURES :] = values
