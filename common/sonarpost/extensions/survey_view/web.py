"""The web application of `sonarpost survey view`: the page, its tiles, places, contacts and picks.

Every path begins with a random token, so that other users and pages of this host cannot read it.
"""

import hmac
import shlex
import threading
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Final, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Receive, Scope, Send

from sonarpost.cli.shared import utc_text
from sonarpost.detection.detector import Detection
from sonarpost.detection.picks import MAX_PICKS, Pick, parse_pick, picks_text
from sonarpost.errors import ConfigError
from sonarpost.extensions.survey_view.waterfall import TILE_ROWS, PixelPlace, Waterfall
from sonarpost.files import write_atomically
from sonarpost.services.console.web.access import SecurityMiddleware
from sonarpost.sonar.source import SurveyInfo
from sonarpost.wire import first_error

STATIC: Final = Path(__file__).parent / "static"
MAX_BODY_BYTES: Final = 1 << 16

_Json: TypeAlias = dict[str, object]


class SavedPicks(BaseModel):
    """The body of a request to save picks."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")

    picks: list[str] = Field(max_length=MAX_PICKS)


@dataclass
class DetectedContacts:
    """The contacts, which a thread detects while the page is shown.

    Attributes:
        state: "running", "done" or "failed".
        message: Why the detection failed.
        detections: Contacts in the order of the recording; their ping indices are those of the file.
    """

    state: str = "running"
    message: str = ""
    detections: Sequence[Detection] = ()
    lock: threading.Lock = field(default_factory=threading.Lock)

    def finish(self, detections: Sequence[Detection]) -> None:
        """Set the contacts."""
        with self.lock:
            self.detections = sorted(detections, key=lambda d: (d.ping_index, d.side.value, d.sample))
            self.state = "done"

    def fail(self, message: str) -> None:
        """Set the reason why there are no contacts."""
        with self.lock:
            self.state, self.message = "failed", message


class SurveyViewApp:
    """The application of one recording.

    Attributes:
        asgi: The application.

    Args:
        info: The recording.
        waterfall: Its image.
        contacts: Its contacts.
        picks: Picks that the file of picks has already, with the index of their ping.
        out: File of picks that Save writes.
        command: `sonarpost detect` with the options of this call, which Save completes by the picks.
        token: First part of every path.
    """

    def __init__(
        self,
        info: SurveyInfo,
        waterfall: Waterfall,
        contacts: DetectedContacts,
        picks: Sequence[tuple[Pick, int]],
        out: Path,
        command: Sequence[str],
        token: str,
    ) -> None:
        self._info = info
        self._waterfall = waterfall
        self._contacts = contacts
        self._picks = dict(picks)
        self._out = out
        self._command = command
        self._lock = threading.Lock()
        routes = [
            Route("/", lambda _: _page()),
            Route("/info", _endpoint(self._describe)),
            Route("/contacts", _endpoint(self._list_contacts)),
            Route("/tile/{number}.png", _endpoint(self._tile)),
            Route("/snippet.png", _endpoint(self._snippet)),
            Route("/place", _endpoint(self._place)),
            Route("/picks", self._save, methods=["POST"]),
            Mount("/static", StaticFiles(directory=STATIC)),
        ]
        app = Starlette(routes=routes, exception_handlers={HTTPException: _error_response})
        self.asgi: ASGIApp = SecurityMiddleware(_TokenGate(app, token), (), tls=False)

    def _describe(self, _request: Request) -> Response:
        waterfall, info = self._waterfall, self._info
        with self._lock:
            picks = dict(self._picks)
        return JSONResponse(
            {
                "file": info.path.name,
                "line": info.line_name,
                "pings": info.ping_count,
                "warnings": list(info.warnings),
                "rows": waterfall.rows,
                "columns": 2 * waterfall.side_px,
                "tile_rows": TILE_ROWS,
                "tiles": waterfall.tiles,
                "stretch": waterfall.stretch,
                "max_range_m": waterfall.max_range_m,
                "pings_per_row": waterfall.pings_per_row,
                "out": str(self._out),
                "max_picks": MAX_PICKS,
                "picks": [self._pick_json(pick, index) for pick, index in picks.items()],
            }
        )

    def _pick_json(self, pick: Pick, ping_index: int) -> _Json:
        row, column = self._waterfall.pixel(ping_index, pick.side, pick.sample)
        return {"pick": str(pick), "row": row, "column": column}

    def _list_contacts(self, _request: Request) -> Response:
        with self._contacts.lock:
            state, message, detections = self._contacts.state, self._contacts.message, self._contacts.detections
        return JSONResponse({"state": state, "message": message, "contacts": list(map(self._contact_json, detections))})

    def _contact_json(self, d: Detection) -> _Json:
        waterfall = self._waterfall
        near_m = d.highlight_samples[0] * d.pixel_across_m
        far_m = (d.highlight_samples[1] + d.shadow_samples) * d.pixel_across_m
        columns = sorted(waterfall.column(d.side, range_m) for range_m in (near_m, far_m))
        rows = [min(max(index // waterfall.pings_per_row, 0), waterfall.rows - 1) for index in d.highlight_pings]
        return {
            "class": d.atd_class,
            "confidence": d.confidence,
            "row": min(d.ping_index // waterfall.pings_per_row, waterfall.rows - 1),
            "column": waterfall.column(d.side, d.slant_range_m),
            "rows": rows,
            "columns": columns,
            "length_m": d.length_m,
            "height_m": d.height_m,
        }

    def _tile(self, request: Request) -> Response:
        number = _whole_number(request.path_params["number"], "tile")
        return Response(self._waterfall.tile(number), media_type="image/png", headers={"Cache-Control": "private"})

    def _snippet(self, request: Request) -> Response:
        row, column = _pixel(request)
        return Response(self._waterfall.snippet(row, column), media_type="image/png")

    def _place(self, request: Request) -> Response:
        place = self._waterfall.place(*_pixel(request))
        return JSONResponse({"place": None if place is None else _place_json(place)})

    async def _save(self, request: Request) -> Response:
        """Write the picks of the page to the file; the response has the command that lists their contacts."""
        body = bytearray()
        async for chunk in request.stream():
            body += chunk
            if len(body) > MAX_BODY_BYTES:
                raise HTTPException(413, f"body: got over {MAX_BODY_BYTES} bytes, expected less")
        return await run_in_threadpool(self._save_picks, bytes(body))

    def _save_picks(self, body: bytes) -> Response:
        try:
            given = SavedPicks.model_validate_json(body)
        except ValidationError as error:
            name, _, expected = first_error(error)
            raise HTTPException(400, f"{name or 'body'}: {expected}") from error
        with self._lock:
            try:
                picks = {pick: self._ping_index(pick) for pick in (parse_pick(text, "picks") for text in given.picks)}
                write_atomically(self._out, picks_text(picks).encode())
            except ConfigError as error:
                raise HTTPException(400, str(error)) from error
            except OSError as error:
                raise HTTPException(503, f"{self._out}: cannot be written: {error.strerror or error}") from error
            self._picks = picks
        command = [*self._command, *(part for pick in picks for part in ("--pick", str(pick)))]
        return JSONResponse({"file": str(self._out), "picks": len(picks), "command": shlex.join(command)})

    def _ping_index(self, pick: Pick) -> int:
        """Return the index of the ping of a pick, which may be in the file already."""
        known = self._picks.get(pick)
        return self._waterfall.ping_index_of(pick) if known is None else known


def _place_json(place: PixelPlace) -> _Json:
    fields = asdict(place)
    return (
        fields
        | {"pick": str(place.pick), "side": place.pick.side.value, "sample": place.pick.sample}
        | {"time_utc": utc_text(place.time_utc_s)}
    )


def _page() -> Response:
    return FileResponse(STATIC / "index.html", headers={"Cache-Control": "no-cache"})


def _endpoint(handler: Callable[[Request], Response]) -> Callable[[Request], Response]:
    """Return an endpoint, called in a thread, that reports a place outside the image as status 404."""

    def serve(request: Request) -> Response:
        try:
            return handler(request)
        except IndexError as error:
            raise HTTPException(404, str(error)) from error

    return serve


def _pixel(request: Request) -> tuple[int, int]:
    row, column = (_whole_number(request.query_params.get(name, ""), name) for name in ("row", "column"))
    return row, column


def _whole_number(text: str, name: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) <= 12):
        raise HTTPException(400, f"{name}: got {text[:40]!r}, expected a whole number, 0 or more")
    return int(text)


async def _error_response(_request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return JSONResponse({"error": error.detail}, error.status_code)


class _TokenGate:
    """Passes requests whose path begins with the token, without it; the others get status 404."""

    def __init__(self, app: ASGIApp, token: str) -> None:
        self._app = app
        self._token = token.encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http":
            return
        given, _, rest = scope["path"].removeprefix("/").partition("/")
        if not hmac.compare_digest(given.encode("utf-8", "surrogateescape"), self._token):
            await JSONResponse({"error": "no such page: use the address that the command printed"}, 404)(
                scope, receive, send
            )
            return
        path = f"/{rest}"
        await self._app({**scope, "path": path, "raw_path": path.encode("utf-8", "surrogateescape")}, receive, send)
