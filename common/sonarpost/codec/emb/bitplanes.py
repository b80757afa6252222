"""Coding a picture's coefficients plane by plane: what both ends do in the same order."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb import kernel, transform
from sonarpost.codec.emb import perceptual_weights as aim
from sonarpost.codec.emb.coder import PLAIN_SCALE, Coder, State
from sonarpost.codec.emb.layout import HEIGHT, HL, LEVEL, LL, OFFSET, ORIENT, STRIDE, WIDTH
from sonarpost.codec.emb.model import Model
from sonarpost.codec.emb.region import OUTSIDE, weights
from sonarpost.codec.emb.side_info import MAX_EXTRA, Box, SideInfo

I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]

# First threshold in coefficient units (1/64 grey) for each start step: from 2880 grey down, 2^(1/8) apart, multiples of
# 2^10 so that halving them ten times is exact.
STEPS: Final = tuple(round(2880 * 64 / 1024 * 2 ** (-i / 8)) * 1024 for i in range(8))
PLANES: Final = 10
NO_BAR: Final = -kernel.LOGIT_LIMIT - 1
PASSES: Final = ((kernel.NEAR, -560), (kernel.ALL, -930), (kernel.REFINE, NO_BAR), (kernel.ALL, NO_BAR))
"""Passes of a plane, and the least logit of significance (1/256) that each takes: a bit spent on a likely coefficient
takes away more error, so those come first. A refinement is worth about as much as significance with a chance of
1/40."""
_FIRST_PLANE: Final = {1: 3, 2: 2, 3: 1}
"""Plane from which a level is coded; its coefficients are hardly ever larger than twice that threshold, and those that
are count as that large."""
_FIRST_PLANE_AIMED: Final = _FIRST_PLANE | {1: 4}
"""The same of models with an aim, which make the finest level small."""


def code_planes(
    coder: Coder,
    state: State,
    model: Model,
    targets: I32,
    side: SideInfo,
    price: int = 0,
    planes: int = PLANES,
    plain: I32 | None = None,
) -> None:
    """Write, read or list plane after plane until the coder stops.

    Args:
        coder: Where to.
        state: What is known; brought forward.
        model: The networks.
        targets: Coefficients to tell, flat, int32; anything where the coder reads.
        side: Start step, mean level and region of interest.
        price: See `kernel.code_band`.
        planes: How many to code at most, beside the extra ones.
        plain: What `Coder.curve` takes for the true coefficients; `targets` if not given.
    """
    lay, mean = state.lay, side.mean
    bands, widths = lay.bands.tolist(), lay.sides[:, 1].tolist()  # plain numbers are ten times faster to work with
    features = np.zeros(kernel.FEATURES, np.int32)
    base = np.zeros((2, kernel.HIDDEN_1), np.int32)
    still = np.zeros(lay.cells, np.int32)
    plain = targets if plain is None else plain
    scaled = targets if model.aim is None else aim.begin(model.aim, state, targets)
    known = (
        state.values, state.widths, state.signs, state.seen, state.signed, state.marks, state.odds, still, state.scale,
    )  # fmt: skip
    nets = (model.w1, model.w2, model.b2, _last_layer(model))
    sign_nets, tables = (model.sign_w1, model.sign_b1, model.sign_w2), (model.chances, model.costs, model.centres)
    stream = (coder.words, coder.data, coder.good, coder.curve, plain)
    lists = (coder.rows, coder.sign_rows)
    first_plane = _FIRST_PLANE if model.aim is None else _FIRST_PLANE_AIMED
    for plane in range(-side.extra, planes):
        threshold = (STEPS[side.step] << side.extra) >> (plane + side.extra)
        state.threshold, number = threshold, plane + side.extra + 1
        kernel.refresh(state.values, state.widths, state.signs, state.seen, state.signed, threshold)
        still[:] = 0
        rows = [i for i, band in enumerate(bands) if plane >= first_plane.get(band[LEVEL], -side.extra)]
        finest = min(bands[i][LEVEL] for i in rows)
        lows = low_pictures(state, model, side, finest)
        for number_in_plane, (kind, bar) in enumerate(PASSES):
            for row in rows:
                band = bands[row]
                is_new_level = number_in_plane == 0 and band[ORIENT] == HL and band[LEVEL] in aim.FOLLOWING
                if model.aim is not None and is_new_level:
                    aim.follow(model.aim, state, row, lows, finest, targets, scaled)
                    kernel.refresh(state.values, state.widths, state.signs, state.seen, state.signed, threshold)
                if row == 1 and kind != kernel.REFINE:
                    lows = low_pictures(state, model, side, finest)
                _band_features(features, band, threshold, mean, _density(state, band))
                for net in (0, 1):
                    kernel.band_base(features, model.w1[net], model.b1[net], base[net])
                low_width = widths[band[LEVEL]]
                end = kernel.code_band(
                    coder.mode, kind, number, threshold, row, low_width, price, bar, lay.bands, scaled, lows,
                    features, base, known, nets, sign_nets, tables, stream, lists,
                )  # fmt: skip
                if end < 0:
                    return


def held(targets: I32, state: State, side: SideInfo) -> I32:
    """Return targets changed by as little as makes the coder decide as a stream already has.

    Args:
        targets: Shape (lay.cells,), int32.
        state: What the stream says.
        side: Its side information.
    """
    first = STEPS[side.step] << side.extra
    # A plane that only looked left what the plane before it had decided.
    planes = np.where(state.marks > 0, state.marks - 1, np.maximum(-state.marks - 2, 0))
    not_yet = np.where(state.marks == 0, first << 1, first >> planes)
    low, high = state.values, np.where(state.values > 0, state.values + state.widths, not_yet) - 1
    scaled = np.abs(targets.astype(np.int64)) * state.scale // PLAIN_SCALE
    size = -(-np.clip(scaled, low, high) * PLAIN_SCALE // state.scale)
    size = np.where(scaled == np.clip(scaled, low, high), np.abs(targets), size)
    return (size * np.where(state.values > 0, state.signs, np.sign(targets))).astype(np.int32)


def _last_layer(model: Model) -> I64:
    """The last layer's weights and bias, 1/2^28: what the kernel goes on learning."""
    return np.concatenate([model.w3.astype(np.int64) << 16, model.b3[:, None].astype(np.int64) << 8], 1)


