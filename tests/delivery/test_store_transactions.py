"""Transactions of the durable store: atomicity after kills and full disks, and with several threads."""

import itertools
import random
import subprocess
import sys
import threading

import msgpack
import pytest
from builders.store_steps import fail_within, queued_items, record, send
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import ROWS_PER_STATEMENT, UnitOfWork, runs
from sonarpost.errors import DeliveryError


def test_state_is_remembered_replaced_and_forgotten(store, open_store):
    effects = UnitOfWork()
    effects.put_states("part/", {"a": b"1", "b": b"", "c": b"3"})
    effects.put_state("party", b"other")
    with store.transaction() as tx:
        effects.write(tx)
        assert store.get_state("party") == b"other"
    effects = UnitOfWork()
    effects.put_states("part/", {"a": b"2", "c": None})
    with store.transaction() as tx:
        effects.write(tx)
        tx.put_state("x", b"1")
        tx.put_state("x", b"2")
        tx.delete_state("absent")
    store = open_store()
    assert store.states("part/") == {"a": b"2", "b": b""}
    assert store.states("absent/") == {}
    assert [store.get_state(name) for name in ("party", "x", "absent")] == [b"other", b"2", None]
    with store.transaction() as tx:
        tx.delete_state("x")
        assert store.get_state("x") is None
    assert store.get_state("x") is None


KILLED = """
import itertools, sys
from hashlib import sha256
from pathlib import Path
from sonarpost.delivery.records import ReceivedChunk
from sonarpost.delivery.store import Store
store = Store(Path(sys.argv[1]))
first = int(store.get_state("n") or b"0") + 1
for n in itertools.count(first):
    with store.transaction() as tx:
        for part in range(5):
            payload = b"%d/%d" % (n, part)
            chunk = ReceivedChunk(b"o" * 16, 5 * n + part - 4, len(payload), sha256(payload).digest(), 0, payload)
            assert not tx.was_received("k", chunk)
            tx.accept("k", payload, chunk)
        for item in store.inbox_items(3):
            tx.remove_handled(item)
            tx.send("k", "c", item.payload, encoding="e")
        tx.put_state("n", b"%d" % n)
    print(n, flush=True)
"""


def check_complete(path, reported):
    """Check that all transactions up to `reported` or the next one are complete."""
    store = Store(path)
    assert store._query("PRAGMA integrity_check") == [("ok",)]
    done = int(store.get_state("n") or b"0")
    assert done in (reported, reported + 1)  # the last one can be committed and not yet reported
    inbox = [item.payload for item in store.inbox_items(10**6)]
    queued = queued_items(store, "c", 10**6)
    # Handled records are queued and no longer in the inbox, in order, without duplicates or gaps.
    assert [*(item.payload for item in queued), *inbox] == [
        b"%d/%d" % (n, p) for n in range(1, done + 1) for p in range(5)
    ]
    assert [item.seq for item in queued] == list(range(1, len(queued) + 1))
    assert store._query("SELECT highest FROM received_window") == [(5 * done,)]
    assert store._query("SELECT COUNT(*) FROM received") == [(5 * done,)]
    store.close()


