"""Metrics of a fleet, scraped over HTTP and parsed with Prometheus's parser."""

import os
import signal
import subprocess
import sys
import urllib.request

import pytest
from builders.common import eventually, free_port, running
from prometheus_client import generate_latest
from prometheus_client.openmetrics.exposition import generate_latest as openmetrics
from prometheus_client.openmetrics.parser import text_string_to_metric_families as parse_openmetrics
from prometheus_client.parser import text_string_to_metric_families

from sonarpost.extensions.metrics.command import MAX_VALUES, FleetCollector, registry_of
from sonarpost.messages import Health
from sonarpost.monitoring.fleet import FleetState, ServiceStatus
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service

Samples = dict[tuple[str, ...], float]


def samples(text):
    """Values by name and label values; a duplicate series is an error."""
    found = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            key = (
                sample.name,
                *(sample.labels[label] for label in ("platform", "service", "state") if label in sample.labels),
            )
            assert key not in found
            found[key] = sample.value
    return found


def health(service="op_modem", **changes):
    fields = {"counters": {"frames_received": 7}, "gauges": {"inbox": 2.0, "snr_in_db": -1.5}}
    record = {"platform_id": "vessel-1", "service": service, "time_utc_s": 20.0, "started_utc_s": 10.0, "state": "ok"}
    return Health(**(record | fields | changes))


def scraped(*services, connected=True, rejected=0):
    registry = registry_of(FleetCollector(lambda: FleetState(services, connected, rejected), stale_after_s=30.0))
    text = openmetrics(registry).decode()
    assert len(list(parse_openmetrics(text))) > 0  # strict about names, types and order
    return samples(generate_latest(registry).decode())


def test_metrics_of_a_service():
    found = scraped(ServiceStatus("vessel-1", "op_modem", health(), 1.5, True), rejected=3)
    who = ("vessel-1", "op_modem")
    assert found["sonarpost_up", *who] == 1
    assert found["sonarpost_frames_received_total", *who] == 7
    assert found["sonarpost_inbox", *who] == 2
    assert found["sonarpost_snr_in_db", *who] == -1.5
    assert found["sonarpost_health_age_seconds", *who] == 1.5
    assert found["sonarpost_started_time_seconds", *who] == 10
    assert found["sonarpost_health_time_seconds", *who] == 20
    assert {state: found["sonarpost_state", *who, state] for state in ("starting", "ok", "degraded", "stopping")} == {
        "starting": 0,
        "ok": 1,
        "degraded": 0,
        "stopping": 0,
    }
    assert found["sonarpost_exporter_router_connected",] == 1
    assert found["sonarpost_exporter_records_rejected_total",] == 3


def test_stale_values_are_omitted_except_those_for_alerts():
    found = scraped(ServiceStatus("vessel-1", "op_modem", health(), 30.1, False))
    assert {name for name, *who in found if who} == {"sonarpost_up", "sonarpost_health_age_seconds"}
    assert found["sonarpost_up", "vessel-1", "op_modem"] == 0


def test_no_liveliness_metric_without_a_router():
    found = scraped(ServiceStatus("vessel-1", "op_modem", health(), 1.0, None), connected=False)
    assert found["sonarpost_exporter_router_connected",] == 0
    assert not [name for name, *_ in found if name == "sonarpost_up"]


def test_invalid_and_excess_names_are_omitted():
    hostile = {"a b": 1, 'x{y="z"}': 1, "": 1, "A": 1, "up": 1, "x_total": 1, "n\n# TYPE": 1, "fine": 1}
    many = {f"gauge_{n:04}": 1.0 for n in range(1000)} | {"fine": 2.0}
    found = scraped(ServiceStatus("vessel-1", "op_modem", health(counters=hostile, gauges=many), 1.0, True))
    assert found["sonarpost_fine_total", "vessel-1", "op_modem"] == 1
    assert ("sonarpost_fine", "vessel-1", "op_modem") not in found  # one name is one metric
    assert len(found) < MAX_VALUES + 20


@pytest.fixture
def exporter(router):
    """Address of `sonarpost metrics`, run as a process."""
    port = free_port()
    command = [sys.executable, "-m", "sonarpost.cli.main", "metrics", "--router", router, "--port", str(port)]
    with subprocess.Popen([*command, "--stale-after", "1"], stderr=subprocess.PIPE, env=os.environ) as process:
        yield f"http://127.0.0.1:{port}/metrics"
        process.send_signal(signal.SIGTERM)
        assert process.wait(120) == 0


def scrape(url):
    try:
        with urllib.request.urlopen(url, timeout=120) as reply:
            return samples(reply.read().decode())
    except OSError:  # not started yet
        return {}


def test_running_service_is_scraped_and_its_series_end_with_it(exporter, platform, tmp_path):
    with running(C2Service(platform("shore-1"), C2Config(out_dir=platform("shore-1").state_dir / "out"))) as service:
        who = ("shore-1", "c2")
        eventually(
            lambda: ("sonarpost_inbox", *who) in (found := scrape(exporter)) and found["sonarpost_up", *who] == 1
        )
        service.count("images_stored", 5)
        eventually(lambda: scrape(exporter).get(("sonarpost_images_stored_total", *who)) == 5)
    eventually(lambda: ("sonarpost_inbox", *who) not in scrape(exporter), what="the end of stale series")
    assert scrape(exporter)["sonarpost_up", *who] == 0


@pytest.mark.system
def test_port_in_use_is_reported_in_one_line(exporter, router):
    eventually(lambda: scrape(exporter) != {})
    port = exporter.rpartition(":")[2].removesuffix("/metrics")
    command = [sys.executable, "-m", "sonarpost.cli.main", "metrics", "--router", router, "--port", port]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith(f"sonarpost: 127.0.0.1:{port}: ")
    assert done.stderr.count("\n") == 1
