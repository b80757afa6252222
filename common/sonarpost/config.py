"""Configuration: one TOML file a platform, one table a service, every key known.

`[platform]` is common to all services of the file, `[{service}]` is each service's own. An unknown table or key is
refused with file, line and key. `SONARPOST_{TABLE}__{KEY}` in the environment overrides a value (the environment is
what compose files set); its text is read as a TOML value, or as a plain string when it is none.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import to_json

from sonarpost.errors import ConfigError
from sonarpost.logs import LogFormat
from sonarpost.messages import PlatformId
from sonarpost.toml_lines import key_lines
from sonarpost.wire import expected_text

ENVIRONMENT_PREFIX = "SONARPOST_"

SERVICES = (
    "atd_stub",
    "compressor",
    "uuv_modem",
    "acoustic_channel",
    "op_modem",
    "decompressor",
    "relay",
    "c2",
    "console",
)


# Tables inside a table that the environment can set key by key.
TABLES_INSIDE = {("platform", "tls")}

# Keys of version 0.1 and their names since version 0.2; a configuration that uses an old name is refused.
RENAMED_KEYS: Mapping[str, Mapping[str, str]] = {
    "atd_stub": {
        "max_on_the_way": "max_in_flight",
        "needs_done": "require_done_marker",
        "seam_pings": "join_overlap_pings",
        "seam_wait_s": "join_timeout_s",
    },
    "compressor": {"catalogue": "codebook", "keep_pictures": "cache_images", "keep_s": "cache_s"},
    "uuv_modem": {
        "frame_s": "tdma_cycle_s",
        "frames_per_picture": "frames_per_image",
        "gather_s": "group_delay_s",
        "listen_every_s": "tx_burst_s",
        "listen_s": "rx_window_s",
        "mean_wait_s": "mean_backoff_s",
        "medium": "mac",
        "more_rates": "allowed_rates",
        "picture_share": "image_airtime_share",
        "quiet_s": "holdoff_s",
    },
    "op_modem": {
        "frame_s": "tdma_cycle_s",
        "medium": "mac",
        "order_lifetime_s": "command_lifetime_s",
        "patience_s": "max_defer_s",
        "quiet_s": "holdoff_s",
        "report_frames": "feedback_interval_frames",
        "report_s": "feedback_interval_s",
    },
    "decompressor": {"catalogues": "codebooks", "links": "wire_formats", "picture_consumers": "image_consumers"},
    "console": {"session_most_s": "session_max_s", "side": "role"},
}


class ServiceConfig(BaseModel):
    """Base of every configuration table: unknown keys are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


C = TypeVar("C", bound=ServiceConfig)


class TlsConfig(ServiceConfig):
    """The `tls` key of `[platform]`: the host's own certificate, for routers reached by `tls/…`.

    Attributes:
        ca: Certificate of the fleet's authority (PEM).
        certificate: This platform's certificate (PEM).
        key: Its private key (PEM, no passphrase, readable by its owner only).
        warn_days: From how many days before its end on health warns of it.
    """

    ca: Path
    certificate: Path
    key: Path
    warn_days: Annotated[float, Field(ge=0, le=3650)] = 30.0


class PlatformConfig(ServiceConfig):
    """The `[platform]` table.

    Attributes:
        id: Name of the platform in key expressions, for example "uuv-1".
        router: Zenoh endpoints of the platform's router, tried in turn.
        state_dir: Folder of the services' durable stores.
        tls: The host's own certificate; needed where `router` or `upstream` has a `tls/…` endpoint.
        upstream: Endpoints of the routers that the platform's router links to. Services do not connect to them; the
            relay tries them when the shore does not answer, to say why.
        acoustic_key_file: Key that vehicles and vessel have in common; with it, only frames sealed with it are sent and
            taken on the `v1` acoustic link.
        health_interval_s: How often a service publishes its health.
        log_level: Least severity of log lines: debug, info, warning or error.
        log_format: Log lines as text or as JSON objects.
    """

    id: PlatformId
    router: Annotated[tuple[str, ...], Field(min_length=1)] = ("tcp/127.0.0.1:7447",)
    tls: TlsConfig | None = None
    upstream: tuple[str, ...] = ()
    state_dir: Path = Path("state")
    acoustic_key_file: Path | None = None
    health_interval_s: Annotated[float, Field(ge=0.05, le=3600)] = 5.0
    log_level: Annotated[str, Field(pattern="^(debug|info|warning|error)$")] = "info"
    log_format: LogFormat = "text"


