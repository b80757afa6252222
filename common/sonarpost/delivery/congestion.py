"""Congestion control of the queries to one consumer: bytes in flight, size of a query, time-out. Pure.

The network loses no query while its connections last, so that a full buffer shows in the reply times only. The window
therefore follows these: it doubles with each round trip until replies wait in a queue, then it holds a small queue in
the slowest part of the path. `docs/specifications/delivery.md` specifies the rules.
"""

from __future__ import annotations

import math

from sonarpost.delivery.protocol import CHUNK_BYTES

START_BYTES = 2048
"""Window before the first reply."""
LOCAL_START_BYTES = 8 * CHUNK_BYTES
"""The same to a consumer on the same platform: a record of up to 32 KiB is one query, and one commit."""
MIN_QUERY_BYTES = 2048
"""Size of a query on a slow link. A smaller one would consist of headers; a larger one delays urgent records."""
QUERIES = 8
"""Number of queries in a window, as far as their size allows. Routers forward whole queries: each hop adds the time of
one to a reply time."""
MAX_WINDOW_BYTES = 64 * CHUNK_BYTES
QUEUE_FACTOR, QUEUE_S = 1.25, 0.05
"""Reply times up to the shortest one times the factor, and by these seconds more, show no queue: a consumer commits
several queries at once."""
STEP_BYTES, GROWTH = 1024, 1 / 8
"""Growth of the window with each round trip: this number, and a part of the window. The number makes windows equal that
share a link."""
RESUME_FACTOR = 3
"""Growth after an interruption or a pause, per byte acknowledged: the window is fourfold after each round trip."""
PAUSE_S = 10.0
"""Time without a reply after which the window is small again: the rate can have changed."""
MEASURE_EVERY_S = 240.0
"""Interval at which the shortest reply time is measured again, with the first window: at multiples of it in UTC, so
that all queues that share a link do it at the same time and find an empty link."""
MIN_TIMEOUT_S, MAX_TIMEOUT_S = 30.0, 300.0
MAX_DOUBLINGS = 10
TIMEOUT_FACTOR = 8
"""Longest reply times in a time-out: the rate of a radio link can fall by this factor."""
FADE = 0.9
"""Factor by which the longest reply time and the usual size of a query are forgotten with each reply."""


