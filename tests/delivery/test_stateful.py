"""Random sequences of faults with the real store, outbox and inbox: invariants of `docs/specifications/delivery.md`."""

import hashlib
import shutil
import tempfile
from contextlib import ExitStack
from pathlib import Path
from unittest import mock

import msgpack
import pytest
from builders.delivery_machine import Delivery, query_of
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from sonarpost.delivery import queue_sender, received
from sonarpost.delivery.received import DuplicateWindow

DECISION = "sonarpost/v1/vessel-1/contact/decision"
IMAGE = "sonarpost/v1/vessel-1/image/reconstructed"
OTHER_IMAGE = "sonarpost/v1/vessel-2/image/reconstructed"
PRODUCER_KEYS = ((DECISION, IMAGE), (IMAGE, OTHER_IMAGE))
HOSTILE_KEYS = ("sonarpost/v1/other/tasking/a/comment", "sonarpost/v1/other/tasking/b/comment", "sonarpost/v1/other/x")
MAX_RESTORES = 2
SMALL_LIMITS = {
    (queue_sender, "BACK_OFF_S"): (0.0,),
    # Two producers with three origins each share a key; all others have fewer windows.
    (received, "MAX_WINDOWS"): 2 * (1 + MAX_RESTORES),
    (received, "MAX_WRITER_RECORDS"): 2,
    (received, "MAX_RECORDS"): 10,
}
WHICH = st.integers(0, 1)
ANY = st.integers(0, 10**6)


