"""Configuration of a platform's router as JSON5, for zenohd and for the embedded router.

Other platforms connect by TLS with certificates on both sides; access control identifies them by common name. The
platform's own services connect by plain TCP, on the loopback address or on a network of their own.

Access control denies everything that no rule allows. Flows are seen from the router: *ingress* is what the peer sends,
*egress* what it receives. Zenoh also filters declarations: if the egress of `declare_subscriber` is denied, a vessel
never learns of a subscription at the shore and does not send its publications of that key. The router that a peer
connects to enforces the rules; the peer's own router need not be trusted.
"""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import PurePosixPath
from typing import Literal

from sonarpost import keys
from sonarpost.config import service_packages
from sonarpost.errors import BadInputError
from sonarpost.security import fleet
from sonarpost.security.fleet import CertificateEntry, FleetIndex, PkiError, PreparedName, Role

LEASE_MS = 3000
# A message in transmission on a slow radio link takes longer than Zenoh's default of five seconds.
WAIT_BEFORE_CLOSE_US = 60_000_000
# A record has at most 8 MiB; the difference is for Zenoh's headers.
MAX_PAYLOAD_BYTES = 8 * 1024 * 1024
MAX_MESSAGE_BYTES = MAX_PAYLOAD_BYTES + 64 * 1024
THIN_HEALTH_S = 7.5
"""Shortest time between two health reports of a service on a thin link. With the default interval of 5 s, every second
report passes, up to 2.5 s early or late. Console and `sonarpost status` show a service as silent or stale after
15 s."""
TLS_FOLDER = PurePosixPath("/etc/sonarpost/tls")
PEER_ROLES: dict[Role, tuple[Role, ...]] = {
    "shore": ("vessel", "uuv", "console", "observer", "shore"),
    "vessel": ("shore", "console", "observer"),
}
"""Roles that the router of a platform admits, by the role of the platform."""

# Subscriptions are not secret and are allowed on every key: otherwise a subscriber of `**` would not receive the keys
# that it may read. The rules for `put` decide what it receives.
INTEREST = ("declare_subscriber", "declare_liveliness_subscriber", "liveliness_query")
EVERY_MESSAGE = ("put", "delete", "query", "reply", "declare_queryable", "liveliness_token", *INTEREST)
_ENDPOINT = re.compile(
    r"(?P<protocol>tcp|tls)/(?P<host>\[[0-9a-fA-F:.%a-z]+\]|[A-Za-z0-9._-]+|\*):(?P<port>[0-9]{1,5})"
)
_LOOPBACK = re.compile(r"localhost|127\.[0-9.]+|\[::1\]")

_Json = dict[str, object]
AccessRule = tuple[Literal["ingress", "egress"], tuple[str, ...], tuple[str, ...]]
"""Something that is allowed: flow, kinds of Zenoh messages, key expressions."""


@dataclass(frozen=True, slots=True)
class RouterOptions:
    """Options of a router configuration.

    Attributes:
        platform: Platform of the router; it must have a certificate.
        listen: TLS endpoints for other platforms.
        local: Plain TCP endpoints for the platform's own services.
        connect: TLS endpoints of routers to link to.
        files: Folder of ca.pem, certificate.pem and key.pem on the router's host.
        sites: Names of the shore site in keys.
        open_local: Whether `local` may be other than a loopback address.
        other_vessels: Vessels that may deliver their frames to this lead vessel.
        lead_vessel: Vessel that this one may deliver its frames to; empty for none.
        thin_link: Compress the link to routers that have this option too. The router of a vessel also sends other
            platforms only one health report of each of its services in `THIN_HEALTH_S`.
    """

    platform: str
    listen: Sequence[str] = ()
    local: Sequence[str] = ("tcp/127.0.0.1:7447",)
    connect: Sequence[str] = ()
    files: PurePosixPath = TLS_FOLDER
    sites: Sequence[str] = (keys.SHORE,)
    open_local: bool = False
    other_vessels: Sequence[str] = ()
    lead_vessel: str = ""
    thin_link: bool = False


