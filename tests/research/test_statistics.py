"""BD-rate against analytic cases, bootstrap, AUC, MS-SSIM."""

import numpy as np
import pytest
from builders.images import ssim_windows
from hypothesis import given
from hypothesis import strategies as st

from research.codecs.report import rate_difference
from research.common import statistics
from research.common.measurement import BudgetResult, CodecUnderTest
from research.common.quality import ms_ssim
from research.common.statistics import auc, bd_rate_percent, bootstrap_weights, interval
from sonarpost.errors import StreamError

RATES = np.array([22.0, 44, 64, 128, 256, 512])


def curve(rates: np.ndarray, db_per_octave: float = 1.5, offset_db: float = 15.0) -> np.ndarray:
    return offset_db + db_per_octave * np.log2(rates)


def test_bd_rate_of_a_constant_rate_factor_and_of_a_constant_gain() -> None:
    for factor in (0.25, 1.0, 1.7):
        found = bd_rate_percent(factor * RATES, curve(RATES), RATES, curve(RATES))
        assert found == pytest.approx(100 * (factor - 1), abs=1e-9)
    # At 1.5 dB an octave a gain of 1.5 dB is half the rate, wherever the points lie.
    other_rates = np.array([30.0, 70, 150, 400, 900])
    found = bd_rate_percent(RATES, curve(RATES) + 1.5, other_rates, curve(other_rates))
    assert found == pytest.approx(-50.0, abs=1e-6)


def test_bd_rate_averages_logarithms_over_the_common_range() -> None:
    # First: log10 rate = q / 10; second: log10 rate = q / 5 - 2. Common range 20..30: the mean difference of the
    # logarithms is mean(2 - q / 10) = -0.5.
    q1, q2 = np.array([10.0, 18, 24, 30]), np.array([20.0, 26, 33, 40])
    found = bd_rate_percent(10 ** (q1 / 10), q1, 10 ** (q2 / 5 - 2), q2)
    assert found == pytest.approx(100 * (10**-0.5 - 1), abs=1e-9)
    assert statistics.overlap_db(q1, q2) == (20.0, 30.0)


def test_interpolation_does_not_overshoot() -> None:
    # A step: a cubic through these would dip below 10 B between the first two points.
    quality = np.array([20.0, 21.0, 21.1, 22.0])
    rates = np.array([10.0, 10.5, 400, 420])
    flat = np.array([20.0, 21.0])
    found = bd_rate_percent(rates, quality, np.array([10.0, 10.0000001]), flat)
    assert found is not None
    assert 0.0 <= found <= 5.0


def test_incomparable_curves_have_no_bd_rate_and_inefficient_points_are_ignored() -> None:
    quality = curve(RATES)
    assert bd_rate_percent(RATES, quality, RATES, quality + 40) is None
    assert statistics.overlap_db(quality, quality + 40) is None
    assert bd_rate_percent(RATES[:1], quality[:1], RATES, quality) is None
    assert bd_rate_percent(np.array([10.0, 20]), np.array([5.0, 5.0]), RATES, quality) is None
    quality = curve(RATES)
    rates = np.concatenate((RATES, RATES * 1.6, [600.0]))
    worse = np.concatenate((quality, quality, [1.0]))
    assert bd_rate_percent(rates, worse, RATES, quality) == pytest.approx(0.0, abs=1e-9)
    assert bd_rate_percent(np.append(RATES, np.nan), np.append(quality, np.nan), RATES, quality) == pytest.approx(0.0)


@given(st.lists(st.floats(0.5, 2.0), min_size=6, max_size=6), st.lists(st.floats(0.1, 2.0), min_size=6, max_size=6))
def test_swapping_the_codecs_inverts_the_bd_rate(steps: list[float], others: list[float]) -> None:
    first, second = 18 + np.cumsum(steps), 18 + np.cumsum(others)
    one, two = bd_rate_percent(RATES, first, RATES, second), bd_rate_percent(RATES, second, RATES, first)
    assert (one is None) == (two is None)
    if one is not None and two is not None:
        assert (1 + one / 100) * (1 + two / 100) == pytest.approx(1.0)


def point(budget: int, sizes: list[float], psnr: list[float]) -> BudgetResult:
    blank = np.full(len(sizes), np.nan)
    codec = type("Named", (), {"name": "some"})()
    return BudgetResult(CodecUnderTest(codec), budget, np.array(sizes), np.array(psnr), blank, blank, blank, blank)


