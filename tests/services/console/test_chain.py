"""The chain of places between an operator and the vehicles."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest

from sonarpost.messages import Health
from sonarpost.monitoring.fleet import ServiceStatus
from sonarpost.services.console.chain import ChainHistory, ChainLink, RouterState, chain_links

VESSEL = "vessel-1"
NOW_S = 10_000.0
ROUTER = RouterState(
    platform_id=VESSEL,
    reached=True,
    changed_utc_s=9_000.0,
    listening_since_utc_s=9_000.0,
    detail="tcp/127.0.0.1:7447",
)


def status(
    service: str, state: Any = "ok", *, age_s: float = 1.0, alive: bool | None = True, detail: str = "", **gauges: float
) -> ServiceStatus:
    health = Health(
        platform_id=VESSEL,
        service=service,
        time_utc_s=NOW_S - age_s,
        started_utc_s=9_000.0,
        state=state,
        detail=detail,
        counters={},
        gauges=gauges,
    )
    return ServiceStatus(VESSEL, service, health, age_s, alive)


ALL = (status("console"), status("op_modem", modem_ready=1.0), status("decompressor"))
UUV_1 = {"uuv-1": 3.0}


def links(
    services: tuple[ServiceStatus, ...] = ALL,
    vehicles: Mapping[str, float] = UUV_1,
    router: RouterState | None = ROUTER,
    side: Any = "vessel",
    expected: tuple[str, ...] = (),
) -> dict[str, ChainLink]:
    found = chain_links(side, router, services, vehicles, expected, now_utc_s=NOW_S, vehicle_stale_s=120.0)
    return {link.name if link.place == "vehicle" else link.place: link for link in found}


def test_all_places_work():
    chain = links()
    assert list(chain) == ["server", "router", "decoder", "modem", "uuv-1"]
    assert {link.state for link in chain.values()} == {"ok"}
    assert chain["uuv-1"].heard_utc_s == NOW_S - 3.0


def test_lost_router_hides_what_is_behind_it():
    lost = ROUTER.changed(9_990.0, reached=False)
    chain = links(router=lost)
    assert (chain["router"].state, chain["router"].since_utc_s) == ("lost", 9_990.0)
    assert [chain[name].state for name in ("server", "decoder", "modem", "uuv-1")] == ["ok", *["unknown"] * 3]
    # The time of the first connection is kept, because records are received from then on.
    assert lost.changed(9_995.0, reached=True) == replace(ROUTER, changed_utc_s=9_995.0)
    assert lost.changed(9_999.0, reached=False) is lost


def with_modem(modem: ServiceStatus | None) -> tuple[ServiceStatus, ...]:
    return (ALL[0], ALL[2], *(() if modem is None else (modem,)))


@pytest.mark.parametrize(
    ("modem", "state", "reason"),
    [
        (status("op_modem", "degraded", modem_ready=0.0, detail="/dev/ttyUSB0: no such file"), "lost", "no_modem"),
        (status("op_modem", "degraded", modem_ready=1.0, detail="disk full"), "degraded", "reported"),
        (status("op_modem", "stopping"), "lost", "not_running"),
        (status("op_modem", alive=False), "lost", "not_running"),
        (status("op_modem", age_s=15.1), "lost", "no_report"),
        (status("op_modem", age_s=15.1, alive=None), "lost", "no_report"),
        (status("op_modem", age_s=14.9, alive=None), "ok", ""),
        (None, "lost", "not_running"),
        (ServiceStatus(VESSEL, "op_modem", None, None, True), "waiting", ""),
    ],
)
def test_modem(modem, state, reason):
    chain = links(with_modem(modem))
    assert (chain["modem"].state, chain["modem"].reason) == (state, reason)
    # Images that are already here are decoded, but frames of a vehicle cannot arrive.
    assert chain["decoder"].state == "ok"
    assert chain["uuv-1"].state == ("unknown" if state == "lost" else "ok")
    if modem is not None and modem.health is not None and reason in ("no_modem", "reported"):
        assert chain["modem"].detail == modem.health.detail


def test_service_of_another_platform_does_not_count():
    other = status("op_modem")
    chain = links((ALL[0], ALL[2], ServiceStatus("vessel-2", "op_modem", other.health, 1.0, True)))
    assert chain["modem"].state == "lost"


def test_services_have_time_to_appear_after_the_connection():
    chain = links((), router=replace(ROUTER, changed_utc_s=NOW_S - 4.0))
    assert (chain["modem"].state, chain["decoder"].state) == ("waiting", "waiting")


def test_silent_vehicle_is_named_with_the_time_of_its_last_frame():
    chain = links(vehicles=UUV_1 | {"uuv-2": 121.0})
    assert chain["uuv-1"].state == "ok"
    silent = chain["uuv-2"]
    assert (silent.state, silent.reason, silent.since_utc_s) == ("degraded", "no_frames", NOW_S - 121.0)


def test_vehicles_before_their_first_frame_are_waited_for():
    assert links(vehicles={}, expected=("uuv-3",))["uuv-3"] == ChainLink(
        "vehicle", "uuv-3", "waiting", since_utc_s=9_000.0
    )
    assert links(vehicles={})[""].state == "waiting"


def test_degraded_console_is_named_unless_the_router_is_the_reason():
    own = (status("console", "degraded", detail="no space left on device"), *ALL[1:])
    assert (links(own)["server"].state, links(own)["server"].detail) == ("degraded", "no space left on device")
    assert links(own, router=ROUTER.changed(9_990.0, reached=False))["server"].state == "ok"


def test_shore_site_and_console_without_a_network():
    c2 = ServiceStatus("vessel-1", "c2", status("c2").health, 1.0, True)
    assert list(links((c2,), side="shore")) == ["server", "router", "c2"]
    assert list(links((), {}, router=None)) == ["server"]


def test_time_of_a_state_is_that_of_its_first_observation():
    history = ChainHistory()
    ok, lost = ChainLink("modem", "op_modem", "ok"), ChainLink("modem", "op_modem", "lost", "no_modem")
    own_time = replace(lost, since_utc_s=5.0)
    observed = [(ok, 10.0), (ok, 20.0), (lost, 30.0), (lost, 40.0), (own_time, 50.0), (ok, 60.0)]
    times = [history.with_times([link], now)[0].since_utc_s for link, now in observed]
    assert times == [10.0, 10.0, 30.0, 30.0, 5.0, 60.0]
