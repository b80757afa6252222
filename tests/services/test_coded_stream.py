"""From op_modem's record to the shore: decompressor, relay and c2 with coded streams and differences."""

import os
import signal

import msgpack
import numpy as np
import pytest
from builders.common import eventually
from builders.vessel_frames import CONTACT

from sonarpost import keys, wire
from sonarpost.archive import image_parts
from sonarpost.archive.image_parts import stream_of
from sonarpost.codec.registry import default_registry
from sonarpost.delivery.records import InboxItem, OutboxItem, Topic
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.link.downlink.messages import image_of_number
from sonarpost.link.receiver import ImageUpdate, received_image
from sonarpost.messages import CodedImage, ImagePart, ReconstructedImage, Relayed
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service
from sonarpost.services.decompressor.config import DecompressorConfig
from sonarpost.services.decompressor.service import DecompressorService
from sonarpost.services.relay.config import RelayConfig
from sonarpost.services.relay.service import RelayService
from sonarpost.sonar.image_files import read_image

VESSEL = "vessel-1"


@pytest.fixture
def stream(texture):
    """A stream whose prefixes are coarser images."""
    return default_registry().create("emb").encode(texture(), 600)


def update(stream, version=1, number=1, missing=()):
    zeroed = bytearray(stream)
    for start, stop in missing:
        zeroed[start:stop] = bytes(stop - start)
    received = len(stream) - sum(stop - start for start, stop in missing)
    name, at_s = image_of_number(number), 1.7e9 + version
    found = ImageUpdate(
        3, name, version, CONTACT, bytes(zeroed), missing, False, received, 600, 4, 0, 1.7e9, last_frame_s=at_s
    )
    return received_image(found, VESSEL, "uuv-1", authenticated=True)


@pytest.fixture
def start_c2(runner, platform, tmp_path):
    return lambda **options: runner.start(
        C2Service(platform("shore-1"), C2Config(out_dir=tmp_path / "shore", **options))
    )


@pytest.fixture
def start_relay(runner, platform):
    return lambda: runner.start(RelayService(platform(VESSEL), RelayConfig()))


@pytest.fixture
def op_modem(runner, platform, tmp_path):
    """Peer that feeds a running decompressor."""
    config = DecompressorConfig(out_dir=tmp_path / "vessel", codebooks=("nominal-10",))
    runner.start(DecompressorService(platform(VESSEL), config))
    peer = runner.peer(VESSEL, "op_modem")

    def send(*images):
        peer.send(keys.acoustic_image(VESSEL), "decompressor", *images)

    return send


def images(samples):
    return [wire.decode(ReconstructedImage, s.payload.to_bytes(), "") for s in samples]


def test_shore_has_the_same_image_as_the_vessel(op_modem, start_relay, start_c2, watch, stream, tmp_path):
    on_vessel, at_shore = watch(keys.image_reconstructed(VESSEL)), watch(keys.shore_image(VESSEL))
    coded = watch(keys.shore_coded(VESSEL))
    start_relay(), start_c2()
    op_modem(update(stream[:200], missing=((100, 120),)))
    eventually(lambda: on_vessel and at_shore and coded)
    assert images(at_shore) == images(on_vessel)
    record = wire.decode(CodedImage, coded[0].payload.to_bytes(), "")
    assert (record.codec, record.bytes_received, record.missing) == ("emb", 180, ((100, 120),))
    [vessel_tiff], [shore_tiff] = (list((tmp_path / name).rglob("*.tiff")) for name in ("vessel", "shore"))
    np.testing.assert_array_equal(read_image(shore_tiff), read_image(vessel_tiff))
    assert shore_tiff.with_suffix(".json").read_bytes() == vessel_tiff.with_suffix(".json").read_bytes()
    # A contact without a stream arrives as well.
    op_modem(update(b"", number=2))
    eventually(lambda: len(at_shore) == 2)
    image = images(at_shore)[1]
    assert (image.codec, image.missing_fraction, image.contact.lat_deg) == ("", 1.0, CONTACT.lat_deg)


def test_later_versions_travel_as_differences(op_modem, start_relay, start_c2, watch, stream):
    on_vessel, at_shore = watch(keys.image_reconstructed(VESSEL)), watch(keys.shore_image(VESSEL))
    relay, c2 = start_relay(), start_c2()
    for version, length in enumerate((200, 300, 400, 500), start=1):
        op_modem(update(stream[:length], version))
        eventually(lambda: len(at_shore) == version)  # noqa: B023 used in this iteration
        eventually(lambda: relay.store.outbox_depth() == 0)
    assert images(at_shore) == images(on_vessel)
    counters = relay.health().counters
    assert (counters["image_differences"], counters["coded_images_relayed"]) == (3, 4)
    assert c2.health().counters["images_accepted"] == 4


