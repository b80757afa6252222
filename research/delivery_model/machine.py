"""States and transitions of producers, network, consumer and a hostile peer.

The network keeps every query for ever and delivers any of them at any time: this covers loss, duplication, delay and
reordering. A record is a name; its digest is the name, and its chunks are (name, index). All states are hashable.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import NamedTuple

from research.delivery_model.rules import Rules

FAR = 99
"""A number far above those that a producer assigns."""
OWN_ORIGIN = "own origin"
"""Origin that the hostile peer has chosen."""


class Row(NamedTuple):
    """A queued record."""

    seq: int
    origin: str
    name: str


class Saved(NamedTuple):
    """A backup of a producer's store."""

    rows: tuple[Row, ...]
    last_seq: int
    origin: str


class Query(NamedTuple):
    """A delivery query with one chunk."""

    key: str
    origin: str
    seq: int
    name: str
    chunk: int
    data: tuple[str, int]
    done_up_to: int


class Reply(NamedTuple):
    """A reply; `highest` is 0 without an accepted record of this key and origin.

    `reused` is not sent: the consumer held the number with another digest.
    """

    origin: str
    seq: int
    name: str
    status: str
    highest: int
    digest: str
    reused: bool


class Producer(NamedTuple):
    """A producer: `rows`, `last_seq` and `origin` are on its disk, `asked` and `replies` in its memory."""

    rows: tuple[Row, ...]
    last_seq: int
    origin: str
    asked: frozenset[Query]
    replies: frozenset[Reply]
    queued: int
    saved: Saved | None


class Partial(NamedTuple):
    """An incomplete record; the tuple of them is in the order of their last chunks."""

    key: str
    origin: str
    seq: int
    name: str
    data: tuple[tuple[str, int], ...]


class Window(NamedTuple):
    """What a consumer stores of a (key, origin): single records, an edge up to which all are known, refused records."""

    seen: frozenset[tuple[int, str]] = frozenset()
    edge: int = 0
    refused: frozenset[tuple[int, str]] = frozenset()


class Consumer(NamedTuple):
    """A consumer; `pending` is not on its disk.

    `accepted` is sorted and holds (key, name, whether the hostile peer sent it) of every accepted record.
    """

    windows: tuple[tuple[tuple[str, str], Window], ...] = ()
    partials: tuple[Partial, ...] = ()
    accepted: tuple[tuple[str, str, bool], ...] = ()
    pending: tuple[Query, ...] = ()


class State(NamedTuple):
    """Everything; `excused` are records that need not arrive: dropped, invalid, or lost with the restored disk."""

    producers: tuple[Producer, ...]
    consumer: Consumer
    network: frozenset[Query]
    excused: frozenset[str]
    crashes: int
    restores: int
    attacks: int
    origins: int


class Step(NamedTuple):
    """A transition.

    Attributes:
        label: Description for a trace.
        after: The next state.
        attack_on: Key that a hostile peer used, otherwise empty.
        reused: Producer and origin of a reply to a record whose number was used before.
    """

    label: str
    after: State
    attack_on: str = ""
    reused: tuple[int, str] | None = None


@dataclass(frozen=True)
class Record:
    """A record of a configuration; the name is unique."""

    name: str
    key: str
    chunks: int = 1
    valid: bool = True
    droppable: bool = False


@dataclass(frozen=True)
class World:
    """A configuration.

    Attributes:
        rules: Rules of producers and consumer.
        queues: Records that each producer queues, in this order.
        crashes: Number of crashes of producers, or of the consumer if it replies before the commit.
        restores: Number of restores of a producer's store from a backup.
        attacks: Number of queries of the hostile peer.
        hostile_keys: Keys to which the hostile peer may write.
        hostile_records: Records that it sends.
        hostile_large: It sends only first chunks of records with two chunks.
        max_partials: Number of incomplete records that the consumer keeps.
        origin_leaked: The hostile peer knows the origins although the rules keep them secret.
    """

    rules: Rules
    queues: tuple[tuple[Record, ...], ...]
    crashes: int = 0
    restores: int = 0
    attacks: int = 0
    hostile_keys: tuple[str, ...] = ()
    hostile_records: tuple[Record, ...] = ()
    hostile_large: bool = False
    max_partials: int = 9
    origin_leaked: bool = False

    def record(self, name: str) -> Record:
        """Return a record by its name."""
        return self.records[name]

    @cached_property
    def records(self) -> dict[str, Record]:
        """All records by name."""
        return {r.name: r for r in (*(r for queue in self.queues for r in queue), *self.hostile_records)}


