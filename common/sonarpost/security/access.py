"""Who may say what through a router: Zenoh access control by the common name of a peer's certificate.

Everything that no rule allows is denied. Flows are seen from the router: *ingress* is what the peer sends, *egress*
what it gets. Besides records, Zenoh filters interest: a subscription ashore reaches the vessel as an egress
`declare_subscriber`, and where it is denied the vessel's publications of that key stay aboard, silently.

A peer that links to a router is held to its rules by *that* router; nobody has to trust the peer's own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from sonarpost import keys
from sonarpost.security.index import Issued, Role

Flow = Literal["ingress", "egress"]
Json = dict[str, object]

# Who listens for what is no secret here, and is allowed whole: a watcher of `**` ashore would otherwise get nothing of
# the keys that it may see. What it then gets is decided by the rules for `put`.
INTEREST = ("declare_subscriber", "declare_liveliness_subscriber", "liveliness_query")
EVERY_MESSAGE = (
    "put",
    "delete",
    "query",
    "reply",
    "declare_queryable",
    "liveliness_token",
    *INTEREST,
)


@dataclass(frozen=True, slots=True)
class Rule:
    """One thing that is allowed.

    Attributes:
        flow: Direction, seen from the router.
        messages: Kinds of Zenoh messages.
        key_expressions: Where.
    """

    flow: Flow
    messages: tuple[str, ...]
    key_expressions: tuple[str, ...]


def at_shore(entry: Issued, sites: Sequence[str]) -> list[Rule]:
    """Return what a shore router allows the holder of a certificate.

    Args:
        entry: The certificate.
        sites: Words that this shore answers to in keys, `shore` among them as a rule.
    """
    by_role: Mapping[Role, Callable[[str, Sequence[str]], list[Rule]]] = {
        "vessel": _vessel_at_shore,
        "uuv": _uuv_at_shore,
        "console": _console_at_shore,
        "observer": lambda _platform, _sites: _observer(),
        "shore": _shore_at_shore,
    }
    return by_role[entry.role](entry.platform, sites)


def at_vessel(entry: Issued, vessel: str, sites: Sequence[str]) -> list[Rule]:
    """Return what a vessel's router allows the holder of a certificate.

    The shore may advise and command. It may neither hand in pictures or decisions as if they had been made aboard nor
    read what the vessel keeps to itself.
    """
    if entry.role == "shore":
        return _shore_at_vessel(vessel, sites)
    if entry.role == "console":
        return _console_at_vessel(vessel)
    return _observer() if entry.role == "observer" else []


def _vessel_at_shore(vessel: str, sites: Sequence[str]) -> list[Rule]:
    own = (keys.everything_of(vessel),)
    inboxes = tuple(keys.below(keys.shore_inbox(vessel, site)) for site in sites)
    return [
        Rule("ingress", ("put", "reply", "declare_queryable", "liveliness_token"), own),
        Rule("ingress", ("declare_subscriber",), own),
        Rule("ingress", ("query",), inboxes),
        Rule("egress", INTEREST, (keys.ANY,)),
        Rule("egress", ("query", "put"), own),
        Rule("egress", ("reply",), inboxes),
        Rule("egress", ("declare_queryable",), _answers(sites)),
    ]


def _uuv_at_shore(vehicle: str, _sites: Sequence[str]) -> list[Rule]:
    """A vehicle on deck, linked for a transfer or a test: it may show what it has."""
    return [
        Rule("ingress", ("put", "liveliness_token"), (keys.everything_of(vehicle),)),
        Rule("egress", INTEREST, (keys.ANY,)),
    ]


def _shore_at_vessel(vessel: str, sites: Sequence[str]) -> list[Rule]:
    own = (keys.everything_of(vessel),)
    downward = (keys.below(keys.advice(vessel)), keys.below(keys.command_all(vessel)))
    inboxes = tuple(keys.below(keys.shore_inbox(vessel, site)) for site in sites)
    return [
        Rule("ingress", INTEREST, (keys.ANY,)),
        Rule("ingress", ("query", "put"), downward),
        Rule("ingress", ("reply",), inboxes),
        Rule("ingress", ("declare_queryable",), _answers(sites)),
        Rule("egress", ("put", "liveliness_token"), own),
        Rule("egress", ("reply", "declare_queryable", "declare_subscriber"), downward),
        Rule("egress", ("query",), inboxes),
    ]


def _console_at_vessel(vessel: str) -> list[Rule]:
    """An operator's program aboard: it hands in decisions and commands, and takes advice."""
    handed_in = (keys.below(keys.contact_decision(vessel)), keys.below(keys.command_all(vessel)))
    taken = (keys.delivery_query_any(keys.advice(vessel)),)
    return [
        *_observer(),
        *_handing_in(handed_in),
        Rule("ingress", ("reply", "declare_queryable"), taken),
        Rule("egress", ("query",), taken),
    ]


