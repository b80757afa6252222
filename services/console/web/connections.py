"""Deadlines of the console's connections: an ASGI middleware."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final

from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from sonarpost.network.connections import ConnectionLimits

CHUNK_BYTES: Final = 65536
"""Size of the parts of a response; a client has a limited time to read each."""


class ConnectionDeadlines:
    """ASGI middleware that sets the deadlines of connections.

    A client has `request_s` to send a request, and `read_s` to read each chunk of the response. While the server
    prepares a response, and between the events of a stream, there is no deadline.

    Args:
        app: The application.
        limits: The open connections.
    """

    def __init__(self, app: ASGIApp, limits: ConnectionLimits) -> None:
        self._app = app
        self._limits = limits

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        limits, peer = self._limits, scope["client"]
        if peer not in limits:
            # The connection was closed for another one, and its address is unknown.
            response = PlainTextResponse("too many connections", 503, {"Connection": "close"})
            await response(scope, receive, send)
            return

        async def receive_in_time() -> Message:
            message = await receive()
            if not message.get("more_body", False):
                limits.set_deadline(peer, math.inf)
            return message

        async def send_in_time(message: Message) -> None:
            for part in _parts(message):
                limits.set_deadline(peer, limits.read_s)
                await send(part)
            limits.set_deadline(peer, math.inf)

        if scope["method"] in ("GET", "HEAD"):
            limits.set_deadline(peer, math.inf)
        try:
            await self._app(scope, receive_in_time, send_in_time)
        finally:
            limits.set_deadline(peer, limits.request_s)


def _parts(message: Message) -> Iterable[Message]:
    """Split the body of a response: the server waits for the client only between messages."""
    body = message.get("body", b"")
    if message["type"] != "http.response.body" or len(body) <= CHUNK_BYTES:
        yield message
        return
    for start in range(0, len(body), CHUNK_BYTES):
        yield {**message, "body": bytes(body[start : start + CHUNK_BYTES]), "more_body": True}
    yield {**message, "body": b""}
