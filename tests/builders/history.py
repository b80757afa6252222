"""Operation log of a test run, and the checker that decides exactly-once delivery, order and integrity from it.

The log holds one operation a line, as JSON, as the test harness observed it: which records a source has queued durably,
which records are in the durable output of each consumer, and which faults were injected. A `consumer` line declares a
process to which the rules apply.

Rules, for each declared consumer and the keys that it declares:

- **lost**: a record that was queued is not handled by the consumer.
- **doubled**: the consumer handled a record more often than once.
- **unknown**: the consumer, or a subscriber, has a record that was not queued.
- **damaged**: a record has another digest than it was queued with; without that, than another process observed.
- **reordered**: an `ordered` consumer observed the records of a key in another order than they were queued. The order
  is guaranteed while nothing fails, so this rule applies to logs without faults only.
- **miscounted**: the consumer committed another number of records than were queued for it.
"""

import json
import threading
import time
from collections import Counter, defaultdict
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Literal

Kind = Literal["consumer", "queued", "acknowledged", "accepted", "handled", "seen", "fault"]
SHOWN = 5
"""Operations that the verdict shows for each violation."""


@dataclass(frozen=True)
class Operation:
    """One line of the log.

    Attributes:
        operation: `consumer` declares a process that the rules apply to; `queued`: committed to the outbox of
            `process`; `acknowledged`: removed from the outbox of `process`; `accepted`: `count` records committed by
            `process`; `handled`: in the durable output of `process`; `seen`: received by the subscriber `process`;
            `fault`: injected into `process`.
        process: Process that did it, or to which it happened.
        time_s: Monotonic time of the harness since the start of the log.
        key: Zenoh key of the record. A `consumer` with a key handles the records of this key only.
        record: Identity of the record, unique for each key.
        sha256: Digest of the content in hexadecimal; empty if not known.
        count: Number of records, for `accepted`.
        ordered: For `consumer`: records of a key arrive in the order of queueing while nothing fails.
        delivery: For `consumer`: `once`, or `any` for a subscriber that may miss and repeat records.
        detail: For a reader; what the fault was.
    """

    operation: Kind
    process: str
    time_s: float = 0.0
    key: str = ""
    record: str = ""
    sha256: str = ""
    count: int = 1
    ordered: bool = False
    delivery: Literal["once", "any"] = "once"
    detail: str = ""

    def __str__(self):
        text = [f"{self.time_s:10.3f} s", self.operation, self.process, self.key, self.record, self.sha256[:12]]
        text += [str(self.count)] * (self.operation == "accepted") + [self.detail]
        return " ".join(part for part in text if part)

    def as_json(self):
        """Return the line of the log; fields with their default are omitted."""
        plain = {n: v for n, v in asdict(self).items() if v != getattr(Operation, n, None)}
        return json.dumps(plain)


class History:
    """Writes the log of a run, and keeps its operations. Safe for several threads.

    Args:
        path: File of the log; its folder is made.
    """

    def __init__(self, path):
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("a", encoding="utf-8", buffering=1)
        self._operations = []
        self._lock = threading.Lock()
        self._start_s = time.monotonic()

    def add(self, operation, process, record="", **fields):
        """Append an operation; the parameters are the attributes of `Operation`."""
        with self._lock:
            at_s = round(time.monotonic() - self._start_s, 3)
            done = Operation(operation, process, at_s, record=record, **fields)
            self._operations.append(done)
            if not self._file.closed:
                self._file.write(done.as_json() + "\n")

    def fault(self, process, detail):
        """Append the injection of a fault, or its end."""
        self.add("fault", process, detail=detail)

    @property
    def operations(self):
        with self._lock:
            return tuple(self._operations)

    def verdict(self):
        return check(self.operations)

    def close(self):
        with self._lock:
            self._file.close()


@dataclass(frozen=True)
class Violation:
    """A rule that the run violates, with the operations that show it."""

    rule: str
    process: str
    message: str
    operations: tuple[Operation, ...]

    def __str__(self):
        lines = [f"{self.rule.upper()} at {self.process}: {self.message}"]
        return "\n".join([*lines, *(f"    {done}" for done in self.operations[:SHOWN])])


