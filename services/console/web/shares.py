"""Shares of the users in the threads of the server, in which requests are handled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, ParamSpec, TypeVar
from weakref import WeakValueDictionary

from anyio import CapacityLimiter, to_thread

from sonarpost.limits import limit

_SURFACE: Final = "HTTP interface of the console"
MAX_THREADS: Final = limit(16, "requests", "shares", _SURFACE, "all users", "handled in total", "others wait")
MAX_THREADS_OF_USER: Final = limit(2, "requests", "shares", _SURFACE, "user", "handled at a time", "others wait")
MAX_WAITING_OF_USER: Final = limit(64, "requests", "shares", _SURFACE, "user", "waiting", "429 with Retry-After")
P = ParamSpec("P")
R = TypeVar("R")


class TooManyRequestsError(Exception):
    """Too many requests of one user are waiting."""


class ThreadShares:
    """Runs functions in threads, with a share for each user. Used in the event loop."""

    def __init__(self) -> None:
        self._threads = CapacityLimiter(MAX_THREADS)
        self._shares: WeakValueDictionary[str, CapacityLimiter] = WeakValueDictionary()

    async def run(self, user: str, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        """Run a function in a thread; return its result.

        Raises:
            TooManyRequestsError: The limit of waiting requests is reached.
        """
        # Requests hold the share of their user; without any it is deleted.
        share = self._shares.setdefault(user, CapacityLimiter(MAX_THREADS_OF_USER))
        if share.statistics().tasks_waiting >= MAX_WAITING_OF_USER:
            raise TooManyRequestsError
        async with share:
            return await to_thread.run_sync(lambda: function(*args, **kwargs), limiter=self._threads)
