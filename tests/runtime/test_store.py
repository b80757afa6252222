"""The durable store: nothing half-written after a kill, pieces, duplicates, a full disk, a damaged file."""

from __future__ import annotations

import hashlib
import itertools
import random
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarpost.errors import HandoffError
from sonarpost.runtime import rows
from sonarpost.runtime.store import Store
from sonarpost.runtime.transaction import Chunk, OutboxItem, Transaction

ORIGIN = b"o" * 16


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    opened = Store(tmp_path / "s.db")
    yield opened
    opened.close()


def send(store: Store, *payloads: bytes, consumer: str = "c", priority: int = 4) -> list[int]:
    with store.transaction() as tx:
        return [tx.send("k", consumer, p, encoding="e", priority=priority) for p in payloads]


def fail_within(store: Store, write: Callable[[Transaction], object]) -> None:
    """Write in a transaction that then meets an error which has nothing to do with the store."""
    with store.transaction() as tx:
        write(tx)
        raise ZeroDivisionError


# Outbox


def test_what_is_owed_is_as_it_was_given(store: Store) -> None:
    assert send(store, b"payload") == [1]
    assert store.owed("c", 9) == (OutboxItem("c", 1, "k", "e", 4, b"payload", hashlib.sha256(b"payload").digest()),)
    assert store.owed("other", 9) == ()


def test_numbers_run_without_gaps_a_consumer_and_are_never_used_again(tmp_path: Path) -> None:
    store = Store(tmp_path / "s.db")
    assert send(store, b"1", b"2") == [1, 2]
    assert send(store, b"1", consumer="d") == [1]
    with store.transaction() as tx:
        tx.acknowledged("c", 1)
        tx.acknowledged("c", 2)
    origin = store.origin
    store.close()
    store = Store(tmp_path / "s.db")
    assert send(store, b"3") == [3]
    assert store.origin == origin
    store.close()


def test_a_transaction_that_failed_uses_no_number(store: Store) -> None:
    with pytest.raises(ZeroDivisionError):
        fail_within(store, lambda tx: tx.send("k", "c", b"lost", encoding="e"))
    assert send(store, b"1") == [1]
    assert [item.payload for item in store.owed("c", 9)] == [b"1"]


@given(st.lists(st.integers(1, 7), max_size=12))
@settings(max_examples=20)
def test_the_most_urgent_is_owed_first_then_the_oldest(
    tmp_path_factory: pytest.TempPathFactory, priorities: list[int]
) -> None:
    store = Store(tmp_path_factory.mktemp("order") / "s.db")
    for priority in priorities:
        send(store, b"x", priority=priority)
    owed = [(item.priority, item.seq) for item in store.owed("c", 99)]
    assert owed == sorted(owed)
    assert len(owed) == len(priorities)
    assert store.owed("c", 3) == store.owed("c", 99)[:3]
    store.close()


def test_two_stores_have_two_origins(tmp_path: Path) -> None:
    a, b = Store(tmp_path / "a.db"), Store(tmp_path / "b.db")
    assert a.origin != b.origin
    assert len(a.origin) == len(b.origin) == 16
    a.close()
    b.close()


def test_what_was_refused_is_kept_with_its_reason(store: Store) -> None:
    send(store, b"bad")
    with store.transaction() as tx:
        tx.rejected(store.owed("c", 1)[0], "no such record")
    assert (store.outbox_depth(), store.refused_count()) == (0, 1)
    assert store._query("SELECT direction, key, payload, reason FROM refused") == [
        ("out", "k", b"bad", "no such record")
    ]


