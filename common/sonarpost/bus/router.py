"""An embedded Zenoh router as a process, for hosts without a `zenohd`: the demo, tests, small deployments.

It takes `zenohd`'s options `--config`, `--listen`, `--connect` and `--cfg` and the same JSON5 files, so that either can
stand in for the other. It has no plugins: no REST interface, no storages. What it refuses is in its log and, where the
configuration's `metadata` says whose router it is, in its health record (`router_watch`). As with zenohd, RUST_LOG asks
for more of the library's own log.
"""

from __future__ import annotations

import argparse
import json
import logging
import signal
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from types import FrameType

import zenoh

from sonarpost import logs
from sonarpost.bus.router_monitor import monitored_router
from sonarpost.bus.session import router_config
from sonarpost.errors import ConfigError, SonarpostError
from sonarpost.parent_process import exit_with_parent

log = logging.getLogger(__name__)

EXIT_CANNOT_START = 2
DEFAULT_LISTEN = ("tcp/127.0.0.1:7447",)


def run(config: zenoh.Config) -> int:
    """Route until SIGTERM or SIGINT; return the exit status (2: cannot listen, or not a usable configuration)."""
    stop = threading.Event()

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, on_signal)
    listen, connect = _shown(config, "listen/endpoints"), _shown(config, "connect/endpoints")
    try:
        with monitored_router(config):
            log.info("Router started", extra=logs.kv(listen=listen, connect=connect))
            stop.wait()
    except (zenoh.ZError, SonarpostError) as error:
        log.error("Router cannot start", extra=logs.kv(listen=listen, error=str(error)))
        return EXIT_CANNOT_START
    log.info("Router stopped")
    return 0


def run_parsed(parsed: argparse.Namespace) -> int:
    """Run with the options of `add_arguments`; a configuration that cannot be used is one line on standard error."""
    try:
        config = load(parsed.config, parsed.listen, parsed.connect, parsed.cfg)
    except ConfigError as error:
        print(f"router: {error}", file=sys.stderr)
        return EXIT_CANNOT_START
    return run(config)


def load(path: Path | None, listen: Sequence[str], connect: Sequence[str], settings: Sequence[str]) -> zenoh.Config:
    """Return a router's configuration.

    Args:
        path: JSON5 file as zenohd takes it; None for sonarpost's own defaults.
        listen: Endpoints to listen on, instead of the file's; without a file and without any, loopback only.
        connect: Routers to link to, instead of the file's.
        settings: `KEY:VALUE` each, the value in JSON5, set last: `transport/link/tx/lease:3000`.

    Raises:
        ConfigError: The file cannot be read or says something else than a router's configuration, or an endpoint or
            setting is wrong.
    """
    if path is None:
        try:
            config = router_config(listen or DEFAULT_LISTEN, connect)
        except zenoh.ZError as error:
            raise ConfigError("command line", "endpoint", str(error), "Zenoh endpoints, PROTOCOL/ADDRESS") from error
    else:
        config = _from_file(path)
        for name, endpoints in (("listen", listen), ("connect", connect)):
            if endpoints:
                _set(config, f"{name}/endpoints", json.dumps(list(endpoints)), f"--{name}")
    for setting in settings:
        key, colon, value = setting.partition(":")
        if not colon:
            raise ConfigError("command line", "--cfg", setting, "KEY:VALUE")
        _set(config, key, value, "--cfg")
    if json.loads(config.get_json("mode")) != "router":
        raise ConfigError(str(path or "command line"), "mode", config.get_json("mode"), '"router"')
    return config


def _from_file(path: Path) -> zenoh.Config:
    try:
        path.read_bytes()  # the library's own error does not name the file
        config = zenoh.Config.from_file(str(path))
    except OSError as error:
        raise ConfigError(str(path), "", error.strerror or str(error), "a readable JSON5 file") from error
    except zenoh.ZError as error:
        # The reason names the key and those there are; as the value that was met it would be cut short.
        reason = " ".join(str(error).split())
        raise ConfigError(str(path), "", "something else", f"a Zenoh configuration in JSON5: {reason}") from error
    if json.loads(config.get_json("mode")) is None:
        config.insert_json5("mode", '"router"')
    if json.loads(config.get_json("plugins")):
        log.warning("The embedded router has no plugins; the file's are ignored", extra=logs.kv(file=str(path)))
    return config


def _set(config: zenoh.Config, key: str, value: str, option: str) -> None:
    try:
        config.insert_json5(key, value)
    except zenoh.ZError as error:
        raise ConfigError("command line", option, f"{key}:{value}", f"a known key and its value ({error})") from error


def _shown(config: zenoh.Config, key: str) -> str:
    """Return endpoints as text: a list, or lists by mode as zenohd's own default has them."""
    value = json.loads(config.get_json(key))
    if isinstance(value, dict):
        value = value.get("router", [])
    return ", ".join(str(endpoint) for endpoint in value)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run with `python -m sonarpost.bus.router [--config FILE] [--listen ENDPOINT…] [--connect ENDPOINT…]`."""
    parser = argparse.ArgumentParser(prog="python -m sonarpost.bus.router", description=__doc__)
    add_arguments(parser)
    parsed = parser.parse_args(arguments)
    exit_with_parent()
    logs.set_up("router")
    return run_parsed(parsed)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the router's options to a parser; they are those of zenohd, each may be given several times."""
    parser.add_argument("-c", "--config", type=Path, metavar="FILE", help="JSON5 configuration, as zenohd takes it")
    parser.add_argument(
        "-l",
        "--listen",
        nargs="+",
        action="extend",
        default=[],
        metavar="ENDPOINT",
        help=f"where to listen (default: the file's; without a file {', '.join(DEFAULT_LISTEN)})",
    )
    parser.add_argument(
        "-e", "--connect", nargs="*", action="extend", default=[], metavar="ENDPOINT", help="routers to link to"
    )
    parser.add_argument(
        "--cfg", action="append", default=[], metavar="KEY:VALUE", help="set one key of the configuration, in JSON5"
    )


if __name__ == "__main__":
    sys.exit(main())