def initial(world: World) -> State:
    """Return the state in which nothing is queued."""
    producers = tuple(
        Producer((), 0, f"origin-{number}", frozenset(), frozenset(), 0, None)
        for number, _ in enumerate(world.queues, 1)
    )
    return State(
        producers, Consumer(), frozenset(), frozenset(), world.crashes, world.restores, world.attacks, len(producers)
    )


def steps(world: World, state: State) -> Iterator[Step]:
    """Yield all transitions of a state."""
    for which in range(len(state.producers)):
        yield from _producer_steps(world, state, which)
    for query in state.network:
        yield _deliver(world, state, query)
    if state.consumer.pending:
        yield Step("consumer commits", state._replace(consumer=_commit_pending(world, state.consumer)))
        if state.crashes:
            lost = state.consumer._replace(pending=())
            yield Step("consumer crashes", state._replace(consumer=lost, crashes=state.crashes - 1))
    if state.attacks:
        yield from _attacks(world, state)


def cooperative_step(world: World, state: State) -> State | None:
    """Return the next state of one schedule without faults, None when no record is queued."""
    for which, producer in enumerate(state.producers):
        for reply in producer.replies:
            if any(row.seq == reply.seq and row.name == reply.name for row in producer.rows):
                return _use_reply(world, state, which, reply).after
        for row in producer.rows:
            for query in _queries_of(world, producer, row):
                if query not in producer.asked:
                    return _sent(state, which, query)
            have = _stored_chunks(world, state.consumer, row, producer)
            queries = _queries_of(world, producer, row)
            return _deliver(world, state, queries[have if have < len(queries) else 0]).after
    return None


# Producer


def _with(state: State, which: int, producer: Producer) -> State:
    producers = (*state.producers[:which], producer, *state.producers[which + 1 :])
    return state._replace(producers=producers)


def _producer_steps(world: World, state: State, which: int) -> Iterator[Step]:
    producer = state.producers[which]
    who = f"producer-{which + 1}"
    records = world.queues[which]
    if producer.queued < len(records):
        record = records[producer.queued]
        row = Row(producer.last_seq + 1, producer.origin, record.name)
        added = producer._replace(rows=(*producer.rows, row), last_seq=row.seq, queued=producer.queued + 1)
        yield Step(f"{who} queues {record.name} as {row.origin}/{row.seq}", _with(state, which, added))
    for row in producer.rows:
        in_flight = any(query.seq == row.seq for query in producer.asked)
        if world.record(row.name).droppable and not in_flight:
            kept = producer._replace(rows=tuple(other for other in producer.rows if other != row))
            after = _with(state, which, kept)._replace(excused=state.excused | {row.name})
            yield Step(f"{who} drops {row.name}", after)
        for query in _queries_of(world, producer, row):
            if query not in producer.asked:
                yield Step(f"{who} sends {_text(query)}", _sent(state, which, query))
    for reply in producer.replies:
        yield _use_reply(world, state, which, reply)
    if state.crashes and (producer.asked or producer.replies):
        yield Step(f"{who} crashes", _with(state._replace(crashes=state.crashes - 1), which, _started(world, producer)))
    if state.restores:
        yield from _backup_steps(world, state, which)


def _backup_steps(world: World, state: State, which: int) -> Iterator[Step]:
    producer = state.producers[which]
    now = Saved(producer.rows, producer.last_seq, producer.origin)
    if producer.saved is None:
        yield Step(f"backup of producer-{which + 1}", _with(state, which, producer._replace(saved=now)))
    elif producer.saved != now:
        saved = producer.saved
        restored = _started(world, producer)._replace(
            rows=saved.rows, last_seq=saved.last_seq, origin=saved.origin, saved=None
        )
        lost = {row.name for row in producer.rows} - {row.name for row in saved.rows}
        after = state._replace(restores=state.restores - 1, excused=state.excused | lost)
        yield Step(f"producer-{which + 1} is restored from its backup", _with(after, which, restored))


