"""What the console states about the received data of an image: stage, air time, resolution, invented texture."""

from __future__ import annotations

import random

import pytest
from builders.console import FIRST_UTC_S, image_record

from research.common.images import simulated_images
from sonarpost.archive.decoder import Decoder
from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.link.config import SenderConfig
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.link.received_image import received_image
from sonarpost.modem.micromodem.rates import RATES
from sonarpost.review.resolution import detail_px, sharp_to_m

ID = "sonarpost.vessel-1.uuv-1.20231114T221320Z.00A7"


def v1_record(version, received, *, complete=False):
    """A version as the v1 link delivers it: no frames, and no length before the plan has arrived."""
    changes = {
        "complete": complete,
        "bytes_received": received,
        "bytes_total": received if complete else 0,
        "frames_received": 0,
    }
    return image_record(version=version).model_copy(update=changes)


def versions_of(console):
    return console.browser("watch").contact(ID)["versions"]


def test_v1_versions_name_their_bytes_and_stage(make_console):
    console = make_console(assumed_rate=1)
    for version, (received, complete) in enumerate([(30, False), (131, True), (200, False), (314, True)], 1):
        console.state.store_image(v1_record(version, received, complete=complete))
    versions = versions_of(console)
    assert [(one["stage"], one["bytes_received"]) for one in versions] == [
        ("preview", 30),
        ("sent", 131),
        ("preview", 200),
        ("sent", 314),
    ]
    assert [one["percent_received"] for one in versions] == [None, 100.0, None, 100.0]
    assert {one["frames_received"] for one in versions} == {None}
    [row] = console.browser("watch").get("/api/contacts").json()["items"]
    assert (row["stage"], row["percent_received"]) == ("sent", 100.0)


def test_row_of_a_preview_has_no_percentage(console):
    console.state.store_image(v1_record(1, 30))
    [row] = console.browser("watch").get("/api/contacts").json()["items"]
    assert (row["stage"], row["bytes_received"], row["percent_received"]) == ("preview", 30, None)


def test_longer_stream_after_a_refine_request_is_refined(console):
    console.state.store_image(v1_record(1, 314, complete=True))
    anna = console.browser("anna")
    assert anna.post(f"/api/contacts/{ID}/requests", {"kind": "refine"}).status_code == 201
    console.state.store_image(v1_record(2, 629, complete=True))
    assert [one["stage"] for one in versions_of(console)] == ["sent", "refined"]
    assert anna.contact(ID)["contact"]["stage"] == "refined"


def test_air_time_of_shared_frames_is_a_lower_limit(make_console):
    console = make_console(assumed_rate=1)
    console.state.store_image(v1_record(1, 96))
    [version] = versions_of(console)
    assert version["airtime_is"] == "at_least"
    assert version["airtime_s"] == pytest.approx(96 / 192 * RATES[1].airtime_s)


def test_air_time_of_counted_frames_is_an_estimate(make_console):
    console = make_console(assumed_rate=1)
    console.state.store_image(image_record())
    [version] = versions_of(console)
    assert (version["airtime_is"], version["airtime_s"], version["frames_received"]) == (
        "estimated",
        RATES[1].airtime_s,
        1,
    )


def test_air_time_is_unknown_without_a_rate(console):
    console.state.store_image(v1_record(1, 96))
    [version] = versions_of(console)
    assert (version["airtime_is"], version["airtime_s"]) == (None, None)


def test_more_bytes_resolve_smaller_detail():
    widths = [detail_px("emb", received, 80 * 140) for received in (24, 48, 131, 314, 629)]
    assert widths == sorted(widths, reverse=True)
    assert widths[2] == pytest.approx(3.05, abs=0.1)  # 0.0117 bytes a pixel, between rows of the table


def test_detail_is_in_metres_of_the_larger_pixels():
    record = image_record(total=100)  # 40 x 60 px of 0.1 m x 0.05 m
    assert sharp_to_m(record) == pytest.approx(0.1 * detail_px("emb", 100, 2400))


def test_resolution_of_other_codecs_is_unknown():
    assert detail_px("vq", 100, 2400) is None
    assert sharp_to_m(image_record(pixel_along_m=None)) is None


@pytest.mark.parametrize(("codec", "texture"), [("vq", "codebook"), ("emb", None)])
def test_codebook_texture_is_stated(codec, texture, console):
    console.state.store_image(image_record().model_copy(update={"codec": codec}))
    [version] = versions_of(console)
    assert version["texture"] == texture
    assert "guessed_fraction" not in version


def test_versions_over_a_lossy_v1_link_state_true_values(make_console):
    """Sender, link with 30 % loss, receiver, decoder and console."""
    pixels = simulated_images(1).images[0].pixels
    stream = EmbCodec().encode(pixels, 630)
    draws = random.Random(4)
    console = make_console(assumed_rate=1)
    receiver = V1Receiver()
    sender = V1Sender(
        SenderConfig(frame_bytes=64, feedback=True, stream_bytes=314, group_delay_s=0.0, max_defer_s=60.0)
    )
    summary = ContactSummary(
        height_px=80,
        width_px=80,
        time_utc_s=FIRST_UTC_S,
        pixel_along_m=0.1,
        pixel_across_m=0.1,
        lat_deg=56.0,
        lon_deg=-5.0,
    )
    sender.add_image(7, summary, stream, FIRST_UTC_S)

    def transmit(start_s, stop_s):
        for second in range(start_s, stop_s, 5):
            now = FIRST_UTC_S + second
            frame = sender.next_frame(now)
            if frame is not None and draws.random() > 0.3:
                for event in receiver.accept(3, frame, now):
                    record = received_image(event, "vessel-1", "uuv-1")
                    console.state.store_image(Decoder(()).decode(record))
            if receiver.feedback_is_due(3, now) and (feedback := receiver.feedback(3, now)) is not None:
                sender.on_feedback(feedback, now)

    transmit(0, 1500)
    [row] = console.browser("watch").get("/api/contacts").json()["items"]
    assert (row["stage"], row["bytes_received"] >= 314) == ("sent", True)
    versions = console.browser("watch").contact(row["id"])["versions"]
    for version in versions:
        assert version["percent_received"] == {"preview": None, "sent": 100.0}[version["stage"]]
        assert version["frames_received"] is None
        assert version["airtime_is"] == "at_least"
        assert version["airtime_s"] == pytest.approx(version["bytes_received"] / 192 * RATES[1].airtime_s)
    details = [one["sharp_to_m"] for one in versions]
    assert details == sorted(details, reverse=True)
