"""Every kind of certificate against every durable key: only what access control allows is accepted.

Each peer knows the origins of all producers, which real peers do not, and claims the highest sequence numbers. The
producers deliver all their records nevertheless.
"""

import hashlib
from collections import Counter
from contextlib import ExitStack

import pytest
from builders.common import eventually

from sonarpost import keys
from sonarpost.delivery.inbox import Inbox
from sonarpost.delivery.outbox import Outbox
from sonarpost.delivery.protocol import attachment, batch_attachment
from sonarpost.delivery.records import OutboxItem
from sonarpost.delivery.store import Store
from sonarpost.errors import PayloadError

pytestmark = pytest.mark.system

VESSEL, VEHICLE = "vessel-1", "uuv-1"
RECORDS = 60
CERTIFICATES = ("uuv-1", "vessel-1", "vessel-2", "shore-1", "console-1", "observer-1")
UPLINK = (keys.shore_inbox(VESSEL),)
TASKING = (keys.tasking_comment(VESSEL), keys.tasking_command(VESSEL))
ON_VESSEL = (
    keys.image_reconstructed(VESSEL),
    keys.contact_decision(VESSEL),
    keys.command(VESSEL, "resend"),
    keys.comment(VESSEL),
    keys.acoustic_image(VESSEL),
    keys.message_received(VESSEL),
    keys.vessel_frames(VESSEL, "vessel-2"),
)
ON_VEHICLE = (
    keys.contact_detected(VEHICLE),
    keys.image_encoded(VEHICLE),
    keys.message_outgoing(VEHICLE),
    keys.command(VEHICLE, "resend"),
)
AT_SHORE = (*UPLINK, keys.shore_inbox("vessel-2"), *TASKING)
ALL_KEYS = (*AT_SHORE, *ON_VESSEL, *ON_VEHICLE)

# What docs/explanation/security.md grants: (certificate, door) to keys.
ALLOWED = {
    ("vessel-1", "shore"): {keys.shore_inbox("vessel-1")},
    ("vessel-2", "shore"): {keys.shore_inbox("vessel-2")},
    ("console-1", "shore"): set(TASKING),
    ("console-1", "vessel"): {keys.contact_decision(VESSEL), keys.command(VESSEL, "resend")},
    ("shore-1", "vessel"): {keys.comment(VESSEL), keys.command(VESSEL, "resend")},
}
# A vehicle on deck publishes below its own prefix, and a vessel below its own.
ALLOWED_PUBLICATIONS = ALLOWED | {
    ("uuv-1", "shore"): set(ON_VEHICLE),
    ("vessel-1", "shore"): set(ON_VESSEL),
    ("vessel-2", "shore"): set(),
}


class Consumer:
    """Inbox of a site that accepts every record with the prefix `valid`."""

    def __init__(self, session, path, name, expressions):
        self.store = Store(path)
        self.refused = 0
        self._inbox = Inbox(session, self.store, name, expressions, self._validate, self._count_refused)

    def _validate(self, key, payload):
        if not payload.startswith(b"valid"):
            raise PayloadError(key, "payload", payload[:10], "a valid record")

    def _count_refused(self, _):
        self.refused += 1

    def received(self):
        return Counter((item.key, item.payload) for item in self.store.inbox_items(100_000))

    def close(self):
        self._inbox.close()
        self.store.close()


class Producer:
    """Outbox of a site."""

    def __init__(self, session, path, queue, expressions):
        self._queue = queue
        self._keys = expressions
        self._count = 0
        self.store = Store(path)
        self.sent: Counter[tuple[str, bytes]] = Counter()
        self._outbox = Outbox(session, self.store)

    def send(self, count):
        with self.store.transaction() as tx:
            for _ in range(count):
                self._count += 1
                key, payload = self._keys[self._count % len(self._keys)], b"valid %d" % self._count
                tx.send(key, self._queue, payload, encoding="")
                self.sent[key, payload] += 1

    @property
    def origin(self):
        return bytes(self.store._query("SELECT origin FROM outbox_next")[0][0])

    def is_done(self):
        return self.store.outbox_depth() == 0

    def close(self):
        self._outbox.close()
        self.store.close()


@pytest.fixture
def sites(world, shore_session, vessel_session, tmp_path):
    with ExitStack() as stack:
        consumers = {
            "c2": Consumer(shore_session, tmp_path / "c2.db", "c2", AT_SHORE),
            "relay": Consumer(vessel_session, tmp_path / "relay.db", "relay", (*ON_VESSEL, *ON_VEHICLE)),
        }
        producers = {
            "uplink": Producer(vessel_session, tmp_path / "uplink.db", "c2", UPLINK),
            "tasking": Producer(shore_session, tmp_path / "tasking.db", "c2", TASKING),
            "vessel": Producer(vessel_session, tmp_path / "vessel.db", "relay", ON_VESSEL),
        }
        for closing in (*consumers.values(), *producers.values()):
            stack.callback(closing.close)
        yield consumers, producers


def attack(session, who, door, origins):
    """Send poisoned queries and publications on every key, and wait for the ends of the queries."""
    queries = []
    highest = 1 << 62
    for key in ALL_KEYS:
        selector = keys.delivery_query(key, "c2" if key in AT_SHORE else "relay")
        for origin in origins:
            for payload in (b"junk", f"valid {who} {door} query".encode()):
                item = OutboxItem("c2", highest, key, "", 4, payload, hashlib.sha256(payload).digest())
                single = attachment(origin, item, 0, highest - 1)
                batch = batch_attachment(origin, [item], highest - 1)
                for attached in (single, batch):
                    queries.append(session.get(selector, payload=payload, attachment=attached, timeout=30))
        session.put(key, f"valid {who} {door} publication".encode())
    for query in queries:
        list(query)


def test_only_granted_records_are_accepted_and_no_peer_blocks_another(world, sites):
    consumers, producers = sites
    for producer in producers.values():
        producer.send(3)
    eventually(lambda: all(p.is_done() for p in producers.values()), what="the first records")
    origins = [producer.origin for producer in producers.values()]
    doors = {"shore": world.shore_tls, "vessel": world.vessel_tls}
    for who in CERTIFICATES:
        for door, endpoint in doors.items():
            with world.open(who, endpoint=endpoint) as session:
                attack(session, who, door, origins[:1])
                attack(session, who, door, origins)  # routes are known now
    for producer in producers.values():
        producer.send(RECORDS)
    eventually(lambda: all(p.is_done() for p in producers.values()), what="all records acknowledged")

    received = consumers["c2"].received() + consumers["relay"].received()
    sent = sum((p.sent for p in producers.values()), Counter())
    assert {record: count for record, count in received.items() if record in sent} == sent
    foreign = received - sent
    accepted: dict[tuple[str, str, str], set[str]] = {}
    for key, payload in foreign:
        _, who, door, kind = payload.decode().split()
        accepted.setdefault((who, door, kind), set()).add(key)
    for who in CERTIFICATES:
        for door in doors:
            assert accepted.get((who, door, "query"), set()) == ALLOWED.get((who, door), set()), (who, door)
            granted = ALLOWED_PUBLICATIONS.get((who, door), set()) | ALLOWED.get((who, door), set())
            assert accepted.get((who, door, "publication"), set()) <= granted, (who, door)
    assert all(consumer.refused for consumer in consumers.values())