class DeliveryFaults(RuleBasedStateMachine):
    """Faults of producers, consumer, network and a peer that may write to other keys and has all origins."""

    @initialize()
    def start(self):
        # In memory where possible: opening a store flushes its files.
        memory = Path("/dev/shm")
        self.folder = Path(tempfile.mkdtemp(prefix="delivery-", dir=memory if memory.is_dir() else None))
        self.delivery = Delivery(self.folder, PRODUCER_KEYS, HOSTILE_KEYS)
        self.restores = [0, 0]
        self.hostile_serial = 100

    def teardown(self):
        if not hasattr(self, "delivery"):
            return
        try:
            self.delivery.deliver_everything()
            self.delivery.handle(10**6)
            self.delivery.check()
        finally:
            self.delivery.close()
            shutil.rmtree(self.folder)

    @property
    def sent(self):
        return self.delivery.network.sent

    # Producers

    @rule(which=WHICH, second=st.booleans(), count=st.integers(1, 4), valid=st.integers(0, 9))
    def queue(self, which, second, count, valid):
        for _ in range(count):
            self.delivery.queue(which, PRODUCER_KEYS[which][second], 100, valid=valid > 0)

    @rule(which=WHICH, second=st.booleans(), size_bytes=st.sampled_from([32768, 32769, 70_000]))
    def queue_large(self, which, second, size_bytes):
        self.delivery.queue(which, PRODUCER_KEYS[which][second], size_bytes)

    @rule(which=WHICH, topic=st.sampled_from(["t1", "t2"]))
    def queue_edition(self, which, topic):
        self.delivery.queue(which, PRODUCER_KEYS[which][0], 100, topic=topic)

    @rule(which=WHICH)
    def send(self, which):
        self.delivery.producers[which].send()

    @rule(which=WHICH)
    def use_replies(self, which):
        self.delivery.producers[which].use_replies()

    @rule(which=WHICH)
    def remove_acknowledged(self, which):
        self.delivery.producers[which].sender._remove_acknowledged()

    @rule(which=WHICH)
    def kill_producer(self, which):
        self.delivery.kill_producer(which)

    @rule(which=WHICH)
    def back_up(self, which):
        self.delivery.back_up(which)

    @precondition(lambda self: any(producer.backup for producer in self.delivery.producers))
    @rule(which=WHICH)
    def restore(self, which):
        if self.delivery.producers[which].backup is not None and self.restores[which] < MAX_RESTORES:
            self.restores[which] += 1
            self.delivery.restore(which)

    @rule(which=WHICH, lost=st.booleans())
    def exchange(self, which, lost):
        """Send, receive and reply without a fault; the process may be killed before it uses the replies."""
        producer, already = self.delivery.producers[which], len(self.sent)
        producer.send()
        new = self.sent[already:]
        if new:
            self.delivery.receive(new)
        for query in new:
            query.end(query.replies[-1])
        if lost:
            self.delivery.kill_producer(which)
        else:
            producer.use_replies()
            producer.sender._remove_acknowledged()

    @rule(which=WHICH, second=st.booleans(), before=st.integers(0, 2), after=st.integers(1, 3))
    def restore_after_deliveries(self, which, second, before, after):
        if self.restores[which] == MAX_RESTORES:
            return
        for _ in range(before):
            self.delivery.queue(which, PRODUCER_KEYS[which][second], 100)
        self.back_up(which)
        for _ in range(after):
            self.delivery.queue(which, PRODUCER_KEYS[which][second], 100)
        self.exchange(which, lost=False)
        self.restore(which)
        self.delivery.queue(which, PRODUCER_KEYS[which][second], 100)

    # Network: any query arrives at any time and any number of times; replies arrive late or are lost.

    @precondition(lambda self: self.sent)
    @rule(chosen=st.lists(ANY, min_size=1, max_size=6))
    def deliver_any(self, chosen):
        self.delivery.receive([self.sent[number % len(self.sent)] for number in chosen])

    @precondition(lambda self: self.sent)
    @rule(count=st.integers(1, 8))
    def deliver_latest(self, count):
        self.delivery.receive(self.sent[-count:])

    @precondition(lambda self: self.sent)
    @rule(count=st.integers(1, 12))
    def reply_in_order(self, count):
        for query in [q for q in self.sent if q.replies and not q.has_ended][:count]:
            query.end(query.replies[0])

    @precondition(lambda self: self.sent)
    @rule(number=ANY)
    def lose_reply(self, number):
        self.sent[number % len(self.sent)].end()

    # Consumer

    @rule()
    def kill_consumer(self):
        self.delivery.kill_consumer()

    @rule(at_once=st.booleans())
    def handle_at_once(self, at_once):
        """From then on, handle records in the transaction that accepts them, or only later."""
        self.delivery.handles_at_once = at_once

    @rule(limit=st.integers(1, 5))
    def handle(self, limit):
        self.delivery.handle(limit)

    # A peer that may write to its own keys only. It has the origins, which watchers do not receive.

    @rule(
        key=st.sampled_from(HOSTILE_KEYS),
        number=ANY,
        seq_from=st.sampled_from(["same", "next", "small", "far"]),
        done_up_to_below_seq=st.booleans(),
        content=st.sampled_from(["junk", "own", "same", "wrong digest", "first chunk", "batch"]),
        own_origin=st.one_of(st.none(), st.integers(0, 9)),
        with_producer=st.booleans(),
    )
    def attack(self, key, number, seq_from, done_up_to_below_seq, content, own_origin, with_producer):
        origin, seq, payload = bytes([number % 5]) * 16, 1, b"x"
        companions = []
        if self.sent:
            seen = self.sent[number % len(self.sent)]
            fields = msgpack.unpackb(seen.attached)
            origin = fields["origin"]
            seq = fields["seq"] if fields["v"] == 1 else fields["records"][0][0]
            payload = seen.content
            companions = [seen] if with_producer else []
        if own_origin is not None:
            origin = bytes([own_origin]) * 16
        seq = {"same": seq, "next": seq + 1, "small": 1 + number % 9, "far": 2**62}[seq_from]
        done_up_to = seq - 1 if done_up_to_below_seq else 0
        own = f"{key} valid own {number % 7}".encode()
        records = {
            "junk": [(seq, b"junk")],
            "own": [(seq, own)],
            "same": [(seq, payload)],
            "wrong digest": [(seq, own)],
            "first chunk": [(seq, own)],
            "batch": [(seq, own), (seq + 1, b"junk"), (seq + 2, own + b"+")],
        }[content]
        with_digest = [(n, data, hashlib.sha256(data).digest()) for n, data in records]
        if content == "wrong digest":
            with_digest = [(seq, own, hashlib.sha256(payload).digest())]
        whole_bytes = 40_000 if content == "first chunk" else 0
        query = query_of(key, origin, with_digest, done_up_to, whole_bytes=whole_bytes)
        if not companions:
            before = self.delivery.consumer_state_of_producers()
            self.delivery.receive([query])
            assert self.delivery.consumer_state_of_producers() == before, "I4: another writer's state has changed"
        else:
            # In one transaction with a query of a producer.
            self.delivery.receive([query, *companions])

    @rule(key=st.sampled_from(HOSTILE_KEYS), more=st.integers(1, 3))
    def send_from_many_origins(self, key, more):
        """Fill the windows of a writer, then use new ones together with those that were used least recently."""
        limit = received.MAX_WINDOWS
        for origins in (range(limit), [*range(limit, limit + more), *range(limit)]):
            queries = []
            for number in origins:
                self.hostile_serial += 1
                data = f"{key} valid own {self.hostile_serial}".encode()
                records = [(self.hostile_serial, data, hashlib.sha256(data).digest())]
                queries.append(query_of(key, bytes([100 + number]) * 16, records, 0))
            self.delivery.receive(queries)

    @precondition(lambda self: self.sent)
    @rule(number=ANY)
    def attack_same_key(self, number):
        """Send other bytes under the identity of a producer's record, on its own key."""
        seen = self.sent[number % len(self.sent)]
        fields = msgpack.unpackb(seen.attached)
        if fields["v"] == 1:
            seq, digest = fields["seq"], fields["sha256"]
        else:  # a batch has one digest of all its records
            seq, size = fields["records"][0]
            digest = hashlib.sha256(seen.content[:size]).digest()
        key = seen.key.removesuffix("/delivery/relay")
        windows, _, inbox = self.delivery.consumer_state_of_producers()
        self.delivery.receive([query_of(key, fields["origin"], [(seq, f"{key} valid own".encode(), digest)], 0)])
        after = self.delivery.consumer_state_of_producers()
        assert (after[0], after[2]) == (windows, inbox)  # with the origin, it can interrupt a transfer in chunks

    @invariant()
    def invariants_hold(self):
        if hasattr(self, "delivery"):
            self.delivery.check()


