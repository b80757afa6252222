"""The parts of `research.thin_links` with few images: every record arrives once, and the link has carried its bytes."""

import json

from builders.common import WAIT_S

from research.linked_vessel import Link, vessel
from research.thin_links import Bench, images_of, sent_payload
from sonarpost import keys

FAST = Link(rate_bytes_per_s=64_000, hops=2, buffer_bytes=16384)


def test_images_and_a_decision_arrive_once_over_a_link_that_is_cut():
    images = images_of(200)
    with vessel(FAST, images) as one:
        far = one.links[0][0]
        events = [(0.5, far.cut), (0.6, one.relay.queue_decision), (0.7, far.mend)]
        found = one.drain(len(images), WAIT_S, events)
    assert found.records == len(images)
    assert len(found.decisions_s) == 1
    assert found.wire_bytes[0] > sum(len(sent_payload(image)) for image in images)
    assert found.wire_bytes[1] > 0


def test_a_site_is_served_beside_one_that_cannot_be_reached():
    images = images_of(50)
    with vessel(FAST, images, [keys.SHORE, "shore-2"]) as one:
        events = [(0.0, link.stall) for link in one.links[1]]
        assert one.drain(len(images), WAIT_S, events).records == len(images)


def test_a_missed_aim_fails_the_command(capsys):
    bench = Bench([1], 16384)
    bench.drain(FAST, "sonarpost", 20, is_busy=False)
    assert bench.passed
    bench.report("drain", FAST, good=False)
    assert not bench.passed
    drain, missed = map(json.loads, capsys.readouterr().out.splitlines())
    assert (drain["arrived"], drain["again"], drain["good"], missed["good"]) == (20, 0, True, False)
