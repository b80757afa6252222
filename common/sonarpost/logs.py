"""Structured logs on standard error: one line for each event, as text or JSON.

A line holds the fields of its call and those of the log context: `vehicle` and `image_id` identify an image on every
platform, `contact_id` a contact on the vehicle.
"""

import json
import logging
import math
import re
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextvars import ContextVar
from datetime import UTC, datetime
from functools import lru_cache
from typing import Literal

from typing_extensions import override

from sonarpost.errors import PayloadError
from sonarpost.messages import ImagePart, Relayed
from sonarpost.wire import unpack_map

LogFormat = Literal["text", "json"]


class Fields(dict[str, object]):
    """Fields of a line; as text, each with a space before it: ` image_id=0001 bytes=232`."""

    @override
    def __str__(self) -> str:
        return "".join(f" {name}={_shown(value)}" for name, value in self.items())


def kv(**fields: object) -> dict[str, object]:
    """Return the `extra` argument of a log call: log.info("Image stored", extra=kv(image_id="0001"))."""
    return {"fields": Fields(fields)}


_NEEDS_QUOTES = re.compile(r"[ \"'=]").search


class log_context:  # noqa: N801  # a context manager, named like a function
    """Context manager that adds fields to every line that this thread logs inside the block.

    Args:
        payload: A record as msgpack; its vehicle, image and contact are added when the first line is logged.
        **fields: Further fields; None is omitted.
    """

    __slots__ = ("_fields", "_outer", "_own", "_payload", "_token")

    def __init__(self, payload: bytes = b"", /, **fields: object) -> None:
        self._payload = payload
        self._own = fields
        self._fields: Mapping[str, object] | None = None

    def __enter__(self) -> None:
        self._outer = _context.get()
        self._token = _context.set(self)

    def __exit__(self, *_: object) -> None:
        _context.reset(self._token)

    def fields(self) -> Mapping[str, object]:
        """Return the fields of this context and of those around it."""
        if self._fields is None:
            outer = {} if self._outer is None else self._outer.fields()
            own = {name: value for name, value in self._own.items() if value is not None}
            self._fields = {**outer, **context_of_payload(self._payload), **own}
        return self._fields


_context: ContextVar[log_context | None] = ContextVar("log_context", default=None)


def context_of_payload(payload: bytes) -> dict[str, str]:
    """Return `vehicle`, `image_id` and `contact_id` of a record as far as its payload holds them.

    The record inside a `relayed` record and the short names of a `part` are read as well. An invalid payload gives no
    fields.
    """
    fields = _unpacked(payload)
    inner = fields.get("payload")
    if fields.get("type") == Relayed.TYPE and isinstance(inner, bytes):
        fields = _unpacked(inner)
    if fields.get("type") == ImagePart.TYPE:
        fields = {"vehicle_id": fields.get("u"), "image_id": fields.get("i")}
    contact = fields.get("contact")
    contact = contact if isinstance(contact, dict) else {}
    found = {
        "vehicle": fields.get("vehicle_id") or contact.get("vehicle_id"),
        "image_id": fields.get("image_id"),
        "contact_id": contact.get("contact_id"),
    }
    return {name: value for name, value in found.items() if isinstance(value, str)}


def _unpacked(payload: bytes) -> Mapping[str, object]:
    try:
        return unpack_map(payload, "")
    except PayloadError:
        return {}


def log_batch(logger: logging.Logger, message: str, payloads: Sequence[bytes], /, **counts: int) -> None:
    """Log one line at level info for records that were handled together; at level debug, each has its own line.

    Args:
        logger: Logger of the module.
        message: Message of the line.
        payloads: The records as msgpack. One record gives the fields of its log context, several give `first` and
            `last`, each with vehicle and image.
        **counts: Further fields, for example the number of records of each type.
    """
    names = context_of_payload(payloads[0])
    if len(payloads) > 1:
        ends = zip(("first", "last"), (names, context_of_payload(payloads[-1])), strict=True)
        names = {end: "/".join([*found.values()][:2]) for end, found in ends}
    logger.info(message, extra=kv(**names, **counts))


def fields_of(record: logging.LogRecord) -> dict[str, object]:
    """Return the fields of a line: the log context, overridden by the fields of the call."""
    context = _context.get()
    return {**({} if context is None else context.fields()), **getattr(record, "fields", {})}