def test_killed_process_leaves_complete_transactions_only(tmp_path):
    path, chance = tmp_path / "s.db", random.Random(7)
    for _ in range(3):
        command = [sys.executable, "-c", KILLED, str(path)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as writer:
            for _ in range(1 + chance.randrange(40)):
                reported = int(writer.stdout.readline())
            writer.kill()
            *complete_lines, _ = writer.stdout.read().split("\n")
            assert writer.stderr.read() == ""
        check_complete(path, int(complete_lines[-1]) if complete_lines else reported)


def test_full_disk_rolls_back_the_transaction_only(store):
    send(store, b"before")
    pages = store._query("PRAGMA page_count")[0][0]
    store._query(f"PRAGMA max_page_count={pages}")

    def write():
        with store.transaction() as tx:
            tx.put_state("small", b"1")
            tx.accept("k", b"x" * 100_000)

    with pytest.raises(DeliveryError, match="full"):
        write()
    assert store.get_state("small") is None
    assert store.inbox_depth() == 0
    assert [item.payload for item in queued_items(store, "c", 9)] == [b"before"]
    store._query("PRAGMA max_page_count=1000000")
    write()
    assert (store.get_state("small"), store.inbox_depth()) == (b"1", 1)


def test_threads_write_one_at_a_time(store):
    def count():
        for _ in range(25):
            with store.transaction() as tx:
                tx.put_state("n", str(int(store.get_state("n") or b"0") + 1).encode())
                tx.send("k", "c", b"x", encoding="e")

    threads = [threading.Thread(target=count) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert store.get_state("n") == b"100"
    assert [item.seq for item in queued_items(store, "c", 999)] == list(range(1, 101))


def test_transaction_reads_its_own_writes(store):
    def write(tx):
        tx.put_state("a", b"1")
        tx.accept("k", b"x", record(3, b"x"))
        assert store.get_state("a") == b"1"
        assert tx.was_received("k", record(3, b"x"))

    with pytest.raises(ZeroDivisionError):
        fail_within(store, write)
    with store.transaction() as tx:
        assert store.get_state("a") is None
        assert not tx.was_received("k", record(3, b"x"))


@given(st.sets(st.integers(-50, 50)))
def test_runs_cover_exactly_the_numbers(numbers):
    found = list(runs(numbers))
    assert [n for first, last in found for n in range(first, last + 1)] == sorted(numbers)
    assert all(last + 1 < first for (_, last), (first, _) in itertools.pairwise(found))


def test_many_records_in_one_transaction_keep_order_and_numbers(store):
    payloads = [str(n).encode() for n in range(3 * ROWS_PER_STATEMENT + 5)]
    with store.transaction() as tx:
        numbers = [tx.send("k", "c", payload, encoding="") for payload in payloads]
        for payload in payloads:
            tx.accept("k", payload)
    assert numbers == list(range(1, len(payloads) + 1))
    assert [item.payload for item in queued_items(store, "c", 1000)] == payloads
    assert [item.payload for item in store.inbox_items(1000)] == payloads
    with store.transaction() as tx:
        assert tx.send("k", "c", b"x", encoding="") == len(payloads) + 1
        tx.remove_acknowledged("c", [*range(1, 50), 60, len(payloads) + 1])
        for done in store.inbox_items(40):
            tx.remove_handled(done)
    assert [item.seq for item in queued_items(store, "c", 1000)] == [*range(50, 60), *range(61, len(payloads) + 1)]
    assert [item.payload for item in store.inbox_items(1000)] == payloads[40:]


def test_rollback_discards_collected_rows(store):
    with pytest.raises(ZeroDivisionError):
        fail_within(store, lambda tx: (tx.send("k", "c", b"x", encoding=""), tx.accept("k", b"x", record(1, b"x"))))
    assert store.outbox_depth() == store.inbox_depth() == 0
    with store.transaction() as tx:
        assert tx.send("k", "c", b"x", encoding="") == 1
        assert not tx.was_received("k", record(1, b"x"))


STEPS = st.sampled_from(["add", "put", "delete", "get", "names"])
STATES = st.lists(st.tuples(STEPS, st.sampled_from("abc")), max_size=60)


@given(steps=STATES)
@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_added_states_are_seen_by_every_later_step_of_the_transaction(store, steps):
    with store.transaction() as tx:
        for name in "abc":
            tx.delete_state(name)
        model: dict[str, bytes] = {}
        for number, (step, name) in enumerate(steps):
            value = b"%d" % number
            if step == "add":
                tx.add_state(name, value)
                model.setdefault(name, value)
            elif step == "put":
                tx.put_state(name, value)
                model[name] = value
            elif step == "delete":
                tx.delete_state(name)
                model.pop(name, None)
            elif step == "get":
                assert tx.get_state(name) == model.get(name)
            else:
                assert tx.state_names(name) == ([name] if name in model else [])
    assert store.states("") == model


def test_state_that_cannot_be_read_is_quarantined_alone(store, open_store, caplog):
    values = {"good": msgpack.packb([7]), "junk": b"\xc1", "cut": b"\x92\x01", "text": msgpack.packb("x"), "gone": b""}
    with store.transaction() as tx:
        for name, value in values.items():
            tx.put_state(f"part/{name}", value)
    assert store.read_states("part/", lambda name, value: (name, msgpack.unpackb(value)[0] + 1)) == {
        "good": ("good", 8)
    }
    assert (store.states_discarded, store.refused_count()) == (4, 4)
    assert "Stored state discarded" in caplog.text
    store = open_store()
    assert store.state_names("part/") == ("part/good",)
    assert store.read_state("part/good", int, 5) == 5
    assert store.read_state("part/good", int, 6) == 6
    assert (store.states_discarded, store.refused_count()) == (1, 5)


def test_fault_of_the_machine_does_not_discard_a_state(store):
    def parse(value):
        raise MemoryError

    with store.transaction() as tx:
        tx.put_state("name", b"value")
    with pytest.raises(MemoryError):
        store.read_state("name", parse, None)
    assert (store.get_state("name"), store.refused_count()) == (b"value", 0)
