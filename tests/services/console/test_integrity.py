"""What the console states about the received data of an image: stage, air time, resolution, invented texture."""

import random

import pytest
from builders.console import FIRST_UTC_S, contact_id, image_record, partial_record

from research.common.images import simulated_images
from sonarpost.archive.decoder import Decoder
from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.link.config import SenderConfig
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.link.receiver import received_image
from sonarpost.modem.micromodem.rates import RATES
from sonarpost.review.resolution import detail_px, sharp_to_m

ID = contact_id()


def versions_of(console):
    return console.browser("watch").contact(ID)["versions"]


def test_v1_versions_name_their_bytes_and_stage(make_console):
    console = make_console(assumed_rate=1)
    for version, (received, complete) in enumerate([(30, False), (131, True), (200, False), (314, True)], 1):
        console.state.store_image(partial_record("00A7", version, received, complete=complete))
        [row] = console.browser("watch").rows().values()
        stage, percent = ("sent", 100.0) if complete else ("preview", None)
        assert (row["stage"], row["bytes_received"], row["percent_received"]) == (stage, received, percent)
        found = versions_of(console)[-1]
        assert [found[name] for name in ("stage", "bytes_received", "percent_received", "frames_received")] == [
            stage,
            received,
            percent,
            None,
        ]


def test_longer_stream_after_a_refine_request_is_refined(console):
    console.state.store_image(partial_record(received=314, complete=True))
    anna = console.browser("anna")
    assert anna.post(f"/api/contacts/{ID}/requests", {"kind": "refine"}).status_code == 201
    console.state.store_image(partial_record("00A7", 2, 629, complete=True))
    assert [one["stage"] for one in versions_of(console)] == ["sent", "refined"]
    assert anna.contact(ID)["contact"]["stage"] == "refined"


@pytest.mark.parametrize(
    ("rate", "record", "airtime_is", "airtime_s", "frames"),
    [
        # Frames of several images: a lower limit.
        (1, partial_record(received=96), "at_least", pytest.approx(96 / 192 * RATES[1].airtime_s), None),
        (1, image_record(), "estimated", RATES[1].airtime_s, 1),
        (None, partial_record(received=96), None, None, None),
    ],
)
def test_air_time_of_a_version(make_console, rate, record, airtime_is, airtime_s, frames):
    console = make_console(assumed_rate=rate)
    console.state.store_image(record)
    [version] = versions_of(console)
    found = version["airtime_is"], version["airtime_s"], version["frames_received"]
    assert found == (airtime_is, airtime_s, frames)


def test_detail_by_received_bytes():
    widths = [detail_px("emb", received, 80 * 140) for received in (24, 48, 131, 314, 629)]
    assert widths == sorted(widths, reverse=True)
    assert widths[2] == pytest.approx(3.53, abs=0.1)  # 0.0117 bytes a pixel, between rows of the table
    # In metres of the larger pixels: 40 x 60 px of 0.1 m x 0.05 m.
    assert sharp_to_m(image_record(total=100)) == pytest.approx(0.1 * detail_px("emb", 100, 2400))
    # Unknown for other codecs and sizes.
    assert detail_px("vq", 100, 2400) is None
    assert sharp_to_m(image_record(pixel_along_m=None)) is None


def test_codebook_texture_is_stated(console):
    for version, (codec, texture) in enumerate((("vq", "codebook"), ("emb", None)), 1):
        console.state.store_image(image_record(version=version).model_copy(update={"codec": codec}))
        found = versions_of(console)[-1]
        assert found["texture"] == texture
        assert "guessed_fraction" not in found


@pytest.mark.system
def test_versions_over_a_lossy_v1_link_state_true_values(make_console):
    """Sender, link with 30 % loss, receiver, decoder and console."""
    pixels = simulated_images(1).images[0].pixels
    stream = EmbCodec().encode(pixels, 630)
    draws = random.Random(4)
    console = make_console(assumed_rate=1)
    receiver = V1Receiver()
    config = SenderConfig(frame_bytes=64, feedback=True, stream_bytes=314, group_delay_s=0.0, max_defer_s=60.0)
    sender = V1Sender(config)
    sizes = {"height_px": 80, "width_px": 80, "pixel_along_m": 0.1, "pixel_across_m": 0.1}
    summary = ContactSummary(time_utc_s=FIRST_UTC_S, lat_deg=56.0, lon_deg=-5.0, **sizes)
    sender.add_image(7, summary, stream, FIRST_UTC_S)

    for second in range(0, 1500, 5):
        now = FIRST_UTC_S + second
        frame = sender.next_frame(now)
        if frame is not None and draws.random() > 0.3:
            for event in receiver.accept(3, frame, now):
                console.state.store_image(Decoder(()).decode(received_image(event, "vessel-1", "uuv-1")))
        if receiver.feedback_is_due(3, now) and (feedback := receiver.feedback(3, now)) is not None:
            sender.on_feedback(feedback, now)
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
