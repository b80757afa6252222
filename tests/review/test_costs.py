"""Estimate of the arrival of answers to requests."""

import pytest

from sonarpost.modem.micromodem import RATES
from sonarpost.review.costs import LinkRecord, expected_arrival, request_cost

HEADER = 5


def arrival(link: LinkRecord, loss: float | None = None, bytes_total: int = 131):
    cost = request_cost(
        "expand",
        downlink_rate=RATES[0],
        uplink_rate=RATES[1],
        bytes_received=0,
        bytes_total=bytes_total,
        loss=loss,
        overhead_bytes=HEADER,
    )
    return expected_arrival(cost, RATES[1], HEADER, link)


def test_without_loss_the_answer_takes_its_packets_and_turns():
    # 2.7 s and 3.2 s down, 5.7 s, 2 s of coding, four frames in two packets of 6.1 s.
    found = arrival(LinkRecord(0.0))
    assert (found.median_s, found.most_s) == pytest.approx((25.8, 25.8))


def test_loss_of_each_direction_and_past_requests_delay_the_answer():
    clear, lossy = arrival(LinkRecord(0.0)), arrival(LinkRecord(0.3))
    assert lossy.most_s > 2 * clear.most_s
    assert arrival(LinkRecord(0.0, sent=20, lost=10)).most_s > clear.most_s
    assert arrival(LinkRecord(None)).most_s == arrival(LinkRecord(0.2)).most_s
    past = arrival(LinkRecord(0.3, ratios=(8.0,)))
    assert (past.median_s, past.most_s) == pytest.approx((2 * lossy.median_s, 2 * lossy.most_s))
    assert arrival(LinkRecord(0.3, ratios=(1e9,) * 20)).most_s == pytest.approx(4 * lossy.most_s)
    assert arrival(LinkRecord(1.0, 1000, 1000), bytes_total=65535).most_s < 1e5