class IntervalLog:
    """Logs one repeated event at most once an interval. Threads may share an instance.

    The first occurrence is logged at once. Each line has the fields of one occurrence. Its field
    `suppressed` is the number of occurrences since the previous line that were not logged.

    Args:
        logger: Logger of the module.
        level: Level of the lines, for example `logging.WARNING`.
        message: Message of the lines.
        interval_s: Shortest time between two lines, seconds.
        clock: Monotonic time in seconds.
    """

    def __init__(
        self,
        logger: logging.Logger,
        level: int,
        message: str,
        interval_s: float = 60.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._logger = logger
        self._level = level
        self._message = message
        self._interval_s = interval_s
        self._clock = clock
        self._lock = threading.Lock()
        self._next_line_s = -math.inf
        self._suppressed = 0
        self._last_fields: dict[str, object] = {}

    def log(self, exception: BaseException | None = None, /, **fields: object) -> None:
        """Log an occurrence with its fields and the traceback of an exception, or count it as suppressed."""
        with self._lock:
            now = self._clock()
            if now < self._next_line_s:
                self._suppressed += 1
                self._last_fields = fields
                return
            suppressed, self._suppressed = self._suppressed, 0
            self._next_line_s = now + self._interval_s
        self._write(fields, suppressed, exception)

    def flush(self, *, stopping: bool = False) -> None:
        """Log the last suppressed occurrence if its interval has ended, or at once with `stopping`.

        The owner calls this periodically, so that the end of a burst is logged, and when it stops.
        """
        with self._lock:
            now = self._clock()
            if not self._suppressed or (now < self._next_line_s and not stopping):
                return
            suppressed, self._suppressed = self._suppressed - 1, 0
            fields = self._last_fields
            self._next_line_s = now + self._interval_s
        self._write(fields, suppressed)

    def _write(self, fields: dict[str, object], suppressed: int, exception: BaseException | None = None) -> None:
        if suppressed:
            fields = {**fields, "suppressed": suppressed}
        self._logger.log(self._level, self._message, exc_info=exception, extra=kv(**fields))


def _time_text(record: logging.LogRecord) -> str:
    second, microsecond = divmod(round(record.created * 1e6), 1_000_000)
    return f"{_second_text(second)}.{microsecond // 1000:03}Z"


@lru_cache(maxsize=2)
def _second_text(second: int) -> str:
    return datetime.fromtimestamp(second, UTC).isoformat()[:19]


class TextFormatter(logging.Formatter):
    """`2016-10-12T09:00:00.000Z INFO compressor: Image encoded image_id=0001 bytes=232`."""

    def __init__(self, service: str) -> None:
        super().__init__()
        self._service = service

    @override
    def format(self, record: logging.LogRecord) -> str:
        message = record.getMessage()
        if not message.isprintable():
            message = json.dumps(message)[1:-1]
        line = f"{_time_text(record)} {record.levelname} {self._service}: {message}{Fields(fields_of(record))}"
        return f"{line}\n{self.formatException(record.exc_info)}" if record.exc_info else line


class JsonFormatter(logging.Formatter):
    """One JSON object for each line: time, level, service, message, and the fields.

    A field with one of these four names gets an underscore appended.
    """

    def __init__(self, service: str) -> None:
        super().__init__()
        self._service = service

    @override
    def format(self, record: logging.LogRecord) -> str:
        event: dict[str, object] = {
            "time": _time_text(record),
            "level": record.levelname.lower(),
            "service": self._service,
            "message": record.getMessage(),
        }
        for name, value in fields_of(record).items():
            event[f"{name}_" if name in event else name] = _jsonable(value)
        if record.exc_info:
            event["traceback"] = self.formatException(record.exc_info)
        return json.dumps(event)


def _jsonable(value: object) -> object:
    """Return a value that JSON can represent: the text of any other value, including NaN and infinity."""
    try:
        json.dumps(value, allow_nan=False)
    except (ValueError, TypeError):
        return str(value)
    return value


def _shown(value: object) -> str:
    text = value if isinstance(value, str) else f"{value:.6g}" if isinstance(value, float) else str(value)
    # External text can contain line ends or terminal control characters.
    return json.dumps(text) if not text.isprintable() or not text or _NEEDS_QUOTES(text) else text


def configure_logging(service: str, level: str = "info", log_format: LogFormat = "text") -> None:
    """Send all logs of this process to standard error in one format."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter(service) if log_format == "json" else TextFormatter(service))
    # Not part of a line, and a tenth of its cost.
    logging.logThreads = logging.logProcesses = logging.logMultiprocessing = False
    logging._srcfile = None  # noqa: SLF001  documented for this purpose
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level.upper())
