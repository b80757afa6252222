"""The link between vessel and shore, correct, cut or without data: every image arrives exactly once and unchanged."""

from __future__ import annotations

import time

import pytest
from builders.image_source import make_image
from builders.vessel_and_shore import VesselAndShore

COUNT = 200
LONG = [pytest.mark.system, pytest.mark.timeout(400)]


def test_images_arrive_in_order_while_nothing_fails(system: VesselAndShore) -> None:
    # A consumer that starts in the middle of a window may receive its records in another order.
    system.send([make_image(0)])
    system.assert_all_delivered_once()
    for first in range(1, COUNT, 20):
        system.send([make_image(n) for n in range(first, first + 20)])
    system.assert_all_delivered_once()
    seen = {done.record for done in system.history.operations if done.operation == "seen"}
    assert len(seen) > COUNT // 2, "the order was observed"


@pytest.mark.parametrize(
    ("kind", "seconds"),
    [
        ("cut", 10.0),
        ("stall", 5.0),  # longer than the lease of 3 s, after which the routers close the connection
        pytest.param("cut", 60.0, marks=LONG),
        pytest.param("stall", 60.0, marks=LONG),
    ],
)
def test_outage_loses_duplicates_and_corrupts_nothing(system: VesselAndShore, kind: str, seconds: float) -> None:
    link = system.link
    assert link is not None
    system.send([make_image(n) for n in range(60)])
    system.wait_until(lambda: system.shore_image_count() >= 5, 60, "first images at the shore")
    (link.cut if kind == "cut" else link.stall)()
    ends_s = time.monotonic() + seconds
    for first in range(60, COUNT, 20):
        system.send([make_image(n) for n in range(first, first + 20)])
    time.sleep(max(0.0, ends_s - time.monotonic()))
    assert system.shore_image_count() < COUNT, "the outage has delayed some images"
    link.mend()
    system.assert_all_delivered_once()


@pytest.mark.system
@pytest.mark.timeout(400)
def test_repeated_short_outages_lose_nothing(system: VesselAndShore) -> None:
    link = system.link
    assert link is not None
    for outage in range(8):
        system.send([make_image(n) for n in range(25 * outage, 25 * outage + 25)])
        time.sleep(0.7)
        (link.cut if outage % 2 else link.stall)()
        time.sleep(1.5)
        link.mend()
    system.assert_all_delivered_once(240)
