"""Configuration: one TOML file for each platform, with a table for each service.

`[platform]` and `[modem]` apply to all services of the file, `[{service}]` to one service. An unknown table or key is
an error that names file, line and key. The environment variable `SONARPOST_{TABLE}__{KEY}` overrides a value; its text
is parsed as a TOML value, or used as a string if it is not one. An empty variable overrides nothing.
"""

import inspect
import logging
import stat
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar, cast

from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, ValidationError, create_model
from pydantic_core import to_json

from sonarpost.errors import ConfigError
from sonarpost.logs import LogFormat
from sonarpost.messages import PlatformId
from sonarpost.registry import installed_points
from sonarpost.wire import expected_text

log = logging.getLogger(__name__)

ENVIRONMENT_PREFIX = "SONARPOST_"

ConsumerName = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,39}$")]
"""Name of a service that records are delivered to, as in `sonarpost.keys`."""

SERVICE_GROUP: Final = "sonarpost.services"
SERVICES = (
    "atd_stub",
    "compressor",
    "uuv_modem",
    "op_modem",
    "decompressor",
    "relay",
    "c2",
    "console",
)
"""Services of the core."""

# Inline tables of which environment variables can override single keys: SONARPOST_PLATFORM__TLS__KEY.
NESTED_TABLES = {("platform", "tls")}


@cache
def service_packages() -> Mapping[str, str]:
    """Return the package of each service by name: those of the core, then those of extensions and plug-ins.

    A package has the modules `__main__` and `config`. A service `good_name` has the table `GoodNameConfig` there.
    """
    found = {name: f"sonarpost.services.{name}" for name in SERVICES}
    for point in installed_points(SERVICE_GROUP):
        if point.name in (*found, "platform", "modem", "all"):
            log.warning("Service ignored: its name is taken: %s = %s", point.name, point.value)
        else:
            found[point.name] = point.value
    return found


def table_names() -> tuple[str, ...]:
    """Return the name of every table of a configuration file."""
    return ("platform", "modem", *service_packages())


class ServiceConfig(BaseModel):
    """Base class of all configuration tables; unknown keys are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    def check_with(self, platform: "PlatformConfig") -> None:
        """Check the table together with `[platform]`, and the files that both name; the default accepts everything.

        Raises:
            ConfigError: The service cannot start with both.
        """


C = TypeVar("C", bound=ServiceConfig)


def adds_keys(found: object, base: type) -> bool:
    """Return whether an object is a concrete class of `base` whose `KEYS` are a model for `with_keys`."""
    if not (isinstance(found, type) and issubclass(found, base)) or inspect.isabstract(found):
        return False
    added = getattr(found, "KEYS", None)
    return isinstance(added, type) and issubclass(added, ServiceConfig)


def with_keys(*added: type[ServiceConfig]) -> Callable[[type[C]], type[C]]:
    """Return a decorator that adds the keys of other models to a configuration table."""

    def extended(table: type[C]) -> type[C]:
        models = dict.fromkeys((*added, table))  # in this order the added keys follow those of the table
        bases: Any = tuple(each for each in models if not any(issubclass(one, each) for one in models if one != each))
        model = create_model(table.__name__, __base__=bases, __module__=table.__module__, __doc__=table.__doc__)
        return cast(type[C], model)

    return extended


class TlsConfig(ServiceConfig):
    """The `tls` key of `[platform]`: the host's own certificate, for `tls/...` endpoints.

    Attributes:
        ca: Certificate of the fleet's authority (PEM).
        certificate: This platform's certificate (PEM).
        key: Its private key (PEM, no passphrase, readable by its owner only).
        warn_days: Remaining validity in days below which health shows a warning.
    """

    ca: Path
    certificate: Path
    key: Path
    warn_days: Annotated[float, Field(ge=0, le=3650)] = 30.0


class ModemTable(ServiceConfig):
    """The `[modem]` table: the modem of the platform. A shore site names that of its vessels, for estimates.

    Attributes:
        driver: Name of the driver, see `sonarpost.modem.registry`.
    """

    driver: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,39}$")] = "micromodem"


class PlatformConfig(ServiceConfig):
    """The `[platform]` table. The property `modem` has the `[modem]` table of the same file.

    Attributes:
        id: Name of the platform in key expressions, for example "uuv-1".
        router: Zenoh endpoints of the platform's router, tried in turn.
        state_dir: Folder of the services' durable stores.
        tls: The host's own certificate; required if `router` or `upstream` has a `tls/...` endpoint.
        upstream: Endpoints of the routers that the platform's router links to. Services do not connect to them; the
            relay probes them if the shore does not reply, to report the reason.
        acoustic_auth: Authentication of the acoustic link. "key": uuv_modem and op_modem send and accept frames
            authenticated with `acoustic_key_file` only, and do not start without it. "none": frames are not
            authenticated, and every modem in range can forge them.
        acoustic_key_file: Key shared by vehicles and vessel; `sonarpost pki acoustic` creates it. Not read with "none".
        health_interval_s: Interval of the health records.
        log_level: Least severity of log lines: debug, info, warning or error.
        log_format: Log lines as text or as JSON objects.
    """

    id: PlatformId
    router: Annotated[tuple[str, ...], Field(min_length=1)] = ("tcp/127.0.0.1:7447",)
    tls: TlsConfig | None = None
    upstream: tuple[str, ...] = ()
    state_dir: Path = Path("state")
    acoustic_auth: Literal["key", "none"] = "key"
    acoustic_key_file: Path | None = None
    health_interval_s: Annotated[float, Field(ge=0.05, le=3600)] = 5.0
    log_level: Annotated[str, Field(pattern="^(debug|info|warning|error)$")] = "info"
    log_format: LogFormat = "text"
    _modem: ModemTable = PrivateAttr(default_factory=ModemTable)

    @property
    def modem(self) -> ModemTable:
        """The `[modem]` table of the same file."""
        return self._modem

    def with_modem(self, modem: ModemTable) -> "PlatformConfig":
        """Return this table with another `[modem]` table."""
        copy = self.model_copy()
        copy._modem = modem  # noqa: SLF001 - an object of this class
        return copy


def load(path: Path, service: str, model: type[C], environment: Mapping[str, str]) -> tuple[PlatformConfig, C]:
    """Read a configuration file; return the `[platform]` table and the table of one service.

    Args:
        path: The TOML file.
        service: Name of the service; an absent table has default values.
        model: Type of its table.
        environment: Environment variables with overrides.

    Raises:
        ConfigError: The file is unreadable or not TOML, a table or key is unknown, or a value is invalid; names file,
            line and key.
    """
    file = ConfigFile(path, environment)
    platform, own = file.platform(), file.table(service, model)
    if platform is None or own is None or file.errors:
        raise file.errors[0]
    return platform, own


def overridden_keys(service: str, environment: Mapping[str, str]) -> tuple[str, ...]:
    """Return the keys of a service's tables that environment variables set, as `table.key`."""
    prefixes = tuple(f"{ENVIRONMENT_PREFIX}{table.upper()}__" for table in ("platform", "modem", service))
    names = sorted(name for name, text in environment.items() if text and name.startswith(prefixes))
    return tuple(name.removeprefix(ENVIRONMENT_PREFIX).lower().replace("__", ".") for name in names)


