"""Commands to the vehicle with v1, in real processes."""

import threading
import time

import pytest

from sonarpost import keys, wire
from sonarpost.bus.session import open_with_retry
from sonarpost.extensions.simulation.demo.settings import STREAM_BYTES, UUV, VESSEL
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.xtf_writer import write_xtf
from sonarpost.messages import Command

pytestmark = pytest.mark.chain


def send_command(run, kind, image_id):
    """Publish a command as a program without an outbox does."""
    session = open_with_retry([f"tcp/127.0.0.1:{run.settings.router_ports[1]}"], threading.Event())
    with session:
        command_id, now_utc_s = f"{kind}-{time.time_ns()}", time.time()
        record = Command(
            command_id=command_id,
            kind=kind,
            vehicle_id=UUV,
            image_id=image_id,
            issued_by="test",
            issued_utc_s=now_utc_s,
        )
        key = keys.command(VESSEL, kind)
        publisher = session.declare_publisher(key)
        run.until(lambda: publisher.matching_status.matching, f"subscriber of {key}")
        publisher.put(wire.encode(record), encoding=wire.encoding_of(Command))
        publisher.undeclare()


def test_refine_command_extends_an_image_from_uuv_modem_then_from_the_compressor(start_chain):
    held = 700
    run = start_chain(link="v1", loss=0.1, extra=(("compressor", f"refine_bytes = {held}"),))
    run.deposit(1)
    run.until(lambda: len(run.watcher.encoded) == 1, "the image encoded")
    [image_id] = run.watcher.encoded
    assert len(run.watcher.encoded[image_id].stream) > 0.9 * held

    def has(least, most):
        image = run.watcher.shore.get(image_id)
        return image is not None and image.complete and least <= image.bytes_received <= most

    # Without a command: the planned bytes, and what fills the last frame.
    run.until(lambda: has(STREAM_BYTES, STREAM_BYTES + 64), "bytes without a command")
    send_command(run, "refine", image_id)
    run.until(lambda: has(held - 16, held), "all bytes of uuv_modem")
    send_command(run, "refine", image_id)
    run.until(lambda: has(int(1.9 * held), 2 * held + 2), "the stream extended by the compressor")


def test_expand_command_sends_an_image_of_twice_the_ground(start_chain):
    run = start_chain(link="v1", loss=0.1, mode="survey")
    hidden = run.settings.incoming / ".line.xtf"
    write_xtf(simulate_survey(SurveySpec(seed=1, pings=400, samples=1024, clutter=0)).survey, hidden)
    hidden.rename(run.settings.incoming / "line.xtf")
    shore = run.watcher.shore
    run.until(lambda: any(image.complete for image in list(shore.values())), "an image at the shore site")
    run.until_idle()
    before = set(shore)
    first = next(image for image in shore.values() if image.complete)
    send_command(run, "expand", first.image_id)
    run.until(lambda: any(i not in before and shore[i].complete for i in list(shore)), "the expanded image received")
    (wide_id,) = set(shore) - before
    near, wide = run.watcher.encoded[first.image_id].contact, run.watcher.encoded[wide_id].contact
    assert wide.contact_id == near.contact_id
    assert wide.pixel_across_m == 2 * (near.pixel_across_m or 0.0) > 0
    # The acoustic contact record has size steps of 2.5 %.
    received = shore[wide_id].contact
    assert received is not None
    assert received.pixel_across_m == pytest.approx(wide.pixel_across_m, rel=0.03)
    assert (received.lat_deg, received.lon_deg) == pytest.approx((near.lat_deg, near.lon_deg), abs=1e-6)
