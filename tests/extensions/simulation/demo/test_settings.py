"""Ports of the demo."""

import socket
from itertools import islice

from builders.common import PORTS, free_port, worker_ports

from sonarpost.extensions.simulation.demo.settings import reserved_ports


def test_free_port_is_reserved_and_can_be_listened_on():
    wanted = free_port()
    with reserved_ports(wanted) as (port,), socket.socket() as listener:
        assert port == wanted
        listener.bind(("127.0.0.1", port))
        # Another demo, while this one runs and before its router listens.
        with reserved_ports(wanted) as (other,):
            assert other > wanted
    with reserved_ports(wanted) as (again,):
        assert again == wanted


def test_port_of_another_program_is_skipped():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        taken = listener.getsockname()[1]
        with reserved_ports(taken, taken) as ports:
            assert len({taken, *ports}) == 3
            assert all(port > taken for port in ports)


def test_workers_of_the_tests_use_different_ports(monkeypatch):
    monkeypatch.setenv("PYTEST_XDIST_WORKER_COUNT", "3")
    found = []
    for worker in ("gw0", "gw1", "gw2"):
        monkeypatch.setenv("PYTEST_XDIST_WORKER", worker)
        found += islice(worker_ports(), len(PORTS) // 3)
    assert len(found) == len(set(found))