def router_json5(index: FleetIndex, options: RouterOptions, now_utc_s: float) -> str:
    """Return the content of a configuration file.

    Raises:
        BadInputError: The platform has no certificate, its role has no router, or an endpoint is invalid.
    """
    entry = index.current(options.platform)
    _check_endpoints(options)
    head = [
        f"// Router of {entry.platform} ({entry.role}), fleet {index.fleet}.",
        f"// Written by `sonarpost pki router-config` on {datetime.fromtimestamp(now_utc_s, UTC):%Y-%m-%d %H:%M} UTC.",
        "// Zenoh reads it at the start only: after `sonarpost pki issue` of a name that is not in it, and after",
        "// `sonarpost pki revoke`, write it again and restart.",
    ]
    if revoked := index.revoked_names():
        head.append("// Revoked and denied: " + ", ".join(revoked) + ".")
    return "\n".join(head) + "\n" + json.dumps(_settings(index, entry, options), indent=2) + "\n"


def _settings(index: FleetIndex, router: CertificateEntry, options: RouterOptions) -> _Json:
    tls: _Json = {
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
        "root_ca_certificate": str(options.files / fleet.CA_CERTIFICATE),
    }
    for side in ("listen", "connect"):
        tls[f"{side}_certificate"] = str(options.files / fleet.CERTIFICATE)
        tls[f"{side}_private_key"] = str(options.files / fleet.KEY)
    return {
        "mode": "router",
        # Read by the embedded router: platform of its health record, sites of its presence replies.
        "metadata": {"platform": router.platform, "sites": list(options.sites) if router.role == "shore" else []},
        "listen": {"endpoints": [*options.local, *options.listen], "timeout_ms": 0, "exit_on_failure": True},
        "connect": {
            "endpoints": list(options.connect),
            "timeout_ms": -1,
            "exit_on_failure": False,
            "retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5},
        },
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "shared_memory": {"enabled": False},
            "unicast": {"compression": {"enabled": options.thin_link}},
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
        "qos": dropped_replies(),
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
        "downsampling": _thinned_health(router) if options.thin_link else [],
        "access_control": _access_control(index, router, options),
    }


def _thinned_health(router: CertificateEntry) -> list[_Json]:
    """Return Zenoh's `downsampling` section: health of a vessel's services on its way to other platforms.

    Zenoh keeps one time for each rule: with a wildcard, the report of one service would cause the reports of all others
    to be dropped. Hence one rule for each service. A shore site sends no health to a vessel.
    """
    if router.role != "vessel":
        return []
    names = ("router", *service_packages())
    return [
        {
            "id": "health",
            "flows": ["egress"],
            "link_protocols": ["tls"],
            "messages": ["put"],
            "rules": [{"key_expr": keys.health(router.platform, name), "freq": 1 / THIN_HEALTH_S} for name in names],
        }
    ]


def dropped_replies() -> _Json:
    """Return Zenoh's `qos` section: replies of c2 are dropped for a client that does not read them.

    A reply has the congestion control of its query. With that of a query to c2 set to drop, a client that stops reading
    cannot block the router. Replies are numbered and counted, so that the client notices a gap.
    """
    overwrite: _Json = {
        "id": "queries for stored records",
        "messages": ["query"],
        "key_exprs": [keys.shore_contact_everywhere(), keys.tasking_state_everywhere()],
        "overwrite": {"congestion_control": "drop"},
        "flows": ["ingress"],
    }
    return {"network": [overwrite]}


def _check_endpoints(options: RouterOptions) -> None:
    for field, endpoints, protocol in (
        ("listen", options.listen, "tls"),
        ("connect", options.connect, "tls"),
        ("local", options.local, "tcp"),
    ):
        for endpoint in endpoints:
            match = _ENDPOINT.fullmatch(endpoint)
            if match is None or match["protocol"] != protocol or not 0 < int(match["port"]) < 65536:
                raise BadInputError("router-config", field, endpoint, f"{protocol}/HOST:PORT")
            if field == "local" and not _LOOPBACK.fullmatch(match["host"]) and not options.open_local:
                expected = (
                    "a loopback address; every program that reaches this endpoint has all rights, --open-local "
                    "confirms that only the platform's own services do"
                )
                raise BadInputError("router-config", field, endpoint, expected)


