"""Time from a request to its answer, with both ends of the link on simulated time."""

import statistics

import pytest

from research.request_times import LOST_FRAMES, RequestSpec, run_request
from sonarpost.modem.micromodem import RATES
from sonarpost.review.costs import LinkRecord, expected_arrival, request_cost


@pytest.mark.parametrize("contact_every_s", [0.0, 120.0])
def test_answers_arrive_within_the_estimate_at_30_percent_loss(contact_every_s):
    runs = [run_request(RequestSpec("expand", LOST_FRAMES, contact_every_s, seed)) for seed in range(10)]
    times_s = [one.arrived_s - one.asked_s for one in runs if one.arrived_s is not None]
    assert len(times_s) == 10
    cost = request_cost(
        "expand",
        downlink_rate=RATES[0],
        uplink_rate=RATES[1],
        bytes_received=0,
        bytes_total=131,
        loss=LOST_FRAMES,
        overhead_bytes=5,
    )
    expected = expected_arrival(cost, RATES[1], 5, LinkRecord(LOST_FRAMES))
    assert sum(time_s <= expected.most_s for time_s in times_s) >= 8
    assert statistics.median(times_s) < 60.0
