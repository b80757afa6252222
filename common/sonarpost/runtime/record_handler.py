"""Passes records of the inbox to a service, exactly once, and commits what follows from them.

Up to `BATCH` records are handled in one transaction. If this fails twice, records are handled one by one, so that one
that always fails does not delay the others.
"""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import zenoh

from sonarpost import keys, wire
from sonarpost.delivery.inbox import Handle
from sonarpost.delivery.records import InboxItem
from sonarpost.delivery.transaction import Transaction, UnitOfWork
from sonarpost.errors import BadInputError, DeliveryError, can_concern_record
from sonarpost.limits import limit
from sonarpost.logs import IntervalLog, kv, log_context
from sonarpost.messages import Record
from sonarpost.runtime.health import ServiceHealth

if TYPE_CHECKING:
    from sonarpost.runtime.service import Service

log = logging.getLogger(__name__)

RETRY_AFTER_S = 1.0
MAX_RETRY_FACTOR = 4
ALONE_AFTER: Final = limit(
    2, "failures", "isolation", "all services", "sender", "attempts of a failing batch", "its records one by one"
)
FAILURES_ALONE: Final = limit(
    3, "failures", "blame", "all services", "sender", "failures alone while others are handled", "it is quarantined"
)
MAX_DECODED, MAX_DECODED_BYTES = 2048, 4096
"""Maximum number and size of the accepted records that are kept decoded until they are handled."""
TYPES_KEPT = 1000
"""Maximum number of keys in the cache of record types."""
MAX_REFUSAL_LOGS = 64
"""Maximum number of writers whose refused records are logged separately."""


class ServiceStoppingError(Exception):
    """Raised by `Service.handle` when the service stops before the record is handled; it stays in the inbox."""


