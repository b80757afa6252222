"""Sender and receiver of short messages: loss, duplication, reordering, restarts, limits."""

import random

import pytest
from builders.short_messages import decision, received
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.bearers.receiver import ACKNOWLEDGE_AFTER_S, MessageReceiver
from sonarpost.bearers.sender import MessageSender, QueuedItem, decision_items, image_items, image_name
from sonarpost.bearers.short_message import Acknowledgement, Item, ItemType, ShortMessage, ShortMessageError
from sonarpost.messages import Decision


def add(sender, record, now_s=0.0, preview_bytes=260):
    """Queue a record; return its items and the numbers of those to remove."""
    if isinstance(record, Decision):
        items = decision_items(record, sender.next_number, now_s)
    else:
        items = image_items(record, sender.next_number, preview_bytes, now_s)
    return items, sender.insert(items)


class Exchange:
    """A sender and a receiver that are restarted at random, with a lossy bearer and a simulated clock."""

    def __init__(self, seed, loss=0.2, restarts=0.0, duplicates=0.1, **options):
        self.rng = random.Random(seed)
        self.loss, self.restarts, self.duplicates = loss, restarts, duplicates
        self.options = options
        self.sender = MessageSender(7)
        self.receiver = MessageReceiver("vessel-1")
        self.stored_items, self.stored_messages = {}, {}
        self.records, self.sizes, self.now_s = [], [], 0.0
        self.to_shore, self.to_vessel = [], []

    def add(self, record):
        queued, removed = add(self.sender, record, self.now_s, **self.options)
        self.stored_items.update((item.number, item.pack()) for item in queued)
        for number in removed:
            self.stored_items.pop(number)

    def _carry(self, queue, data):
        for _ in range(1 + (self.rng.random() < self.duplicates)):
            if self.rng.random() >= self.loss:
                queue.append((self.now_s + self.rng.uniform(1, 120), data))

    def step(self, step_s=10.0):
        self.now_s += step_s
        message = self.sender.next_message(self.now_s)
        if message is not None:
            assert len(message.data) <= 340
            self.stored_messages[message.seq] = message.stored
            for number in message.packed:
                del self.stored_items[number]
            self.sizes.append(len(message.data))
            self._carry(self.to_shore, message.data)
        for due in sorted(entry for entry in self.to_shore if entry[0] <= self.now_s):
            self.to_shore.remove(due)
            self.records += self.receiver.receive(due[1], self.now_s)
        for ack in self.receiver.acknowledgements(self.now_s):
            self._carry(self.to_vessel, ack)
        for due in sorted(entry for entry in self.to_vessel if entry[0] <= self.now_s):
            self.to_vessel.remove(due)
            for seq in self.sender.acknowledge(due[1], self.now_s):
                del self.stored_messages[seq]
        if self.rng.random() < self.restarts:
            self.restart()

    def restart(self):
        self.sender = MessageSender(7, self.sender.next_seq, self.sender.next_number)
        items = [QueuedItem.unpack(data) for data in self.stored_items.values()]
        self.sender.restore(items, self.stored_messages.values(), self.now_s)
        self.receiver = MessageReceiver.unpack("vessel-1", self.receiver.pack())

    def run(self, limit=20_000):
        for _ in range(limit):
            if not (self.sender.waiting or self.sender.unacknowledged):
                return
            self.step()
        raise AssertionError(f"{self.sender.waiting} items, {self.sender.unacknowledged} messages left")


@given(st.integers(0, 2**32), st.floats(0, 0.6), st.floats(0, 0.2), st.integers(0, 260))
def test_every_record_arrives_once_with_any_loss_and_restarts(seed, loss, restarts, preview_bytes):
    exchange = Exchange(seed, loss, restarts, preview_bytes=preview_bytes)
    images = [received(n, vehicle=f"uuv-{n % 3}") for n in range(1, 31)]
    decisions = [decision(f"d{n}", remark="x" * (n * 250)) for n in range(6)]
    for n, record in enumerate((*images, *decisions)):
        exchange.add(record)
        if n % 4 == 0:
            exchange.step()
    exchange.run()
    names = sorted(r.decision_id if isinstance(r, Decision) else r.image_id for r in exchange.records)
    assert names == sorted([*(i.image_id for i in images), *(d.decision_id for d in decisions)])
    assert all(r in decisions for r in exchange.records if isinstance(r, Decision))
    # The whole stream of 200 bytes fits, except where other items share the message.
    assert preview_bytes < 220 or any(r in images for r in exchange.records)