def test_of_what_was_refused_the_latest_are_kept_and_the_beginning_of_each(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sonarpost.runtime.transaction.REFUSED_KEPT", 5)
    monkeypatch.setattr("sonarpost.runtime.transaction.REFUSED_BYTES", 3)
    for number in range(12):
        with store.transaction() as tx:
            tx.refuse("in", "k", b"%02d and more" % number, "no")
    assert store.refused_count() == 5
    kept = [payload for (payload,) in store._query("SELECT payload FROM refused ORDER BY id")]
    assert kept == [b"%02d " % number for number in range(7, 12)]


def test_listeners_hear_of_commits_and_not_of_failures(store: Store) -> None:
    event = threading.Event()
    store.listen_outbox(event)
    with pytest.raises(ZeroDivisionError):
        fail_within(store, lambda tx: (tx.send("k", "c", b"x", encoding="e"), tx.accept("k", b"x")))
    assert not event.is_set()
    assert not store.inbox_changed.is_set()
    send(store, b"x")
    assert event.is_set()
    assert not store.inbox_changed.is_set()
    event.clear()
    store.unlisten_outbox(event)
    with store.transaction() as tx:
        tx.send("k", "c", b"x", encoding="e")
        tx.accept("k", b"x")
    assert not event.is_set()
    assert store.inbox_changed.is_set()


# Inbox


def test_a_record_waits_until_it_is_done(tmp_path: Path) -> None:
    store = Store(tmp_path / "s.db")
    with store.transaction() as tx:
        assert tx.accept("k", b"1")
        assert tx.accept("k", b"2")
    store.close()
    store = Store(tmp_path / "s.db")
    first, second = store.pending(9)
    assert (first.payload, second.payload) == (b"1", b"2")
    assert store.pending(9, after_id=first.id) == (second,)
    with store.transaction() as tx:
        tx.done(first)
    assert store.pending(9) == (second,)
    assert store.inbox_depth() == 1
    store.close()


@given(st.lists(st.tuples(st.sampled_from([b"a" * 16, b"b" * 16]), st.integers(1, 30)), max_size=80))
@settings(max_examples=30)
def test_each_number_of_an_origin_is_accepted_once_in_any_order(
    tmp_path_factory: pytest.TempPathFactory, arrivals: list[tuple[bytes, int]]
) -> None:
    store = Store(tmp_path_factory.mktemp("seen") / "s.db")
    accepted = set()
    for origin, seq in arrivals:
        with store.transaction() as tx:
            assert tx.was_seen(origin, seq) == ((origin, seq) in accepted)
            assert tx.accept("k", b"x", origin, seq) == ((origin, seq) not in accepted)
        accepted.add((origin, seq))
    assert store.inbox_depth() == len(accepted)
    # Memory of the past: only what lies above the first gap is kept one by one.
    kept = {(bytes(o), s) for o, s in store._query("SELECT origin, seq FROM seen")}  # type: ignore[arg-type]
    above_gap = set()
    for origin in (b"a" * 16, b"b" * 16):
        numbers = {seq for o, seq in accepted if o == origin}
        upto = 0
        while upto + 1 in numbers:
            upto += 1
        above_gap |= {(origin, seq) for seq in numbers if seq > upto}
    assert kept == above_gap
    store.close()


def test_what_was_refused_is_not_accepted_and_stays_refused(store: Store) -> None:
    with store.transaction() as tx:
        assert not tx.was_refused(ORIGIN, 1)
        tx.mark_refused(ORIGIN, 1)
        tx.mark_refused(ORIGIN, 1)
        assert tx.was_refused(ORIGIN, 1)
        assert not tx.accept("k", b"x", ORIGIN, 1)
    assert store.inbox_depth() == 0


def test_a_closed_store_says_so(tmp_path: Path) -> None:
    store = Store(tmp_path / "s.db")
    store.close()
    with pytest.raises(HandoffError, match="closed"), store.transaction():
        pass


# Pieces


def pieces(data: bytes, *cuts: int, seq: int = 1) -> list[Chunk]:
    sha = hashlib.sha256(data).digest()
    edges = [0, *cuts, len(data)]
    return [Chunk(ORIGIN, seq, len(data), sha, a, data[a:b]) for a, b in itertools.pairwise(edges)]


def add(store: Store, chunk: Chunk) -> bytes | int:
    with store.transaction() as tx:
        return tx.add_chunk(chunk)


def partials(store: Store) -> int:
    return len(store._query("SELECT 1 FROM partial"))


@given(data=st.binary(min_size=1, max_size=60), seed=st.integers(0, 2**32))
@settings(max_examples=30)
def test_pieces_in_any_order_and_number_end_in_the_whole(
    tmp_path_factory: pytest.TempPathFactory, data: bytes, seed: int
) -> None:
    """As a producer would: it sends pieces, some twice, some lost, and goes on where it is told to."""
    folder, chance = tmp_path_factory.mktemp("pieces"), random.Random(seed)
    store = Store(folder / "s.db")
    sha = hashlib.sha256(data).digest()
    offset: bytes | int = 0
    for _ in range(1000):
        assert isinstance(offset, int)
        if chance.random() < 0.2:
            store.close()
            store = Store(folder / "s.db")
        start = offset if chance.random() < 0.6 else chance.randrange(len(data))
        offset = add(store, Chunk(ORIGIN, 1, len(data), sha, start, data[start : start + chance.randint(1, 20)]))
        if isinstance(offset, bytes):
            break
    assert offset == data
    assert partials(store) == 0
    store.close()


def test_a_piece_that_does_not_continue_is_told_where_to_go_on(store: Store) -> None:
    first, second, third = pieces(b"0123456789", 4, 8)
    assert add(store, second) == 0
    assert add(store, first) == 4
    assert add(store, first) == 4
    assert add(store, third) == 4
    assert add(store, second) == 8
    assert add(store, third) == b"0123456789"


def test_pieces_of_two_records_do_not_mix(store: Store) -> None:
    a, b = pieces(b"aaaa", 2), pieces(b"bbbb", 2, seq=2)
    assert add(store, a[0]) == add(store, b[0]) == 2
    assert (add(store, a[1]), add(store, b[1])) == (b"aaaa", b"bbbb")


def test_another_record_under_the_same_number_starts_anew(store: Store) -> None:
    add(store, pieces(b"old record", 5)[0])
    new = pieces(b"new record", 5)
    assert add(store, new[1]) == 0
    assert add(store, new[0]) == 5
    assert add(store, new[1]) == b"new record"


def test_a_damaged_record_starts_anew(store: Store) -> None:
    first, second = pieces(b"0123456789", 5)
    bad = Chunk(ORIGIN, 1, first.size, first.sha256, 0, b"0x234")
    assert add(store, bad) == 5
    assert add(store, second) == 0
    assert partials(store) == 0
    assert add(store, first) == 5
    assert add(store, second) == b"0123456789"


def test_accepting_a_record_forgets_its_pieces(store: Store) -> None:
    add(store, pieces(b"0123456789", 5)[0])
    with store.transaction() as tx:
        tx.accept("k", b"0123456789", ORIGIN, 1)
    assert partials(store) == 0


def test_only_the_pieces_touched_last_are_kept(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sonarpost.runtime.transaction.PARTIALS_KEPT", 3)
    firsts = {seq: pieces(b"0123456789", 4, seq=seq) for seq in range(1, 5)}
    for seq in (1, 2, 3):
        assert add(store, firsts[seq][0]) == 4
    assert add(store, firsts[1][0]) == 4  # touched again
    assert add(store, firsts[4][0]) == 4
    assert partials(store) == 3
    # The second went; its producer is told to begin again, and loses nothing by it.
    assert add(store, firsts[2][1]) == 0
    assert add(store, firsts[1][1]) == b"0123456789"


# State


def test_state_is_remembered_replaced_and_forgotten(tmp_path: Path) -> None:
    store = Store(tmp_path / "s.db")
    with store.transaction() as tx:
        tx.put_state("a", b"1")
        tx.put_state("b", b"")
        assert tx.get_state("a") == b"1"
    with store.transaction() as tx:
        tx.put_state("a", b"2")
        tx.delete_state("absent")
    store.close()
    store = Store(tmp_path / "s.db")
    assert (store.get_state("a"), store.get_state("b"), store.get_state("absent")) == (b"2", b"", None)
    with store.transaction() as tx:
        tx.delete_state("a")
        assert tx.get_state("a") is None
    assert store.get_state("a") is None
    store.close()


# Atomic and durable


def test_records_are_on_the_disk_when_a_transaction_ends(store: Store) -> None:
    """FULL (2) makes SQLite wait for the disk at each commit of a write-ahead log; NORMAL (1) does not."""
    assert store._query("PRAGMA synchronous") == [(2,)]
    assert store._query("PRAGMA journal_mode") == [("wal",)]


KILLED = """
import itertools, sys
from pathlib import Path
from sonarpost.runtime import rows
from sonarpost.runtime.store import Store
store = Store(Path(sys.argv[1]))
first = int(store.get_state("n") or b"0") + 1
for n in itertools.count(first):
    with store.transaction() as tx:
        for part in range(5):
            assert tx.accept("k", b"%d/%d" % (n, part), b"o" * 16, 5 * n + part - 4)
        for item in store.pending(3):
            tx.done(item)
            tx.send("k", "c", item.payload, encoding="e")
        tx.put_state("n", b"%d" % n)
    print(n, flush=True)
"""


def check_whole(path: Path, told: int) -> None:
    """Check that the transactions are there from the first to one not before `told`, each whole."""
    store = Store(path)
    assert store._query("PRAGMA integrity_check") == [("ok",)]
    done = int(store.get_state("n") or b"0")
    assert done in (told, told + 1)  # the last may have been committed and not told
    inbox = [item.payload for item in store.pending(10**6)]
    owed = store.owed("c", 10**6)
    # What was handled is owed and no longer in the inbox, in order, nothing twice and nothing missing.
    assert [*(item.payload for item in owed), *inbox] == [
        b"%d/%d" % (n, p) for n in range(1, done + 1) for p in range(5)
    ]
    assert [item.seq for item in owed] == list(range(1, len(owed) + 1))
    assert store._query("SELECT seq FROM seen_upto") == [(5 * done,)]
    assert store._query("SELECT COUNT(*) FROM seen") == [(0,)]
    store.close()


def test_a_killed_process_leaves_whole_transactions_only(tmp_path: Path) -> None:
    path, chance = tmp_path / "s.db", random.Random(7)
    for _ in range(6):
        writer = subprocess.Popen(
            [sys.executable, "-c", KILLED, str(path)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert writer.stdout is not None
        told = int(writer.stdout.readline())
        time.sleep(chance.uniform(0, 0.05))
        writer.send_signal(signal.SIGKILL)
        rest, complaints = writer.communicate()
        assert complaints == ""
        whole_lines = [line for line in rest.split("\n")[:-1] if line]
        check_whole(path, int(whole_lines[-1]) if whole_lines else told)


def test_a_full_disk_keeps_nothing_of_the_transaction_and_the_rest_unharmed(store: Store) -> None:
    send(store, b"before")
    pages = store._query("PRAGMA page_count")[0][0]
    store._query(f"PRAGMA max_page_count={pages}")

    def write() -> None:
        with store.transaction() as tx:
            tx.put_state("small", b"1")
            tx.accept("k", b"x" * 100_000)

    with pytest.raises(HandoffError, match="full"):
        write()
    assert store.get_state("small") is None
    assert store.inbox_depth() == 0
    assert [item.payload for item in store.owed("c", 9)] == [b"before"]
    store._query("PRAGMA max_page_count=1000000")
    write()
    assert (store.get_state("small"), store.inbox_depth()) == (b"1", 1)


def test_threads_take_turns(store: Store) -> None:
    def count() -> None:
        for _ in range(25):
            with store.transaction() as tx:
                tx.put_state("n", str(int(tx.get_state("n") or b"0") + 1).encode())
                tx.send("k", "c", b"x", encoding="e")

    threads = [threading.Thread(target=count) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert store.get_state("n") == b"100"
    assert [item.seq for item in store.owed("c", 999)] == list(range(1, 101))


def test_a_store_belongs_to_one_process_at_a_time(tmp_path: Path) -> None:
    path = tmp_path / "s.db"
    script = f"from pathlib import Path; from sonarpost.runtime.store import Store; Store(Path({str(path)!r}))"
    store = Store(path)
    other = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert "HandoffError" in other.stderr
    assert "in use by another process" in other.stderr
    send(store, b"still mine")
    store.close()
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, check=False).returncode == 0


# Files that are no stores


def test_a_file_that_is_no_store_is_refused_and_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "s.db"
    path.write_bytes(b"not a database, but somebody's file" * 100)
    before = path.read_bytes()
    with pytest.raises(HandoffError, match=r"s\.db: cannot be opened as a sonarpost store"):
        Store(path)
    assert path.read_bytes() == before


def test_a_store_of_another_version_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "s.db"
    Store(path).close()
    with sqlite3.connect(path) as db:
        db.execute("UPDATE meta SET value = ? WHERE name = 'version'", (b"99",))
    db.close()
    with pytest.raises(HandoffError, match="store version b'99', expected 2"):
        Store(path)


def test_a_folder_in_the_way_is_named(tmp_path: Path) -> None:
    (tmp_path / "s.db").mkdir()
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "s.db", tmp_path / "file" / "s.db"):
        with pytest.raises(HandoffError, match=str(path)):
            Store(path)


def test_reading_a_closed_store_says_so(tmp_path: Path) -> None:
    store = Store(tmp_path / "s.db")
    store.close()
    with pytest.raises(HandoffError, match="closed"):
        store.owed("c", 1)


def test_a_transaction_that_reads_sees_what_it_wrote(store: Store) -> None:
    def write(tx: Transaction) -> None:
        tx.put_state("a", b"1")
        tx.accept("k", b"x", ORIGIN, 3)
        assert tx.get_state("a") == b"1"
        assert tx.was_seen(ORIGIN, 3)

    with pytest.raises(ZeroDivisionError):
        fail_within(store, write)
    with store.transaction() as tx:
        assert tx.get_state("a") is None
        assert not tx.was_seen(ORIGIN, 3)


@given(st.sets(st.integers(-50, 50)))
def test_runs_are_the_numbers_and_nothing_between(numbers: set[int]) -> None:
    found = list(rows.runs(numbers))
    assert [n for first, last in found for n in range(first, last + 1)] == sorted(numbers)
    assert all(last + 1 < first for (_, last), (first, _) in itertools.pairwise(found))


def test_many_records_in_one_transaction_keep_their_order_and_numbers(store: Store) -> None:
    payloads = [str(n).encode() for n in range(3 * rows.ROWS_AT_ONCE + 5)]
    with store.transaction() as tx:
        numbers = [tx.send("k", "c", payload, encoding="") for payload in payloads]
        for payload in payloads:
            tx.accept("k", payload)
    assert numbers == list(range(1, len(payloads) + 1))
    assert [item.payload for item in store.owed("c", 1000)] == payloads
    assert [item.payload for item in store.pending(1000)] == payloads
    with store.transaction() as tx:
        assert tx.send("k", "c", b"x", encoding="") == len(payloads) + 1
        tx.all_acknowledged("c", [*range(1, 50), 60, len(payloads) + 1])
        for done in store.pending(40):
            tx.done(done)
    assert [item.seq for item in store.owed("c", 1000)] == [*range(50, 60), *range(61, len(payloads) + 1)]
    assert [item.payload for item in store.pending(1000)] == payloads[40:]


def test_what_a_transaction_collected_is_gone_with_it(store: Store) -> None:
    def fail() -> None:
        with store.transaction() as tx:
            tx.send("k", "c", b"x", encoding="")
            tx.accept("k", b"x", ORIGIN, 1)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert store.outbox_depth() == store.inbox_depth() == 0
    with store.transaction() as tx:
        assert tx.send("k", "c", b"x", encoding="") == 1
        assert not tx.was_seen(ORIGIN, 1)


@pytest.mark.parametrize(("max_bytes", "count"), [(None, 4), (0, 1), (10, 1), (29, 2), (30, 3), (1000, 4)])
def test_what_is_pending_is_given_up_to_so_many_bytes(store: Store, max_bytes: int | None, count: int) -> None:
    with store.transaction() as tx:
        for _ in range(4):
            tx.accept("k", bytes(10))
    assert len(store.pending(9, max_bytes=max_bytes)) == count
    assert len(store.pending(1, max_bytes=max_bytes)) == 1


def test_what_is_deleted_is_not_written_once_more(store: Store) -> None:
    assert store._query("PRAGMA secure_delete") == [(0,)]