def test_curves_use_the_images_coded_by_both_codecs() -> None:
    images = 20
    base = np.linspace(18, 24, images)
    easy = np.arange(images) < 19
    one = [point(int(b), [b] * images, list(base + curve(np.array(b)))) for b in RATES]
    # The other is the same codec at twice the bytes; it misses the best image at one budget. It misses nearly
    # all at another, which is therefore excluded.
    two = [point(int(b), [2 * b] * images, list(base + curve(np.array(b)))) for b in RATES]
    for array in (two[2].stream_bytes, two[2].psnr):
        array[~easy] = np.nan
    for array in (two[0].stream_bytes, two[0].psnr):
        array[3:] = np.nan
    weights = bootstrap_weights([str(i) for i in range(images)], 50)
    found = rate_difference(one, two, weights)
    assert found.percent == pytest.approx(-50.0)
    assert found.images == 19
    assert found.ci is not None
    assert found.ci == pytest.approx((-50.0, -50.0))
    assert rate_difference(one, two[:1]).percent is None


def test_bootstrap_draws_sources_and_is_reproducible() -> None:
    sources = ["a", "a", "b", "c", "c", "c"]
    weights = bootstrap_weights(sources, 500, seed=4)
    assert weights.shape == (500, 6)
    assert np.array_equal(weights, bootstrap_weights(sources, 500, seed=4))
    assert (weights[:, 0] == weights[:, 1]).all()
    assert (weights[:, 3] == weights[:, 5]).all()
    assert (weights[:, [0, 2, 3]].sum(axis=1) == 3).all()
    assert not np.array_equal(weights, bootstrap_weights(sources, 500, seed=5))


def test_interval_of_a_mean_agrees_with_theory() -> None:
    values = np.random.default_rng(0).normal(20, 3, 400)
    weights = bootstrap_weights([str(i) for i in range(400)])
    found = interval(statistics.weighted_means(values, weights))
    assert found is not None
    half = 1.96 * values.std() / 20
    assert found[0] == pytest.approx(values.mean() - half, abs=0.06)
    assert found[1] == pytest.approx(values.mean() + half, abs=0.06)


def test_auc() -> None:
    scores = np.array([3.0, 1.0, 2.0, 2.0, 0.0])
    is_target = np.array([True, True, False, True, False])
    # Pairs (target, other): 3>2, 3>0, 1<2, 1>0, 2=2, 2>0: 4.5 of 6.
    assert auc(scores, is_target) == pytest.approx([0.75])
    # The second target twice, the first not at all: 1<2, 1>0, twice; 2=2, 2>0: 2 + 1.5 of 6.
    weights = np.array([[0.0, 2, 1, 1, 1], [1, 1, 0, 1, 0]])
    weighted = auc(scores, is_target, weights)
    assert weighted[0] == pytest.approx(3.5 / 6)
    assert np.isnan(weighted[1])
    rng = np.random.default_rng(1)
    is_target = rng.random(2000) < 0.4
    assert auc(rng.random(2000), is_target)[0] == pytest.approx(0.5, abs=0.05)
    assert auc(is_target.astype(float), is_target)[0] == 1.0
    assert auc(np.zeros(2000), is_target)[0] == 0.5


def made_image(seed: int, shape: tuple[int, int] = (80, 80)) -> np.ndarray:
    return np.clip(60 * np.random.default_rng(seed).rayleigh(1.0, shape), 0, 255).astype(np.uint8)


def test_ms_ssim_equals_its_definition_and_invalid_pairs_are_errors() -> None:
    """Computed window by window over three scales of a mirrored image."""
    a, b = made_image(2, (17, 22)), made_image(3, (17, 22))
    x, y, result = a.astype(float), b.astype(float), 1.0
    weights = np.array([0.0448, 0.2856, 0.3001])
    for scale, weight in enumerate(weights / weights.sum()):
        terms = ssim_windows(np.pad(x, 5, mode="symmetric"), np.pad(y, 5, mode="symmetric"))
        mean = np.mean([structure * (luminance if scale == 2 else 1) for luminance, structure in terms])
        result *= max(mean, 1e-6) ** weight
        rows, columns = x.shape[0] // 2 * 2, x.shape[1] // 2 * 2
        x, y = (z[:rows, :columns].reshape(rows // 2, 2, columns // 2, 2).mean((1, 3)) for z in (x, y))
    assert ms_ssim(a, b) == pytest.approx(result, rel=1e-9)
    with pytest.raises(StreamError, match="at least 4 px"):
        ms_ssim(made_image(0, (3, 40)), made_image(1, (3, 40)))
    with pytest.raises(StreamError, match="shape"):
        ms_ssim(made_image(0), made_image(1, (80, 79)))
