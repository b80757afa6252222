"""Sessions: configuration without discovery, and opening with retries until success or stop."""

import json
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import pytest
import zenoh
from builders.common import eventually, free_port

from sonarpost.bus import session
from sonarpost.bus.session import client_config, lost_reason, open_with_retry, router_config


def setting(config, path):
    return json.loads(config.get_json(path))


@pytest.mark.parametrize(
    "config", [client_config(["tcp/127.0.0.1:1"]), router_config(["tcp/127.0.0.1:1"], ["tcp/h:2"])]
)
def test_discovery_and_shared_memory_are_off(config):
    assert setting(config, "scouting/multicast/enabled") is False
    assert setting(config, "scouting/gossip/enabled") is False
    assert setting(config, "transport/shared_memory/enabled") is False
    assert setting(config, "transport/link/tx/lease") == 3000


def test_services_are_clients_and_hubs_are_routers():
    client, router = client_config(["tcp/a:1", "tcp/b:2"]), router_config(["tcp/c:3"], ["tcp/d:4"])
    assert (setting(client, "mode"), setting(router, "mode")) == ("client", "router")
    assert setting(client, "connect/endpoints") == ["tcp/a:1", "tcp/b:2"]
    assert setting(client, "listen/endpoints") == []
    assert setting(router, "listen/endpoints") == ["tcp/c:3"]
    assert setting(router, "connect/endpoints") == ["tcp/d:4"]


def test_later_attempts_wait_longer():
    waits_ms = [setting(client_config(["tcp/a:1"], attempt=n), "connect/timeout_ms") for n in range(5)]
    assert waits_ms == [1000, 2000, 4000, 4000, 4000]


def test_second_endpoint_is_used_if_the_first_is_unreachable(router):
    opened = open_with_retry(["tcp/127.0.0.1:1", router], threading.Event())
    assert len(opened.info.routers_zid()) == 1
    opened.close()


def test_router_that_starts_later_is_joined(caplog, monkeypatch):
    monkeypatch.setattr(session, "RETRY_S", (0.02,))
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    stop = threading.Event()
    with ThreadPoolExecutor(1) as pool, ExitStack() as stack:
        stack.callback(stop.set)
        joining = pool.submit(open_with_retry, [endpoint], stop)
        eventually(lambda: "Zenoh router not reached; retrying" in caplog.text)
        assert not joining.done()
        late = zenoh.open(router_config([endpoint]))
        joining.result().close()
    late.close()
    # One warning for all attempts with the same reason, with the endpoint.
    fields = [vars(r)["fields"] for r in caplog.records if r.message.startswith("Zenoh router not reached")]
    assert fields[0] == {"router": endpoint, "error": f"no connection: {endpoint}: Connection refused"}
    assert len({line["error"] for line in fields}) == len(fields)


def test_reasons_of_all_endpoints_are_logged_and_passed_on(caplog, monkeypatch):
    monkeypatch.setattr(session, "RETRY_S", (0.0,))
    monkeypatch.setattr(session, "OPEN_TIMEOUT_MS", (50,))
    endpoints = [f"tcp/127.0.0.1:{free_port()}", "nonsense"]
    stop, reasons = threading.Event(), []

    def on_failure(reason):
        reasons.append(reason)
        if len(reasons) == 4:
            stop.set()

    assert open_with_retry(endpoints, stop, None, on_failure) is None
    expected = [
        f"no connection: {endpoints[0]}: Connection refused",
        "no reply: nonsense is not tcp/HOST:PORT or tls/HOST:PORT",
    ]
    assert reasons == expected * 2
    assert [vars(record)["fields"]["error"] for record in caplog.records] == expected


def test_reason_of_a_lost_router_is_found_until_it_is_back():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    hub = zenoh.open(router_config([endpoint]))
    opened = open_with_retry([endpoint], threading.Event())
    try:
        assert lost_reason(opened) == ""
        hub.close()
        eventually(lambda: lost_reason(opened) == f"no connection: {endpoint}: Connection refused")
        hub = zenoh.open(router_config([endpoint]))
        eventually(lambda: lost_reason(opened) == "")
    finally:
        opened.close()
        hub.close()


def test_stop_ends_the_wait_between_attempts(monkeypatch, caplog):
    monkeypatch.setattr(session, "RETRY_S", (1e6,))
    stop = threading.Event()
    with ThreadPoolExecutor(1) as pool, ExitStack() as stack:
        stack.callback(stop.set)
        opened = pool.submit(open_with_retry, ["tcp/127.0.0.1:1"], stop)
        eventually(lambda: "Zenoh router not reached; retrying" in caplog.text)
        stop.set()
        assert opened.result() is None


def test_no_attempt_after_a_stop(monkeypatch):
    def no_open(_):
        raise AssertionError("tried")

    monkeypatch.setattr(zenoh, "open", no_open)
    stop = threading.Event()
    stop.set()
    assert open_with_retry(["tcp/127.0.0.1:1"], stop) is None


def test_linked_routers_forward_publications(router):
    far_endpoint = f"tcp/127.0.0.1:{free_port()}"
    far = zenoh.open(router_config([far_endpoint], [router]))
    here, there = zenoh.open(client_config([router])), zenoh.open(client_config([far_endpoint]))
    got = []
    there.declare_subscriber("a/b", lambda sample: got.append(sample.payload.to_bytes()))
    publisher = here.declare_publisher("a/b")
    try:
        eventually(lambda: publisher.matching_status.matching)
        publisher.put(b"x")
        eventually(lambda: got == [b"x"])
    finally:
        for opened in (here, there, far):
            opened.close()
