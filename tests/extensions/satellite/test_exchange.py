"""Sender and receiver of short messages: loss, duplication, reordering, restarts, limits."""

import contextlib
import random
import struct

import msgpack
import pytest
from extensions.satellite.records import decision, received, with_crc
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.errors import BadInputError
from sonarpost.extensions.satellite.policy import ByteBudget
from sonarpost.extensions.satellite.receiver import ACKNOWLEDGE_AFTER_S, MAX_FRAGMENTS_KEPT, ShortMessageReceiver
from sonarpost.extensions.satellite.sender import (
    PendingMessage,
    QueuedItem,
    ShortMessageSender,
    decision_items,
    image_items,
    image_name,
)
from sonarpost.extensions.satellite.short_message import (
    Item,
    ItemType,
    ShortAcknowledgement,
    ShortMessage,
    ShortMessageError,
)
from sonarpost.link.state import SavedParts
from sonarpost.messages import Decision

ANY = st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=5) | st.binary(max_size=5) | st.none()


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
        self.sender = ShortMessageSender(7)
        self.receiver = ShortMessageReceiver("vessel-1")
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
        self.sender = ShortMessageSender(7, self.sender.next_seq, self.sender.next_number)
        items = [QueuedItem.unpack(data) for data in self.stored_items.values()]
        self.sender.restore(items, map(PendingMessage.unpack, self.stored_messages.values()), self.now_s)
        parts, self.receiver = self.receiver.parts(), ShortMessageReceiver("vessel-1")
        for name, data in parts.items():
            self.receiver.restore(name, data)

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
    sender = ShortMessageSender(1)
    for n in range(1, 5):
        add(sender, received(n), preview_bytes=60)
    add(sender, decision())
    first = ShortMessage.unpack(sender.next_message(0.0).data)
    assert [item.type for item in first.items] == [ItemType.DECISION] + [ItemType.CONTACT] * 2
    second = ShortMessage.unpack(sender.next_message(0.0).data)
    assert [item.type for item in second.items] == [ItemType.CONTACT] * 2
    assert sender.next_message(0.0) is None


def test_many_contacts_of_one_vehicle_delay_one_of_another_by_one_message():
    sender = ShortMessageSender(1)
    for n in range(1, 101):
        add(sender, received(n, vehicle="uuv-1"))
    add(sender, received(101, vehicle="uuv-2"))
    add(sender, received(102, vehicle="uuv-3"))
    sent = [sender.next_message(0.0).packed for _ in range(102)]
    assert sent[:4] == [(0,), (100,), (101,), (1,)]
    assert sorted(number for packed in sent for number in packed) == list(range(102))


def test_newer_version_replaces_a_queued_one_and_a_delivered_image_is_withdrawn():
    sender = ShortMessageSender(1)
    add(sender, received(1))
    _, replaced = add(sender, received(1, version=2))
    assert replaced == (0,)
    add(sender, received(2))
    assert sender.withdraw(image_name("uuv-1", "0002")) == (2,)
    assert sender.withdraw("unknown") == ()
    [record] = ShortMessageReceiver("vessel-1").receive(sender.next_message(0.0).data, 0.0)
    assert record.version == 2
    # More detail of an image whose first version is in a message waits for another way.
    assert add(sender, received(1, version=3))[1] == (3,)
    assert sender.next_message(0.0) is None


def test_items_wait_for_another_way_first():
    sender = ShortMessageSender(1, after_s=60.0)
    add(sender, received(1), now_s=100.0)
    assert sender.next_message(159.0) is None
    assert sender.next_message(160.0).packed == (0,)


def test_message_is_repeated_later_and_later_and_at_once_when_a_later_one_arrived():
    sender = ShortMessageSender(1)
    for n in (1, 2):
        add(sender, received(n))
    assert sender.next_message(0.0).seq == 0
    assert sender.next_message(1.0).seq == 1
    assert sender.next_message(299.0) is None
    assert sender.next_message(300.0).seq == 0
    assert sender.next_message(301.0).seq == 1
    assert sender.next_message(899.0) is None
    sender.failed(0, 880.0, 5.0)
    assert sender.next_message(884.0) is None
    # Message 1 was sent after message 0 and has arrived.
    assert sender.acknowledge(ShortAcknowledgement(1, 0, frozenset({1})).pack(), 890.0) == (1,)
    assert sender.next_message(890.0).seq == 0
    assert sender.acknowledge(ShortAcknowledgement(1, 2).pack(), 900.0) == (0,)
    assert sender.next_message(100_000.0) is None


