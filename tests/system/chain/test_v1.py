"""The chain with v1 in real processes: complete images over a lossy channel, and commands to the vehicle."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import pytest
import zenoh
from builders.chain import RunningChain

from sonarpost import keys, wire
from sonarpost.bus.session import open_with_retry
from sonarpost.cli.demo.settings import STREAM_BYTES, UUV, VESSEL
from sonarpost.messages import Command
from sonarpost.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.sonar.xtf_writer import write_xtf

pytestmark = pytest.mark.chain

StartChain = Callable[..., RunningChain]
IMAGES = 6


def all_complete(run: RunningChain) -> bool:
    """Whether every snippet was encoded and is complete at the shore site."""
    encoded = run.watcher.encoded
    return len(encoded) == IMAGES and all(i in run.watcher.shore and run.watcher.shore[i].complete for i in encoded)


@pytest.mark.parametrize(
    "killed",
    [pytest.param(None, marks=pytest.mark.system), "op_modem", pytest.param("uuv_modem", marks=pytest.mark.system)],
)
def test_every_image_is_complete_with_a_third_of_the_frames_lost(start_chain: StartChain, killed: str | None) -> None:
    run = start_chain(link="v1", loss=0.3)
    run.deposit(IMAGES)
    if killed is not None:
        run.until(lambda: len(run.watcher.shore) >= 1, 60, "first preview at the shore site")
        run.kill(killed)
        run.chain.start(killed)
    run.until(lambda: len(run.watcher.shore) == IMAGES, 60, "every preview at the shore site")
    run.until(lambda: all_complete(run), 120, "every image at the shore site")
    run.until_idle()
    run.assert_delivered_once()
    result = run.outcome()
    assert result.frames_lost > 0
    assert result.images_vessel == result.images_shore == result.images_complete == IMAGES
    assert result.sha256_match
    assert result.succeeded
    assert all(image.codec == "emb" and image.missing_fraction == 0.0 for image in run.watcher.shore.values())


@pytest.fixture
def send_command():
    """Publishes a command as a program without an outbox does."""
    sessions: list[zenoh.Session] = []

    def send(run: RunningChain, kind: str, image_id: str) -> None:
        if not sessions:
            session = open_with_retry([f"tcp/127.0.0.1:{run.settings.router_ports[1]}"], threading.Event())
            assert session is not None
            sessions.append(session)
        key = keys.command(VESSEL, kind)
        record = Command(
            command_id=f"{kind}-{time.time_ns()}",
            kind=kind,
            vehicle_id=UUV,
            image_id=image_id,
            issued_by="test",
            issued_utc_s=time.time(),
        )
        publisher = sessions[0].declare_publisher(key)
        run.until(lambda: publisher.matching_status.matching, 20, f"subscriber of {key}")
        publisher.put(wire.encode(record), encoding=wire.encoding_of(Command))
        publisher.undeclare()

    yield send
    for session in sessions:
        session.close()


@pytest.mark.system
def test_refine_command_extends_an_image_from_uuv_modem_then_from_the_compressor(
    start_chain: StartChain, send_command: Callable[[RunningChain, str, str], None]
) -> None:
    held = 700
    run = start_chain(link="v1", loss=0.1, extra=(("compressor", f"refine_bytes = {held}"),))
    begun = STREAM_BYTES
    run.deposit(1)
    run.until(lambda: len(run.watcher.encoded) == 1, 60, "the image encoded")
    [image_id] = run.watcher.encoded
    assert len(run.watcher.encoded[image_id].stream) > 0.9 * held

    def has(least: int, most: int) -> bool:
        image = run.watcher.shore.get(image_id)
        return image is not None and image.complete and least <= image.bytes_received <= most

    # Without a command: the planned bytes, and what fills the last frame.
    run.until(lambda: has(begun, begun + 64), 60, "bytes without a command")
    send_command(run, "refine", image_id)
    run.until(lambda: has(held - 16, held), 60, "all bytes of uuv_modem")
    send_command(run, "refine", image_id)
    run.until(lambda: has(int(1.9 * held), 2 * held + 2), 60, "the stream extended by the compressor")


@pytest.mark.system
def test_expand_command_sends_an_image_of_twice_the_ground(
    start_chain: StartChain, send_command: Callable[[RunningChain, str, str], None]
) -> None:
    run = start_chain(link="v1", loss=0.1, mode="survey")
    survey = simulate_survey(SurveySpec(seed=1, pings=400, samples=1024, clutter=0)).survey
    hidden = run.settings.incoming / ".line.xtf"
    write_xtf(survey, hidden)
    hidden.rename(run.settings.incoming / "line.xtf")
    shore = run.watcher.shore
    run.until(lambda: any(image.complete for image in shore.values()), 120, "an image at the shore site")
    run.until_idle()
    before = set(shore)
    first = next(image for image in shore.values() if image.complete)
    send_command(run, "wider", first.image_id)
    run.until(lambda: any(i not in before and shore[i].complete for i in shore), 120, "the wider image received")
    (wide_id,) = set(shore) - before
    near, wide = run.watcher.encoded[first.image_id].contact, run.watcher.encoded[wide_id].contact
    assert wide.contact_id == near.contact_id
    assert wide.pixel_across_m == 2 * (near.pixel_across_m or 0.0) > 0
    # The acoustic contact record has size steps of 2.5 %.
    received = shore[wide_id].contact
    assert received is not None
    assert received.pixel_across_m == pytest.approx(wide.pixel_across_m, rel=0.03)
    assert (received.lat_deg, received.lon_deg) == pytest.approx((near.lat_deg, near.lon_deg), abs=1e-6)
