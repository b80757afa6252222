"""The loss model, compared with the binomial distribution and with simulated chains."""

import math

import numpy as np
import pytest

from sonarpost.errors import ConfigError
from sonarpost.link.coding.channel_capacity import (
    LossChannel,
    RateSelector,
    frames_for,
    received_distribution,
    unseen_share,
)
from sonarpost.modem.micromodem import RATES


@pytest.mark.parametrize("loss", [0.0, 0.1, 0.5, 0.9])
def test_independent_losses_are_binomial(loss: float) -> None:
    found = received_distribution(20, LossChannel(loss))
    law = [math.comb(20, k) * (1 - loss) ** k * loss ** (20 - k) for k in range(21)]
    assert found == pytest.approx(law, abs=1e-12)
    assert received_distribution(0, LossChannel(loss)).tolist() == [1.0]


@pytest.mark.parametrize(("loss", "burst"), [(0.3, 4.0), (0.5, 8.0), (0.1, 2.0)])
def test_bursts_have_the_configured_length_and_share(loss: float, burst: float) -> None:
    channel, rng = LossChannel(loss, burst), np.random.default_rng(3)
    draws, steps = rng.random((4000, 60)), []
    lost = rng.random(4000) < loss
    for step in range(60):
        steps.append(lost)
        lost = draws[:, step] < loss - loss * channel.memory + channel.memory * lost
    fates = np.array(steps)
    assert fates.mean() == pytest.approx(loss, abs=0.01)
    ends = (fates[:-1] & ~fates[1:]).sum()
    assert fates[:-1].sum() / ends == pytest.approx(burst, rel=0.08)
    seen = np.bincount((~fates).sum(axis=0), minlength=61) / 4000
    assert np.abs(np.cumsum(seen) - np.cumsum(received_distribution(60, channel))).max() < 0.03


def test_interleaved_frames_see_shorter_bursts() -> None:
    channel = LossChannel(0.3, 8.0)
    assert channel.spread(2).memory == pytest.approx(channel.memory**2)
    assert channel.spread(50).memory < 1e-3
    assert LossChannel(0.3).spread(3) == LossChannel(0.3)


def test_unseen_share_of_a_systematic_block() -> None:
    # One source symbol sent twice: unseen if both are lost.
    assert unseen_share(1, 2, LossChannel(0.3)) == pytest.approx(0.09)
    # Two source symbols sent once: each is unseen if it is lost.
    assert unseen_share(2, 2, LossChannel(0.3)) == pytest.approx(0.3)
    assert frames_for(1, LossChannel(0.3), 0.05, 99) == 3
    assert frames_for(1, LossChannel(0.3), 1e-9, 5) == 5


def test_higher_loss_takes_more_frames() -> None:
    found = [frames_for(24, LossChannel(loss), 0.004, 255) for loss in (0.0, 0.1, 0.3, 0.5)]
    assert found[0] == 24
    assert found == sorted(found)
    assert frames_for(24, LossChannel(0.3, 8.0), 0.004, 255) > found[2]
    assert frames_for(24, LossChannel(0.9), 0.004, 30) == 30


@pytest.mark.parametrize(("loss", "burst"), [(-0.1, 1), (1.0, 1), (float("nan"), 1), (0.3, 0.5)])
def test_channel_out_of_range_is_rejected(loss: float, burst: float) -> None:
    with pytest.raises(ConfigError, match="acoustic channel"):
        LossChannel(loss, burst)


@pytest.mark.parametrize(
    ("losses", "best"),
    [({0: 0.0, 1: 0.0, 5: 0.0}, 5), ({0: 0.0, 1: 0.1, 5: 0.98}, 1), ({0: 0.1, 1: 0.95, 5: 1.0}, 0), ({0: 0.0}, 5)],
)
def test_rate_with_the_most_payload_per_second_is_selected(losses: dict[int, float], best: int) -> None:
    selector = RateSelector(
        [RATES[n] for n in (0, 1, 5)], 0, losses={number: (loss, 50.0) for number, loss in losses.items()}
    )
    assert selector.select(100.0) == best


def test_a_rate_without_a_measured_loss_stays() -> None:
    selector = RateSelector([RATES[n] for n in (0, 1, 5)], 1, losses={0: (0.0, 50.0), 1: (0.9, -9000.0)})
    assert selector.select(100.0) == 1
    assert selector.losses == {0: (0.0, 50.0)}, "old measurements are deleted"


@pytest.mark.parametrize(("allowed", "first"), [((1,), 0), ((), 1)])
def test_first_rate_must_be_allowed(allowed: tuple[int, ...], first: int) -> None:
    with pytest.raises(ConfigError, match="rate selection"):
        RateSelector([RATES[n] for n in allowed], first)
