"""Repair of images: sent without feedback, in blocks that left the window or have another frame length, restarts."""

import pytest
from builders.queue_exchange import Exchange, all_delivered


def test_delivered_images_and_received_parts_of_retired_blocks_are_not_sent_again() -> None:
    exchange = Exchange(loss=0.0)
    for number in range(1, 8):
        exchange.add(number)
        exchange.run(60.0, feedback=False)
    first = exchange.queue.sender.state.frames_sent
    assert len(exchange.queue.sender.window.retired) == 14
    there = sum(len(data) for data in exchange.shown.values())
    exchange.add(8)
    exchange.run(7200.0, feedback=True)
    assert len(exchange.complete) == 8
    assert all_delivered(exchange)
    # The missing parts of seven images, and the eighth image.
    cut = 8 * 300 - there
    sent = exchange.queue.sender.state.frames_sent
    assert sent - first <= 2 + 1.25 * cut / exchange.queue.sender.symbol_bytes
    exchange.run(3600.0, feedback=True)
    assert exchange.queue.sender.state.frames_sent == sent
    assert exchange.queue.is_idle


@pytest.mark.parametrize("feedback", [True, False])
def test_restart_at_any_time_loses_no_image(feedback: bool) -> None:
    exchange = Exchange(loss=0.4)
    for number in range(1, 21):
        exchange.add(number)
        exchange.run(90.0, feedback=feedback and number % 3 == 0)
        exchange.restart()
    for _ in range(12):
        exchange.run(1200.0, feedback=True)
        exchange.restart()
    assert len(exchange.complete) == 20
    assert all_delivered(exchange)


def test_feedback_gaps_and_other_frame_lengths_lose_no_image() -> None:
    exchange = Exchange(rates=(1, 0), first_rate=1)
    for number in range(1, 31):
        exchange.add(number)
        # 13 minutes with feedback, 20 without reception: the rate falls back, blocks are given up.
        exchange.run(200.0, feedback=number % 10 < 4, reception=number % 10 < 4)
    exchange.run(6 * 3600.0, feedback=True)
    assert len(exchange.complete) == 30
    assert all_delivered(exchange)


def test_delivered_images_are_deleted_first() -> None:
    exchange = Exchange(loss=0.0, kept_images=8)
    for number in range(1, 5):
        exchange.add(number)
    exchange.run(3600.0, feedback=True)
    assert all_delivered(exchange)
    exchange.run(5400.0, feedback=False, reception=False)
    for number in range(5, 13):
        exchange.add(number)
        exchange.run(2000.0, feedback=False, reception=False)
    assert set(exchange.queue.sender.kept) == set(range(5, 13)), "what may still have to be sent is kept"


def test_refinement_without_feedback_is_repaired_later() -> None:
    exchange = Exchange(stream_bytes=200)
    exchange.add(1, length=900)
    exchange.run(200.0, feedback=False)
    assert exchange.queue.refine(1, 700, exchange.now)
    exchange.run(60.0, feedback=False, reception=False)
    exchange.run(3600.0, feedback=True)
    assert 700 <= len(exchange.shown[1]) < 760
    assert exchange.queue.refine(1, 0, exchange.now)
    exchange.run(3600.0, feedback=True)
    assert exchange.complete == [1]


@pytest.mark.parametrize("length", [28, 29, 30, 31, 32])
def test_stream_that_just_fills_its_preview_is_completed(length: int) -> None:
    exchange = Exchange(loss=0.0)
    exchange.add(1, length)
    exchange.run(600.0, feedback=True)
    assert exchange.complete == [1]
    assert exchange.receiver.counts.complete == 1


def test_reminders_of_a_lost_block_are_sent_among_many_messages() -> None:
    exchange = Exchange(loss=0.0)
    exchange.add(1)
    exchange.run(600.0, feedback=True)
    assert exchange.complete == [1]
    exchange.add(2)
    count = 0
    for minutes in range(10):
        for _ in range(30):  # more than fits
            count += 1
            exchange.queue.add_message(f"m{count}", "flood", bytes([count % 256]) * 55, exchange.now, lifetime_s=600.0)
        # At first no frame of the second image arrives, so the receiver cannot feedback_message it as missing.
        exchange.run(60.0, feedback=True, reception=minutes >= 3)
    assert exchange.complete == [1, 2]
