"""The link between vessel and shore is cut or swallows everything: every picture arrives, once, as it was."""

from __future__ import annotations

import time

import pytest
from builders.coast import Coast
from builders.feeder import make_image

COUNT = 200
LONG = [pytest.mark.long, pytest.mark.timeout(400)]


@pytest.mark.parametrize(
    ("kind", "seconds"),
    [
        ("cut", 10.0),
        ("stall", 5.0),  # longer than the lease of 3 s, after which the routers give the connection up
        pytest.param("cut", 60.0, marks=LONG),
        pytest.param("stall", 60.0, marks=LONG),
    ],
)
def test_an_outage_loses_doubles_and_corrupts_nothing(coast: Coast, kind: str, seconds: float) -> None:
    link = coast.link
    assert link is not None
    coast.owe([make_image(n) for n in range(60)])
    coast.until(lambda: coast.ashore_count() >= 5, 60, "first pictures ashore")
    (link.cut if kind == "cut" else link.stall)()
    ends_s = time.monotonic() + seconds
    for first in range(60, COUNT, 20):
        coast.owe([make_image(n) for n in range(first, first + 20)])
    time.sleep(max(0.0, ends_s - time.monotonic()))
    assert coast.ashore_count() < COUNT, "the outage has kept some from the shore"
    link.mend()
    coast.assert_all_ashore_once()


@pytest.mark.long
@pytest.mark.timeout(400)
def test_flaps_of_a_second_and_a_half_lose_nothing(coast: Coast) -> None:
    link = coast.link
    assert link is not None
    for flap in range(8):
        coast.owe([make_image(n) for n in range(25 * flap, 25 * flap + 25)])
        time.sleep(0.7)
        (link.cut if flap % 2 else link.stall)()
        time.sleep(1.5)
        link.mend()
    coast.assert_all_ashore_once(240)
