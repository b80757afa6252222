"""Stream of server-sent events to an open page."""

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

from sonarpost.limits import limit
from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.web.access import AccessControl, ApiError, error_response

KEEP_ALIVE_S = 5.0
MAX_STREAMS_OF_USER = limit(8, "streams", "shares", "event stream", "user", "of one user", "429 with Retry-After")
MAX_STREAMS = limit(100, "streams", "shares", "event stream", "all users", "in total", "503")
RETRY_S = 10


class EventStream:
    """Route of the event stream."""

    def __init__(self, state: ConsoleState) -> None:
        self._state = state
        self._open: Counter[str] = Counter()
        self._stopped = False

    def routes(self, access: AccessControl) -> list[Route]:
        """Return the route."""

        async def endpoint(request: Request) -> Response:
            session = await asyncio.to_thread(access.session_of, request)
            if session is None:
                return error_response(ApiError(401, "no_session", "log in first"))
            headers = {"Retry-After": str(RETRY_S)}
            if self._open[session.name] >= MAX_STREAMS_OF_USER:
                message = f"{session.name} has {MAX_STREAMS_OF_USER} open pages, no more are permitted: close one"
                return error_response(ApiError(429, "too_many", message, "pages", headers))
            if self._open.total() >= MAX_STREAMS:
                return error_response(ApiError(503, "busy", "too many open pages", headers=headers))
            last_id = request.headers.get("last-event-id") or request.query_params.get("last", "")
            events = self._events(request, access, session.name, last_id)
            headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
            return StreamingResponse(events, media_type="text/event-stream", headers=headers)

        return [Route("/events", endpoint)]

    def stop(self) -> None:
        """End all streams, so that the server can stop."""
        self._stopped = True
        self._state.events.notify_all()

    async def _events(self, request: Request, access: AccessControl, user: str, last_id: str) -> AsyncIterator[str]:
        hub, loop, notified = self._state.events, asyncio.get_running_loop(), asyncio.Event()

        def notify() -> None:
            loop.call_soon_threadsafe(notified.set)

        hub.subscribe(notify)
        self._open[user] += 1
        try:
            number = hub.parse_event_id(last_id) if last_id else hub.last
            hello = json.dumps({"now_utc_s": self._state.clock()})
            yield _event_text("hello", hello, hub.event_id(hub.last if number is None else number))
            session_checked_s = clock_sent_s = time.monotonic()
            while not self._stopped:
                if time.monotonic() - session_checked_s >= KEEP_ALIVE_S:
                    session_checked_s = time.monotonic()
                    if await asyncio.to_thread(access.session_of, request, is_use=False) is None:
                        yield _event_text("session", "{}", None)
                        return
                notified.clear()
                events = None if number is None else hub.events_after(number)
                if events is None:
                    number = hub.last
                    yield _event_text("reset", "{}", hub.event_id(number))
                    continue
                for event in events:
                    number = event.number
                    yield _event_text(event.name, event.data, hub.event_id(number))
                if time.monotonic() - clock_sent_s >= KEEP_ALIVE_S:
                    clock_sent_s = time.monotonic()
                    yield _event_text("clock", json.dumps({"now_utc_s": self._state.clock()}), None)
                with suppress(TimeoutError):
                    await asyncio.wait_for(notified.wait(), KEEP_ALIVE_S)
        finally:
            hub.unsubscribe(notify)
            self._open[user] -= 1
            if self._open[user] <= 0:
                del self._open[user]


def _event_text(name: str, data: str, event_id: str | None) -> str:
    head = "" if event_id is None else f"id: {event_id}\n"
    return f"{head}event: {name}\ndata: {data}\n\n"