def _console_at_shore(_platform: str, sites: Sequence[str]) -> list[Rule]:
    """An expert's program ashore: it hands in advice and tasking."""
    handed_in = tuple(
        keys.below(key) for site in sites for key in (keys.tasking_advice_all(site), keys.tasking_command_all(site))
    )
    return [*_observer(), *_handing_in(handed_in)]


def _handing_in(expressions: tuple[str, ...]) -> list[Rule]:
    return [
        Rule("ingress", ("query", "put"), expressions),
        Rule("egress", ("reply", "declare_queryable", "declare_subscriber"), expressions),
    ]


def _observer() -> list[Rule]:
    """A program that watches: it can change nothing."""
    return [
        Rule("ingress", INTEREST, (keys.ANY,)),
        Rule("egress", ("put", "liveliness_token"), (keys.everything(),)),
    ]


def _shore_at_shore(_platform: str, sites: Sequence[str]) -> list[Rule]:
    """Another shore site: it sees what this one has accepted."""
    shown = tuple(keys.below(keys.shore_contact_all(site)) for site in sites)
    return [
        Rule("ingress", INTEREST, (keys.ANY,)),
        Rule("egress", ("put",), shown),
    ]


def _answers(sites: Sequence[str]) -> tuple[str, ...]:
    """Where a site answers vessels: as its services declare it, for all vessels at once."""
    expressions = []
    for site in sites:
        expressions += [keys.delivery_query_any(keys.shore_inbox_all(site)), keys.below(keys.shore_inbox_all(site))]
    return tuple(expressions)


@dataclass(frozen=True, slots=True)
class Grant:
    """Somebody, and what they may do.

    Attributes:
        subject: Name for the configuration.
        matches: Zenoh's description of the peer: `cert_common_names` or `link_protocols`.
        rules: What is allowed.
    """

    subject: str
    matches: Json
    rules: tuple[Rule, ...]


def certificate_grant(entry: Issued, rules: Iterable[Rule]) -> Grant:
    """Return the grant of a certificate's holder, by its common name and over TLS only."""
    matches: Json = {"cert_common_names": [entry.common_name], "link_protocols": ["tls"]}
    return Grant(f"{entry.role} {entry.common_name}", matches, tuple(rules))


def local_grant() -> Grant:
    """Return the grant of the platform's own services, which come by plain TCP to an address only they can reach."""
    rules = tuple(Rule(flow, EVERY_MESSAGE, (keys.ANY, keys.ROUTER_ADMINISTRATION)) for flow in ("ingress", "egress"))
    return Grant("local services", {"link_protocols": ["tcp"]}, rules)


def access_control(grants: Iterable[Grant]) -> Json:
    """Return Zenoh's `access_control` section: deny by default, one policy a grant."""
    rules: list[Json] = []
    subjects: list[Json] = []
    policies: list[Json] = []
    for grant in grants:
        names = []
        for number, rule in enumerate(grant.rules, start=1):
            name = f"{grant.subject} {number}"
            names.append(name)
            rules.append(
                {
                    "id": name,
                    "permission": "allow",
                    "flows": [rule.flow],
                    "messages": list(rule.messages),
                    "key_exprs": list(rule.key_expressions),
                }
            )
        if names:
            subjects.append({"id": grant.subject, **grant.matches})
            policies.append({"id": grant.subject, "rules": names, "subjects": [grant.subject]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def roles_at(role: Role) -> tuple[Role, ...]:
    """Return which roles a router of a platform with this role lets in."""
    if role == "shore":
        return ("vessel", "uuv", "console", "observer", "shore")
    if role == "vessel":
        return ("shore", "console", "observer")
    return ()
