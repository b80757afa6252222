"""The whole chain in real processes: what is accepted arrives ashore, once, whatever is killed or cut."""

from __future__ import annotations

import json
import time
from collections.abc import Callable

import pytest
from builders.chain import PICTURES, RunningChain
from builders.faulty_link import FaultyLink

from sonarpost.cli.demo.account import read_channel_log, read_pictures, settle
from sonarpost.cli.demo.settings import PLATFORM_OF, free_ports

pytestmark = pytest.mark.chain

StartChain = Callable[..., RunningChain]


def assert_everything_ashore_once(run: RunningChain) -> None:
    """All that the vehicle encoded is on the vessel and ashore, complete, the same, and once."""
    result = settle(run.settings, run.deposited, 0.0)
    shore = read_pictures(run.settings.shore_pictures)
    assert len(run.watcher.encoded) == run.deposited
    assert sorted(p.image_id for p in shore.values()) == sorted(run.watcher.encoded)
    assert result.images_complete == run.deposited
    assert result.images_vessel == result.images_shore == run.deposited
    assert result.sha256_match
    assert {i.contact.contact_id for i in run.watcher.encoded.values()} == set(run.watcher.snippets)


@pytest.mark.parametrize("rate", [0, 1, 4, 5])
def test_every_rate_of_the_papers_table_carries_pictures_ashore(start_chain: StartChain, rate: int) -> None:
    run = start_chain(rate=rate)
    run.deposit(3)
    run.until(lambda: len(run.watcher.shore) == 3, 60, "three pictures ashore")
    run.until_idle()
    assert_everything_ashore_once(run)


@pytest.mark.parametrize("service", [s for s in PLATFORM_OF if s not in ("op_modem", "acoustic_channel")])
def test_a_killed_service_loses_and_doubles_nothing(start_chain: StartChain, service: str) -> None:
    run = start_chain()
    run.deposit()
    run.until(lambda: len(run.watcher.shore) >= 1, 60, "first picture ashore")
    run.chain.kill(service)
    if service == "atd_stub":
        run.deposit(2)  # what comes while it is dead is found when it is back
    time.sleep(1.0)
    run.chain.start(service)
    run.until(lambda: len(run.watcher.shore) == run.deposited, 60, "all pictures ashore")
    run.until_idle()
    assert_everything_ashore_once(run)


@pytest.mark.parametrize("service", ["op_modem", "acoustic_channel"])
def test_when_the_modem_side_is_killed_all_that_was_received_is_ashore(start_chain: StartChain, service: str) -> None:
    run = start_chain()
    run.deposit(4)
    run.until(lambda: len(run.watcher.shore) >= 1, 60, "first picture ashore")
    run.chain.kill(service)
    time.sleep(1.0)
    restarted_utc_s = time.time()
    run.chain.start(service)
    for modem in ("uuv_modem", "op_modem"):
        run.until(lambda modem=modem: modem_is_ready_since(run, modem, restarted_utc_s), 60, f"{modem} ready again")
    before = set(run.watcher.encoded)
    run.deposit(3)
    run.until(lambda: len(run.watcher.encoded) == 7, 60, "all pictures encoded")
    later = set(run.watcher.encoded) - before
    run.until(lambda: later <= set(run.watcher.shore), 90, "the later pictures ashore")
    run.until_idle()
    vessel, shore = read_pictures(run.settings.vessel_pictures), read_pictures(run.settings.shore_pictures)
    # Sound, and bytes on a serial line that nobody read, are gone; whatever op_modem accepted is ashore, and once.
    assert {n: p.sha256 for n, p in vessel.items()} == {n: p.sha256 for n, p in shore.items()}
    assert run.watcher.accepted == {p.image_id for p in shore.values()}
    assert later <= {p.image_id for p in shore.values() if p.complete}


def modem_is_ready_since(run: RunningChain, service: str, since_utc_s: float) -> bool:
    health = run.watcher.health[service]
    return health.time_utc_s > since_utc_s and health.state == "ok" and health.gauges["modem_ready"] == 1.0


def test_a_link_cut_for_ten_seconds_loses_nothing(start_chain: StartChain) -> None:
    ports = free_ports(3)
    link = FaultyLink(ports[2])
    try:
        run = start_chain(router_ports=ports, shore_port_for_vessel=link.port)
        run.deposit()
        run.until(lambda: len(run.watcher.shore) >= 1, 60, "first picture ashore")
        link.cut()
        time.sleep(10.0)
        ashore_when_mended = len(run.watcher.shore)
        assert len(run.watcher.vessel) == PICTURES
        assert ashore_when_mended < PICTURES
        link.mend()
        run.until(lambda: len(run.watcher.shore) == PICTURES, 60, "all pictures ashore")
        run.until_idle()
        assert_everything_ashore_once(run)
    finally:
        link.close()


def test_lost_frames_are_shown_as_missing_exactly_where_the_channel_lost_them(start_chain: StartChain) -> None:
    run = start_chain(rate=4, loss=0.3, seed=7)
    run.deposit(8)
    run.until(lambda: run.watcher.packets_sent >= 16, 90, "all packets sent")
    run.until_idle()
    channel = read_channel_log(run.settings.channel_log)
    assert channel.frames_lost > 0
    sidecars = [json.loads(p.read_text()) for p in sorted(run.settings.shore_pictures.glob("*.json"))]
    latest = {s["image_id"]: s for s in sorted(sidecars, key=lambda s: int(s["version"]))}
    # At rate 4 a half is one frame, so a lost frame is a missing half.
    for image_id in run.watcher.encoded:
        through = {half for half in ("top", "bottom") if channel.frames_through[image_id, half]}
        if image_id not in channel.images_through:
            assert image_id not in latest
            continue
        missing = {"top", "bottom"} - through
        assert set(latest[image_id]["missing_halves"]) == missing
        assert latest[image_id]["complete"] == (not missing)
        assert latest[image_id]["missing_fraction"] == pytest.approx(len(missing) / 2)
        assert (latest[image_id]["contact"] is not None) == bool(channel.frames_through[image_id, "contact"])
    result = settle(run.settings, 8, 0.0)
    assert result.missing_ashore == ()
    assert result.sha256_match


def test_a_vessel_with_another_codebook_says_so_and_shows_no_wrong_picture(start_chain: StartChain) -> None:
    run = start_chain(rate=4, codebook="nominal-20", vessel_codebooks=("nominal-10",))
    run.deposit(2)
    run.until(lambda: run.watcher.packets_sent >= 4, 60, "all packets sent")
    run.until_idle()
    assert read_pictures(run.settings.vessel_pictures) == {}
    log = (run.settings.folder / "logs" / "decompressor.log").read_text()
    assert "Image cannot be decoded" in log
    assert "model_tag" in log
    health = run.watcher.health["decompressor"]
    assert health.counters["images_undecodable"] == 2
    assert health.gauges["refused"] == 2


def test_every_service_stops_cleanly_within_three_seconds(start_chain: StartChain) -> None:
    run = start_chain()
    run.deposit(2)
    run.until(lambda: len(run.watcher.shore) >= 1, 60, "first picture ashore")
    for service in PLATFORM_OF:
        assert run.chain.terminate(service) < 3.0, service
        assert run.chain.status(service) == 0, run.chain.log_tail(service)