# Access control


def _access_control(index: FleetIndex, router: CertificateEntry, options: RouterOptions) -> _Json:
    """Return Zenoh's `access_control` section: the platform's own services, all admitted names.

    Raises:
        PkiError: A platform of this role has no router, or a vessel that is named has no certificate.
    """
    if router.role not in PEER_ROLES:
        raise PkiError("pki", "role", router.role, "shore or vessel: only those have a router for other platforms")
    everywhere = (keys.ANY, keys.ROUTER_ADMINISTRATION)
    local: list[AccessRule] = [("ingress", EVERY_MESSAGE, everywhere), ("egress", EVERY_MESSAGE, everywhere)]
    # The own services connect by plain TCP, to an address that no other program can reach.
    grants: list[tuple[str, _Json, list[AccessRule]]] = [("local services", {"link_protocols": ["tcp"]}, local)]
    for entry in (entry for role in PEER_ROLES[router.role] for entry in index.allowed(role)):
        if entry.platform != router.platform:
            peer: _Json = {"cert_common_names": [entry.common_name], "link_protocols": ["tls"]}
            at_shore = router.role == "shore"
            rules = (
                _rules_at_shore(entry, options.sites)
                if at_shore
                else _rules_at_vessel(entry, router.platform, options.sites)
            )
            grants.append((f"{entry.role} {entry.common_name}", peer, rules))
    for name, rules in _rules_of_other_vessels(router, options).items():
        entries = [entry for entry in index.allowed("vessel") if entry.platform == name != router.platform]
        if not entries:
            raise PkiError("router-config", "vessel", name, "another vessel of the fleet with a certificate")
        for entry in entries:
            named_vessel: _Json = {"cert_common_names": [entry.common_name], "link_protocols": ["tls"]}
            grants.append((f"vessel {entry.common_name}", named_vessel, rules))
    named = [(subject, number, rule) for subject, _, rules in grants for number, rule in enumerate(rules, start=1)]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [
            {
                "id": f"{subject} {number}",
                "permission": "allow",
                "flows": [flow],
                "messages": list(messages),
                "key_exprs": list(expressions),
            }
            for subject, number, (flow, messages, expressions) in named
        ],
        "subjects": [{"id": subject, **peer} for subject, peer, _ in grants],
        "policies": [
            {
                "id": subject,
                "rules": [f"{subject} {number}" for number in range(1, len(rules) + 1)],
                "subjects": [subject],
            }
            for subject, _, rules in grants
        ],
    }


def _rules_at_shore(entry: CertificateEntry | PreparedName, sites: Sequence[str]) -> list[AccessRule]:
    """Return the rights of a certificate at the router of a shore site."""
    own = (keys.everything_of(entry.platform),)
    match entry.role:
        case "vessel":
            inboxes = tuple(keys.below(keys.shore_inbox(entry.platform, site)) for site in sites)
            return [
                ("ingress", ("put", "reply", "declare_queryable", "liveliness_token"), own),
                ("ingress", ("declare_subscriber",), own),
                ("ingress", ("query",), inboxes),
                ("egress", INTEREST, (keys.ANY,)),
                ("egress", ("query", "put"), own),
                ("egress", ("reply",), inboxes),
                ("egress", ("declare_queryable",), _inbox_queryables(sites)),
            ]
        case "uuv":
            # A vehicle on deck, linked for a transfer or a test: it publishes below its own prefix.
            return [("ingress", ("put", "liveliness_token"), own), ("egress", INTEREST, (keys.ANY,))]
        case "console":
            taskings = [(keys.tasking_comment_all(site), keys.tasking_command_all(site)) for site in sites]
            sent = tuple(keys.below(key) for pair in taskings for key in pair)
            return [*_reading(), *_sending(sent), *_querying(_accepted(sites))]
        case "observer":
            return [*_reading(), *_querying(_accepted(sites))]
        case "shore":
            # Another shore site reads what this one has accepted from vessels.
            contacts = tuple(keys.shore_contact_all(site) for site in sites)
            published = tuple(keys.below(key) for key in contacts)
            return [("ingress", INTEREST, (keys.ANY,)), ("egress", ("put",), published), *_querying(contacts)]


