"""The stream of events to a page that is open."""

from __future__ import annotations

import asyncio
import json
import time
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import suppress

from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import Route

from sonarpost.services.console.events import Event
from sonarpost.services.console.state import Board
from sonarpost.services.console.web.access import Gate, RefusedError, answer

KEEP_ALIVE_S = 5.0
MOST_OF_A_SESSION = 4


class Stream:
    """The route of events.

    Args:
        board: The console's state.
        training: Whether contacts are simulated.
    """

    def __init__(self, board: Board, *, training: bool) -> None:
        self._board = board
        self._training = training
        self._open: Counter[str] = Counter()
        self._ended = False

    def routes(self, gate: Gate) -> list[Route]:
        """Return the route."""

        async def endpoint(request: Request) -> Response:
            session = await asyncio.to_thread(gate.session_of, request)
            if session is None:
                return answer(RefusedError(401, "no_session", "log in first"))
            if self._open[session.csrf] >= MOST_OF_A_SESSION:
                headers = {"Retry-After": "5"}
                return answer(RefusedError(429, "too_many", "too many pages of one session are open", headers=headers))
            last_id = request.headers.get("last-event-id") or request.query_params.get("last", "")
            events = self._events(request, gate, session.csrf, last_id)
            headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
            return StreamingResponse(events, media_type="text/event-stream", headers=headers)

        return [Route("/events", endpoint)]

    def end(self) -> None:
        """End every stream, for the server's end."""
        self._ended = True
        self._board.hub.wake_all()

    async def _events(self, request: Request, gate: Gate, who: str, last_id: str) -> AsyncIterator[str]:
        hub, loop, woken = self._board.hub, asyncio.get_running_loop(), asyncio.Event()

        def wake() -> None:
            loop.call_soon_threadsafe(woken.set)

        listener = hub.listen(wake)
        self._open[who] += 1
        try:
            at = hub.last if not last_id else hub.number_of(last_id)
            hello = {"now_utc_s": self._board.clock(), "training": self._training}
            yield _text("hello", json.dumps(hello), hub.identifier(hub.last if at is None else at))
            checked_s = told_s = time.monotonic()
            while not self._ended:
                if time.monotonic() - checked_s >= KEEP_ALIVE_S:
                    checked_s = time.monotonic()
                    if await asyncio.to_thread(gate.session_of, request, use=False) is None:
                        yield _text("session", json.dumps({"ends": "the session has ended"}), None)
                        return
                woken.clear()
                events = None if at is None else hub.since(at)
                if events is None:
                    at = hub.last
                    yield _text("reset", "{}", hub.identifier(at))
                    continue
                for event in events:
                    at = event.number
                    yield self._one(event)
                if time.monotonic() - told_s >= KEEP_ALIVE_S:
                    told_s = time.monotonic()
                    yield _text("clock", json.dumps({"now_utc_s": self._board.clock()}), None)
                with suppress(TimeoutError):
                    await asyncio.wait_for(woken.wait(), KEEP_ALIVE_S)
        finally:
            hub.leave(listener)
            self._open[who] -= 1
            if self._open[who] <= 0:
                del self._open[who]

    def _one(self, event: Event) -> str:
        return _text(event.name, event.data, self._board.hub.identifier(event.number))


def _text(name: str, data: str, identifier: str | None) -> str:
    head = "" if identifier is None else f"id: {identifier}\n"
    return f"{head}event: {name}\ndata: {data}\n\n"
