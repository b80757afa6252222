"""decompressor with v1: pictures that refine, honest about what is there, beside vehicles with the paper's format."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from builders.common import eventually

from sonarpost import keys
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.codec.vq.codebook import open_codebook
from sonarpost.errors import ConfigError
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import Direction
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.config import SenderConfig
from sonarpost.link.downlink.messages import image_of_number
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.sender import plan_packets
from sonarpost.link.frames.v1.frame import Segment, SegmentKind, pack_segments
from sonarpost.link.frames.v1.payload_objects import ENTRY_HEAD_BYTES, Preview
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.messages import AcousticFrame, ReconstructedImage
from sonarpost.runtime.service import UnitOfWork
from sonarpost.security.acoustic_key import read_key
from sonarpost.services.decompressor.config import DecompressorConfig
from sonarpost.services.decompressor.service import DecompressorService

IN, OUT = keys.acoustic_rx("vessel-1"), keys.image_reconstructed("vessel-1")
CONTACT = ContactSummary(height_px=40, width_px=60, lat_deg=56.4, lon_deg=-5.6, time_utc_s=1_475_568_000.0)
LOSS_30 = SenderConfig(frame_bytes=64, channels=(LossChannel(0.3),), frames_per_image=6)


@pytest.fixture(scope="session")
def emb():
    return default_registry().create("emb", CodecResources())


@pytest.fixture(scope="session")
def streams(emb, texture):
    return [emb.encode(texture(seed=seed), 192) for seed in range(8)]


@pytest.fixture
def begin(runner, platform, tmp_path):
    def start(*, key_file=None, **options):
        usual = {"out_dir": tmp_path / "out", "vehicles": {"3": "uuv-1"}, "pairing_timeout_s": 0.3}
        there = platform("vessel-1").model_copy(update={"acoustic_key_file": key_file})
        return runner.start(DecompressorService(there, DecompressorConfig(**(usual | options))))

    return start


@pytest.fixture
def relay(runner):
    return runner.peer("vessel-1", "relay", {OUT: ReconstructedImage})


@pytest.fixture
def modem(runner):
    return runner.peer("vessel-1", "op_modem")


def frame(data, source=3, at_utc_s=None):
    return AcousticFrame(
        direction="rx",
        platform_id="vessel-1",
        time_utc_s=time.time() if at_utc_s is None else at_utc_s,
        source=source,
        destination=1,
        rate=1,
        packet=1,
        frame_number=1,
        frame_count=1,
        data=data,
    )


def sent(streams, config=LOSS_30, first=1, seal=None):
    """All frames of these pictures, in the order they are sent."""
    sender = V1Sender(config, protection=seal)
    for number, stream in enumerate(streams, start=first):
        sender.add_image(number, replace(CONTACT, time_utc_s=1_475_568_000.0 + number), stream, 0.0)
    frames = []
    while (data := sender.next_frame(0.0)) is not None:
        frames.append(data)
    return frames


def hear(modem, frames, **options):
    modem.send(IN, "decompressor", *(frame(data, **options) for data in frames))


def latest(images):
    return {image.image_id: image for image in sorted(images, key=lambda image: image.version)}


def test_pictures_refine_version_by_version(begin, modem, relay, streams, emb):
    service = begin()
    hear(modem, sent(streams[:4]))
    whole = [image_of_number(number) for number in range(1, 5)]
    eventually(
        lambda: [i for i in whole if i in latest(relay.received) and latest(relay.received)[i].complete] == whole
    )
    for number, image_id in enumerate(whole):
        versions = [image for image in relay.received if image.image_id == image_id]
        assert [image.version for image in versions] == list(range(1, len(versions) + 1))
        assert len(versions) >= 2
        lengths = [image.bytes_received for image in versions]
        assert lengths == sorted(lengths)
        for image in versions:
            expected = emb.decode(streams[number][: image.bytes_received])
            np.testing.assert_array_equal(image.picture.to_array(), expected.image)
            assert (image.missing_fraction, image.missing_halves, image.frames_received) == (0.0, (), 0)
            assert image.bytes_total == (image.bytes_received if image.complete else 0)
        assert not versions[0].complete
        assert versions[-1].contact.contact_id == f"uuv-1/{image_id}"
        assert versions[-1].contact.time_utc_s == 1_475_568_001.0 + number
        assert (versions[-1].codec, versions[-1].model) == ("emb", emb.model_hash)
    assert service.health().gauges["images_waiting"] == 0.0


def test_with_a_third_of_the_frames_lost_every_preview_is_shown(begin, modem, relay, streams):
    begin()
    rng = np.random.default_rng(3)
    frames = sent(streams)
    hear(modem, [data for data in frames if rng.random() >= 0.3])
    eventually(lambda: len(latest(relay.received)) == len(streams), what="every contact")
    assert all(image.missing_fraction == 0.0 for image in latest(relay.received).values())


def entry(number, prefix, *, ended=False):
    return Preview(number, CONTACT, prefix, ended=ended)


def test_a_record_without_a_picture_is_all_missing(begin, modem, relay):
    begin()
    record = entry(9, b"").pack(ENTRY_HEAD_BYTES)
    hear(modem, [pack_segments([Segment(SegmentKind.CONTACT, record)], 32)])
    eventually(lambda: len(relay.received) == 1)
    image = relay.received[0]
    assert (image.image_id, image.complete, image.contact.lat_deg) == ("0009", False, 56.4)
    assert (image.missing_fraction, image.missing_halves, image.codec) == (1.0, ("top", "bottom"), "")
    assert (image.bytes_received, image.notes) == (0, ("only the contact record arrived",))


def test_what_a_codec_that_is_not_embedded_lacks_is_missing(begin, modem, relay, texture):
    begin()
    vq = default_registry().create("vq", CodecResources(open_codebook("nominal-10").tiles))
    stream = vq.encode(texture())
    beginning = stream[:24]
    preview = entry(9, beginning).pack(ENTRY_HEAD_BYTES + len(beginning))
    hear(modem, [pack_segments([Segment(SegmentKind.PREVIEW, preview)], 64)])
    eventually(lambda: len(relay.received) == 1)
    image, whole = relay.received[0], vq.decode(stream).image
    assert 0.2 < image.missing_fraction < 0.8
    assert not image.complete
    black = image.missing()
    assert (image.picture.to_array()[black] == 0).all()
    np.testing.assert_array_equal(image.picture.to_array()[~black], whole[~black])


def test_both_formats_are_heard_side_by_side(begin, modem, relay, streams, texture):
    service = begin()
    vq = default_registry().create("vq", CodecResources(open_codebook("nominal-10").tiles))
    halves = [data for packet in plan_packets("0A1B", vq.encode(texture()), CONTACT, 3, 64) for data in packet]
    hear(modem, halves, source=4)
    hear(modem, sent(streams[:1]))
    hear(modem, [b"neither the one nor the other"])
    eventually(lambda: sum(image.complete for image in relay.received) == 2)
    assert {(i.vehicle_id, i.image_id, i.codec) for i in relay.received} == {
        ("modem-4", "0A1B", "vq"),
        ("uuv-1", "0001", "emb"),
    }
    eventually(lambda: service.health().counters.get("frames_rejected") == 1)


@pytest.mark.parametrize(("links", "images"), [(("v1",), {"0001"}), (("paper",), {"0A1B"})])
def test_a_format_that_is_not_configured_is_rejected(links, images, begin, modem, relay, streams, texture):
    service = begin(wire_formats=links)
    vq = default_registry().create("vq", CodecResources(open_codebook("nominal-10").tiles))
    halves = [data for packet in plan_packets("0A1B", vq.encode(texture()), CONTACT, 3, 64) for data in packet]
    hear(modem, [*halves, *sent(streams[:1])])
    eventually(lambda: any(image.complete for image in relay.received))
    assert {i.image_id for i in relay.received} == images
    eventually(lambda: service.health().counters.get("frames_rejected", 0) > 0)


def test_a_restart_in_the_middle_goes_on_with_what_was_there(begin, modem, relay, runner, streams):
    frames = sent(streams[:4])
    service = begin()
    middle = len(frames) * 2 // 3
    hear(modem, frames[:middle])
    eventually(lambda: service.health().counters.get("records_handled") == middle)
    runner.stop(service)
    service = begin()
    hear(modem, frames[middle:])
    whole = {image_of_number(number) for number in range(1, 5)}
    eventually(lambda: {i for i, image in latest(relay.received).items() if image.complete} == whole)
    told = [(image.image_id, image.version) for image in relay.received]
    assert len(told) == len(set(told))


def test_a_frame_whose_commit_failed_is_new_when_it_is_handled_again(begin, streams):
    service = begin()
    with service._lock:
        for data in sent(streams[:1]):
            for _ in range(2):
                service.handle(IN, frame(data), UnitOfWork())  # and no commit: the disk was full
            effects = UnitOfWork()
            service.handle(IN, frame(data), effects)
            service.commit(effects)
        counts = service._hearing.v1.counts
        assert counts.frames == len(sent(streams[:1]))
        assert counts.complete >= 1


def test_a_picture_that_cannot_be_decoded_is_kept_apart(begin, modem, streams, refused):
    service = begin()
    strange = bytes([0xEE]) + streams[0][1:]
    hear(modem, sent([strange]))
    eventually(lambda: service.health().counters.get("images_undecodable", 0) >= 1)
    assert all(key == "image uuv-1/0001" for key, _ in refused(service))


@pytest.fixture
def key_file(tmp_path):
    path = tmp_path / "acoustic.key"
    path.write_text(bytes(range(32)).hex())
    path.chmod(0o600)
    return path


def vehicle_seal(key_file, first_counter=0):
    seal = FrameAuthenticator(read_key(key_file), 3, Direction.FROM_VEHICLE, first_counter=first_counter)
    seal.grant(seal.settings.lifetime_frames)
    return seal


def test_with_a_key_only_sealed_frames_count_and_each_once(begin, modem, relay, runner, streams, key_file):
    service = begin(key_file=key_file)
    genuine = sent(streams[:2], seal=vehicle_seal(key_file))
    hear(modem, sent(streams[2:4], first=3))  # without a seal
    hear(modem, genuine)
    both = {"0001", "0002"}
    eventually(lambda: {i for i, image in latest(relay.received).items() if image.complete} == both)
    rejected = service.health().counters["frames_rejected"]
    hear(modem, genuine, source=4)  # passed off as another vehicle's
    eventually(lambda: service.health().counters["frames_rejected"] == rejected + len(genuine))
    runner.stop(service)
    service = begin(key_file=key_file)
    hear(modem, genuine)  # recorded and played again, over a restart
    eventually(lambda: service.health().counters.get("frames_rejected") == len(genuine))
    hear(modem, sent(streams[4:5], first=5, seal=vehicle_seal(key_file, len(genuine))))
    eventually(lambda: "0005" in latest(relay.received))
    assert set(latest(relay.received)) == {*both, "0005"}


def test_a_sealed_frame_whose_commit_failed_is_no_replay(begin, streams, key_file):
    service = begin(key_file=key_file)
    with service._lock:
        for data in sent(streams[:1], seal=vehicle_seal(key_file)):
            for _ in range(2):
                service.handle(IN, frame(data), UnitOfWork())
            effects = UnitOfWork()
            service.handle(IN, frame(data), effects)
            assert "frames_rejected" not in effects.counts
            service.commit(effects)
        assert service._hearing.seal.counts.replayed == 0


def test_a_key_and_a_format_without_seals_exclude_each_other(begin, key_file):
    with pytest.raises(ConfigError, match="wire_formats"):
        begin(key_file=key_file, wire_formats=("paper",))
