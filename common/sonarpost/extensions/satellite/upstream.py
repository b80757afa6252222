"""Upstream of the relay over a message bearer: contacts with previews and decisions in short messages."""

import logging
import secrets
import threading
import time
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any, cast

import msgpack
from typing_extensions import override

from sonarpost.errors import BadInputError, DeliveryError, PortError
from sonarpost.extensions.satellite.config import SatelliteKeys
from sonarpost.extensions.satellite.iridium import IridiumTerminal, TerminalError
from sonarpost.extensions.satellite.policy import ByteBudget, Window
from sonarpost.extensions.satellite.sender import (
    NextMessage,
    PendingMessage,
    QueuedItem,
    ShortMessageSender,
    decision_items,
    image_items,
    image_name,
)
from sonarpost.extensions.satellite.short_message import MAX_MESSAGE_BYTES, WINDOW, ShortMessageError
from sonarpost.link.state import SavedCount, Word, from_plain, unpack_value
from sonarpost.logs import kv
from sonarpost.messages import CodedImage, Decision
from sonarpost.runtime.service import Service, UnitOfWork
from sonarpost.services.relay.bearers import Bearer

if TYPE_CHECKING:
    from sonarpost.services.relay.config import UpstreamOptions

log = logging.getLogger(__name__)

_WHERE = "state of short messages"
POLL_S = 1.0
RETRY_S = 30.0
"""Delay after a message that the terminal could not send."""


