"""Senders over a shared link, with a simulated clock: the product's scheduler and congestion control, no network.

A query passes the link (rate, delay, jitter, in order), waits for a commit of the consumer, and its reply passes the
link in the other direction. The buffer of the link has no limit, as the buffers of hosts and routers in practice.
"""

import heapq
import itertools

from research.common.link_emulator import SerialLine
from sonarpost.delivery.protocol import BATCH_RECORD_OVERHEAD_BYTES
from sonarpost.delivery.records import OutboxItem
from sonarpost.delivery.scheduler import DeliveryScheduler

QUERY_BYTES = 170
"""Headers and key of a query, and the fixed fields of its attachment."""
REPLY_BYTES = 120


class Link:
    """A line in each direction, or several in series with routers between, each of which receives a query as a whole.

    Args:
        rate_bytes_per_s: Rate of each line.
        delay_s: Time of each direction, without transmission and jitter.
        jitter_s: Maximum additional time of a line.
        hops: Number of lines.
    """

    def __init__(self, rate_bytes_per_s, delay_s, jitter_s=0.0, hops=1):
        self.lines = [
            [SerialLine(rate_bytes_per_s, delay_s / hops, jitter_s, 2 * hop + way) for hop in range(hops)]
            for way in (0, 1)
        ]
        self.carried_bytes = 0

    @property
    def up(self):
        return self.lines[0][0]

    def arrival_s(self, direction, size_bytes, now_s):
        """Send data; return when it arrives."""
        self.carried_bytes += size_bytes * (direction == 0)
        for line in self.lines[direction]:
            now_s = line.arrival_s(size_bytes, now_s)
        return now_s


class Sender:
    """A queue that always holds its records in memory.

    Attributes:
        acknowledged_s: When each record was acknowledged, by number.
        queries: Number of queries for each record.
    """

    def __init__(self, records=(), bytes_per_s=None, begins_s=0.0, max_batch=128):
        self.scheduler = DeliveryScheduler(bytes_per_s, begins_s)
        self.begins_s = begins_s
        self.max_batch = max_batch
        self._not_loaded = []
        self.acknowledged_s = {}
        self.queries = {}
        self.in_flight = 0
        self.epoch = 0
        self.add(records)

    def add(self, records):
        waiting = [transfer.item for transfer in self.scheduler.active.values() if not transfer.in_flight]
        self.scheduler.update([])
        self._not_loaded = sorted([*self._not_loaded, *waiting, *records], key=lambda item: (-item.priority, -item.seq))
        self.load()

    @property
    def is_done(self):
        return not self._not_loaded and not self.scheduler.active

    def load(self):
        """Add the most urgent records to those that the scheduler has."""
        has = [transfer.item for transfer in self.scheduler.active.values()]
        free = max(0, self.scheduler.lookahead - len(has))
        self._not_loaded, more = self._not_loaded[: -free or None], self._not_loaded[len(self._not_loaded) - free :]
        self.scheduler.update([*has, *more])


class Simulation:
    """Runs senders over a link until a time, or until all records are acknowledged.

    Args:
        link: The link.
        senders: Senders that share it.
        commit_s: Time of a commit; queries that arrive until it ends share the next one.
    """

    def __init__(self, link, *senders, commit_s=0.002):
        self.link = link
        self.senders = senders
        self.now_s = 0.0
        self._commit_s = commit_s
        self._committed_s = 0.0
        self._events = []
        self._numbers = itertools.count()
        for sender in senders:
            self.at(sender.begins_s, self.send, sender)

    def at(self, at_s, call, *args):
        heapq.heappush(self._events, (at_s, next(self._numbers), call, args))

    def run(self, until_s=float("inf")):
        while self._events and self._events[0][0] <= until_s:
            self.now_s, _, call, args = heapq.heappop(self._events)
            call(*args)
        self.now_s = max(self.now_s, until_s) if until_s < float("inf") else self.now_s
        return self

    def cut(self, link):
        """Lose all that is in transit and continue over another link; the senders notice it at once."""
        self.link = link
        for sender in self.senders:
            sender.epoch += 1
            sender.in_flight = 0
            sender.scheduler.restart(timed_out=False)
            self.send(sender)

    def send(self, sender):
        scheduler = sender.scheduler
        while True:
            if len(scheduler.active) <= scheduler.lookahead // 2:
                sender.load()
            chunk, wait_s = scheduler.next_chunk(self.now_s)
            if chunk is None:
                if wait_s:
                    self.at(self.now_s + wait_s, self.send, sender)
                return
            chunks = scheduler.batch_with(chunk)
            scheduler.query_sent(chunk, self.now_s, *chunks[1:])
            for each in chunks:
                seq = each.transfer.item.seq
                sender.queries[seq] = sender.queries.get(seq, 0) + 1
            size = sum(each.size + BATCH_RECORD_OVERHEAD_BYTES for each in chunks) + QUERY_BYTES
            arrives_s = self.link.arrival_s(0, size, self.now_s)
            # A commit in progress ends first.
            self._committed_s = max(arrives_s, self._committed_s) + self._commit_s
            self.at(self._committed_s, self._reply, sender, sender.epoch, chunks)

    def _reply(self, sender, epoch, chunks):
        if epoch == sender.epoch:
            arrives_s = self.link.arrival_s(1, REPLY_BYTES, self.now_s)
            self.at(arrives_s, self._end, sender, epoch, chunks)

    def _end(self, sender, epoch, chunks):
        if epoch != sender.epoch:
            return
        scheduler = sender.scheduler
        scheduler.query_ended(chunks[0], self.now_s, replied=True)
        scheduler.probing = False
        scheduler.max_batch = sender.max_batch
        for chunk in chunks:
            item = chunk.transfer.item
            if chunk.end < len(item.payload):
                scheduler.confirm(chunk, chunk.end)
            else:
                scheduler.remove(chunk.transfer)
                sender.acknowledged_s[item.seq] = self.now_s
        self.send(sender)


def records(count, size_bytes=282, priority=5, first=1):
    """Return records of equal size, a coded image by default."""
    return [
        OutboxItem("c2", seq, "k", "", priority, bytes(size_bytes), bytes(32), position=seq)
        for seq in range(first, first + count)
    ]
