"""The whole chain in real processes: exactly-once delivery across killed processes and cut connections."""

from __future__ import annotations

import json
import time
from collections.abc import Callable

import pytest
from builders.chain import IMAGES, RunningChain, latest_versions
from builders.faulty_link import FaultyLink

from sonarpost.cli.demo.outcome import read_channel_log, read_images
from sonarpost.cli.demo.settings import PLATFORM_OF, free_ports

pytestmark = pytest.mark.chain

StartChain = Callable[..., RunningChain]


def assert_delivered_exactly_once(run: RunningChain) -> None:
    """Check that every encoded image is at the vessel and the shore site, complete, identical, and once."""
    run.assert_delivered_once()
    result = run.outcome()
    assert len(run.watcher.encoded) == result.images_complete == run.deposited
    assert result.sha256_match
    assert {i.contact.contact_id for i in run.watcher.encoded.values()} == set(run.watcher.snippets)


@pytest.mark.parametrize("rate", [0, *(pytest.param(rate, marks=pytest.mark.system) for rate in (1, 4)), 5])
def test_images_arrive_at_every_rate_of_the_papers_table(start_chain: StartChain, rate: int) -> None:
    run = start_chain(rate=rate)
    run.deposit(3)
    run.until(lambda: len(run.watcher.shore) == 3, 60, "three images at the shore site")
    run.until_idle()
    assert_delivered_exactly_once(run)


@pytest.mark.parametrize("service", [s for s in PLATFORM_OF if s not in ("op_modem", "acoustic_channel")])
def test_killed_service_neither_loses_nor_duplicates_images(start_chain: StartChain, service: str) -> None:
    run = start_chain()
    run.deposit()
    run.until(lambda: len(run.watcher.shore) >= 1, 60, "first image at the shore site")
    run.kill(service)
    if service == "atd_stub":
        run.deposit(2)  # found when the service runs again
    time.sleep(1.0)
    run.chain.start(service)
    run.until(lambda: len(run.watcher.shore) == run.deposited, 60, "all images at the shore site")
    run.until_idle()
    assert_delivered_exactly_once(run)


@pytest.mark.parametrize("service", ["op_modem", "acoustic_channel"])
def test_received_images_arrive_when_the_vessels_modem_side_is_killed(start_chain: StartChain, service: str) -> None:
    run = start_chain()
    run.deposit(4)
    run.until(lambda: len(run.watcher.shore) >= 1, 60, "first image at the shore site")
    run.kill(service)
    time.sleep(1.0)
    restarted_utc_s = time.time()
    run.chain.start(service)
    for modem in ("uuv_modem", "op_modem"):
        run.until(lambda modem=modem: modem_is_ready_since(run, modem, restarted_utc_s), 60, f"{modem} ready again")
    before = set(run.watcher.encoded)
    run.deposit(3)
    run.until(lambda: len(run.watcher.encoded) == 7, 60, "all images encoded")
    later = set(run.watcher.encoded) - before
    run.until(lambda: later <= set(run.watcher.shore), 90, "the later images at the shore site")
    run.until_idle()
    vessel, shore = latest_versions(run.settings.vessel_images), latest_versions(run.settings.shore_images)
    # Signals and unread bytes on a serial line are lost. What op_modem accepted is at the shore site, once. The relay
    # replaces a version that it has not sent yet by the next one.
    assert {p.name: p.sha256 for p in vessel} == {p.name: p.sha256 for p in shore}
    stored = {p.image_id for p in shore}
    assert run.watcher.images_received == stored
    # A frame is published after its commit, so a kill between the two hides it from the watcher only.
    assert run.watcher.images_with_frames <= stored
    assert later <= {p.image_id for p in shore if p.complete}


def modem_is_ready_since(run: RunningChain, service: str, since_utc_s: float) -> bool:
    health = run.watcher.health[service]
    return health.time_utc_s > since_utc_s and health.state == "ok" and health.gauges["modem_ready"] == 1.0


def test_connection_cut_for_ten_seconds_loses_nothing(start_chain: StartChain) -> None:
    ports = free_ports(3)
    link = FaultyLink(ports[2])
    try:
        run = start_chain(router_ports=ports, shore_port_for_vessel=link.port)
        run.deposit()
        run.until(lambda: len(run.watcher.shore) >= 1, 60, "first image at the shore site")
        link.cut()
        run.history.fault("link", "cut for 10 s")
        time.sleep(10.0)
        arrived_before_repair = len(run.watcher.shore)
        assert len(run.watcher.vessel) == IMAGES
        assert arrived_before_repair < IMAGES
        link.mend()
        run.until(lambda: len(run.watcher.shore) == IMAGES, 60, "all images at the shore site")
        run.until_idle()
        assert_delivered_exactly_once(run)
    finally:
        link.close()


def test_lost_frames_are_shown_as_missing_exactly_where_the_channel_lost_them(start_chain: StartChain) -> None:
    run = start_chain(rate=4, loss=0.3, seed=7)
    run.deposit(8)
    run.until(lambda: run.watcher.packets_sent >= 16, 90, "all packets sent")
    run.until_idle()
    channel = read_channel_log(run.settings.channel_log)
    assert channel.frames_lost > 0
    sidecars = [json.loads(p.read_text()) for p in sorted(run.settings.shore_images.glob("*.json"))]
    latest = {s["image_id"]: s for s in sorted(sidecars, key=lambda s: int(s["version"]))}
    # At rate 4 a half is one frame, so a lost frame is a missing half.
    for image_id in run.watcher.encoded:
        delivered = {half for half in ("top", "bottom") if channel.delivered_frames[image_id, half]}
        if image_id not in channel.delivered_images:
            assert image_id not in latest
            continue
        missing = {"top", "bottom"} - delivered
        assert set(latest[image_id]["missing_halves"]) == missing
        assert latest[image_id]["complete"] == (not missing)
        assert latest[image_id]["missing_fraction"] == pytest.approx(len(missing) / 2)
        assert (latest[image_id]["contact"] is not None) == bool(channel.delivered_frames[image_id, "contact"])
    result = run.outcome()
    assert result.succeeded


def test_vessel_with_another_codebook_reports_it_and_writes_no_image(start_chain: StartChain) -> None:
    run = start_chain(rate=4, codebook="nominal-20", vessel_codebooks=("nominal-10",))
    run.deposit(2)
    run.until(lambda: run.watcher.packets_sent >= 4, 60, "all packets sent")
    run.until_idle()
    assert read_images(run.settings.vessel_images) == {}
    log = (run.settings.folder / "logs" / "decompressor.log").read_text()
    assert "Image cannot be decoded" in log
    assert "model_tag" in log
    health = run.watcher.health["decompressor"]
    assert health.counters["images_undecodable"] == 2
    assert health.gauges["refused"] == 2


def test_every_service_stops_cleanly_within_three_seconds(start_chain: StartChain) -> None:
    run = start_chain()
    run.deposit(2)
    run.until(lambda: len(run.watcher.shore) >= 1, 60, "first image at the shore site")
    for service in PLATFORM_OF:
        assert run.chain.terminate(service) < 3.0, service
        assert run.chain.status(service) == 0, run.chain.log_tail(service)