@dataclass(frozen=True)
class Verdict:
    """Result of the check.

    Attributes:
        violations: All violations; none if the run is correct.
        queued: Number of records that were queued, repetitions not counted.
        handled: Number of `handled` operations by consumer.
        faults: Number of `fault` operations by process.
    """

    violations: tuple[Violation, ...]
    queued: int
    handled: dict[str, int]
    faults: dict[str, int]

    @property
    def ok(self):
        return not self.violations

    def __str__(self):
        handled = ", ".join(f"{process} {count}" for process, count in sorted(self.handled.items()))
        text = (
            f"{self.queued} records queued; handled: {handled or 'none'}; {sum(self.faults.values())} fault operations"
        )
        if self.ok:
            return f"PASS: {text}"
        rules = Counter(violation.rule for violation in self.violations)
        summary = ", ".join(f"{count} {rule}" for rule, count in sorted(rules.items()))
        return "\n".join([f"FAIL: {summary}; {text}", *map(str, self.violations)])


Name = tuple[str, str]


class _Checker:
    def __init__(self, operations):
        self.operations = operations
        self.queued = defaultdict(list)
        self.faults = [done for done in operations if done.operation == "fault"]
        for done in operations:
            if done.operation == "queued":
                self.queued[done.key, done.record].append(done)

    def of_process(self, process, *kinds):
        return [done for done in self.operations if done.process == process and done.operation in kinds]

    def exactly_once(self, consumer):
        """Every record that is queued for the consumer is handled by it, once."""
        if consumer.delivery == "any":
            return
        handled = defaultdict(list)
        for done in self.of_process(consumer.process, "handled"):
            handled[done.key, done.record].append(done)
        for name, queued in self.queued.items():
            if consumer.key not in ("", name[0]):
                continue
            times = handled.get(name, [])
            if not times:
                acknowledged = [
                    d for d in self.operations if d.operation == "acknowledged" and (d.key, d.record) == name
                ]
                what = "was acknowledged and is not handled" if acknowledged else "is not handled"
                yield Violation("lost", consumer.process, f"{name[1]} {what}", (*queued, *acknowledged))
            if len(times) > 1:
                message = f"{name[1]} is handled {len(times)} times"
                yield Violation("doubled", consumer.process, message, (*queued, *times))

    def order(self, consumer):
        """The consumer observes the records of each key in the order of queueing."""
        if not consumer.ordered or self.faults:
            return
        place = {name: number for number, name in enumerate(self.queued)}
        observed = defaultdict(dict)
        for done in self.of_process(consumer.process, "handled", "seen"):
            observed[done.key].setdefault(done.record, done)
        for key, by_record in observed.items():
            known = [done for done in by_record.values() if (key, done.record) in place]
            for first, second in pairwise(known):
                if place[key, first.record] > place[key, second.record]:
                    message = f"{first.record} before {second.record}, which was queued first"
                    yield Violation("reordered", consumer.process, message, (first, second))

    def count(self, consumer):
        """The consumer has committed as many records as were queued for it."""
        accepted = self.of_process(consumer.process, "accepted")
        if not accepted:
            return
        queued = sum(len(times) for (key, _), times in self.queued.items() if consumer.key in ("", key))
        committed = sum(done.count for done in accepted)
        if committed != queued:
            message = f"{committed} records committed, {queued} queued"
            yield Violation("miscounted", consumer.process, message, tuple(accepted))

    def unknown(self):
        """Every observed record was queued."""
        for done in self.operations:
            if done.operation in ("handled", "seen", "acknowledged") and (done.key, done.record) not in self.queued:
                yield Violation("unknown", done.process, f"{done.record} was not queued", (done,))

    def integrity(self):
        """All digests of a record are equal."""
        first = {}
        for name, queued in self.queued.items():
            for done in queued:
                if done.sha256:
                    first.setdefault(name, done)
        for done in self.operations:
            if not (done.sha256 and done.record):
                continue
            original = first.setdefault((done.key, done.record), done)
            if original.sha256 != done.sha256:
                message = f"{done.record} has another digest than at {original.process}"
                yield Violation("damaged", done.process, message, (original, done))


def check(operations):
    """Decide the rules of this module.

    Raises:
        ValueError: The log declares no consumer: no rule would apply.
    """
    checker = _Checker(list(operations))
    consumers = {(d.process, d.key): d for d in checker.operations if d.operation == "consumer"}
    if not consumers:
        raise ValueError("operation log: got no consumer, expected at least one")
    violations = []
    for consumer in consumers.values():
        violations += checker.exactly_once(consumer)
        violations += checker.order(consumer)
        violations += checker.count(consumer)
    violations += checker.unknown()
    violations += checker.integrity()
    return Verdict(
        tuple(violations),
        len(checker.queued),
        dict(Counter(d.process for d in checker.operations if d.operation == "handled")),
        dict(Counter(d.process for d in checker.faults)),
    )