def test_site_that_lost_its_store_gets_the_whole(
    op_modem, runner, start_relay, start_c2, watch, stream, platform, refused
):
    at_shore = watch(keys.shore_image(VESSEL))
    relay, c2 = start_relay(), start_c2()
    op_modem(update(stream[:200]))
    eventually(lambda: len(at_shore) == 1)
    eventually(lambda: relay.store.outbox_depth() == 0)
    runner.stop(c2)
    for file in platform("shore-1").state_dir.glob("c2.db*"):
        file.unlink()
    c2 = start_c2()
    op_modem(update(stream[:300], 2))
    eventually(lambda: len(at_shore) == 2)
    assert images(at_shore)[1].bytes_received == 300
    eventually(lambda: relay.store.outbox_depth() == 0)
    assert relay.health().counters["image_differences_refused"] == 1
    assert refused(relay) == refused(c2) == []
    assert c2.health().counters.get("records_refused", 0) == 0


def test_queued_difference_is_replaced_by_one_to_the_acknowledged_version(
    op_modem, runner, start_relay, start_c2, watch, stream
):
    at_shore = watch(keys.shore_image(VESSEL))
    relay, c2 = start_relay(), start_c2()
    op_modem(update(stream[:200]))
    eventually(lambda: at_shore and relay.store.outbox_depth() == 0)
    runner.stop(c2)
    op_modem(update(stream[:300], 2), update(stream[:400], 3), update(stream[:500], 4))
    eventually(lambda: relay.health().counters.get("coded_images_relayed") == 4)
    start_c2()
    eventually(lambda: any(image.version == 4 for image in images(at_shore)))
    assert images(at_shore)[-1].bytes_received == 500
    eventually(lambda: relay.store.outbox_depth() == 0)
    assert relay.health().counters.get("image_differences_refused", 0) == 0


def test_records_of_the_relay_are_small(op_modem, runner, start_relay, stream):
    received = {keys.shore_part_all(): ImagePart, keys.shore_inbox_all(): Relayed}
    shore = runner.peer("shore-1", "c2", received)
    relay = start_relay()
    op_modem(update(stream[:200]))
    eventually(lambda: len(shore.received) == 1 and relay.store.outbox_depth() == 0)
    op_modem(update(stream[:300], 2))
    eventually(lambda: len(shore.received) == 2)
    whole, difference = shore.received
    assert isinstance(whole, ImagePart)
    assert stream_of(whole) == stream[:200]
    assert len(wire.encode(whole)) <= 300
    assert len(wire.encode(difference)) <= 220


def test_stream_that_cannot_be_decoded_costs_that_image_only_and_other_pixels_are_noted(
    runner, start_relay, start_c2, watch, stream, refused
):
    at_shore = watch(keys.shore_image(VESSEL))
    relay, c2 = start_relay(), start_c2()
    peer = runner.peer(VESSEL, "decompressor")

    def coded(data, number, **fields):
        return CodedImage(**dict(update(data, 1, number)), model="", **fields)

    undecodable = coded(b"\x7f" + bytes(50), 1, codec="", pixels_crc32=None)
    peer.send(keys.image_coded(VESSEL), "relay", undecodable, coded(stream, 2, codec="emb", pixels_crc32=1))
    eventually(lambda: at_shore)
    [(key, reason)] = refused(c2)
    assert key == keys.shore_part(VESSEL)
    assert "codec_id: got '0x7f'" in reason
    assert c2.health().counters["images_undecodable"] == 1
    assert images(at_shore)[0].notes == ("decoded pixels differ from those of the vessel",)
    assert c2.health().counters["images_differing"] == 1
    eventually(lambda: relay.store.outbox_depth() == 0)


def test_killed_decoder_is_started_again(op_modem, start_relay, start_c2, watch, stream):
    at_shore = watch(keys.shore_image(VESSEL))
    start_relay()
    c2 = start_c2()
    op_modem(update(stream[:200]))
    eventually(lambda: len(at_shore) == 1)
    [worker] = c2.decoding.workers
    os.kill(worker.pid, signal.SIGKILL)
    op_modem(update(stream[:200], 1, 2))
    eventually(lambda: len(at_shore) == 2)