def load(path: Path, service: str, model: type[C], environment: Mapping[str, str]) -> tuple[PlatformConfig, C]:
    """Read a platform's file and return its common table and the table of one service.

    Args:
        path: The TOML file.
        service: The service whose table is wanted; an absent table means all defaults.
        model: The table's type.
        environment: Overrides, normally os.environ.

    Raises:
        ConfigError: Unreadable, not TOML, an unknown table or key, a wrong value; names file, line and key.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(str(path), "", str(error), "a readable TOML file") from error
    try:
        tables: dict[str, object] = tomllib.loads(text)
        source = _Source(path, text)
    except (ValueError, RecursionError) as error:
        # Besides its own error tomllib lets through what endless digits and brackets lead to.
        raise ConfigError(str(path), "", str(error), "valid TOML") from error
    for name, table in tables.items():
        if name not in ("platform", *SERVICES):
            raise source.error((name,), "an unknown table", "platform, " + ", ".join(SERVICES))
        if not isinstance(table, dict):
            raise source.error((name,), table, f"a table [{name}]")
    overrides = _overrides(environment)
    platform = _validated(PlatformConfig, "platform", tables, overrides, source)
    return platform, _validated(model, service, tables, overrides, source)


class _Source:
    """Names the file and the line of a key in errors."""

    def __init__(self, path: Path, text: str) -> None:
        self._path = path
        self._lines = key_lines(text)

    def error(self, names: Sequence[str], value: object, expected: str) -> ConfigError:
        where = f"{self._path}:{line}" if (line := self._line(names)) else str(self._path)
        return ConfigError(where, ".".join(names), value, expected)

    def _line(self, names: Sequence[str]) -> int | None:
        """Return the line of a key or, where it is not written, of the nearest table around it."""
        for length in range(len(names), 0, -1):
            if (line := self._lines.get(tuple(names[:length]))) is not None:
                return line
        return None


def _overrides(environment: Mapping[str, str]) -> dict[str, dict[str, object]]:
    found: dict[str, dict[str, object]] = {}
    for name, text in environment.items():
        if not name.startswith(ENVIRONMENT_PREFIX) or "__" not in name:
            continue
        table, _, key = name[len(ENVIRONMENT_PREFIX) :].lower().partition("__")
        if not key or table not in ("platform", *SERVICES):
            raise ConfigError("environment", name, text, "SONARPOST_{platform or a service's name}__{KEY}")
        found.setdefault(table, {})[key] = _toml_value(text)
    return found


def _with_extra(table: str, written: Mapping[str, object], extra: Mapping[str, object]) -> dict[str, object]:
    """Return a table with its overrides; `SONARPOST_PLATFORM__TLS__KEY` is a key of the table inside `[platform]`."""
    inside = {name: value for name, value in extra.items() if _outer(table, name)}
    whole = {**written, **{name: value for name, value in extra.items() if name not in inside}}
    for name, value in inside.items():
        outer, _, inner = name.partition("__")
        below = whole.get(outer, {})
        if isinstance(below, dict):  # what is no table is refused below, with its own name
            whole[outer] = {**below, inner: value}
    return whole


def _outer(table: str, name: str) -> bool:
    outer, separator, inner = name.partition("__")
    return bool(separator and inner) and (table, outer) in TABLES_INSIDE


def _toml_value(text: str) -> object:
    try:
        parsed = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    # A text of several lines may look like more keys; it is one value all the same.
    return parsed["value"] if len(parsed) == 1 else text


def _validated(
    model: type[C],
    table: str,
    tables: Mapping[str, object],
    overrides: Mapping[str, Mapping[str, object]],
    source: _Source,
) -> C:
    written = tables.get(table, {})
    assert isinstance(written, dict)
    extra = overrides.get(table, {})
    _refuse_renamed(table, written, extra, source)
    try:
        # As JSON, because pydantic's strictness (no "5" for 5, no true for 1) is made for the types that JSON has.
        return model.model_validate_json(to_json(_with_extra(table, written, extra)), strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        names = [str(part) for part in first["loc"] if part != "[key]"]
        value = "nothing" if first["type"] == "missing" else first["input"]
        expected = expected_text(first["type"], first["msg"])
        if first["type"] == "extra_forbidden":
            value, expected = "an unknown key", _known_keys(model, names)
        by_environment = next((n for n in ("__".join(names[:2]), *names[:1]) if n in extra), None)
        if by_environment is not None:
            name = f"{ENVIRONMENT_PREFIX}{table.upper()}__{by_environment.upper()}"
            raise ConfigError("environment", name, value, expected) from error
        raise source.error((table, *names), value, expected) from error


def _refuse_renamed(table: str, written: Mapping[str, object], extra: Mapping[str, object], source: _Source) -> None:
    """Raise ConfigError where a key has its name of version 0.1, naming the new one."""
    for old, new in RENAMED_KEYS.get(table, {}).items():
        value, expected = "the key's name of version 0.1", f"its new name, {new}"
        if old in written:
            raise source.error((table, old), value, expected)
        if old in extra:
            raise ConfigError("environment", f"{ENVIRONMENT_PREFIX}{table.upper()}__{old.upper()}", value, expected)


def _known_keys(model: type[ServiceConfig], names: Sequence[str]) -> str:
    if len(names) == 2 and names[0] == "tls":
        return "one of: " + ", ".join(sorted(TlsConfig.model_fields))
    if len(names) != 1:
        return "a key that this table has"
    return "one of: " + ", ".join(sorted(model.model_fields)) if model.model_fields else "no keys in this table"
