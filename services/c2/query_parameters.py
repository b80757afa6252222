"""Parameters of a query to c2, as they follow the `?` of a Zenoh selector."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from typing import Final, Literal, TypeVar
from urllib.parse import unquote

from sonarpost.archive.journal import Area, Criteria
from sonarpost.errors import BadInputError
from sonarpost.review.decisions import ReviewState

PayloadFormat = Literal["msgpack", "json"]
PixelForm = Literal["raw", "png", "none"]

MAX_RECORDS: Final = 256
"""Maximum number of records in the replies to one query."""
MAX_LENGTH: Final = 1000
"""Maximum number of characters of the parameters."""

_PLATFORM: Final = re.compile(r"[a-z0-9][a-z0-9-]{0,31}")
_CURSOR: Final = re.compile(r"([0-9a-f]{8})\.([0-9]{1,18})")
_LIMIT: Final = re.compile(r"[0-9]{1,9}")
_DEGREES: Final = re.compile(r"-?[0-9]{1,3}(\.[0-9]{1,12})?")
_RANGE: Final = re.compile(r"(?P<open>[\[\]])(?P<start>.*?)\.\.(?P<end>.*)(?P<close>[\[\]])")
_NOW: Final = re.compile(r"now\((?P<offset>[^()]*)\)")
_DURATION: Final = re.compile(r"(?P<number>-?[0-9]{1,12}(?:\.[0-9]{1,9})?)(?P<unit>u|ms|s|m|h|d|w)?")
_UNIT_S: Final = {"u": 1e-6, "ms": 1e-3, "s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0, "w": 604800.0}
# Smaller than the resolution of the stored times: it turns an exclusive bound into an inclusive one.
_TICK_S: Final = 1e-6
_TIME_FORM: Final = "[START..END[ with RFC 3339 times or now(-1h), either of them or both"

_PLATFORM_FORM: Final = "1 to 32 of a-z, 0-9 and -, the first a letter or digit"
_REVIEW: Final[dict[str, ReviewState]] = {
    "unreviewed": "unreviewed",
    "mine_like": "mine_like",
    "not_mine_like": "not_mine_like",
    "unsure": "unsure",
    "disputed": "disputed",
}
_VERSION: Final = {"latest": True, "all": False}
_FORMAT: Final[dict[str, PayloadFormat]] = {"msgpack": "msgpack", "json": "json"}
_PIXELS: Final[dict[str, PixelForm]] = {"raw": "raw", "png": "png", "none": "none"}
NAMES: Final = ("_time", "vessel", "vehicle", "area", "review", "version", "limit", "after", "format", "pixels")

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class QueryParameters:
    """Valid parameters of a query.

    Attributes:
        criteria: Conditions on the records.
        limit: Maximum number of records.
        archive: Journal of the cursor; empty for the beginning.
        after: Number of the cursor: only records with higher ones.
        format: Form of the payloads.
        pixels: Form of pixels in JSON.
    """

    criteria: Criteria = field(default_factory=Criteria)
    limit: int = MAX_RECORDS
    archive: str = ""
    after: int = 0
    format: PayloadFormat = "msgpack"
    pixels: PixelForm = "raw"


def parse_parameters(text: str, where: str, now_utc_s: float) -> QueryParameters:
    """Parse `name=value` pairs separated by `;`. Unknown names that begin with `_` are Zenoh's own and are ignored.

    Args:
        text: The parameters, with or without percent encoding.
        where: Key expression of the query, for errors.
        now_utc_s: Present time.

    Raises:
        BadInputError: A parameter is unknown, repeated or invalid.
    """
    if len(text) > MAX_LENGTH:
        raise BadInputError(where, "parameters", f"{len(text)} characters", f"at most {MAX_LENGTH} characters")
    found: dict[str, str] = {}
    for pair in filter(None, text.split(";")):
        name, _, value = pair.partition("=")
        if name in found:
            raise BadInputError(where, name, "two values", "one value")
        if name not in NAMES and not name.startswith("_"):
            raise BadInputError(where, name, unquote(value), "one of the parameters " + ", ".join(NAMES))
        found[name] = unquote(value)

    def get(name: str, parse: Callable[[str], T], expected: str) -> T | None:
        if name not in found:
            return None
        try:
            return parse(found[name])
        except (ValueError, LookupError, OverflowError) as error:
            raise BadInputError(where, name, found[name], expected) from error

    since_utc_s, until_utc_s = get("_time", lambda text: _time_range(text, now_utc_s), _TIME_FORM) or (None, None)
    archive, after = get("after", _cursor, "the `next` of an earlier page") or ("", 0)
    form: PayloadFormat = get("format", _FORMAT.__getitem__, "msgpack or json") or "msgpack"
    pixels: PixelForm = get("pixels", _PIXELS.__getitem__, "raw, png or none") or "raw"
    if pixels != "raw" and form != "json":
        raise BadInputError(where, "pixels", pixels, "raw, unless format is json")
    return QueryParameters(
        Criteria(
            since_utc_s=since_utc_s,
            until_utc_s=until_utc_s,
            vessel_id=get("vessel", _platform, _PLATFORM_FORM),
            vehicle_id=get("vehicle", _platform, _PLATFORM_FORM),
            area=get("area", _area, "SOUTH,WEST,NORTH,EAST in degrees, south of north"),
            review=get("review", _REVIEW.__getitem__, " or ".join(_REVIEW)),
            latest=get("version", _VERSION.__getitem__, "latest or all") or False,
        ),
        get("limit", _limit, f"1 to {MAX_RECORDS}") or MAX_RECORDS,
        archive,
        after,
        form,
        pixels,
    )


def _platform(text: str) -> str:
    return _matched(_PLATFORM, text)[0]


def _limit(text: str) -> int:
    limit = int(_matched(_LIMIT, text)[0])
    if not 1 <= limit <= MAX_RECORDS:
        raise ValueError
    return limit


def _cursor(text: str) -> tuple[str, int]:
    if not text:
        return "", 0
    archive, seq = _matched(_CURSOR, text).groups()
    return archive, int(seq)


def _area(text: str) -> Area:
    south, west, north, east = (float(_matched(_DEGREES, part)[0]) for part in text.split(","))
    if not (-90 <= south <= north <= 90 and -180 <= west <= 180 and -180 <= east <= 180):
        raise ValueError
    return Area(south, west, north, east)


def _time_range(text: str, now_utc_s: float) -> tuple[float | None, float | None]:
    """Return the bounds of a time range of Zenoh: the first is included, the second excluded."""
    found = _matched(_RANGE, text)
    start, end = (_time(found[name], now_utc_s) for name in ("start", "end"))
    since = start + _TICK_S if start is not None and found["open"] == "]" else start
    until = end + _TICK_S if end is not None and found["close"] == "]" else end
    return since, until


def _time(text: str, now_utc_s: float) -> float | None:
    if not text:
        return None
    if (now := _NOW.fullmatch(text)) is not None:
        return now_utc_s + (_seconds(now["offset"]) if now["offset"] else 0.0)
    time = datetime.fromisoformat(text)
    if time.tzinfo is None:
        raise ValueError
    return time.timestamp()


def _seconds(text: str) -> float:
    found = _matched(_DURATION, text)
    return float(found["number"]) * _UNIT_S[found["unit"] or "s"]


def _matched(pattern: re.Pattern[str], text: str) -> re.Match[str]:
    found = pattern.fullmatch(text)
    if found is None:
        raise ValueError
    return found
