"""Images stopped by a verdict, resumed, and moved in the transmit queue."""

import pytest
from builders.queue_exchange import VESSEL, Exchange
from builders.v1_world import VEHICLE

from sonarpost.link.downlink.messages import image_of_number

LENGTH = 400


def previewed(loss: float = 0.0, images: int = 6, *, feedback: bool = True, **config: object) -> Exchange:
    """Return an exchange in which the vessel has the previews of all images, and the detail of none."""
    exchange = Exchange(loss, **config)
    if feedback:
        exchange.queue.sender.expect_feedback(expected=True)
    for number in range(1, images + 1):
        exchange.add(number, LENGTH)
    channel, exchange.lost = exchange.lost, lambda: False
    for _ in range(200):
        if len(exchange.shown) == images:
            break
        exchange.run(1.0, feedback=feedback)
    exchange.lost = channel
    assert len(exchange.shown) == images
    assert not exchange.complete
    return exchange


def frames_to_the_end(exchange: Exchange) -> int:
    before = exchange.queue.sender.state.frames_sent
    exchange.run(4 * 3600.0, feedback=True)
    return exchange.queue.sender.state.frames_sent - before


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_stopped_images_take_no_more_air_time(loss: float) -> None:
    everything = frames_to_the_end(previewed(loss))
    exchange = previewed(loss)
    for number in (1, 2, 4, 5):
        assert exchange.queue.stop(number)
    assert frames_to_the_end(exchange) < 0.6 * everything
    assert exchange.complete == [3, 6]
    assert exchange.queue.is_idle
    assert exchange.queue.images_waiting == 0


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_no_feedback_asks_for_the_blocks_of_stopped_images(loss: float) -> None:
    exchange = previewed(loss)
    for number in exchange.streams:
        exchange.queue.stop(number)
    assert frames_to_the_end(exchange) < 30
    assert not exchange.complete
    assert not exchange.receiver.feedback_is_useful(VEHICLE)
    for number in exchange.streams:
        exchange.receiver.stop_image(VEHICLE, number)
    assert exchange.receiver.incomplete_images == 0


@pytest.mark.parametrize("frames_before", [3, 15, 30, 40, 60])
def test_other_images_of_a_partly_sent_block_arrive(frames_before: int) -> None:
    exchange = previewed(loss=0.3)
    exchange.run(frames_before / 3 * 3.2, feedback=True)
    for number in (1, 2, 3, 4, 5):
        exchange.queue.stop(number)
    exchange.restart()
    exchange.run(4 * 3600.0, feedback=True)
    assert 6 in exchange.complete
    assert exchange.queue.is_idle
    assert not exchange.receiver.feedback_is_useful(VEHICLE)


@pytest.mark.parametrize("feedback", [True, False])
def test_resumed_image_arrives_completely(feedback: bool) -> None:
    exchange = previewed(feedback=feedback)
    exchange.queue.stop(2)
    exchange.run(3600.0, feedback=True)
    assert 2 not in exchange.complete
    exchange.restart()
    assert exchange.queue.resume(2, exchange.now)
    assert not exchange.queue.resume(2, exchange.now)
    exchange.run(3600.0, feedback=True)
    assert len(exchange.complete) == 6


def test_image_that_waits_for_its_group_is_stopped_and_resumed() -> None:
    exchange = Exchange(loss=0.0, group_delay_s=600.0)
    exchange.add(1, LENGTH)
    assert exchange.queue.stop(1)
    assert not exchange.queue.images_waiting
    exchange.run(1200.0, feedback=True)
    assert not exchange.shown
    assert exchange.queue.resume(1, exchange.now)
    exchange.run(3600.0, feedback=True)
    assert exchange.complete == [1]


def test_refinement_of_a_stopped_image_sends_its_rest() -> None:
    exchange = previewed()
    exchange.queue.stop(2)
    exchange.run(3600.0, feedback=True)
    assert exchange.queue.refine(2, 0, exchange.now)
    exchange.run(3600.0, feedback=True)
    assert 2 in exchange.complete


def test_unknown_image_is_neither_stopped_nor_moved() -> None:
    exchange = previewed()
    assert not exchange.queue.stop(99)
    assert not exchange.queue.resume(99, 0.0)
    assert not exchange.queue.prioritise(99, 0.0, first=True)


def order_of_completion(exchange: Exchange) -> list[int]:
    found: list[int] = []
    for _ in range(2000):
        exchange.run(3.0, feedback=True)
        found += [number for number in exchange.complete if number not in found]
    return found


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_image_moved_to_the_front_is_completed_first(loss: float) -> None:
    exchange = previewed(loss, images=24)
    assert exchange.queue.prioritise(20, exchange.now, first=True)
    expected = exchange.queue.expected(exchange.now)
    assert expected[0].image_id == image_of_number(20)
    assert expected[0].done_s < expected[1].done_s
    exchange.restart()
    order = order_of_completion(exchange)
    assert order[0] == 20
    assert sorted(order) == list(range(1, 25))


def test_image_moved_to_the_end_is_completed_last() -> None:
    exchange = previewed(images=24)
    assert exchange.queue.prioritise(3, exchange.now, first=False)
    assert exchange.queue.expected(exchange.now)[-1].image_id == image_of_number(3)
    order = order_of_completion(exchange)
    assert order[-1] == 3
    assert sorted(order) == list(range(1, 25))


def test_waiting_image_moved_to_the_front_begins_at_once() -> None:
    exchange = Exchange(loss=0.0, group_delay_s=600.0)
    for number in (1, 2, 3):
        exchange.add(number, LENGTH)
    exchange.queue.prioritise(1, exchange.now, first=False)
    exchange.queue.prioritise(3, exchange.now, first=True)
    assert [image.number for image in exchange.queue.sender.waiting] == [2, 1]
    exchange.run(60.0, feedback=True)
    assert max(exchange.shown, key=lambda number: len(exchange.shown[number])) == 3
    assert len(exchange.queue.sender.waiting) == 2


def test_late_feedback_on_the_replaced_content_delivers_nothing_wrong() -> None:
    exchange = previewed(images=4)
    exchange.run(10.0, feedback=False)
    late = exchange.receiver.feedback(VEHICLE, exchange.now)
    for number in (1, 2, 3):
        exchange.queue.stop(number)
    assert late is not None
    exchange.queue.on_feedback(late, exchange.now, VESSEL)
    assert frames_to_the_end(exchange) < 40
    assert exchange.complete == [4]
