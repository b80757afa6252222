"""The link between vessel and shore, correct, cut or without data: every image arrives exactly once and unchanged."""

from builders.image_source import make_image

COUNT = 200


def test_images_arrive_in_order_while_nothing_fails(system):
    # A consumer that starts in the middle of a window may receive its records in another order.
    system.send([make_image(0)])
    system.assert_all_delivered_once()
    for first in range(1, COUNT, 20):
        system.send([make_image(n) for n in range(first, first + 20)])
    system.assert_all_delivered_once()
    seen = {done.record for done in system.history.operations if done.operation == "seen"}
    assert len(seen) > COUNT // 2, "the order was observed"


def test_outages_lose_duplicate_and_corrupt_nothing(system):
    """The link is cut, then a black hole, each time until a router has noticed and tried to connect again."""
    link = system.link
    for fault, attempts in ((link.cut, 3), (link.stall, 1), (link.cut, 2), (link.stall, 1)):
        first = len(system.expected)
        system.send([make_image(n) for n in range(first, first + 30)])
        system.wait_until(lambda first=first: system.shore_image_count() > first, "first images at the shore")
        fault()
        wanted = link.attempts + attempts
        system.send([make_image(n) for n in range(first + 30, first + 50)])
        system.wait_until(lambda: system.source.store.outbox_depth() == 0, "all images at the relay")
        system.wait_until(lambda wanted=wanted: link.attempts >= wanted, "attempts to connect")
        assert system.shore_image_count() < len(system.expected), "the outage has delayed some images"
        link.mend()
    system.assert_all_delivered_once()