def _rules_at_vessel(entry: CertificateEntry | PreparedName, vessel: str, sites: Sequence[str]) -> list[AccessRule]:
    """Return the rights of a certificate at the router of a vessel.

    The shore can send comments and commands, and request codebooks. It can neither send images or decisions as if they
    came from the vessel nor read the vessel's internal records.
    """
    match entry.role:
        case "shore":
            downward = (keys.below(keys.comment(vessel)), keys.below(keys.command_all(vessel)))
            inboxes = tuple(keys.below(keys.shore_inbox(vessel, site)) for site in sites)
            return [
                ("ingress", INTEREST, (keys.ANY,)),
                ("ingress", ("query", "put"), downward),
                ("ingress", ("reply",), inboxes),
                ("ingress", ("declare_queryable",), _inbox_queryables(sites)),
                ("egress", ("put", "liveliness_token"), (keys.everything_of(vessel),)),
                ("egress", ("reply", "declare_queryable", "declare_subscriber"), downward),
                ("egress", ("query",), inboxes),
                ("ingress", ("query",), (keys.codebook_all(vessel),)),
                ("egress", ("reply", "declare_queryable"), (keys.codebook_all(vessel),)),
            ]
        case "console":
            # A console on the vessel sends decisions and commands, and receives comments.
            sent = (keys.below(keys.contact_decision(vessel)), keys.below(keys.command_all(vessel)))
            received = (keys.delivery_query_any(keys.comment(vessel)),)
            return [
                *_reading(),
                *_sending(sent),
                ("ingress", ("reply", "declare_queryable"), received),
                ("egress", ("query",), received),
            ]
        case _:
            return _reading()


def _rules_of_other_vessels(router: CertificateEntry, options: RouterOptions) -> dict[str, list[AccessRule]]:
    """Return the rights of the other vessels that are named, at the router of a vessel.

    A vessel delivers frames to its own inbox at the lead vessel. Neither of them reads or sends anything else.

    Raises:
        PkiError: The router is not that of a vessel.
    """
    names = [*options.other_vessels, *([options.lead_vessel] if options.lead_vessel else [])]
    if names and router.role != "vessel":
        raise PkiError("router-config", "vessel", ", ".join(names), "none: only vessels exchange frames")
    if len(set(names)) != len(names):
        raise PkiError("router-config", "vessel", ", ".join(names), "each name once")
    found: dict[str, list[AccessRule]] = {}
    for name in options.other_vessels:
        inbox = (keys.below(keys.vessel_frames(router.platform, name)),)
        found[name] = [("ingress", ("query",), inbox), ("egress", ("reply", "declare_queryable"), inbox)]
    if options.lead_vessel:
        inbox = (keys.below(keys.vessel_frames(options.lead_vessel, router.platform)),)
        found[options.lead_vessel] = [
            ("egress", ("query",), inbox),
            ("ingress", ("reply", "declare_queryable"), inbox),
        ]
    return found


def _reading() -> list[AccessRule]:
    return [("ingress", INTEREST, (keys.ANY,)), ("egress", ("put", "liveliness_token"), (keys.everything(),))]


def _sending(expressions: tuple[str, ...]) -> list[AccessRule]:
    return [
        ("ingress", ("query", "put"), expressions),
        ("egress", ("reply", "declare_queryable", "declare_subscriber"), expressions),
    ]


def _querying(expressions: tuple[str, ...]) -> list[AccessRule]:
    return [
        ("ingress", ("query",), expressions),
        ("egress", ("reply", "declare_queryable"), expressions),
    ]


def _accepted(sites: Sequence[str]) -> tuple[str, ...]:
    """Return the keys on which the c2 of a site replies to queries."""
    return tuple(key for site in sites for key in (keys.shore_contact_all(site), keys.tasking_state_all(site)))


def _inbox_queryables(sites: Sequence[str]) -> tuple[str, ...]:
    """Return the keys that the services of a site declare for all vessels at once."""
    inboxes = [keys.shore_inbox_all(site) for site in sites]
    return tuple(key for inbox in inboxes for key in (keys.delivery_query_any(inbox), keys.below(inbox)))