def test_window_limits_unacknowledged_messages():
    sender = ShortMessageSender(1)
    for n in range(1, 301):
        add(sender, received(n))
    sent = []
    while (message := sender.next_message(0.0)) is not None:
        sent.append(message)
    assert (len(sent), sender.waiting) == (256, 44)
    sender.acknowledge(ShortAcknowledgement(1, 3).pack(), 1.0)
    assert sender.next_message(1.0).seq == 256


def test_acknowledgement_of_messages_that_were_never_made_is_refused():
    sender = ShortMessageSender(1)
    add(sender, received(1))
    sender.next_message(0.0)
    with pytest.raises(ShortMessageError, match="acknowledgement"):
        sender.acknowledge(ShortAcknowledgement(1, 2).pack(), 0.0)
    assert sender.acknowledge(ShortAcknowledgement(99, 1).pack(), 0.0) == ()
    assert sender.unacknowledged == 1
    # c2 has received a forged message of this vessel: true messages are acknowledged nevertheless.
    assert sender.acknowledge(ShortAcknowledgement(1, 0, frozenset({5})).pack(), 0.0) == ()
    assert sender.acknowledge(ShortAcknowledgement(1, 1, frozenset({5})).pack(), 0.0) == (0,)


def test_receiver_follows_the_sender_after_its_own_store_was_lost_and_bounds_its_state():
    sender = ShortMessageSender(1, next_seq=5000)
    add(sender, received(1))
    receiver = ShortMessageReceiver("vessel-1")
    data = sender.next_message(0.0).data
    assert len(receiver.receive(data, 0.0)) == 1
    assert receiver.receive(data, 0.0) == []
    assert receiver.acknowledgements(ACKNOWLEDGE_AFTER_S - 1) == []
    [ack] = receiver.acknowledgements(ACKNOWLEDGE_AFTER_S)
    assert sender.acknowledge(ack, 60.0) == (5000,)
    for epoch in range(2000):
        receiver.receive(ShortMessage(epoch, 0, 0, ()).pack(), 0.0)
    saved, sizes = SavedParts({}), []
    for number in range(2000):
        items = [Item(ItemType.DECISION_FRAGMENT, struct.pack(">IBB", 3 * number + n, 0, 2) + b"x") for n in range(3)]
        receiver.receive(ShortMessage(9, number, max(0, number - 200), tuple(items)).pack(), 0.0)
        parts = receiver.parts()
        sizes.append(sum(len(data or b"") for data in saved.changes(parts).values()))
        saved.commit(parts)
    assert len(receiver.parts()) <= MAX_FRAGMENTS_KEPT + 1
    assert receiver.take_lost() == 6000 - MAX_FRAGMENTS_KEPT
    assert max(sizes) < 6000


def numbered(sender, count, first=0):
    """Return new messages of a sender, each with one decision."""
    found = []
    for n in range(first, first + count):
        add(sender, decision(f"d{n}"))
        found.append(sender.next_message(0.0).data)
    return found


@given(st.integers(0, 2**32 - 2), st.integers(0, 255))
def test_message_with_any_numbers_displaces_no_message_of_the_vessel(seq, behind):
    sender, receiver = ShortMessageSender(7), ShortMessageReceiver("vessel-1")
    messages = numbered(sender, 5)
    forged = ShortMessage(7, seq, max(0, seq - behind), ()).pack()
    records = [record for data in (*messages, forged) for record in receiver.receive(data, 0.0)]
    for n in range(5, 300):
        records += receiver.receive(numbered(sender, 1, n)[0], 0.0)
        for ack in receiver.acknowledgements(1000.0):
            # Those of the forged window are refused.
            with contextlib.suppress(ShortMessageError):
                sender.acknowledge(ack, 0.0)
    assert [record.decision_id for record in records] == [f"d{n}" for n in range(300)]
    assert sender.unacknowledged <= 1


