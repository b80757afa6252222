"""Parts of the compiled coding loop, compared with independent arithmetic in Python integers."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sonarpost.codec.emb import contexts, kernel
from sonarpost.codec.emb import transform as t
from sonarpost.codec.emb.bitplanes import reconstructed_coefficients
from sonarpost.codec.emb.coder import CoefficientState
from sonarpost.codec.emb.model import shipped_model

MODEL = shipped_model()


def plain_logit(features: list[int], net: int, last: list[int]) -> tuple[int, list[int]]:
    """Evaluate the network in Python integers, which cannot overflow."""
    w1, b1, w2, b2 = (getattr(MODEL, name)[net].tolist() for name in ("w1", "b1", "w2", "b2"))
    first = [b1[j] + sum(f * w1[i][j] for i, f in enumerate(features)) for j in range(kernel.HIDDEN_1)]
    first = [min(max(v >> 6, 0), 4095) for v in first]
    second = [b2[j] + sum(v * w2[i][j] for i, v in enumerate(first)) for j in range(kernel.HIDDEN_2)]
    second = [min(max(v >> 12, 0), 4095) for v in second]
    total = 256 * last[-1] + sum(v * w for v, w in zip(second, last[:-1], strict=True))
    return min(max(total >> 28, -kernel.LOGIT_LIMIT), kernel.LOGIT_LIMIT), second


@pytest.mark.parametrize(("net", "reach"), [(0, 5), (1, 48), (0, 288), (1, 288)])
def test_network_and_adaptation_match_unbounded_integers(net: int, reach: int) -> None:
    rng = np.random.default_rng(reach + net)
    last_layer = np.concatenate([MODEL.w3[net].astype(np.int64) << 16, [int(MODEL.b3[net]) << 8]])
    last = last_layer.tolist()
    h1, h2 = np.zeros(kernel.HIDDEN_1, np.int32), np.zeros(kernel.HIDDEN_2, np.int32)
    base = np.zeros(kernel.HIDDEN_1, np.int32)
    steps_taken = []
    for _ in range(60):
        f = rng.integers(-reach // 4, reach + 1, contexts.FEATURES).astype(np.int32)
        kernel.band_base(f, MODEL.w1[net], MODEL.b1[net], base)
        logit = kernel._logit(f, base, MODEL.w1[net], MODEL.w2[net], MODEL.b2[net], last_layer, h1, h2)
        expected, hidden = plain_logit(f.tolist(), net, last)
        assert logit == expected
        assert h2.tolist() == hidden
        bit, probability = int(rng.integers(2)), int(MODEL.probabilities[logit + kernel.LOGIT_LIMIT])
        kernel._adapt(last_layer, h2, bit, probability)
        error = (bit << 16) - probability
        steps = [*(error * v >> 4 for v in hidden), error << 4]
        last = [min(max(w + s, -(1 << 34)), 1 << 34) for w, s in zip(last, steps, strict=True)]
        assert last_layer.tolist() == last
        steps_taken.append(max(map(abs, steps)))
    assert max(steps_taken) > 0


def plain_sign_logit(features: list[int], orient: int) -> int:
    """Evaluate the sign network in Python integers."""
    w1, base, w2 = (getattr(MODEL, name)[orient].tolist() for name in ("sign_w1", "sign_b1", "sign_w2"))
    total = 0
    for j in range(kernel.SIGN_HIDDEN):
        odd = sum(features[i] * w1[i][j] for i in range(contexts.SIGN_ODD))
        even = base[j] + sum(features[i] * w1[i][j] for i in range(contexts.SIGN_ODD, contexts.SIGN_FEATURES))
        total += (min(max(even + odd >> 6, 0), 4095) - min(max(even - odd >> 6, 0), 4095)) * w2[j]
    return min(max(total >> 12, -kernel.LOGIT_LIMIT), kernel.LOGIT_LIMIT)


@pytest.mark.parametrize(("orient", "reach"), [(0, 3), (1, 96), (2, 48), (3, 96)])
def test_sign_network_matches_unbounded_integers_and_is_odd(orient: int, reach: int) -> None:
    rng = np.random.default_rng(reach + orient)
    logits = []
    for _ in range(40):
        f = rng.integers(-reach, reach + 1, contexts.SIGN_FEATURES).astype(np.int32)
        f[contexts.SIGN_ODD :] = rng.integers(0, 25, contexts.SIGN_FEATURES - contexts.SIGN_ODD)
        nets = (MODEL.sign_b1, MODEL.sign_w1, MODEL.sign_w2, orient, np.zeros(2 * kernel.SIGN_HIDDEN, np.int32))
        logits.append(kernel._sign_logit(f, *nets))
        assert logits[-1] == plain_sign_logit(f.tolist(), orient)
        f[: contexts.SIGN_ODD] *= -1
        assert abs(kernel._sign_logit(f, *nets) + logits[-1]) <= 1  # rounded down for both signs
    assert len(set(logits)) > 20


@pytest.mark.parametrize("orient", range(4))
def test_sign_features_are_odd_and_even(orient: int) -> None:
    """The odd features change sign with the image, the even ones do not."""
    layout = t.layout_of(80, 80)
    row = next(
        n for n, band in enumerate(layout.bands) if band[t.ORIENT] == orient and band[t.LEVEL] in (0, 2, layout.levels)
    )
    rng = np.random.default_rng(orient)
    signed = rng.integers(-48, 49, layout.cells).astype(np.int32)
    lows = rng.integers(-3000, 3000, layout.low_cells).astype(np.int32) * 512  # exact multiples of the threshold
    f, inverted = np.zeros(contexts.SIGN_FEATURES, np.int32), np.zeros(contexts.SIGN_FEATURES, np.int32)
    band = layout.bands[row]
    width = int(layout.sides[band[t.LEVEL], 1])
    for y, x in ((0, 0), (2, 3), (int(band[t.HEIGHT]) - 1, int(band[t.WIDTH]) - 1)):
        at = int(band[t.OFFSET] + y * band[t.STRIDE] + x)
        contexts.sign_context(f, signed, lows, layout.bands, width, 2048, row, y, x, at)
        contexts.sign_context(inverted, -signed, -lows, layout.bands, width, 2048, row, y, x, at)
        assert np.array_equal(f[: contexts.SIGN_ODD], -inverted[: contexts.SIGN_ODD])
        assert np.array_equal(f[contexts.SIGN_ODD :], inverted[contexts.SIGN_ODD :])
        assert f[: contexts.SIGN_ODD].any()


@given(threshold=st.integers(100, 2880 * 64 << 6), size=st.integers(0, 2**40))
@example(threshold=2880 * 64 << 6, size=48 * (2880 * 64 << 6) - 1)
def test_quotient_without_division_is_exact(threshold: int, size: int) -> None:
    inverse = (1 << contexts.INVERSE_BITS) // threshold + 1
    below = size // threshold * threshold
    for near in (size, below, max(below - 1, 0), size % (50 * threshold)):
        assert contexts._quotient(near, threshold, inverse) == min(near // threshold, contexts.MAX_EIGHTHS)


@given(st.integers(1, 2**40))
def test_logarithm_is_linear_between_powers_of_two(value: int) -> None:
    power = value.bit_length() - 1
    assert contexts.log2_eighths(value) == 8 * power + ((value << 3) >> power) - 8


def test_reconstruction_points_follow_the_table() -> None:
    layout = t.layout_of(16, 16)
    state = CoefficientState(layout)
    cell = int(layout.bands[2, 0])
    for size in (1, 2, 3, 4, 9):
        for logit in (-kernel.LOGIT_LIMIT, -900, -300, 0, kernel.LOGIT_LIMIT):
            state.lower[cell], state.widths[cell], state.signs[cell] = size * 4096, 4096, -1
            state.logits[cell] = logit
            column = min(max((logit + 2304) // 128, 0), kernel.CENTRE_COLUMNS - 1)
            expected = -(size * 4096 + (4096 * int(MODEL.centres[min(size, 4) - 1, column]) >> 8))
            gain = t.BAND_GAINS[3][int(layout.bands[2, t.ORIENT])]
            found = reconstructed_coefficients(state, MODEL)[layout.position == cell]
            assert found == (expected * 1024 + gain // 2) // gain
    assert np.all((MODEL.centres > 0) & (MODEL.centres < 160))
    # Unlikely coefficients lie low in their interval.
    assert MODEL.centres[0, 8] < MODEL.centres[0, 16] - 30


@pytest.mark.parametrize("size", [(16, 16), (17, 33), (16, 512), (301, 127)])
def test_relatives_of_bands(size: tuple[int, int]) -> None:
    bands = t.layout_of(*size).bands
    for number, band in enumerate(bands):
        if band[t.ORIENT] == t.LL:
            assert (band[[t.NEXT_1, t.NEXT_1 + 1, t.COUSIN_1, t.COUSIN_1 + 1]] == -1).all()
            continue
        earlier = {int(n) for n in band[[t.SIBLING_1, t.SIBLING_1 + 1]] if n >= 0}
        later = {int(n) for n in band[[t.NEXT_1, t.NEXT_1 + 1]] if n >= 0}
        same_level = {n for n in range(1, len(bands)) if bands[n, t.LEVEL] == band[t.LEVEL]}
        assert earlier | later | {number} == same_level
        assert all(n < number for n in earlier)
        assert all(n > number for n in later)
        cousins = {int(n) for n in band[[t.COUSIN_1, t.COUSIN_1 + 1]] if n >= 0}
        if band[t.PARENT] < 0:
            assert not cousins
        else:
            above = {n for n in range(1, len(bands)) if bands[n, t.LEVEL] == band[t.LEVEL] + 1}
            assert cousins | {int(band[t.PARENT])} == above
        assert band[t.HEIGHT] >= 0
        assert band[t.WIDTH] >= 0


@pytest.mark.parametrize("shape", [(3, 8), (9, 4)])
def test_synthesis_of_a_plane_is_that_of_each_row(shape):
    plane = np.random.default_rng(3).integers(-1000, 1000, shape)
    rows = [row[None].copy() for row in plane]
    for row in rows:
        t.synthesise_rows(row)
    whole = plane.copy()
    t.synthesise_rows(whole)
    np.testing.assert_array_equal(whole, np.concatenate(rows))
    assert (whole != plane).any()
