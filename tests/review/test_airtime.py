"""Expected gain of certainty per second of air time."""

import pytest

from sonarpost.review.airtime import (
    RECOGNITION,
    WaitingImage,
    d_prime,
    expected_entropy_bits,
    gain_bits,
    gain_per_s,
    proposal,
)


def waiting(key="a", received=0, left=200, cost_s=10.0, **fields):
    return WaitingImage(key, received, left, cost_s, **{"p_mine_like": 0.5, **fields})


def test_entropy_without_an_observation_is_that_of_the_prior():
    assert expected_entropy_bits(0.5, 0.0) == pytest.approx(1.0)
    assert expected_entropy_bits(0.1, 0.0) == pytest.approx(0.4690, abs=1e-4)


def test_entropy_falls_with_the_distance_to_zero():
    values = [expected_entropy_bits(0.3, distance) for distance in (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)]
    assert values == sorted(values, reverse=True)
    assert values[-1] < 0.01


def test_distance_follows_the_measured_recognition():
    assert d_prime(0) == pytest.approx(0.0)
    assert d_prime(22) == pytest.approx(1.932, abs=1e-3)  # sqrt(2) * 1.366, the quantile of 0.914
    assert [d_prime(each) for each, _ in RECOGNITION] == sorted(d_prime(each) for each, _ in RECOGNITION)
    assert d_prime(10**6) == d_prime(RECOGNITION[-1][0])


def test_first_bytes_gain_more_than_later_ones():
    assert gain_bits(waiting(received=0, left=64)) > 10 * gain_bits(waiting(received=64, left=64)) > 0


def test_doubtful_contacts_gain_more_than_clear_ones():
    assert (
        gain_bits(waiting(p_mine_like=0.5)) > gain_bits(waiting(p_mine_like=0.9)) > gain_bits(waiting(p_mine_like=1.0))
    )
    assert gain_bits(waiting(p_mine_like=None)) == gain_bits(waiting(p_mine_like=0.5))


def test_decided_and_complete_images_gain_nothing():
    assert gain_bits(waiting(is_decided=True)) == 0
    assert gain_bits(waiting(left=0)) == 0
    assert gain_per_s(waiting(cost_s=0.0)) == 0


def test_proposal_takes_the_greatest_gain_per_second_until_the_time_is_used():
    images = [
        waiting("dear", cost_s=100.0),
        waiting("cheap", cost_s=30.0),
        waiting("clear", p_mine_like=0.97, cost_s=40.0),
        waiting("decided", is_decided=True),
        waiting("seen", received=200, cost_s=40.0),
    ]
    assert proposal(images, 60.0) == ["cheap", "dear"]
    assert proposal(images, 20.0) == ["cheap"]
    assert proposal([], 60.0) == []
