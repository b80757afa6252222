"""Places between an operator and the vehicles, each with its state: server, router, decoder, modem, vehicles.

A record of a vehicle passes all of them, so that the first place with a fault explains why no images arrive. The page
adds the connection between browser and server.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

from sonarpost.monitoring.fleet import ServiceStatus
from sonarpost.services.console.store.database import ConsoleSide

ChainPlace = Literal["server", "router", "decoder", "modem", "c2", "vehicle"]
PlaceState = Literal["ok", "waiting", "degraded", "lost", "unknown"]
Reason = Literal["", "not_reached", "no_report", "not_running", "no_modem", "reported", "no_frames"]

SERVICE_STALE_S: Final = 15.0
"""Age of a health record above which its service counts as silent; services publish one every 5 s."""
START_S: Final = 5.0
"""Time after the connection to the router in which services may not be visible yet."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RouterState:
    """Connection of the console to its platform's router.

    Attributes:
        platform_id: Platform of the console.
        reached: Whether the router is reached.
        changed_utc_s: Time of the last change of `reached`, or of the start.
        listening_since_utc_s: Time at which the router was first reached; None before.
        detail: Address of the router, or the remark that it is simulated.
    """

    platform_id: str
    reached: bool
    changed_utc_s: float
    listening_since_utc_s: float | None = None
    detail: str = ""

    def changed(self, now_utc_s: float, *, reached: bool) -> RouterState:
        """Return the state after an observation of the connection."""
        if reached == self.reached:
            return self
        since = self.listening_since_utc_s
        if since is None and reached:
            since = now_utc_s
        return replace(self, reached=reached, changed_utc_s=now_utc_s, listening_since_utc_s=since)


@dataclass(frozen=True, slots=True)
class ChainLink:
    """One place of the chain.

    Attributes:
        place: Kind of the place.
        name: Name of the service or vehicle; empty for the router.
        state: ok; waiting: nothing is received yet, which is not a fault; degraded: it works in part; lost: nothing
            passes it; unknown: it is behind a lost place.
        reason: Why it is degraded or lost.
        detail: Text of the service about its fault, or the address of the router.
        since_utc_s: Time from which the state is known to last.
        heard_utc_s: Arrival of the last report or frame; None if there is none.
    """

    place: ChainPlace
    name: str
    state: PlaceState
    reason: Reason = ""
    detail: str = ""
    since_utc_s: float | None = None
    heard_utc_s: float | None = None


def chain_links(
    side: ConsoleSide,
    router: RouterState | None,
    services: Iterable[ServiceStatus],
    vehicles: Mapping[str, float],
    expected_vehicles: Sequence[str],
    *,
    now_utc_s: float,
    vehicle_stale_s: float,
) -> list[ChainLink]:
    """Return the places from the server outwards.

    Args:
        side: At a shore site, the chain ends at c2.
        router: Connection to the router; None for a console without a network, whose chain has the server only.
        services: Last health of all services.
        vehicles: Age of the last received frame by vehicle.
        expected_vehicles: Names of the configured vehicles.
        now_utc_s: Present time.
        vehicle_stale_s: Time without a frame after which a vehicle is degraded.
    """
    own = {} if router is None else {one.service: one for one in services if one.platform == router.platform_id}
    links = [_server(own.get("console"), router, now_utc_s)]
    if router is None:
        return links
    since = router.changed_utc_s
    if router.reached:
        links.append(ChainLink("router", "", "ok", "", router.detail, since, now_utc_s))
    else:
        links.append(ChainLink("router", "", "lost", "not_reached", router.detail, since))
    starting = now_utc_s - since < START_S
    names: tuple[tuple[ChainPlace, str], ...] = (("decoder", "decompressor"), ("modem", "op_modem"))
    if side == "shore":
        names = (("c2", "c2"),)
    links += [_service(place, name, own.get(name), now_utc_s, starting=starting) for place, name in names]
    if side == "vessel":
        links += _vehicles(vehicles, expected_vehicles, router, now_utc_s, vehicle_stale_s)
    return _behind_lost_places(links)


def _server(own: ServiceStatus | None, router: RouterState | None, now_utc_s: float) -> ChainLink:
    """Return the link of the server itself. Without the router, its health states the router's fault."""
    health = own.health if own is not None else None
    if health is not None and health.state == "degraded" and router is not None and router.reached:
        return ChainLink("server", "console", "degraded", "reported", health.detail, None, now_utc_s)
    return ChainLink("server", "console", "ok", heard_utc_s=now_utc_s)


def _service(
    place: ChainPlace, name: str, status: ServiceStatus | None, now_utc_s: float, *, starting: bool
) -> ChainLink:
    health = None if status is None else status.health
    if status is None or health is None or status.age_s is None:
        is_expected = starting or (status is not None and status.alive)
        return ChainLink(place, name, "waiting") if is_expected else ChainLink(place, name, "lost", "not_running")
    heard = now_utc_s - status.age_s
    if health.state == "stopping" or (status.alive is False and not starting):
        return ChainLink(place, name, "lost", "not_running", "", heard, heard)
    if status.age_s > SERVICE_STALE_S:
        return ChainLink(place, name, "lost", "no_report", "", heard, heard)
    state: PlaceState = "ok"
    reason: Reason = ""
    if health.state == "degraded":
        has_modem = health.gauges.get("modem_ready") != 0.0
        state, reason = ("degraded", "reported") if has_modem else ("lost", "no_modem")
    return ChainLink(place, name, state, reason, health.detail, None, heard)


def _vehicles(
    vehicles: Mapping[str, float],
    expected: Sequence[str],
    router: RouterState,
    now_utc_s: float,
    stale_s: float,
) -> list[ChainLink]:
    links: list[ChainLink] = []
    for name, age_s in vehicles.items():
        heard = now_utc_s - age_s
        if age_s > stale_s:
            links.append(ChainLink("vehicle", name, "degraded", "no_frames", "", heard, heard))
        else:
            links.append(ChainLink("vehicle", name, "ok", heard_utc_s=heard))
    since = router.listening_since_utc_s
    links += [ChainLink("vehicle", name, "waiting", since_utc_s=since) for name in expected if name not in vehicles]
    return sorted(links, key=lambda link: link.name) or [ChainLink("vehicle", "", "waiting", since_utc_s=since)]


def _behind_lost_places(links: list[ChainLink]) -> list[ChainLink]:
    """Mark the places whose state cannot be known: all behind a lost router, and vehicles behind a lost modem."""
    lost = {link.place for link in links if link.state == "lost"}

    def is_hidden(link: ChainLink) -> bool:
        if link.place in ("server", "router"):
            return False
        return "router" in lost or (link.place == "vehicle" and "modem" in lost)

    return [replace(link, state="unknown", reason="", detail="") if is_hidden(link) else link for link in links]


class ChainHistory:
    """Adds the time from which a place has its state, where the place itself does not state it."""

    def __init__(self) -> None:
        self._states: dict[tuple[ChainPlace, str], tuple[PlaceState, float]] = {}

    def with_times(self, links: Sequence[ChainLink], now_utc_s: float) -> list[ChainLink]:
        """Return the links with `since_utc_s`; call it with every observation, from one thread at a time."""
        states: dict[tuple[ChainPlace, str], tuple[PlaceState, float]] = {}
        timed: list[ChainLink] = []
        for link in links:
            state, since = self._states.get((link.place, link.name), (None, now_utc_s))
            since = since if state == link.state else now_utc_s
            states[(link.place, link.name)] = (link.state, since)
            timed.append(link if link.since_utc_s is not None else replace(link, since_utc_s=since))
        self._states = states
        return timed