def test_several_contacts_share_a_message_and_decisions_go_first():
    sender = MessageSender(1)
    for n in range(1, 5):
        add(sender, received(n), preview_bytes=60)
    add(sender, decision())
    first = ShortMessage.unpack(sender.next_message(0.0).data)
    assert [item.type for item in first.items] == [ItemType.DECISION] + [ItemType.CONTACT] * 2
    second = ShortMessage.unpack(sender.next_message(0.0).data)
    assert [item.type for item in second.items] == [ItemType.CONTACT] * 2
    assert sender.next_message(0.0) is None


def test_newer_version_replaces_a_queued_one_and_a_delivered_image_is_withdrawn():
    sender = MessageSender(1)
    add(sender, received(1))
    _, replaced = add(sender, received(1, version=2))
    assert replaced == (0,)
    add(sender, received(2))
    assert sender.withdraw(image_name("uuv-1", "0002")) == (2,)
    assert sender.withdraw("unknown") == ()
    [record] = MessageReceiver("vessel-1").receive(sender.next_message(0.0).data, 0.0)
    assert record.version == 2
    # More detail of an image whose first version is in a message waits for another way.
    assert add(sender, received(1, version=3))[1] == (3,)
    assert sender.next_message(0.0) is None


def test_items_wait_for_another_way_first():
    sender = MessageSender(1, after_s=60.0)
    add(sender, received(1), now_s=100.0)
    assert sender.next_message(159.0) is None
    assert sender.next_due_s() == 160.0
    assert sender.next_message(160.0).packed == (0,)


def test_message_is_repeated_later_and_later_and_at_once_when_a_later_one_arrived():
    sender = MessageSender(1)
    for n in (1, 2):
        add(sender, received(n))
    assert sender.next_message(0.0).seq == 0
    assert sender.next_message(1.0).seq == 1
    assert sender.next_message(299.0) is None
    assert sender.next_due_s() == 300.0
    assert sender.next_message(300.0).seq == 0
    assert sender.next_message(301.0).seq == 1
    assert sender.next_message(899.0) is None
    sender.failed(0, 880.0, 5.0)
    assert sender.next_due_s() == 885.0
    # Message 1 was sent after message 0 and has arrived.
    assert sender.acknowledge(Acknowledgement(1, 0, frozenset({1})).pack(), 890.0) == (1,)
    assert sender.next_message(890.0).seq == 0
    assert sender.acknowledge(Acknowledgement(1, 2).pack(), 900.0) == (0,)
    assert sender.next_due_s() is None


def test_window_limits_unacknowledged_messages():
    sender = MessageSender(1)
    for n in range(1, 301):
        add(sender, received(n))
    sent = []
    while (message := sender.next_message(0.0)) is not None:
        sent.append(message)
    assert (len(sent), sender.waiting) == (256, 44)
    sender.acknowledge(Acknowledgement(1, 3).pack(), 1.0)
    assert sender.next_message(1.0).seq == 256


def test_acknowledgement_of_messages_that_were_never_made_is_refused():
    sender = MessageSender(1)
    add(sender, received(1))
    sender.next_message(0.0)
    for ack in (Acknowledgement(1, 2), Acknowledgement(1, 0, frozenset({5}))):
        with pytest.raises(ShortMessageError, match="acknowledgement"):
            sender.acknowledge(ack.pack(), 0.0)
    assert sender.acknowledge(Acknowledgement(99, 1).pack(), 0.0) == ()
    assert sender.unacknowledged == 1


def test_receiver_follows_the_sender_after_its_own_store_was_lost_and_bounds_its_state():
    sender = MessageSender(1, next_seq=5000)
    add(sender, received(1))
    receiver = MessageReceiver("vessel-1")
    data = sender.next_message(0.0).data
    assert len(receiver.receive(data, 0.0)) == 1
    assert receiver.receive(data, 0.0) == []
    assert receiver.acknowledgements(ACKNOWLEDGE_AFTER_S - 1) == []
    [ack] = receiver.acknowledgements(ACKNOWLEDGE_AFTER_S)
    assert sender.acknowledge(ack, 60.0) == (5000,)
    for epoch in range(2000):
        receiver.receive(ShortMessage(epoch, 0, 0, ()).pack(), 0.0)
    for number in range(1000):
        item = Item(ItemType.DECISION_FRAGMENT, number.to_bytes(4, "big") + b"\0\2x")
        receiver.receive(ShortMessage(9, number, max(0, number - 200), (item,)).pack(), 0.0)
    assert len(receiver.pack()) < 20_000