def _started(world: World, producer: Producer) -> Producer:
    replies = frozenset[Reply]() if world.rules.bind_replies else producer.replies
    return producer._replace(asked=frozenset(), replies=replies)


def _queries_of(world: World, producer: Producer, row: Row) -> list[Query]:
    record = world.record(row.name)
    origin = row.origin if world.rules.origin_of_row else producer.origin
    done_up_to = min(producer.rows[0].seq, row.seq) - 1
    return [
        Query(record.key, origin, row.seq, row.name, index, (row.name, index), done_up_to)
        for index in range(record.chunks)
    ]


def _sent(state: State, which: int, query: Query) -> State:
    producer = state.producers[which]
    after = _with(state, which, producer._replace(asked=producer.asked | {query}))
    return after._replace(network=state.network | {query})


def _use_reply(world: World, state: State, which: int, reply: Reply) -> Step:
    producer = state.producers[which]
    rules = world.rules
    label = f"producer-{which + 1} receives {reply.status!r} for {reply.origin}/{reply.seq}"
    match = [
        row for row in producer.rows if row.seq == reply.seq and (row.name == reply.name or not rules.bind_replies)
    ]
    excused = state.excused
    if reply.status == "refused":
        excused |= {row.name for row in match if not world.record(row.name).valid}
    rows = tuple(row for row in producer.rows if row not in match)
    origin, origins = producer.origin, state.origins
    if rules.detect_restore and _is_older(rules, producer, reply):
        origins += 1
        origin = f"origin-{origins}"
        label += f": it is older than {reply.origin}/{reply.highest}, new records use {origin}"
    asked = frozenset(query for query in producer.asked if query.seq != reply.seq) if match else producer.asked
    replies = producer.replies - {reply}
    if rules.bind_replies:
        replies = frozenset(other for other in replies if any(row.seq == other.seq for row in rows))
    changed = producer._replace(rows=rows, origin=origin, asked=asked, replies=replies)
    after = _with(state, which, changed)._replace(excused=excused, origins=origins)
    return Step(label, after, reused=(which, reply.origin) if reply.reused else None)


def _is_older(rules: Rules, producer: Producer, reply: Reply) -> bool:
    if rules.current_origin_only and reply.origin != producer.origin:
        return False
    held = [row.name for row in producer.rows if (row.seq, row.origin) == (reply.highest, reply.origin)]
    return reply.highest > producer.last_seq or any(name != reply.digest for name in held)


# Consumer


def _deliver(world: World, state: State, query: Query) -> Step:
    consumer, status = react(world, state.consumer, query)
    after = state._replace(consumer=consumer)
    if status in {"stored", "refused"}:
        # Only the reply to the first chunk states a number; "more" changes nothing else and is not modelled.
        highest, digest = _highest(world.rules, state.consumer, query) if query.chunk == 0 else (0, "")
        numbers = _window(world.rules, state.consumer, query).seen
        reused = query.chunk == 0 and any(seq == query.seq and name != query.name for seq, name in numbers)
        reply = Reply(query.origin, query.seq, query.name, status, highest, digest, reused)
        for which, producer in enumerate(after.producers):
            if query in producer.asked or not (world.rules.bind_replies or query.data[0] not in _names(world, which)):
                after = _with(after, which, producer._replace(replies=producer.replies | {reply}))
    return Step(f"consumer receives {_text(query)}: {status}", after)


def _names(world: World, which: int) -> set[str]:
    return {record.name for record in world.queues[which]}


def react(world: World, consumer: Consumer, query: Query, *, hostile: bool = False) -> tuple[Consumer, str]:
    """Return the consumer after a query, and the status of its reply."""
    rules = world.rules
    if not rules.done_up_to_after_acceptance:
        consumer = _use_done_up_to(rules, consumer, query)
    window, number = _window(rules, consumer, query), _number(rules, query)
    if number in window.refused:
        return consumer, "refused"
    if number in window.seen or query.seq <= window.edge:
        return _accepted(rules, consumer, query)
    if any(_same(rules, query, pending) for pending in consumer.pending):
        return consumer, "stored"
    consumer, data = _add_chunk(world, consumer, query)
    return (consumer, "more") if data is None else _judge(world, consumer, query, data, hostile=hostile)