class SatelliteUpstream(Bearer):
    """Sends short messages to one site and processes the acknowledgements.

    Its records are copies: the images themselves wait for the radio. A record that a radio upstream of the same site
    has delivered is not sent.

    Args:
        options: Configuration of the upstream.
        service: The relay. States of its store with the site's prefix hold items, messages and the budget.
        has_radio: Whether the site also has a radio upstream.
    """

    KEYS = SatelliteKeys

    def __init__(self, options: "UpstreamOptions", service: Service[Any], *, has_radio: bool) -> None:
        self.site = options.site
        self._options = own = cast(SatelliteKeys, options)
        self._store = store = service.store
        self._count = service.count
        self._log = service.interval_log(log, logging.WARNING, "Satellite terminal failed")
        self._bearer = IridiumTerminal(own.terminal, own.baud)
        self._prefix = f"short/{self.site}/"
        self._wake = threading.Event()
        self._lock = threading.Lock()
        self._withdrawn: list[str] = []
        self._fault = ""
        self._checked_s = 0.0
        windows = tuple(Window.parse(text) for text in own.windows)
        self._budget = ByteBudget(own.bytes_per_day, windows)
        store.read_state(f"{self._prefix}budget", self._budget.restore, None)
        messages = store.read_states(f"{self._prefix}message/", lambda _, data: PendingMessage.unpack(data))
        items = store.read_states(f"{self._prefix}item/", lambda _, data: QueuedItem.unpack(data))
        epoch, next_seq = self._first_numbers(messages.values())
        self._sender = ShortMessageSender(epoch, next_seq, after_s=own.after_s if has_radio else 0.0)
        self._sender.restore(items.values(), messages.values(), time.time())
        number = store.read_state(
            f"{self._prefix}number", lambda data: from_plain(SavedCount, int.from_bytes(data, "big"), _WHERE), 0
        )
        self._next_number = max(number, self._sender.next_number)
        self._known = {f"{self._prefix}item/{name}" for name in items}

    def _first_numbers(self, messages: Collection[PendingMessage]) -> tuple[int, int]:
        """Return the epoch and the next sequence number."""
        head = self._store.read_state(
            f"{self._prefix}head", lambda data: unpack_value(tuple[Word, Word], data, _WHERE), None
        )
        if head is not None or not messages:
            return head or (secrets.randbits(32), 0)
        # The numbers are lost. No message was given a number that is a window above one without acknowledgement.
        oldest = min((each.message for each in messages), key=lambda message: message.seq)
        return oldest.epoch, oldest.seq + WINDOW

    # Records

    @override
    def queue(self, record: CodedImage | Decision, effects: UnitOfWork) -> None:
        now_s = time.time()
        try:
            if isinstance(record, Decision):
                items = decision_items(record, self._next_number, now_s)
            else:
                items = image_items(record, self._next_number, self._options.preview_bytes, now_s)
        except ShortMessageError as error:
            # The radio still delivers it.
            effects.count("records_too_long_for_short_messages")
            log.warning("Record not sent by short message", extra=kv(reason=str(error)))
            return
        self._next_number += len(items)
        effects.put_state(f"{self._prefix}number", self._next_number.to_bytes(8, "big"))
        for item in items:
            effects.put_state(self._item_name(item.number), item.pack())

    @override
    def committed(self) -> None:
        self._wake.set()

    @override
    def delivered_by_radio(self, fields: Mapping[str, object]) -> None:
        """Withdraw a record that a radio upstream of this site has delivered.

        Args:
            fields: Fields of a decision, a decoded image or a part of an image.
        """
        vehicle_id, image_id = fields.get("vehicle_id", fields.get("u")), fields.get("image_id", fields.get("i"))
        name = fields.get("decision_id") or image_name(str(vehicle_id), str(image_id))
        with self._lock:
            self._withdrawn.append(str(name))
        self._wake.set()

    # Sending

    @override
    def run(self, stopping: threading.Event) -> None:
        """Send until `stopping` is set, then close the terminal."""
        try:
            self._run(stopping)
        finally:
            self._bearer.close()

    def _run(self, stopping: threading.Event) -> None:
        while not stopping.is_set():
            self._wake.clear()
            try:
                self._take_changes()
                busy = self._step(stopping)
                self._fault = ""
            except Exception as error:
                if stopping.is_set():
                    return
                busy = False
                self._fault = str(error) or type(error).__name__
                if isinstance(error, (PortError, BadInputError, DeliveryError)):
                    self._log.log(site=self.site, error=str(error))
                else:  # a defect, or a library's own error: the radio and the other sites continue
                    log.exception("Short messages failed; retrying", extra=kv(site=self.site))
                    self._count("short_messages_failed")
                    stopping.wait(RETRY_S)
            if not busy:
                self._wake.wait(POLL_S)

    def _take_changes(self) -> None:
        """Take over committed items, and withdraw those that the radio has delivered."""
        # Before the items: every withdrawn record was committed earlier.
        with self._lock:
            withdrawn, self._withdrawn = self._withdrawn, []
        new = [name for name in self._store.state_names(f"{self._prefix}item/") if name not in self._known]
        values = {name: data for name in new if (data := self._store.get_state(name)) is not None}
        items = self._store.readable(values, lambda _, data: QueuedItem.unpack(data)).values()
        removed = list(self._sender.insert(sorted(items, key=lambda item: item.number)))
        self._known.update(new)
        for name in withdrawn:
            removed += self._sender.withdraw(name)
        if removed:
            with self._store.transaction() as tx:
                for number in removed:
                    tx.delete_state(self._item_name(number))
            self._known.difference_update(self._item_name(number) for number in removed)

    def _step(self, stopping: threading.Event) -> bool:
        """Send a message, or check for acknowledgements; return whether there may be more to do."""
        now_s = time.time()
        message = None
        if self._budget.allows(MAX_MESSAGE_BYTES, now_s):
            message = self._sender.next_message(now_s)
        if message is not None:
            self._store_message(message, now_s)
        elif not self._is_check_due(now_s):
            return False
        self._checked_s = now_s
        try:
            result = self._bearer.exchange(None if message is None else message.data)
        except (PortError, TerminalError):
            if message is not None and not stopping.is_set():
                self._take_back(message)
            raise
        if stopping.is_set():
            return False
        if message is not None and not result.sent:
            self._take_back(message)
        elif message is not None:
            self._count("short_messages_sent")
        if result.received is not None:
            self._acknowledge(result.received)
            self._checked_s = 0.0 if result.waiting else self._checked_s
        return message is not None and result.sent

    def _is_check_due(self, now_s: float) -> bool:
        waits = self._sender.unacknowledged > 0 and self._budget.is_open(now_s)
        return waits and now_s - self._checked_s >= self._options.check_interval_s

    def _store_message(self, message: NextMessage, now_s: float) -> None:
        """Store a message and its cost before it is sent, so that no restart sends it under another number."""
        self._budget.charge(len(message.data), now_s)
        with self._store.transaction() as tx:
            tx.put_state(f"{self._prefix}head", msgpack.packb((self._sender.epoch, self._sender.next_seq)))
            tx.put_state(self._message_name(message.seq), message.stored)
            tx.put_state(f"{self._prefix}budget", self._budget.pack())
            for number in message.packed:
                tx.delete_state(self._item_name(number))
        self._known.difference_update(self._item_name(number) for number in message.packed)

    def _take_back(self, message: NextMessage) -> None:
        self._count("short_messages_failed")
        self._sender.failed(message.seq, time.time(), RETRY_S)
        self._budget.refund(len(message.data))
        with self._store.transaction() as tx:
            tx.put_state(f"{self._prefix}budget", self._budget.pack())

    def _acknowledge(self, data: bytes) -> None:
        try:
            done = self._sender.acknowledge(data, time.time())
        except BadInputError as error:
            self._count("short_messages_refused")
            self._log.log(site=self.site, error=str(error))
            return
        with self._store.transaction() as tx:
            for seq in done:
                tx.delete_state(self._message_name(seq))
        if done:
            log.info("Short messages acknowledged", extra=kv(site=self.site, messages=len(done)))

    def _item_name(self, number: int) -> str:
        return f"{self._prefix}item/{number}"

    def _message_name(self, seq: int) -> str:
        return f"{self._prefix}message/{seq}"

    @override
    def stop(self) -> None:
        """Stop the exchange in progress."""
        self._wake.set()
        self._bearer.stop()

    # Health

    @override
    def warning(self) -> str:
        """Return the fault of the terminal, or that the budget of the day is used."""
        site = self.site
        if self._fault:
            return f"{site} by satellite: {self._fault}"
        now_s = time.time()
        limit = self._options.bytes_per_day
        if limit is not None and self._sender.waiting and self._budget.used_today(now_s) + MAX_MESSAGE_BYTES > limit:
            return f"{site} by satellite: {limit} bytes of the day are used; {self._sender.waiting} items wait"
        return ""

    @override
    def gauges(self) -> dict[str, float]:
        """Return queue, budget and cost; those that wait for the radio first are included."""
        site, budget = self.site, self._budget
        found = {
            f"satellite_waiting_for_{site}": float(self._sender.waiting),
            f"satellite_unacknowledged_{site}": float(self._sender.unacknowledged),
            f"satellite_bytes_today_{site}": float(budget.used_today(time.time())),
            f"satellite_bytes_{site}": float(budget.total_bytes),
            f"satellite_messages_{site}": float(budget.total_messages),
        }
        if self._options.cost_per_kb is not None:
            found[f"satellite_cost_{site}"] = budget.total_bytes / 1000 * self._options.cost_per_kb
        return found
