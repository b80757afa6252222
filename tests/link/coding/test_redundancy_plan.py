"""The redundancy plan, compared with brute force, and its properties."""

import itertools

import numpy as np
import pytest

from sonarpost.errors import StreamError
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.coding.redundancy_plan import (
    GroupDistortion,
    arrivals,
    copies,
    plan_layers,
    plan_unlayered,
    symbols_to_send,
    usual_curve,
)


def curve(scale: float, length: int = 400) -> np.ndarray:
    return 10 * np.log10(255.0**2 / 60.0**2 * (1 + np.arange(length + 1) * scale))


def test_bytes_go_to_the_steepest_slope() -> None:
    curves = [curve(0.1), curve(0.001), curve(0.03)]
    gain = GroupDistortion.of(curves, [10, 10, 10])
    for total in (0, 5, 60, 200, 700):
        stops = gain.stops(total)
        assert sum(stops) - 30 == min(total, gain.total_bytes)
        found = sum(c[s] - c[10] for c, s in zip(curves, stops, strict=True))
        best = (
            max(
                curves[0][10 + a] + curves[1][10 + b] + curves[2][10 + total - a - b] - sum(c[10] for c in curves)
                for a in range(0, min(total, 390) + 1, 5)
                for b in range(max(0, total - a - 390), min(total - a, 390) + 1, 5)
            )
            if total
            else 0.0
        )
        assert found >= best - 0.02
        assert gain.gains(np.array(total)) == pytest.approx(found, abs=0.05)


def test_curve_with_steps_is_replaced_by_its_hull() -> None:
    steps = 10 * np.log10(255.0**2 / np.repeat([4000.0, 3000.0, 1000.0, 900.0], [20, 30, 30, 21]))
    gain = GroupDistortion.of([steps], [0])
    slopes = np.diff(gain.gain_by_step) / np.diff(gain.bytes_by_step)
    assert (np.diff(slopes) <= 1e-12).all()
    assert gain.total_bytes == 80


def test_streams_that_are_too_long_are_rejected() -> None:
    with pytest.raises(StreamError, match="image"):
        usual_curve(70000)


def test_uncertain_loss_leads_to_layers() -> None:
    gain = GroupDistortion.of([curve(0.05, 2000)], [0])
    arrive = np.zeros(81)
    arrive[[20, 60]] = 0.5
    plan = plan_layers(gain, 59, arrive, 8, 6)
    assert plan is not None
    assert len(plan[0].shares) > 1
    assert plan[0].required_symbols[0] <= 20 < plan[0].required_symbols[-1] <= 60
    sure = np.zeros(81)
    sure[60] = 1.0
    one = plan_layers(gain, 59, sure, 8, 6)
    assert one is not None
    assert one[0].required_symbols[-1] <= 60
    assert one[1] > plan[1]


def test_plan_equals_brute_force_on_a_small_case() -> None:
    gain = GroupDistortion.of([curve(0.05, 800)], [0])
    arrive = arrivals(12, (LossChannel(0.3), LossChannel(0.6)), 1)
    plan = plan_layers(gain, 32, arrive, 8, 6)
    at_least = np.cumsum(arrive[::-1])[::-1]
    best = 0.0
    for first, step, share in itertools.product(range(4, 13), range(1, 8), range(1, 16)):
        if first + step <= 12:
            low = first * 2 * share - 8
            high = low + (first + step) * 2 * (16 - share) - 6
            gains = gain.gains(np.array([low, high]))
            if low > 0 and high > low:
                best = max(best, float(gains[0] * at_least[first] + (gains[1] - gains[0]) * at_least[first + step]))
    for first in range(4, 13):
        best = max(best, float(gain.gains(np.array(first * 32 - 8)) * at_least[first]))
    assert plan is not None
    assert plan[1] >= best - 1e-9


def test_unlayered_plan_finds_the_best_k() -> None:
    gain = GroupDistortion.of([curve(0.05, 800)], [0])
    arrive = arrivals(6, (LossChannel(0.3),), 1)
    found = plan_unlayered(gain, 59, arrive, 12)
    assert found is not None
    at_least = np.cumsum(arrive[::-1])[::-1]
    values = [float(gain.gains(np.array(k * 59 - 12)) * at_least[k]) for k in range(1, 7)]
    assert found == (1 + int(np.argmax(values)), pytest.approx(max(values)))


def test_too_few_frames_give_no_layers() -> None:
    gain = GroupDistortion.of([curve(0.05)], [0])
    assert plan_layers(gain, 59, arrivals(3, (LossChannel(0.1),), 1), 8, 6) is None
    assert plan_layers(gain, 12, arrivals(30, (LossChannel(0.1),), 1), 8, 6) is None


def test_number_of_copies() -> None:
    assert [copies(LossChannel(loss)) for loss in (0.0, 0.1, 0.3, 0.5)] == [1, 2, 4, 7]
    assert copies(LossChannel(0.95)) == 8


def test_symbols_to_send() -> None:
    assert symbols_to_send(0, LossChannel(0.5), 1.0) == 0
    assert symbols_to_send(50, LossChannel(0.0), 2.0) == 50
    assert symbols_to_send(50, LossChannel(0.5), 0.0) == 100
    assert 50 <= symbols_to_send(50, LossChannel(0.5), 2.0) < 100 < symbols_to_send(50, LossChannel(0.5), -2.0)
    # Few symbols: the average need. Many: below it.
    assert [symbols_to_send(n, LossChannel(0.3)) for n in (1, 4, 24, 48)] == [2, 6, 29, 61]