def _judge(
    world: World, consumer: Consumer, query: Query, data: tuple[tuple[str, int], ...], *, hostile: bool
) -> tuple[Consumer, str]:
    """Accept or refuse a complete record."""
    rules = world.rules
    name = data[0][0] if len({part[0] for part in data}) == 1 else "mixed"
    if rules.check_assembled and name != query.name:
        # A record in several chunks starts again; one in a single chunk is refused.
        return consumer, "more" if query.chunk else "refused"
    if not _is_valid(world, query.key, name):
        if not rules.forget_refused:
            window = _window(rules, consumer, query)
            refused = window.refused | {_number(rules, query)}
            consumer = _replaced(rules, consumer, query, window._replace(refused=refused))
        return consumer, "refused"
    if not rules.commit_first:
        return consumer._replace(pending=(*consumer.pending, query)), "stored"
    return _accepted(rules, _accept(rules, consumer, query, name, hostile=hostile), query)


def _accepted(rules: Rules, consumer: Consumer, query: Query) -> tuple[Consumer, str]:
    return _use_done_up_to(rules, consumer, query) if rules.done_up_to_after_acceptance else consumer, "stored"


def _commit_pending(world: World, consumer: Consumer) -> Consumer:
    pending = consumer.pending
    consumer = consumer._replace(pending=())
    for query in pending:
        consumer = _accept(world.rules, consumer, query, query.name, hostile=False)
    return consumer


def _accept(rules: Rules, consumer: Consumer, query: Query, name: str, *, hostile: bool) -> Consumer:
    window = _window(rules, consumer, query)
    window = _extended(window._replace(seen=window.seen | {_number(rules, query)}))
    consumer = _replaced(rules, consumer, query, window)
    return consumer._replace(accepted=tuple(sorted((*consumer.accepted, (query.key, name, hostile)))))


def _is_valid(world: World, key: str, name: str) -> bool:
    if name == "mixed":
        return True
    record = world.record(name)
    return record.valid and (record.key == key or not world.rules.validate_key)


def _scope(rules: Rules, query: Query) -> tuple[str, str]:
    return (query.key if rules.window_of_key else "*", query.origin)


def _number(rules: Rules, query: Query) -> tuple[int, str]:
    return (query.seq, query.name if rules.compare_digest else "")


def _same(rules: Rules, one: Query, other: Query) -> bool:
    return (_scope(rules, one), _number(rules, one)) == (_scope(rules, other), _number(rules, other))


def _window(rules: Rules, consumer: Consumer, query: Query) -> Window:
    scope = _scope(rules, query)
    return next((window for found, window in consumer.windows if found == scope), Window())


def _replaced(rules: Rules, consumer: Consumer, query: Query, window: Window) -> Consumer:
    scope = _scope(rules, query)
    others = [item for item in consumer.windows if item[0] != scope]
    return consumer._replace(windows=tuple(sorted([*others, (scope, window)], key=lambda item: item[0])))


def _use_done_up_to(rules: Rules, consumer: Consumer, query: Query) -> Consumer:
    window = _window(rules, consumer, query)
    if rules.done_up_to_prunes:
        newest = set(sorted(window.seen)[-rules.keep :]) if rules.keep else set()
        kept = frozenset(number for number in window.seen if number[0] > query.done_up_to or number in newest)
        return consumer if kept == window.seen else _replaced(rules, consumer, query, window._replace(seen=kept))
    if query.done_up_to <= window.edge:
        return consumer
    seen = frozenset(number for number in window.seen if number[0] > query.done_up_to)
    refused = frozenset(number for number in window.refused if number[0] > query.done_up_to)
    return _replaced(rules, consumer, query, _extended(Window(seen, query.done_up_to, refused)))


def _extended(window: Window) -> Window:
    """Return the window with equal contents in equal form: without digests, the edge moves over the run behind it."""
    edge, seen = window.edge, window.seen
    while (edge + 1, "") in seen:
        edge += 1
        seen -= {(edge, "")}
    return Window(seen, edge, window.refused)


