"""Configuration: one TOML file a platform, one table a service, every key known.

`[platform]` is common to all services of the file, `[{service}]` is each service's own. An unknown table or key is
refused with file, line and key. `SONARPOST_{TABLE}__{KEY}` in the environment overrides a value (the environment is
what compose files set); its text is read as a TOML value, or as a plain string when it is none.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sonarpost.errors import ConfigError
from sonarpost.messages import PlatformId
from sonarpost.runtime.logs import LogFormat

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
)


class ServiceConfig(BaseModel):
    """Base of every configuration table: unknown keys are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


C = TypeVar("C", bound=ServiceConfig)


class PlatformConfig(ServiceConfig):
    """The `[platform]` table.

    Attributes:
        id: Name of the platform in key expressions, for example "uuv-1".
        router: Zenoh endpoints of the platform's router, tried in turn.
        state_dir: Folder of the services' durable stores.
        health_interval_s: How often a service publishes its health.
    """

    id: PlatformId
    router: Annotated[tuple[str, ...], Field(min_length=1)] = ("tcp/127.0.0.1:7447",)
    state_dir: Path = Path("state")
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
        tables: dict[str, object] = tomllib.loads(text)
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(str(path), "", str(error), "a readable TOML file") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(str(path), "", str(error), "valid TOML") from error
    source = _Source(path, text)
    for name, table in tables.items():
        if name not in ("platform", *SERVICES):
            raise source.error(name, "", "an unknown table", "platform, " + ", ".join(SERVICES))
        if not isinstance(table, dict):
            raise source.error("", name, table, f"a table [{name}]")
    overrides = _overrides(environment)
    platform = _validated(PlatformConfig, "platform", tables, overrides, source)
    return platform, _validated(model, service, tables, overrides, source)


class _Source:
    """Finds the line of a key in the file, for error messages."""

    def __init__(self, path: Path, text: str) -> None:
        self._path = path
        self._lines = text.splitlines()

    def error(self, table: str, key: str, value: object, expected: str) -> ConfigError:
        where = f"{self._path}:{line}" if (line := self._line(table, key)) else str(self._path)
        return ConfigError(where, ".".join(part for part in (table, key) if part), value, expected)

    def _line(self, table: str, key: str) -> int | None:
        current, table_line = "", None
        wanted = key.split(".", maxsplit=1)[0]
        for number, line in enumerate(self._lines, start=1):
            if header := re.match(r"\s*\[+\s*\"?([\w-]+)", line):
                current = header.group(1)
                table_line = number if current == table else table_line
            elif current == table and wanted and re.match(rf"\s*\"?{re.escape(wanted)}\"?\s*[=.]", line):
                return number
        return table_line


def _overrides(environment: Mapping[str, str]) -> dict[str, dict[str, object]]:
    found: dict[str, dict[str, object]] = {}
    for name, text in environment.items():
        if not name.startswith(ENVIRONMENT_PREFIX) or "__" not in name:
            continue
        table, key = name[len(ENVIRONMENT_PREFIX) :].lower().split("__", 1)
        if table not in ("platform", *SERVICES):
            raise ConfigError("environment", name, text, "SONARPOST_{platform or a service's name}__{KEY}")
        found.setdefault(table, {})[key] = _toml_value(text)
    return found


def _toml_value(text: str) -> object:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


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
    try:
        return model.model_validate({**written, **extra})
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(str(part) for part in first["loc"])
        value = "nothing" if first["type"] == "missing" else first["input"]
        expected = first["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
        if first["type"] == "extra_forbidden":
            value, expected = "an unknown key", "one of: " + ", ".join(sorted(model.model_fields))
        if key.split(".")[0] in extra:
            name = f"{ENVIRONMENT_PREFIX}{table.upper()}__{key.split('.', maxsplit=1)[0].upper()}"
            raise ConfigError("environment", name, value, expected) from error
        raise source.error(table, key, value, expected) from error