def run(max_examples, steps, *, only_generate=False):
    profile = settings(
        max_examples=max_examples,
        stateful_step_count=steps,
        phases=(Phase.generate,) if only_generate else tuple(Phase),
        suppress_health_check=list(HealthCheck),
    )
    with ExitStack() as stack:
        for (module, name), value in SMALL_LIMITS.items():
            stack.enter_context(mock.patch.object(module, name, value))
        run_state_machine_as_test(DeliveryFaults, settings=profile)


@pytest.mark.timeout(3600)
@pytest.mark.parametrize(("examples", "steps"), [(25, 40), pytest.param(150, 60, marks=pytest.mark.system)])
def test_random_faults_keep_the_invariants(examples, steps):
    run(examples, steps)


def contains_number(window, seq, sha256):
    """Compare numbers only, as a consumer without digests does."""
    del sha256
    sql = "SELECT 1 FROM received WHERE window = ? AND seq = ?"
    return bool(window._new.get(seq)) or window._db.execute(sql, (window._id, seq)).fetchone() is not None


original_init = DuplicateWindow.__init__


def init_for_all_keys(window, connection, key, origin):
    """Use one window for all keys."""
    del key
    original_init(window, connection, "all", origin)


@pytest.mark.parametrize(
    ("method", "replacement"),
    [
        pytest.param("contains", contains_number, id="digest not compared", marks=pytest.mark.system),
        pytest.param("__init__", init_for_all_keys, id="one window for all keys"),
    ],
)
def test_random_faults_find_a_defect(method, replacement):
    with mock.patch.object(DuplicateWindow, method, replacement), pytest.raises(AssertionError, match=r"I[1-4]: "):
        # Ends at the first failure. Hypothesis also draws constants of the loaded modules: how many are needed varies.
        run(2000, 40, only_generate=True)