def _highest(rules: Rules, before: Consumer, query: Query) -> tuple[int, str]:
    """Return the highest number accepted before a query, or its own if it was used before, and the digest."""
    seen = _window(rules, before, query).seen
    others = sorted(name for seq, name in seen if seq == query.seq and name != query.name)
    if others and rules.state_reused:
        return query.seq, others[0]
    if not seen:
        return 0, ""
    highest = max(seen)[0]
    digests = sorted(name for seq, name in seen if seq == highest)
    return highest, query.name if query.name in digests else digests[0]


# Chunks


def _is_chunk_of(rules: Rules, partial: Partial, query: Query) -> bool:
    if not rules.chunks_of_digest:
        return (partial.origin, partial.seq) == (query.origin, query.seq)
    return (partial.key, partial.origin, partial.seq, partial.name) == (query.key, query.origin, query.seq, query.name)


def _stored_chunks(world: World, consumer: Consumer, row: Row, producer: Producer) -> int:
    query = _queries_of(world, producer, row)[0]
    found = [p for p in consumer.partials if _is_chunk_of(world.rules, p, query) and p.name == query.name]
    return len(found[0].data) if found else 0


def _add_chunk(world: World, consumer: Consumer, query: Query) -> tuple[Consumer, tuple[tuple[str, int], ...] | None]:
    """Return the consumer with one more chunk, and the complete record or None."""
    count = world.record(query.name).chunks
    if count == 1:
        return consumer, (query.data,)
    found = next((partial for partial in consumer.partials if _is_chunk_of(world.rules, partial, query)), None)
    others = tuple(partial for partial in consumer.partials if partial is not found)
    data = found.data if found is not None else ()
    if found is not None and found.name != query.name and world.rules.check_assembled:
        data = ()
    if query.chunk != len(data):
        return consumer, None
    data = (*data, query.data)
    if len(data) == count:
        return consumer._replace(partials=others), data
    partials = (*others, Partial(query.key, query.origin, query.seq, query.name, data))
    while len(partials) > world.max_partials:
        first = _first_to_delete(world.rules, partials)
        partials = tuple(partial for partial in partials if partial is not first)
    return consumer._replace(partials=partials), None


def writer_of(rules: Rules, key: str) -> str:
    """Return the writer of a key: its first letter, or the key itself."""
    return key[0] if rules.writer_of_prefix else key


def _first_to_delete(rules: Rules, partials: tuple[Partial, ...]) -> Partial:
    if not rules.fair_chunks:
        return partials[0]
    chunks: dict[str, int] = {}
    for partial in partials:
        writer = writer_of(rules, partial.key)
        chunks[writer] = chunks.get(writer, 0) + len(partial.data)
    largest = max(chunks.values())
    return next(partial for partial in partials if chunks[writer_of(rules, partial.key)] == largest)


# Hostile peer


def _attacks(world: World, state: State) -> Iterator[Step]:
    """Queries of a peer that receives all publications and may write to its own keys only.

    They are delivered at once: a delayed one is equal to one that is sent later.
    """
    origins = [OWN_ORIGIN]
    if world.origin_leaked or not world.rules.secret_origin:
        origins += sorted({query.origin for query in state.network})
    numbers = sorted({1, *(query.seq for query in state.network), *(query.seq + 1 for query in state.network), FAR})
    contents = [(record.name, record.name) for record in world.hostile_records]
    if not world.hostile_large:
        published = sorted({query.name for query in state.network if world.record(query.name).chunks == 1})
        own = [record.name for record in world.hostile_records if record.valid]
        contents += [(name, data) for name in published for data in (name, *own)]
    after = state._replace(attacks=state.attacks - 1)
    for key, origin, seq, (name, data) in product(world.hostile_keys, origins, numbers, contents):
        for done_up_to in {0, seq - 1}:
            query = Query(key, origin, seq, name, 0, (data, 0), done_up_to)
            consumer, status = react(world, state.consumer, query, hostile=True)
            if consumer != state.consumer:
                label = f"hostile peer sends {_text(query)}: {status}"
                yield Step(label, after._replace(consumer=consumer), key)


def _text(query: Query) -> str:
    chunk = f" chunk {query.chunk}" if query.chunk else ""
    if query.data[0] != query.name:
        chunk += f" with the bytes of {query.data[0]}"
    return f"{query.origin}/{query.seq} {query.name}{chunk} on key {query.key}, done_up_to {query.done_up_to}"