def test_accepted_images_are_decoded_after_a_restart(
    op_modem, runner, start_relay, start_c2, watch, stream, monkeypatch
):
    at_shore = watch(keys.shore_image(VESSEL))
    relay = start_relay()
    with monkeypatch.context() as patch:
        patch.setattr("sonarpost.services.c2.decoding.Decoding.run", lambda self: None)
        c2 = start_c2()
        op_modem(*(update(stream[:200], 1, number) for number in (1, 2, 3)))
        eventually(lambda: c2.health().gauges["images_undecoded"] == 3.0)
        eventually(lambda: relay.store.outbox_depth() == 0)
        runner.stop(c2)
    c2 = start_c2()
    eventually(lambda: len(at_shore) == 3)
    eventually(lambda: c2.health().gauges["images_undecoded"] == 0.0)


def test_invalid_parts_are_refused(runner, start_c2, refused):
    c2, relay = start_c2(), runner.peer(VESSEL, "relay")
    part = {"u": "uuv-1", "i": "000A", "n": 1, "t": 1.0, "p": b"\x04\x30"}
    hole, far = {"p": b"", "s": ((1, b"x"),)}, {"c": b"\x81\xa7lat_deg\xcb\x40\x56\xc0\0\0\0\0\0"}
    relay.send(keys.shore_part(VESSEL), "c2", *(ImagePart(**part | change) for change in (hole, far)))
    eventually(lambda: len(refused(c2)) == 2)
    (_, first), (_, second) = refused(c2)
    assert "s: got '1 bytes', expected every byte of the stream that is not in m" in first
    assert "lat_deg: got 91.0" in second


def test_relay_keeps_the_later_version_if_the_first_is_acknowledged_after_it(platform):
    relay, queue, key = RelayService(platform(VESSEL), RelayConfig()), "c2", keys.shore_part(VESSEL)
    payloads = [wire.encode(ImagePart(u="uuv-1", i="000A", n=n, t=1.0, p=b"\x04" * n)) for n in (1, 2)]
    items = [OutboxItem(queue, n, key, "", 5, payload, b"") for n, payload in enumerate(payloads, start=1)]
    found = []
    for item in (items[0], items[1], items[0]):
        with relay.store.transaction() as tx:
            relay.on_acknowledged(tx, item, None)
        found += relay.store.states("version/").values()
    relay.store.close()
    assert found == [payloads[0], payloads[1], payloads[1]]


@pytest.mark.parametrize("supersede", [True, False])
def test_refused_difference_is_sent_whole_after_another_version_was_acknowledged(platform, supersede):
    """The site has applied version 3 to version 2, the relay has stored version 2: neither is its base."""
    relay = RelayService(platform(VESSEL), RelayConfig(supersede=supersede))
    queue, key = "c2", keys.shore_part(VESSEL)
    streams = [np.random.default_rng(n).integers(0, 256, 300, np.uint8).tobytes() for n in (1, 2)]
    first, second, third = (
        CodedImage(**dict(update(data, version)), model="", codec="emb", pixels_crc32=None)
        for version, data in ((1, streams[0]), (2, streams[1]), (3, streams[0] + streams[1]))
    )
    wholes = [wire.encode(image_parts.whole_part(image)) for image in (first, second, third)]
    items = [OutboxItem(queue, n, key, "", 5, payload, b"") for n, payload in enumerate(wholes, start=1)]
    with relay.store.transaction() as tx:
        relay.on_acknowledged(tx, items[0], None)
    effects = UnitOfWork()
    relay._queue_image(third, effects)
    relay.commit(effects)
    [difference] = relay.store.queued_items(queue, relay.store.queued_numbers(queue, 9))
    assert image_parts.head_of(difference.payload).base == 1
    with relay.store.transaction() as tx:
        relay.on_acknowledged(tx, items[1], None)
        assert relay.on_acknowledged(tx, difference, "k: send the whole image")
        tx.remove_acknowledged(queue, [difference.seq])
    [sent] = relay.store.queued_items(queue, relay.store.queued_numbers(queue, 9))
    names = relay.store.state_names("whole/")
    relay.store.close()
    assert sent.payload == wholes[2]
    assert names == ()