class ConfigFile:
    """A configuration file with its overrides, validated table by table.

    Args:
        path: The TOML file.
        environment: Environment variables with overrides.

    Attributes:
        path: The TOML file.
        services: Services that have a table in the file, in the order of `service_packages`.
        errors: What is invalid: unknown tables and overrides, and the keys of the tables that `table` has validated.

    Raises:
        ConfigError: The file is unreadable or not TOML.
    """

    def __init__(self, path: Path, environment: Mapping[str, str]) -> None:
        self.path = path
        try:
            self._text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(str(path), "", str(error), "a readable TOML file") from error
        try:
            self._tables: dict[str, object] = tomllib.loads(self._text)
        except (ValueError, RecursionError) as error:
            # tomllib raises other errors than its own for very long numbers and deep nesting.
            raise ConfigError(str(path), "", str(error), "valid TOML") from error
        self.services = tuple(name for name in service_packages() if name in self._tables)
        self.errors: list[ConfigError] = []
        for name, table in self._tables.items():
            if name not in table_names():
                self.errors.append(self.error((name,), "an unknown table", ", ".join(table_names())))
            elif not isinstance(table, dict):
                self.errors.append(self.error((name,), table, f"a table [{name}]"))
        self._overrides: dict[str, dict[str, object]] = {}
        for name, text in environment.items():
            self._add_override(name, text)

    def error(self, names: Sequence[str], value: object, expected: str) -> ConfigError:
        """Return an error with the line of a key or, if the key is absent, of the nearest table around it."""
        lines = key_lines(self._text)
        known = (lines.get(tuple(names[:length])) for length in range(len(names), 0, -1))
        line = next((number for number in known if number is not None), None)
        where = str(self.path) if line is None else f"{self.path}:{line}"
        return ConfigError(where, ".".join(names), value, expected)

    def platform(self) -> PlatformConfig | None:
        """Return `[platform]` with `[modem]`; None if one of them is invalid, with all errors in `errors`."""
        platform, modem = self.table("platform", PlatformConfig), self.table("modem", ModemTable)
        return None if platform is None or modem is None else platform.with_modem(modem)

    def table(self, name: str, model: type[C]) -> C | None:
        """Return a table with its overrides; None if it is invalid, with all its errors in `errors`.

        Args:
            name: "platform", "modem" or a service; an absent table has default values.
            model: Type of the table.
        """
        written = self._tables.get(name, {})
        if not isinstance(written, dict):
            return None  # in `errors` already
        overrides = self._overrides.get(name, {})
        merged = _merged(name, written, overrides)
        try:
            # As JSON, whose types fit pydantic's strict mode: no "5" for 5, no true for 1.
            return model.model_validate_json(to_json(merged), strict=True)
        except ConfigError as error:  # in a file that the table names
            self.errors.append(error)
            return None
        except ValidationError as error:
            for details in error.errors(include_url=False):
                names = [str(part) for part in details["loc"] if part != "[key]"]
                value = "nothing" if details["type"] == "missing" else details["input"]
                expected = expected_text(details["type"], details["msg"])
                if details["type"] == "extra_forbidden":
                    value, expected = "an unknown key", _known_keys(model, names)
                by_environment = next((n for n in ("__".join(names[:2]), *names[:1]) if n in overrides), None)
                if by_environment is not None:
                    variable = f"{ENVIRONMENT_PREFIX}{name.upper()}__{by_environment.upper()}"
                    self.errors.append(ConfigError("environment", variable, value, expected))
                else:
                    self.errors.append(self.error((name, *names), value, expected))
        return None

    def _add_override(self, name: str, text: str) -> None:
        if not text or not name.startswith(ENVIRONMENT_PREFIX) or "__" not in name:
            return
        table, _, key = name[len(ENVIRONMENT_PREFIX) :].lower().partition("__")
        if key and table in table_names():
            self._overrides.setdefault(table, {})[key] = _toml_value(text)
        else:
            expected = "SONARPOST_{platform or a service's name}__{KEY}"
            self.errors.append(ConfigError("environment", name, text, expected))


