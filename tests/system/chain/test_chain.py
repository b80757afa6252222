"""The whole chain in real processes: exactly-once delivery across killed processes and cut connections."""

import json
import time

import pytest
from builders.chain import latest_versions
from builders.common import free_port

from research.common.link_emulator import LinkEmulator
from sonarpost.extensions.simulation.demo.outcome import read_channel_log, read_images
from sonarpost.extensions.simulation.demo.settings import PLATFORM_OF

pytestmark = pytest.mark.chain

# Log line of each service for one contact; the first two have `contact_id`, the others `image_id`.
STEPS = {
    "atd_stub": "Contact detected",
    "compressor": "Image encoded",
    "uuv_modem": "Image sent",
    "op_modem": "Image received",
    "decompressor": "Image decoded",
    "relay": "Image queued for the shore",
    "c2": "Image stored",
}


def until_all_complete(run):
    """Wait until every deposited snippet is complete at the shore site and the chain is idle."""
    run.until(lambda: len(run.watcher.encoded) == run.deposited and run.watcher.all_complete, "complete images")
    run.until_idle()


def assert_delivered_exactly_once(run):
    """Check that every encoded image is at the vessel and the shore site, complete, identical, and once."""
    run.assert_delivered_once()
    result = run.outcome()
    assert len(run.watcher.encoded) == result.images_vessel == result.images_shore == run.deposited
    assert result.images_complete == run.deposited
    assert result.sha256_match
    assert result.succeeded
    assert {i.contact.contact_id for i in run.watcher.encoded.values()} == set(run.watcher.snippets)


@pytest.mark.quick
def test_images_cross_the_chain_and_every_service_stops_cleanly(start_chain):
    run = start_chain(link="v1")
    run.deposit(2)
    until_all_complete(run)
    assert_delivered_exactly_once(run)
    assert all(image.codec == "emb" and image.missing_fraction == 0.0 for image in run.watcher.shore.values())
    for service in PLATFORM_OF:
        assert run.terminate(service) == 0, run.chain.log_tail(service)


def test_killed_services_and_a_cut_connection_lose_and_duplicate_nothing(start_chain):
    ports = (free_port(), free_port(), free_port())
    link = LinkEmulator(ports[2])
    try:
        run = start_chain(link="v1", loss=0.3, router_ports=ports, shore_port_for_vessel=link.port)
        for service in PLATFORM_OF:
            before = len(run.watcher.shore)
            run.deposit(2)
            run.until(lambda before=before: len(run.watcher.shore) > before, "a preview at the shore site")
            run.kill(service)
            run.deposit(1)
            run.chain.start(service)
        until_all_complete(run)
        link.cut()
        run.history.fault("link", "cut")
        run.deposit(3)

        def wait_on_the_vessel():
            vessel = dict(run.watcher.vessel)
            return len(vessel) == run.deposited and all(image.complete for image in vessel.values())

        run.until(wait_on_the_vessel, "all images on the vessel")
        run.until(lambda: run.watcher.health["relay"].gauges["outbox"] >= 3, "images that wait for the shore site")
        link.mend()
        until_all_complete(run)
        assert run.outcome().frames_lost > 0
        assert_delivered_exactly_once(run)
    finally:
        link.close()


def test_received_images_arrive_with_the_papers_format_when_the_vessels_modem_side_is_killed(start_chain):
    run = start_chain()
    for service in ("op_modem", "acoustic_channel"):
        at_shore = len(run.watcher.shore)
        run.deposit(4)
        run.until(lambda at_shore=at_shore: len(run.watcher.shore) > at_shore, "first image at the shore site")
        run.kill(service)
        restarted_utc_s = time.time()
        run.chain.start(service)
        for modem in ("uuv_modem", "op_modem"):
            run.until(lambda m=modem, t=restarted_utc_s: modem_is_ready_since(run, m, t), f"{modem} ready again")
        before = set(run.watcher.encoded)
        run.deposit(3)
        run.until(lambda: len(run.watcher.encoded) == run.deposited, "all images encoded")
        later = set(run.watcher.encoded) - before
        run.until(lambda later=later: later <= set(run.watcher.shore), "the later images at the shore site")
        run.until_idle()
        vessel, shore = latest_versions(run.settings.vessel_images), latest_versions(run.settings.shore_images)
        # Signals and unread bytes on a serial line are lost. What op_modem accepted is at the shore site, once. The
        # relay replaces a version that it has not sent yet by the next one.
        assert {p.name: p.sha256 for p in vessel} == {p.name: p.sha256 for p in shore}
        stored = {p.image_id for p in shore}
        assert run.watcher.images_received == stored
        # A frame is published after its commit, so a kill between the two hides it from the watcher only.
        assert run.watcher.images_with_frames <= stored
        assert later <= {p.image_id for p in shore if p.complete}


def modem_is_ready_since(run, service, since_utc_s):
    health = run.watcher.health[service]
    return health.time_utc_s > since_utc_s and health.state == "ok" and health.gauges["modem_ready"] == 1.0


def test_contacts_at_rate_0_are_followed_in_the_logs_from_detection_to_the_shore(start_chain, monkeypatch):
    monkeypatch.setenv("SONARPOST_PLATFORM__LOG_FORMAT", "json")
    monkeypatch.setenv("SONARPOST_PLATFORM__LOG_LEVEL", "debug")
    run = start_chain(rate=0)
    run.deposit(2)
    until_all_complete(run)
    assert_delivered_exactly_once(run)
    texts = {service: (run.settings.folder / "logs" / f"{service}.log").read_text() for service in STEPS}
    lines = [json.loads(line) | {"file": service} for service, text in texts.items() for line in text.splitlines()]

    def services_with(**wanted):
        """Return the services that logged their line of `STEPS` with these fields."""
        found = [line for line in lines if wanted.items() <= line.items() and line["message"] == STEPS[line["file"]]]
        return {line["service"] for line in found}

    for contact_id in run.watcher.snippets:
        assert services_with(contact_id=contact_id) == {"atd_stub", "compressor", "uuv_modem"}
        [join] = (n for n in lines if n["message"] == STEPS["compressor"] and n["contact_id"] == contact_id)
        names = {"vehicle": join["vehicle"], "image_id": join["image_id"]}
        assert services_with(**names) == set(STEPS) - {"atd_stub"}


def test_lost_frames_are_shown_as_missing_exactly_where_the_channel_lost_them(start_chain):
    run = start_chain(rate=4, loss=0.3, seed=7)
    run.deposit(8)
    run.until(lambda: run.watcher.packets_sent >= 16, "all packets sent")
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
    assert run.outcome().succeeded


def test_vessel_with_another_codebook_reports_it_and_writes_no_image(start_chain):
    run = start_chain(
        rate=4,
        extra=(("compressor", 'codebook = "nominal-20"'), ("decompressor", 'codebooks = ["nominal-10"]')),
    )
    run.deposit(2)
    run.until(lambda: run.watcher.health["decompressor"].gauges["refused"] == 2, "both images refused")
    run.until_idle()
    assert read_images(run.settings.vessel_images) == {}
    log = (run.settings.folder / "logs" / "decompressor.log").read_text()
    assert "Image cannot be decoded" in log
    assert "model_tag" in log
    assert run.watcher.health["decompressor"].counters["images_undecodable"] == 2
