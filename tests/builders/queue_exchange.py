"""A transmit queue, a receiver, and a channel between them that loses frames."""

from collections.abc import Callable

import numpy as np

from builders.v1_world import VEHICLE, contact, queue_config, stream, take_packet
from sonarpost.link.coding.byte_ranges import count_positions
from sonarpost.link.downlink.messages import image_of_number, number_of_image
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.queue.transmit_queue import TransmitQueue
from sonarpost.link.receiver import ImageUpdate, MessageReceived
from sonarpost.link.sender import ImageToSend
from sonarpost.modem.micromodem import RATES

VESSEL = 1


class Exchange:
    """A vehicle and a vessel, and the stream of each image as far as the vessel received it."""

    def __init__(self, loss: float = 0.3, **config: object) -> None:
        rng = np.random.default_rng(5)
        self.lost: Callable[[], bool] = lambda: bool(rng.random() < loss)
        self.config = queue_config(expected_loss=max(loss, 0.05), **config)
        self.queue = TransmitQueue(self.config)
        self.receiver = V1Receiver()
        self.streams: dict[int, bytes] = {}
        self.shown: dict[int, bytes] = {}
        self.now = 0.0

    def add(self, number: int, length: int = 300) -> None:
        self.streams[number] = stream(number, length)
        image = ImageToSend(image_of_number(number), f"c{number}", contact(number), self.streams[number])
        self.queue.add_image(image, self.now)

    def run(self, seconds: float, *, feedback: bool, reception: bool = True) -> None:
        """Send for `seconds`, or until there is nothing to send."""
        end = self.now + seconds
        while self.now < end:
            frames = take_packet(self.queue, self.now)
            self.now += RATES[self.queue.rate].airtime_s
            for frame in frames:
                if not reception or self.lost():
                    continue
                for event in self.receiver.accept(VEHICLE, frame, self.now):
                    if isinstance(event, MessageReceived):
                        continue
                    assert isinstance(event, ImageUpdate)
                    number = number_of_image(event.image_id)
                    assert self.streams[number].startswith(event.stream)
                    self.shown[number] = event.stream
            if feedback and self.receiver.feedback_is_due(VEHICLE, self.now):
                feedback_message = self.receiver.feedback(VEHICLE, self.now)
                if feedback_message is not None and not self.lost():
                    self.queue.on_feedback(feedback_message, self.now, VESSEL)

    def restart(self) -> None:
        parts = self.queue.parts()
        self.queue = TransmitQueue(self.config)
        assert not self.queue.restore(parts)

    @property
    def complete(self) -> list[int]:
        return [n for n, data in self.streams.items() if self.shown.get(n) == data]


def all_delivered(exchange: Exchange) -> bool:
    kept = exchange.queue.sender.kept
    return all(count_positions(kept[n].delivered) == len(data) for n, data in exchange.streams.items())