def test_acknowledged_difference_is_stored_whole(platform, stream):
    relay, queue, key = RelayService(platform(VESSEL), RelayConfig()), "c2", keys.shore_part(VESSEL)
    first, second = (
        CodedImage(**dict(update(stream[:length], version)), model="", codec="emb", pixels_crc32=None)
        for version, length in ((1, 200), (2, 300))
    )
    with relay.store.transaction() as tx:
        payload = wire.encode(image_parts.whole_part(first))
        relay.on_acknowledged(tx, OutboxItem(queue, 1, key, "", 5, payload, b""), None)
    effects = UnitOfWork()
    relay._queue_image(second, effects)
    relay.commit(effects)
    [difference] = relay.store.queued_items(queue, relay.store.queued_numbers(queue, 9))
    with relay.store.transaction() as tx:
        assert not relay.on_acknowledged(tx, difference, None)
    found, left = relay.store.states("version/"), relay.store.state_names("whole/")
    with relay.store.transaction() as tx:
        # Its whole image is gone; the site has this version and no later one.
        assert not relay.on_acknowledged(tx, difference, "k: send the whole image")
    relay.store.close()
    assert list(found.values()) == [wire.encode(image_parts.whole_part(second))]
    assert left == ()


def test_relay_deletes_surplus_versions_except_those_with_a_queued_record(platform, monkeypatch):
    monkeypatch.setattr("sonarpost.archive.image_parts.MAX_VERSIONS", 1)
    monkeypatch.setattr("sonarpost.archive.image_parts.PRUNE_EVERY", 1)
    relay, queue, key = RelayService(platform(VESSEL), RelayConfig()), "c2", keys.shore_part(VESSEL)
    parts = [ImagePart(u="uuv-1", i=image_of_number(n), n=1, t=float(n), p=b"\x04\x30") for n in range(1, 5)]
    with relay.store.transaction() as tx:
        tx.send(key, queue, b"", encoding="", topic=Topic("uuv-1/0002/2.0", 2))
        for part in parts:
            relay.on_acknowledged(tx, OutboxItem(queue, part.n, key, "", 5, wire.encode(part), b""), None)
    names = relay.store.state_names("version/")
    relay.store.close()
    assert names == ("version/c2/uuv-1/0002/2.0", "version/c2/uuv-1/0004/4.0")


def test_accepted_image_is_decoded_once_or_again_if_it_is_read_from_the_store(platform, tmp_path, monkeypatch):
    c2, key = C2Service(platform("shore-1"), C2Config(out_dir=tmp_path / "shore")), keys.shore_part(VESSEL)
    payload = wire.encode(ImagePart(u="uuv-1", i="000A", n=1, t=1.0, p=b"\x04\x30"))
    decoded: list[bytes] = []
    decode = wire.decode
    monkeypatch.setattr(wire, "decode", lambda kind, data, where: decoded.append(data) or decode(kind, data, where))
    c2._handler.keep_decoded(key, payload, c2._handler.check(key, payload))
    for times in (1, 2):
        c2._handler._effects_of(InboxItem(times, key, bytes(bytearray(payload))))
        assert len(decoded) == times
    first, second = (entry.record for entry in c2._archive._entries)
    assert first == second
    c2.store.close()


def test_number_of_accepted_images_in_memory_is_limited(platform, tmp_path, monkeypatch):
    monkeypatch.setattr("sonarpost.runtime.record_handler.MAX_DECODED", 3)
    c2, key = C2Service(platform("shore-1"), C2Config(out_dir=tmp_path / "shore")), keys.shore_part(VESSEL)
    for number in range(1, 6):
        part = ImagePart(u="uuv-1", i=image_of_number(number), n=1, t=1.0, p=b"\x04\x30" + bytes(5000 * (number == 1)))
        payload = wire.encode(part)
        c2._handler.keep_decoded(key, payload, c2._handler.check(key, payload))
    kept = {record.image_id for record in c2._handler._decoded.values()}
    assert kept == {image_of_number(number) for number in (2, 3, 4)}
    c2.store.close()


def test_site_keeps_a_limited_number_of_versions(runner, start_c2, monkeypatch):
    monkeypatch.setattr("sonarpost.archive.image_parts.MAX_VERSIONS", 10)
    monkeypatch.setattr("sonarpost.archive.image_parts.PRUNE_EVERY", 1)
    monkeypatch.setattr("sonarpost.services.c2.decoding.Decoding.run", lambda self: None)
    c2 = start_c2()
    relay = runner.peer(VESSEL, "relay")
    parts = (ImagePart(u="uuv-1", i=image_of_number(n), n=1, t=1000.0 - n, p=b"\x04\x30") for n in range(1, 31))
    relay.send(keys.shore_part(VESSEL), "c2", *parts)
    eventually(lambda: relay.store.outbox_depth() == 0)
    names = c2.store.state_names("version/")
    assert len(names) <= 11
    eventually(lambda: c2._archive.index().backlog.waiting_count + c2.store.inbox_depth() == 30)
    assert msgpack.unpackb(c2.store.get_state(names[0]))["u"] == "uuv-1"