def extra_planes(targets: I32, step: int) -> int:
    """How many planes above the usual first one the largest coefficient needs."""
    largest, extra = int(np.abs(targets).max()), 0
    while extra < MAX_EXTRA and largest >= STEPS[step] << (extra + 1):
        extra += 1
    return extra


def _density(state: State, band: list[int]) -> int:
    """Share of the band that is significant, 8 log2 of it per 1/1024, shifted to be about zero."""
    cells = band[HEIGHT] * band[WIDTH]
    start = band[OFFSET] - 2 * band[STRIDE] - 2
    stop = start + (band[HEIGHT] + 4) * band[STRIDE]
    significant = int(np.count_nonzero(state.values[start:stop]))
    share = (2048 * significant + 512) // (cells + 1)
    return _log2_eighths(share + 1) - 40


def _log2_eighths(value: int) -> int:
    power = value.bit_length() - 1
    return 8 * power + ((value << 3) >> power) - 8


def _band_features(features: I32, band: list[int], threshold: int, mean: int, density: int) -> None:
    here = [0] * (kernel.FEATURES - kernel.BAND_FEATURES)
    if band[ORIENT] != LL:
        here[min(band[LEVEL], 4) - 1] = 32
        here[3 + band[ORIENT]] = 32
    here[7] = min(_log2_eighths(threshold) - 104, 36)
    here[8] = _log2_eighths(max(mean, 4)) - 48
    here[9] = density
    features[kernel.BAND_FEATURES :] = here


def low_pictures(state: State, model: Model, side: SideInfo, down_to: int) -> I32:
    """The low-pass pictures of what is known so far, in 1/64 grey times 2^level."""
    plane = known_plane(state, model, side.box)
    _, lows = transform.inverse(plane, state.lay, down_to)
    for level in range(down_to, state.lay.levels + 1):
        at = int(state.lay.low_offsets[level])
        height, width = (int(n) + 2 for n in state.lay.sides[level])
        lows[at : at + height * width] += side.mean * transform.UNIT << level
    return lows


def known_plane(state: State, model: Model, box: Box | None = None) -> I64:
    """Most likely value of every coefficient, in the transform's square layout."""
    flat = np.zeros(state.lay.cells, np.int32)
    kernel.most_likely(state.values, state.widths, state.signs, state.odds, model.centres, flat)
    if model.aim is not None:
        flat = (flat.astype(np.int64) * PLAIN_SCALE // state.scale).astype(np.int32)
    if box is not None:
        flat = (flat * OUTSIDE // weights(state.lay, box)).astype(np.int32)
    return transform.from_flat(flat, state.lay)


def situation(state: State, mean: int) -> tuple[int, int, int]:
    """How fine a picture is, how bright, and how much of it is known: the enhancer's features of the whole."""
    share = 8192 * int(np.count_nonzero(state.values)) // (state.lay.height_px * state.lay.width_px)
    return _log2_eighths(state.threshold) - 96, _log2_eighths(max(mean, 4)) - 48, _log2_eighths(share + 16) - 56