class CongestionControl:
    """Window and time-out of the queries to one consumer.

    Args:
        clock_offset_s: What is added to the times of all calls for times that other hosts share, as UTC.
        start_bytes: Window before the first reply.

    Attributes:
        window_bytes: Payload that may be in flight.
    """

    def __init__(self, clock_offset_s: float = 0.0, start_bytes: int = START_BYTES) -> None:
        self._clock_offset_s = clock_offset_s
        self._start_bytes = float(start_bytes)
        self.window_bytes = self._start_bytes
        self._shortest_s = math.inf
        self._usual_bytes = 0.0
        self._longest_s = 0.0
        self._timeouts = 0
        self._doubling = True
        self._is_first = True
        self._resume_bytes = 0.0
        self._replied_s = math.inf
        self._period = math.inf
        self._measured_s = math.inf
        self._measuring_since_s = 0.0
        self._round_began_s = -math.inf
        self._round_s = math.inf
        self._was_full = False

    @property
    def query_bytes(self) -> int:
        """Maximum payload of a query."""
        return int(min(max(self.window_bytes / QUERIES, MIN_QUERY_BYTES), CHUNK_BYTES))

    @property
    def timeout_s(self) -> float:
        """Time-out of the next query; much longer than a reply takes, because a broken connection ends a query."""
        return min((MIN_TIMEOUT_S + TIMEOUT_FACTOR * self._longest_s) * 2.0**self._timeouts, MAX_TIMEOUT_S)

    def begins(self, now_s: float) -> None:
        """Prepare for a query while no other is in flight."""
        if now_s - self._replied_s > PAUSE_S:
            self._restart(max(self._resume_bytes, self.window_bytes))

    def replied(self, size_bytes: int, sent_s: float, now_s: float, in_flight_bytes: int) -> None:
        """Use the reply to a query.

        Args:
            size_bytes: Payload of the query.
            sent_s: When it was sent.
            now_s: Present time, of the same monotonic clock.
            in_flight_bytes: Payload in flight before the reply, with the query's own.
        """
        reply_s = now_s - sent_s
        self._replied_s = now_s
        self._timeouts = 0
        self._longest_s = max(reply_s, FADE * self._longest_s)
        usual_bytes = self._usual_bytes
        self._usual_bytes = max(size_bytes, FADE * usual_bytes)
        if size_bytes < min(usual_bytes, self.query_bytes) / 2:
            return  # it is faster than others
        is_slower = self._is_first and reply_s > self._free_s
        if is_slower:
            self._resume_bytes = 0.0  # another path
        if is_slower or (in_flight_bytes <= 2 * size_bytes and size_bytes > 2 * usual_bytes):
            self._shortest_s = reply_s  # nothing was in flight before it
        self._shortest_s = min(self._shortest_s, reply_s)
        self._round_s = min(self._round_s, reply_s)
        self._was_full = self._was_full or self._is_first or in_flight_bytes >= self.window_bytes / 2
        self._is_first = False
        if self._doubling and not self._measuring_since_s and self._was_full and reply_s <= self._free_s:
            factor = RESUME_FACTOR if self.window_bytes < self._resume_bytes else 1
            self._set_window(self.window_bytes + factor * size_bytes)
        if sent_s >= self._round_began_s:
            self._end_round(now_s)

    def timed_out(self) -> None:
        """Use that a query had no reply: double the time-out and begin with a small window."""
        self._timeouts = min(self._timeouts + 1, MAX_DOUBLINGS)
        self._restart(0.0)

    def interrupted(self) -> None:
        """Use that the connection or the consumer was lost: grow faster up to half of the present window."""
        self._restart(self._resume_bytes if self._is_first else max(self._resume_bytes, self.window_bytes) / 2)

    @property
    def _free_s(self) -> float:
        """Longest reply time without a queue."""
        return QUEUE_FACTOR * self._shortest_s + QUEUE_S

    def _restart(self, resume_bytes: float) -> None:
        self.window_bytes = self._start_bytes
        self._resume_bytes = resume_bytes
        self._measuring_since_s = 0.0
        self._doubling = self._is_first = True
        self._begin_round(-math.inf)

    def _begin_round(self, now_s: float) -> None:
        self._round_began_s = now_s
        self._round_s = math.inf
        self._was_full = False

    def _end_round(self, now_s: float) -> None:
        """Adapt the window once for each round trip, by the shortest reply time in it."""
        period = (now_s + self._clock_offset_s) // MEASURE_EVERY_S
        if self._measuring_since_s:
            self._measured_s = min(self._measured_s, self._round_s)
            if now_s - self._measuring_since_s >= 2 * self._longest_s:
                self._shortest_s = self._measured_s
                self._set_window(self._resume_bytes)
                self._measuring_since_s = self._resume_bytes = 0.0
        elif self._was_full and not self._doubling and period > self._period:
            self._resume_bytes = self.window_bytes
            self.window_bytes = self._start_bytes
            self._measured_s = math.inf
            self._measuring_since_s = now_s
        else:
            free = 1.0 if self._round_s <= self._free_s else self._free_s / self._round_s
            if free < 1.0:
                self._doubling, self._resume_bytes = False, 0.0
            adapted = (free + GROWTH) * self.window_bytes + STEP_BYTES
            if not self._doubling and (self._was_full or adapted < self.window_bytes):
                self._set_window(adapted)
        self._period = period
        self._begin_round(now_s)

    def _set_window(self, window_bytes: float) -> None:
        self.window_bytes = min(max(window_bytes, 2 * MIN_QUERY_BYTES), MAX_WINDOW_BYTES)
