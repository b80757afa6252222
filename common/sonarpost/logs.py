"""Structured logs: one line an event, as text for people or JSON for machines, on standard error."""

from __future__ import annotations

import json
import logging
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import UTC, datetime
from functools import lru_cache
from types import MappingProxyType
from typing import Literal

LogFormat = Literal["text", "json"]


def kv(**fields: object) -> dict[str, object]:
    """Return the `extra` of a log call, so that fields stay apart from the sentence: log.info("…", extra=kv(…))."""
    return {"fields": fields}


_NEEDS_QUOTES = re.compile(r"[ \"'=]").search


class lazy_log_context:  # noqa: N801  # a context manager, read as a verb like `log_context`
    """As `log_context`, with fields that are looked for only if a line is logged inside."""

    def __init__(self, find: Callable[[], Mapping[str, object]]) -> None:
        self._find = find
        self._found: Mapping[str, object] | None = None

    def __enter__(self) -> None:
        self._outer = _concerned.get()
        self._token = _concerned.set(self)

    def __exit__(self, *_: object) -> None:
        _concerned.reset(self._token)

    def fields(self) -> Mapping[str, object]:
        """Return what is known outside, and what `find` finds."""
        if self._found is None:
            found = self._find()
            self._found = {**_known(self._outer), **{name: found[name] for name in found if found[name] is not None}}
        return self._found


_concerned: ContextVar[Mapping[str, object] | lazy_log_context] = ContextVar("concerned", default=MappingProxyType({}))


def _known(concerned: Mapping[str, object] | lazy_log_context) -> Mapping[str, object]:
    return concerned.fields() if isinstance(concerned, lazy_log_context) else concerned


@contextmanager
def log_context(**fields: object) -> Iterator[None]:
    """Put these fields into every line that is logged inside, in this thread; None is not known and left out.

    `vehicle` and `image_id` name a picture on every platform, `contact_id` a contact on the vehicle: whoever logs about
    one of them need not know which it is.
    """
    known = {name: value for name, value in fields.items() if value is not None}
    token = _concerned.set({**_known(_concerned.get()), **known})
    try:
        yield
    finally:
        _concerned.reset(token)


def fields_of(record: logging.LogRecord) -> dict[str, object]:
    """Return the fields of a line: what it concerns first, then those of the call, which win."""
    return {**_known(_concerned.get()), **getattr(record, "fields", {})}


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

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        pairs = "".join(f" {name}={_shown(value)}" for name, value in fields_of(record).items())
        message = record.getMessage()
        if not message.isprintable():
            message = json.dumps(message)[1:-1]
        line = f"{_time_text(record)} {record.levelname} {self._service}: {message}{pairs}"
        return f"{line}\n{self.formatException(record.exc_info)}" if record.exc_info else line


class JsonFormatter(logging.Formatter):
    """One JSON object a line: time, level, service, message, then the event's fields.

    A field of one of those four names gets an underscore behind it.
    """

    def __init__(self, service: str) -> None:
        super().__init__()
        self._service = service

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
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
    """Return what JSON can say of a value: its text where it has no type for it (NaN and infinity among those)."""
    try:
        json.dumps(value, allow_nan=False)
    except (ValueError, TypeError):
        return str(value)
    return value


def _shown(value: object) -> str:
    text = value if isinstance(value, str) else f"{value:.6g}" if isinstance(value, float) else str(value)
    # What came from outside may hold ends of line or a terminal's control characters.
    return json.dumps(text) if not text.isprintable() or not text or _NEEDS_QUOTES(text) else text


def set_up(service: str, level: str = "info", log_format: LogFormat = "text") -> None:
    """Send all logs of this process to standard error in one format."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter(service) if log_format == "json" else TextFormatter(service))
    # Nothing of these is in a line, and finding them out costs a tenth of it.
    logging.logThreads = logging.logProcesses = logging.logMultiprocessing = False
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level.upper())
