"""Embedded Zenoh router as a process, for hosts without a `zenohd`: the demo, tests, small deployments.

It accepts the options `--config`, `--listen`, `--connect` and `--cfg` of `zenohd` and the same JSON5 files, so that
either can replace the other. It has no plugins: no REST interface, no storages. Zenoh's own log goes to standard error:
warnings (refused TLS connections, for example) and peers that match no access control subject. The environment variable
RUST_LOG selects other levels; `RUST_LOG=warn,zenoh::net::routing::interceptor=trace` shows each denied message. If the
configuration names its platform (`metadata.platform`), the router publishes a health record and its presence.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import zenoh

from sonarpost import keys, logs, wire
from sonarpost.bus.connectivity import declare_presence
from sonarpost.bus.session import router_config
from sonarpost.config import TlsConfig
from sonarpost.errors import BadInputError, ConfigError, DeliveryError, SonarpostError
from sonarpost.messages import Health, ServiceState
from sonarpost.monitoring.service_manager import ServiceManager
from sonarpost.security.tls_files import TlsMonitor
from sonarpost.stop_signals import exit_process, exit_with_parent, stop_on_signals

log = logging.getLogger(__name__)

EXIT_CANNOT_START = 2
DEFAULT_LISTEN = ("tcp/127.0.0.1:7447",)
ZENOH_LOG_FILTER = "warn,zenoh::net::routing::interceptor::access_control=info"
HEALTH_INTERVAL_S = 5.0
NAME = "router"


class RouterMonitor:
    """Log of the links, presence and health record of a router session.

    Args:
        config: Its configuration; `metadata.platform` and `metadata.sites` name the platform and the shore sites.

    Raises:
        BadInputError: `metadata` is invalid.
        ConfigError: The TLS files are missing, unreadable, do not match, or the key is not private.
    """

    def __init__(self, config: zenoh.Config) -> None:
        self._platform, self._sites = platform_and_sites(config)
        self._tls = TlsMonitor(_own_tls(config))
        self._certificate_names = _certificate_names(config)
        self._started_utc_s = time.time()
        self._lock = threading.Lock()
        self._peers: dict[str, str] = {}
        self._denied: dict[str, str] = {}
        self._stop = threading.Event()
        self._manager = ServiceManager(os.environ, HEALTH_INTERVAL_S)
        self._declared: list[object] = []
        self._thread: threading.Thread | None = None

    def start(self, session: zenoh.Session) -> None:
        """Start to log links, to notify systemd and, if the platform is known, to publish health and presence."""
        self._declared.append(session.info.declare_link_events_listener(self._on_link, history=True))
        platform = self._platform
        if platform is not None:
            self._declared.append(session.liveliness().declare_token(keys.alive(platform, NAME)))
            self._declared += [declare_presence(session, platform, NAME, site) for site in self._sites]
        self._thread = threading.Thread(target=self._run, args=(session, platform), name="router-health", daemon=True)
        self._thread.start()
        self._manager.ready("started")

    def close(self) -> None:
        """Publish a last health record and stop; the session stays open."""
        self._manager.stopping()
        self._stop.set()
        if self._thread is not None:
            self._thread.join()

    def _on_link(self, event: zenoh.LinkEvent) -> None:
        link = event.link
        zid, name, address = str(link.zid), link.auth_identifier or "", str(link.dst)
        fields = logs.kv(peer=name or "no certificate", address=address, zid=zid)
        is_tls = address.startswith("tls/")
        with self._lock:
            if event.kind != zenoh.SampleKind.PUT:
                self._denied.pop(zid, None)
                if self._peers.pop(zid, None) is not None and is_tls:
                    log.info("Peer disconnected", extra=fields)
                return
            self._peers[zid] = name
            if is_tls:
                log.info("Peer connected", extra=fields)
            if is_tls and self._certificate_names is not None and name not in self._certificate_names:
                self._denied[zid] = name or address
                log.warning("Peer denied by access control: certificate name not listed", extra=fields)

    def health(self, platform: str, state: ServiceState | None = None) -> Health:
        """Return the health record of this moment."""
        now_utc_s = time.time()
        with self._lock:
            links = float(len(self._peers))
            denied = ", ".join(sorted(set(self._denied.values())))
        expired = self._tls.degraded_reason(now_utc_s)
        warnings = (self._tls.warning(now_utc_s), denied and f"denied by access control: {denied}")
        return Health(
            platform_id=platform,
            service=NAME,
            time_utc_s=now_utc_s,
            started_utc_s=self._started_utc_s,
            state=state or ("degraded" if expired else "ok"),
            detail="; ".join(text for text in (expired, *warnings) if text)[:2000],
            counters={},
            gauges={"links": links, **self._tls.gauges(now_utc_s)},
        )

    def _run(self, session: zenoh.Session, platform: str | None) -> None:
        stopping = False
        while not stopping:
            stopping = self._stop.wait(HEALTH_INTERVAL_S)
            with self._lock:
                links = len(self._peers)
            self._manager.alive(f"ok: {links} links")
            if platform is None:
                continue
            try:
                record = self.health(platform, "stopping" if stopping else None)
                session.put(keys.health(platform, NAME), wire.encode(record), encoding=wire.encoding_of(Health))
            except (DeliveryError, zenoh.ZError) as error:
                log.warning("Health not published", extra=logs.kv(error=str(error)))
            except Exception:  # for example about the name of one peer
                log.exception("Health not published after an unexpected exception")


def platform_and_sites(config: zenoh.Config) -> tuple[str | None, tuple[str, ...]]:
    """Return the platform of a router, None if its configuration names none, and the sites that it replies for.

    Raises:
        BadInputError: `metadata` holds invalid names.
    """
    metadata = json.loads(config.get_json("metadata"))
    if not isinstance(metadata, dict) or "platform" not in metadata:
        return None, ()
    platform, sites = metadata["platform"], metadata.get("sites", [])
    if not isinstance(sites, list):
        raise BadInputError("router configuration", "metadata.sites", sites, "a list of names")
    for field, value in (("platform", platform), *(("sites", site) for site in sites)):
        if not isinstance(value, str):
            raise BadInputError("router configuration", f"metadata.{field}", value, "text")
        keys.alive(value, NAME)
    return platform, tuple(sites)


def _own_tls(config: zenoh.Config) -> TlsConfig | None:
    """Return the TLS files that a router listens with, None if there are none."""
    names = ("root_ca_certificate", "listen_certificate", "listen_private_key")
    paths = [json.loads(config.get_json(f"transport/link/tls/{name}")) for name in names]
    if not all(isinstance(path, str) and path for path in paths):
        return None
    return TlsConfig(ca=Path(paths[0]), certificate=Path(paths[1]), key=Path(paths[2]))


def _certificate_names(config: zenoh.Config) -> frozenset[str] | None:
    """Return the certificate names of the access control list; None if peers without a rule are not denied."""
    access = json.loads(config.get_json("access_control"))
    if not access["enabled"] or access["default_permission"] != "deny":
        return None
    return frozenset(name for subject in access["subjects"] or () for name in subject["cert_common_names"] or ())


def run(config: zenoh.Config) -> int:
    """Route until SIGTERM or SIGINT.

    Returns:
        Exit status; 2 if the router cannot listen or the configuration is invalid.
    """
    _log_zenoh_to_stderr()
    listen, connect = _endpoints_text(config, "listen/endpoints"), _endpoints_text(config, "connect/endpoints")
    try:
        monitor = RouterMonitor(config)
        with stop_on_signals() as stop, zenoh.open(config) as session:
            monitor.start(session)
            log.info("Router started", extra=logs.kv(listen=listen, connect=connect))
            stop.wait()
            monitor.close()
    except (zenoh.ZError, SonarpostError) as error:
        log.error("Router cannot start", extra=logs.kv(listen=listen, error=str(error)))
        return EXIT_CANNOT_START
    log.info("Router stopped")
    return 0


def _log_zenoh_to_stderr() -> None:
    """Send Zenoh's log, which the library writes to standard output, to standard error; coloured on terminals only."""
    if not sys.stderr.isatty():
        os.environ.setdefault("NO_COLOR", "1")
    sys.stdout.flush()
    os.dup2(2, 1)
    zenoh.init_log_from_env_or(ZENOH_LOG_FILTER)