def key_lines(text: str) -> dict[tuple[str, ...], int]:
    """Return the first line of each table and key, from 1; `tomllib` does not report lines.

    The document is parsed up to the end of each line: keys that are new there belong to the statement that ends there.

    Args:
        text: A TOML document that `tomllib` accepts.

    Returns:
        Lines by path. The elements of an array are named by their index: ("modems", "0", "address"). What is nested in
        one element over several lines has the first line of the element.
    """
    lines: dict[tuple[str, ...], int] = {}
    rows = text.replace("\r\n", "\n").split("\n")
    first = 1
    for number in range(1, len(rows) + 1):
        # The bracket completes an array that continues on the next line.
        for end in ("", "\n]"):
            with suppress(ValueError, RecursionError):
                for path in _paths(tomllib.loads("\n".join(rows[:number]) + end)):
                    lines.setdefault(path, first)
                first = number + 1
                break
    return lines


def _paths(value: object, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Yield the paths of all keys and elements in a document."""
    members = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, member in members:
        yield (*path, str(name))
        yield from _paths(member, (*path, str(name)))


def _merged(table: str, written: Mapping[str, object], overrides: Mapping[str, object]) -> dict[str, object]:
    """Return a table with its overrides."""
    merged = dict(written)
    # In this order, the override of a nested table precedes those of its keys.
    for name in sorted(overrides):
        outer, _, inner = name.partition("__")
        if not inner or (table, outer) not in NESTED_TABLES:
            merged[name] = overrides[name]
        elif isinstance(nested := merged.get(outer, {}), dict):  # otherwise the validation rejects it
            merged[outer] = {**nested, inner: overrides[name]}
    return merged


def _toml_value(text: str) -> object:
    try:
        parsed = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    # Text of several lines can parse as several keys; it is one value.
    return parsed["value"] if len(parsed) == 1 else text


def _known_keys(model: type[ServiceConfig], names: Sequence[str]) -> str:
    if len(names) == 2 and names[0] == "tls":
        return "one of: " + ", ".join(sorted(TlsConfig.model_fields))
    if len(names) != 1:
        return "a key that this table has"
    return "one of: " + ", ".join(sorted(model.model_fields)) if model.model_fields else "no keys in this table"


def read_passphrase(path: Path) -> bytes:
    """Return the first line of a file that only its owner can read.

    Raises:
        ConfigError: It cannot be read, others can read it, or the line is empty.
    """
    try:
        mode = stat.S_IMODE(path.stat().st_mode)
        lines = path.read_bytes().splitlines()
    except OSError as error:
        raise ConfigError(str(path), "passphrase", error.strerror or str(error), "a readable file") from error
    if mode & 0o077:
        raise ConfigError(str(path), "mode", f"{mode:04o}", "0600: readable by its owner only")
    if not lines or not lines[0]:
        raise ConfigError(str(path), "passphrase", "an empty first line", "the passphrase")
    return lines[0]
