"""The configuration of a platform's router, as JSON5 for zenohd and for sonarpost's own router.

Outside: TLS with certificates on both sides, and access control by common name. Inside: plain TCP for the platform's
own services, on the loopback address or on a network that nobody else is in.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import PurePosixPath

from sonarpost.errors import BadInputError
from sonarpost.keys import SHORE
from sonarpost.security import access, fleet
from sonarpost.security.access import Json
from sonarpost.security.index import FleetIndex, Issued, PkiError

LEASE_MS = 3000
# A thin radio link takes long over what is under way; five seconds, Zenoh's own choice, close it too early.
WAIT_BEFORE_CLOSE_US = 60_000_000
# A record is at most 8 MiB; the rest is for Zenoh's own headers.
MAX_PAYLOAD_BYTES = 8 * 1024 * 1024
MAX_MESSAGE_BYTES = MAX_PAYLOAD_BYTES + 64 * 1024
_ENDPOINT = re.compile(
    r"(?P<protocol>tcp|tls)/(?P<host>\[[0-9a-fA-F:.%a-z]+\]|[A-Za-z0-9._-]+|\*):(?P<port>[0-9]{1,5})"
)
_LOOPBACK = re.compile(r"localhost|127\.[0-9.]+|\[::1\]")


ON_HOST = PurePosixPath("/etc/sonarpost/tls")


@dataclass(frozen=True, slots=True)
class Wanted:
    """What is asked of a router.

    Attributes:
        platform: Whose router it is; it must have a certificate.
        listen: TLS endpoints for other platforms.
        local: Plain TCP endpoints for the platform's own services.
        connect: TLS endpoints of routers to link to.
        files: Folder of ca.pem, certificate.pem and key.pem on the router's host.
        sites: Words that the shore answers to in keys.
        open_local: Whether `local` may be other than a loopback address.
    """

    platform: str
    listen: Sequence[str] = ()
    local: Sequence[str] = ("tcp/127.0.0.1:7447",)
    connect: Sequence[str] = ()
    files: PurePosixPath = ON_HOST
    sites: Sequence[str] = (SHORE,)
    open_local: bool = False


def router_json5(index: FleetIndex, wanted: Wanted, now_utc_s: float) -> str:
    """Return the file.

    Raises:
        BadInputError: The platform has no certificate or its role has no router; an endpoint is not what it must be.
    """
    entry = index.current(wanted.platform)
    if entry is None:
        raise PkiError("pki", "platform", wanted.platform, "a platform with a certificate that is not revoked")
    _check_endpoints(wanted)
    settings = router_settings(index, entry, wanted)
    head = [
        f"// Router of {entry.platform} ({entry.role}), fleet {index.fleet}.",
        f"// Written by `sonarpost pki router-config` on {datetime.fromtimestamp(now_utc_s, UTC):%Y-%m-%d %H:%M} UTC.",
        "// Zenoh reads it when the router starts: after `sonarpost pki issue` or `revoke`, write it anew and restart.",
    ]
    if revoked := index.revoked_names():
        head.append("// Revoked, and let in nowhere: " + ", ".join(revoked) + ".")
    return "\n".join(head) + "\n" + json.dumps(settings, indent=2) + "\n"


def router_settings(index: FleetIndex, entry: Issued, wanted: Wanted) -> Json:
    """Return Zenoh's settings of a platform's router."""
    file = {name: str(wanted.files / name) for name in (fleet.CA_CERTIFICATE, fleet.CERTIFICATE, fleet.KEY)}
    tls: Json = {
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
        "root_ca_certificate": file[fleet.CA_CERTIFICATE],
    }
    for side in ("listen", "connect"):
        tls[f"{side}_certificate"] = file[fleet.CERTIFICATE]
        tls[f"{side}_private_key"] = file[fleet.KEY]
    return {
        "mode": "router",
        # Zenoh carries this along; sonarpost's own router takes from it whose health to publish and whom to answer.
        "metadata": {"platform": entry.platform, "sites": list(wanted.sites) if entry.role == "shore" else []},
        "listen": {"endpoints": [*wanted.local, *wanted.listen], "timeout_ms": 0, "exit_on_failure": True},
        "connect": {
            "endpoints": list(wanted.connect),
            "timeout_ms": -1,
            "exit_on_failure": False,
            "retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5},
        },
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "shared_memory": {"enabled": False},
            "link": {
                "protocols": ["tcp", "tls"],
                "tx": {
                    "lease": LEASE_MS,
                    "queue": {"congestion_control": {"block": {"wait_before_close": WAIT_BEFORE_CLOSE_US}}},
                },
                "rx": {"max_message_size": MAX_MESSAGE_BYTES},
                "tls": tls,
            },
        },
        "low_pass_filter": [
            {
                "id": "records",
                "flows": ["ingress"],
                "link_protocols": ["tls"],
                "messages": ["put", "query", "reply"],
                "key_exprs": ["**"],
                "size_limit": MAX_PAYLOAD_BYTES,
            }
        ],
        "access_control": access.access_control(grants(index, entry, wanted.sites)),
    }


def grants(index: FleetIndex, router: Issued, sites: Sequence[str]) -> list[access.Grant]:
    """Return who may do what at a platform's router: its own services, and every certificate that is not revoked.

    Raises:
        PkiError: A platform of this role has no router.
    """
    roles = access.roles_at(router.role)
    if not roles:
        raise PkiError("pki", "role", router.role, "shore or vessel: only those have a router for others")
    found = [access.local_grant()]
    for role in roles:
        for entry in index.allowed(role):
            if entry.platform == router.platform:
                continue
            if router.role == "shore":
                rules = access.at_shore(entry, sites)
            else:
                rules = access.at_vessel(entry, router.platform, sites)
            found.append(access.certificate_grant(entry, rules))
    return found


def _check_endpoints(wanted: Wanted) -> None:
    for field, endpoints, protocol in (
        ("listen", wanted.listen, "tls"),
        ("connect", wanted.connect, "tls"),
        ("local", wanted.local, "tcp"),
    ):
        for endpoint in endpoints:
            match = _ENDPOINT.fullmatch(endpoint)
            if match is None or match["protocol"] != protocol or not 0 < int(match["port"]) < 65536:
                raise BadInputError("router-config", field, endpoint, f"{protocol}/HOST:PORT")
            if field == "local" and not _LOOPBACK.fullmatch(match["host"]) and not wanted.open_local:
                expected = (
                    "a loopback address; whoever reaches this one may do everything, --open-local says that "
                    "only the platform's own services do"
                )
                raise BadInputError("router-config", field, endpoint, expected)