def run_parsed(parsed: argparse.Namespace) -> int:
    """Run with the options of `add_arguments`; an invalid configuration is reported in one line on standard error."""
    try:
        config = load(parsed.config, parsed.listen, parsed.connect, parsed.cfg)
    except ConfigError as error:
        print(f"router: {error}", file=sys.stderr)
        return EXIT_CANNOT_START
    return run(config)


def load(path: Path | None, listen: Sequence[str], connect: Sequence[str], settings: Sequence[str]) -> zenoh.Config:
    """Return the configuration of a router.

    Args:
        path: JSON5 file as for zenohd; None for the defaults of sonarpost.
        listen: Endpoints to listen on; replaces those of the file. The default without a file is loopback only.
        connect: Routers to link to; replaces those of the file.
        settings: `KEY:VALUE` each, the value in JSON5, applied last: `transport/link/tx/lease:3000`.

    Raises:
        ConfigError: The file cannot be read or is not the configuration of a router, or an endpoint or setting is
            invalid.
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
        path.read_bytes()  # Zenoh's own error does not name the file
        config = zenoh.Config.from_file(str(path))
    except OSError as error:
        raise ConfigError(str(path), "", error.strerror or str(error), "a readable JSON5 file") from error
    except zenoh.ZError as error:
        # Zenoh's message lists the known keys; BadInputError would shorten it if it were the value.
        reason = " ".join(str(error).split())
        raise ConfigError(str(path), "", "something else", f"a Zenoh configuration in JSON5: {reason}") from error
    if json.loads(config.get_json("mode")) is None:
        config.insert_json5("mode", '"router"')
    if json.loads(config.get_json("plugins")):
        log.warning("Plugins ignored: the embedded router has none", extra=logs.kv(file=str(path)))
    return config


def _set(config: zenoh.Config, key: str, value: str, option: str) -> None:
    try:
        config.insert_json5(key, value)
    except zenoh.ZError as error:
        raise ConfigError("command line", option, f"{key}:{value}", f"a known key and its value ({error})") from error


def _endpoints_text(config: zenoh.Config, key: str) -> str:
    """Return endpoints as text; the configuration holds a list, or a map of lists by mode (the default of zenohd)."""
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
    logs.configure_logging("router")
    return run_parsed(parsed)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the router's options to a parser; they are those of zenohd and can be repeated."""
    parser.add_argument("-c", "--config", type=Path, metavar="FILE", help="JSON5 configuration, as for zenohd")
    parser.add_argument(
        "-l",
        "--listen",
        nargs="+",
        action="extend",
        default=[],
        metavar="ENDPOINT",
        help=f"endpoints to listen on (default: those of the file; without a file {', '.join(DEFAULT_LISTEN)})",
    )
    parser.add_argument(
        "-e", "--connect", nargs="*", action="extend", default=[], metavar="ENDPOINT", help="routers to link to"
    )
    parser.add_argument(
        "--cfg", action="append", default=[], metavar="KEY:VALUE", help="set one key of the configuration, in JSON5"
    )


if __name__ == "__main__":
    exit_process(main())