def test_messages_of_forged_epochs_make_no_message_count_as_received():
    sender, receiver = ShortMessageSender(7), ShortMessageReceiver("vessel-1")
    messages = numbered(sender, 20)
    forged = [ShortMessage(epoch, 0, 0, ()).pack() for epoch in range(100, 110)]
    records = [
        record
        for data in (*messages[:15], *forged, ShortMessage(7, 19, 19, ()).pack())
        for record in receiver.receive(data, 0.0)
    ]
    for ack in receiver.acknowledgements(ACKNOWLEDGE_AFTER_S):
        sender.acknowledge(ack, 0.0)
    assert sender.unacknowledged == 4, "15 to 18 were not received; 19 has the number of the forged one"
    records += [record for data in messages[15:] for record in receiver.receive(data, 0.0)]
    assert [record.decision_id for record in records] == [f"d{n}" for n in range(20)]


def test_last_sequence_number_is_refused_and_every_other_can_be_acknowledged():
    receiver = ShortMessageReceiver("vessel-1")
    with pytest.raises(ShortMessageError, match="seq"):
        receiver.receive(with_crc(struct.pack(">BIIB", 0xB1, 5, 2**32 - 1, 0)), 0.0)
    receiver.receive(ShortMessage(5, 2**32 - 2, 2**32 - 2, ()).pack(), 0.0)
    [ack] = receiver.acknowledgements(ACKNOWLEDGE_AFTER_S)
    assert ShortAcknowledgement.unpack(ack) == ShortAcknowledgement(5, 2**32 - 1)
    with pytest.raises(ShortMessageError):
        ShortAcknowledgement(5, 2**32).pack()


def test_receiver_of_an_older_copy_of_the_store_and_a_sender_that_lost_a_message_continue():
    sender, receiver = ShortMessageSender(7), ShortMessageReceiver("vessel-1")
    for n in range(1000):
        [data] = numbered(sender, 1, n)
        if n == 300:
            del sender._pending[n]  # it is never sent
        elif not 500 <= n < 900:  # received by the later copy
            assert [r.decision_id for r in receiver.receive(data, 0.0)] == [f"d{n}"]
            assert receiver.receive(data, 0.0) == []
        else:
            del sender._pending[n]
        for ack in receiver.acknowledgements(1000.0):
            sender.acknowledge(ack, 0.0)
    assert sender.unacknowledged == 0


def test_wrong_fragment_costs_its_decision_only():
    sender, receiver = ShortMessageSender(7), ShortMessageReceiver("vessel-1")
    add(sender, decision("d1", remark="x" * 500))
    first, last = (sender.next_message(0.0).data for _ in range(2))
    item = ShortMessage.unpack(first).items[0]
    wrong = Item(item.type, item.content[:6] + bytes(len(item.content) - 6))
    receiver.receive(ShortMessage(7, 100, 0, (wrong,)).pack(), 0.0)
    assert receiver.receive(last, 0.0) == []
    assert receiver.take_lost() == 1
    assert len(receiver.receive(numbered(sender, 1)[0], 0.0)) == 1
    assert len(receiver.parts()) == 1


@given(st.sampled_from(["windows", "1/2/3/0"]), st.binary(max_size=60) | st.recursive(ANY, st.lists).map(msgpack.packb))
def test_damaged_state_of_the_receiver_is_refused_or_harmless(name, data):
    receiver = ShortMessageReceiver("vessel-1")
    with contextlib.suppress(BadInputError):
        receiver.restore(name, data)
    assert len(receiver.receive(numbered(ShortMessageSender(7), 1)[0], 0.0)) == 1
    receiver.acknowledgements(1e12)


@given(st.binary(max_size=60) | st.recursive(ANY, st.lists).map(msgpack.packb))
def test_damaged_state_of_the_sender_is_refused(data):
    for parse in (QueuedItem.unpack, PendingMessage.unpack, ByteBudget().restore):
        with contextlib.suppress(BadInputError):
            parse(data)
