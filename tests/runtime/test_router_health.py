"""Health of a service whose router is not reached: why, before the first connection and after a loss."""

import time
from concurrent.futures import ThreadPoolExecutor

import zenoh
from builders.common import eventually, free_port

from sonarpost.bus.session import router_config
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.monitoring.healthcheck import health_problem
from sonarpost.monitoring.heartbeat import VARIABLE
from sonarpost.runtime.service import Service


class Idle(Service[ServiceConfig]):
    """The base class alone."""

    NAME = "compressor"

    def handle(self, key, record, effects):
        raise NotImplementedError


def test_reason_is_in_the_health_of_a_service_until_its_router_is_reached(tmp_path, monkeypatch):
    heartbeat = tmp_path / "heartbeat"
    monkeypatch.setenv(VARIABLE, str(heartbeat))
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    reason = f"router not reached: no connection: {endpoint}: Connection refused"
    values = {"id": "vessel-1", "router": (endpoint,), "state_dir": tmp_path / "state", "health_interval_s": 0.1}
    service = Idle(PlatformConfig(**values, acoustic_auth="none"), ServiceConfig())
    hub = None
    with ThreadPoolExecutor(1) as pool:
        started = pool.submit(service.start)
        try:
            eventually(heartbeat.exists)
            assert health_problem(heartbeat, time.monotonic()) == f"degraded: {reason}"
            hub = zenoh.open(router_config([endpoint]))
            assert started.result()
            for _ in range(2):
                eventually(lambda: (service.health().state, service.health().detail) == ("ok", ""))
                hub.close()
                eventually(lambda: service.health().detail == reason)
                eventually(lambda: health_problem(heartbeat, time.monotonic()) == "")
                hub = zenoh.open(router_config([endpoint]))
        finally:
            service.stop()
            if hub is not None:
                hub.close()