class RecordHandler:
    """Checks, accepts and handles the records of one service.

    Args:
        service: The service; its hooks check and handle the records.
        health: Its health: refused and quarantined records are counted, failing ones make it degraded.
    """

    def __init__(self, service: Service[Any], health: ServiceHealth) -> None:
        self._service = service
        self._store = service.store
        self._health = health
        self._stopping = service.stopping
        self._record_type = lru_cache(TYPES_KEPT)(self._find_record_type)
        self._decoded: dict[tuple[str, bytes], Record] = {}  # accepted records that are not handled yet
        self._refusal_logs: dict[str, IntervalLog] = {}
        self._failed_alone: dict[int, int] = {}

    def _find_record_type(self, key: str) -> type[Record]:
        for expression, record_type in self._service.consumed_keys().items():
            if zenoh.KeyExpr(expression).intersects(key):
                return record_type
        raise BadInputError(key, "", key, "a key this service consumes: " + ", ".join(self._service.consumed_keys()))

    def check(self, key: str, payload: bytes) -> Record:
        """Return the record of a payload, or what `validate` returns in its place.

        Raises:
            BadInputError: The record is refused.
        """
        record = wire.decode(self._record_type(key), payload, key)
        return self._service.validate(key, record) or record

    def keep_decoded(self, key: str, payload: bytes, record: Record) -> bool:
        """Keep an accepted record until it is handled in its turn; return False."""
        if len(self._decoded) < MAX_DECODED and len(payload) <= MAX_DECODED_BYTES:
            self._decoded[key, payload] = record
        return False

    def refused(self, error: BadInputError) -> None:
        """Count and log a refused record."""
        self._health.count("records_refused")
        self._refusal_log(error.where).log(key=error.where, field=error.field, reason=str(error))

    def _refusal_log(self, key: str) -> IntervalLog:
        """Return the log for refused records of one writer, so that one peer cannot hide the refusals of another."""
        writer = keys.writer_of(key)
        if writer not in self._refusal_logs and len(self._refusal_logs) >= MAX_REFUSAL_LOGS:
            writer = ""
        if writer not in self._refusal_logs:
            self._refusal_logs[writer] = self._health.interval_log(log, logging.ERROR, "Record refused")
        return self._refusal_logs[writer]

    def run(self) -> None:
        """Handle records until the service stops."""
        failures = 0
        while True:
            self._store.inbox_changed.clear()
            if self._stopping.is_set():  # `stop` sets both, this one first
                return
            try:
                found = self._handle_in_batches() if failures < ALONE_AFTER else self._handle_each_alone(failures)
            except ServiceStoppingError:
                return
            except Exception as error:
                if not isinstance(error, (OSError, DeliveryError)):
                    log.exception("Records not handled after an unexpected exception; trying again")
                failures += 1
                self._health.set_degraded(f"{type(error).__name__}: {error}")
                self._stopping.wait(RETRY_AFTER_S * min(2 ** max(0, failures - ALONE_AFTER), MAX_RETRY_FACTOR))
                continue
            failures = 0
            self._health.set_degraded("")
            if not found:
                self._decoded.clear()  # of records that were not accepted
                self._store.inbox_changed.wait()

    def _handle_in_batches(self) -> bool:
        items = self._store.inbox_items(max(16, self._service.BATCH), max_bytes=self._service.BATCH_BYTES)
        for first in range(0, len(items), self._service.BATCH):
            if self._stopping.is_set():
                raise ServiceStoppingError
            self.handle_batch(items[first : first + self._service.BATCH])
        return bool(items)

    def _handle_each_alone(self, failures: int) -> bool:
        """Handle records one by one, so that one that fails does not delay the others.

        A record is quarantined if it fails `FAILURES_ALONE` times while others are handled, with an error that is not
        one of the machine or the network.

        Args:
            failures: Number of rounds that failed. It increases the number of records, for the case that all of the
                first ones fail.

        Raises:
            Exception: A record has failed.
        """
        factor = 2 ** min(failures // 4, 4)
        items = self._store.inbox_items(
            factor * max(16, self._service.BATCH), max_bytes=factor * self._service.BATCH_BYTES
        )
        failed: list[tuple[InboxItem, Exception]] = []
        for item in items:
            if self._stopping.is_set():
                raise ServiceStoppingError
            try:
                self.handle_batch([item])
            except ServiceStoppingError:
                raise
            except Exception as error:  # noqa: BLE001  raised below
                failed.append((item, error))
        counted = self._failed_alone
        if len(failed) < len(items):
            counted = {each.id: counted.get(each.id, 0) + 1 for each, why in failed if can_concern_record(why)}
        for item, why in failed:
            if counted.get(item.id, 0) >= FAILURES_ALONE:
                log.error("Record quarantined: it fails while others are handled", extra=kv(key=item.key))
                self._health.count("records_failed")
                self._quarantine_record(item, f"{type(why).__name__}: {why}")
        self._failed_alone = {name: count for name, count in counted.items() if count < FAILURES_ALONE}
        if failed:
            raise failed[0][1]
        return bool(items)

    @contextmanager
    def accepting(self) -> Iterator[tuple[Transaction, Handle[Record]]]:
        """Open a transaction that accepts records, and handles the first ones unless earlier ones wait."""
        handled: list[UnitOfWork] = []
        with self._service.handling(wait=False) as is_held:
            with self._store.transaction() as tx:
                limit = self._service.MAX_AT_ONCE if is_held and tx.is_inbox_empty() else 0

                def handle(key: str, payload: bytes, record: Record) -> bool:
                    nonlocal limit
                    if len(handled) >= limit or not self._service.is_quick(record):
                        limit = 0  # later records do not overtake it
                        return self.keep_decoded(key, payload, record)
                    try:
                        with log_context(payload):
                            handled.append(self._call_handle(key, payload, record))
                    except (DeliveryError, sqlite3.Error):
                        raise  # the transaction can have ended
                    except Exception as error:  # noqa: BLE001 - raised again when it is handled in its turn
                        # Later records do not overtake it.
                        log.debug("Record not handled when accepted", extra=kv(key=key, error=str(error)))
                        limit = 0
                    return bool(limit)

                yield tx, handle
                if handled:
                    self._service.before_commit()
                    handled.extend(self._service.further_effects())
                for effects in handled:
                    effects.write(tx)
            if is_held and not tx.wrote_inbox:
                self._decoded.clear()  # of records that were not accepted
            if handled:
                try:
                    self._service.after_commit(handled, tx.superseded)
                except Exception:
                    # The records are accepted and handled: the inbox must not repeat them.
                    log.exception("Work after the commit of handled records failed")

    def handle_batch(self, items: Sequence[InboxItem]) -> None:
        """Handle records of the inbox and commit what follows from them."""
        handled: list[UnitOfWork] = []
        with self._service.handling():
            try:
                for item in items:
                    effects = self._effects_of(item)
                    if effects is not None:
                        effects.remove_from_inbox(item)
                        handled.append(effects)
            finally:
                # Records before the one that has to be retried are complete.
                if handled:
                    self._service.commit_batch(handled)

    def _effects_of(self, item: InboxItem) -> UnitOfWork | None:
        """Handle a record; return its effects, or None if it was quarantined."""
        with log_context(item.payload):
            try:
                record = self._decoded.pop((item.key, item.payload), None)
                if record is None:
                    record = wire.decode(self._record_type(item.key), item.payload, item.key)
                return self._call_handle(item.key, item.payload, record)
            except (OSError, DeliveryError, MemoryError, ServiceStoppingError):
                raise
            except BadInputError as error:
                self.refused(error)
                self._quarantine_record(item, str(error))
                return None
            except Exception as error:
                # An unexpected exception must neither block later records nor lose this one.
                log.exception("Record quarantined after an unexpected exception", extra=kv(key=item.key))
                self._health.count("records_failed")
                self._quarantine_record(item, f"{type(error).__name__}: {error}")
                return None

    def _call_handle(self, key: str, payload: bytes, record: Record) -> UnitOfWork:
        effects = UnitOfWork(payload)
        self._service.handle(key, record, effects)
        effects.count("records_handled")
        return effects

    def _quarantine_record(self, item: InboxItem, reason: str) -> None:
        with self._store.transaction() as tx:
            tx.quarantine("in", item.key, item.payload, reason, is_accepted=True)
            tx.remove_handled(item)
