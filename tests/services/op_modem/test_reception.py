"""op_modem: receives all frames, assembles images, loses and repeats nothing across kills, full disks and restarts."""

import sqlite3
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from builders.common import eventually
from builders.vessel_frames import CONTACT, packet, preview_frame, received
from hypothesis import given
from hypothesis import strategies as st

from sonarpost import keys, wire
from sonarpost.delivery.store import Store
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.config import SenderConfig
from sonarpost.link.downlink.messages import image_of_number
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.frame import ContactFrame
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.link.receiver import ImageUpdate
from sonarpost.messages import AcousticFrame
from sonarpost.modem.interface import FrameDecoded, ReceptionQuality
from sonarpost.modem.micromodem import nmea
from sonarpost.services.op_modem import reception
from sonarpost.services.op_modem.reception import quality_of

VESSEL = "vessel-1"
RX = keys.acoustic_rx(VESSEL)
SECOND = image_of_number(2)


@pytest.fixture
def observed(watch):
    """Return the frames published for observers so far."""
    samples = watch(RX)
    return lambda: [wire.decode(AcousticFrame, s.payload.to_bytes(), RX) for s in samples]


def numbers(peer):
    """Return (image number, version) of the received images."""
    return [(int(image.image_id, 36), image.version) for image in peer.received]


def sentences(number, data, src=3, dest=1):
    """Return the modem's sentences for a received packet of one frame."""
    clock = "20161012000000.000000,0,21286,38,0125,0141,07,00,00,00,00"
    quality = "141,12.5,9.50,-100,-9.50,-01,0.00,51,25000,5000"
    statistics = f"6,0,{clock},1,{src:03d},{dest:03d},0,3,1,0,{quality}"
    return nmea.format("CARXD", src, dest, 0, number, data.hex().upper()) + nmea.format("CACST", *statistics.split(","))


def test_packets_are_published_with_consecutive_numbers(modem_pair, begin, observed, check_monitoring):
    modem_pair.start()
    service = begin()
    eventually(lambda: service.health().state == "ok")
    for n in range(3):
        service.on_modem_event(packet(received(bytes([n]), 1), received(bytes([n, n]), 2), bad=1, nframes=3))
    eventually(lambda: len(observed()) == 6)
    assert [(f.packet, f.frame_number, f.data) for f in observed()] == [
        (n + 1, k, bytes([n] * k)) for n in range(3) for k in (1, 2)
    ]
    assert {(f.frame_count, f.rate, f.source, f.destination) for f in observed()} == {(3, 1, 3, 1)}
    counters = service.health().counters
    assert (counters["packets_received"], counters["frames_received"], counters["frames_bad"]) == (3, 6, 3)
    check_monitoring(service)


def test_a_packet_is_one_commit(begin, monkeypatch):
    service, commits = begin(image_consumers=[]), []
    transaction = service.store.transaction
    monkeypatch.setattr(service.store, "transaction", lambda: commits.append(1) or transaction())
    for number in (1, 4, 7):
        frames = [received(preview_frame(number + n), n + 1) for n in range(3)]
        for frame in frames:
            service.on_modem_event(FrameDecoded(frame))
        service.on_modem_event(packet(*frames))
    assert service.health().gauges["images_incomplete"] == 9.0
    assert len(commits) == 3


def test_packet_numbers_continue_after_a_restart(begin, runner, observed):
    for number in range(1, 4):
        service = begin()
        service.on_modem_event(packet(b"x"))
        eventually(lambda n=number: len(observed()) == n)
        runner.stop(service)
    assert [f.packet for f in observed()] == [1, 2, 3]


def test_images_wait_for_their_consumer_over_a_restart(begin, runner, request):
    service = begin()
    service.on_modem_event(packet(preview_frame(2, 40, 128)))
    assert service.health().gauges["outbox"] == 1
    runner.stop(service)
    begin()
    late = request.getfixturevalue("decompressor")
    eventually(lambda: len(late.received) == 1)
    [image] = late.received
    assert (image.vessel_id, image.vehicle_id, image.image_id, image.version) == (VESSEL, "uuv-1", SECOND, 1)
    assert (image.contact.contact_id, image.contact.lat_deg) == (f"uuv-1/{SECOND}", 56.4)
    assert (image.height_px, image.width_px, len(image.stream), image.bytes_received) == (40, 60, 40, 40)
    assert (image.missing, image.complete, image.bytes_total) == ((), False, 0)


def test_overheard_frame_gives_images_and_its_link_quality(modem_pair, begin, decompressor, observed, serial_cable):
    modem_pair.start()
    line = serial_cable(modem_pair.port(modem_pair.VESSEL))
    service = begin(port=line.port)
    eventually(lambda: service.modem.ready)
    line.say(sentences(1, preview_frame(2), dest=9))
    eventually(lambda: numbers(decompressor) == [(2, 1)])
    [got] = observed()
    assert (got.destination, got.data, got.rate, got.frame_count) == (9, preview_frame(2), 1, 1)
    assert (got.quality.snr_in_db, got.quality.frames, got.quality.bad_frames) == (12.5, 1, 0)
    assert decompressor.received[0].vehicle_id == "uuv-1"


def test_invalid_sentences_are_counted_and_later_frames_processed(modem_pair, begin, observed, serial_cable):
    modem_pair.start()
    line = serial_cable(modem_pair.port(modem_pair.VESSEL))
    service = begin(port=line.port)
    eventually(lambda: service.modem.ready)
    line.say(
        b"\xff\x00$$$***" * 300
        + b"\r\n$CARXD,3,1,0,1,ABC\r\n"
        + nmea.format("CARXD", 3, 1, 0, 1, "61")[:-4]
        + b"00\r\n"
    )
    line.say(nmea.format("CARXD", 3, 1, 0, 1, "0g") + nmea.format("CARXD", 300, 1, 0, 1, "00"))
    eventually(lambda: service.health().counters.get("sentences_rejected", 0) >= 4)
    line.say(sentences(1, b"good"))
    eventually(lambda: [f.data for f in observed()] == [b"good"])
    assert service.health().state == "ok"


def test_unexpected_exception_about_a_frame_loses_that_frame_only(begin, decompressor, refused, monkeypatch):
    service = begin()
    accept = V1Receiver.accept
    bad = preview_frame(2)

    def fail_on_one(self, source, frame, now, **options):
        return 1 // 0 if frame == bad else accept(self, source, frame, now, **options)

    monkeypatch.setattr(V1Receiver, "accept", fail_on_one)
    first, third = preview_frame(1), preview_frame(3)
    service.on_modem_event(packet(received(first, 1), received(bad, 2), received(third, 3), nframes=3))
    eventually(lambda: numbers(decompressor) == [(1, 1), (3, 1)])
    assert [(key, "ZeroDivisionError" in reason) for key, reason in refused(service)] == [(RX, True)]
    assert service.health().counters["frames_refused"] == 1
    assert not service.failed


@pytest.mark.parametrize("damaged", [b"", b"\xc1", b"x"])
def test_state_that_cannot_be_read_does_not_stop_the_service(damaged, begin, runner, decompressor, refused):
    service = begin()
    runner.stop(service)
    store = Store(service.store.path)
    with store.transaction() as tx:
        for name in ("packets", "authenticated-since"):
            tx.put_state(name, damaged)
    store.close()
    service = begin()
    service.on_modem_event(packet(received(preview_frame(1), 1)))
    eventually(lambda: numbers(decompressor) == [(1, 1)])
    assert {"state packets", "state authenticated-since"} == {key for key, _ in refused(service)}
    assert service.health().counters["states_discarded"] == 2


def test_packets_in_memory_have_shares_by_address(begin, monkeypatch, unwritable):
    monkeypatch.setattr(reception, "MAX_UNSAVED", 4)
    service = begin()
    with unwritable(service):
        for number, source in enumerate([3, 3, 9, 9, 9, 9, 9, 9], start=1):
            service.on_modem_event(packet(preview_frame(number), src=source))
        assert [each.src for each, _ in service._reception._unsaved] == [3, 3, 9, 9]


def test_invalid_frames_are_quarantined_and_block_nothing(begin, decompressor, observed, refused, caplog):
    bad = [received(number=9), received(number=200), received(bytes(2049)), received(src=200)]
    service = begin()
    service.on_modem_event(packet(received(preview_frame(1)), *bad))
    service.on_modem_event(packet(preview_frame(2)))
    eventually(lambda: numbers(decompressor) == [(1, 1), (2, 1)])
    assert len(observed()) == 2
    for (key, reason), frame in zip(refused(service), bad, strict=True):
        assert key == RX
        assert f"frame {frame.frame_number} of {len(frame.data)} bytes" in reason
    assert service.health().counters["frames_refused"] == len(bad)
    assert service.health().gauges["unsaved"] == 0
    assert sum(r.message == "Frame quarantined" for r in caplog.records) == len(bad)


def test_impossible_statistics_are_published_as_unknown(begin, observed):
    service = begin()
    odd = ReceptionQuality(nframes=-5, nbad=-1, snr_in_db=7.5)
    service.on_modem_event(packet(received(b"good", rate=77), nframes=200, rate=77, statistics=odd))
    eventually(lambda: len(observed()) == 1)
    [got] = observed()
    assert (got.data, got.rate, got.frame_count) == (b"good", None, None)
    assert (got.quality.snr_in_db, got.quality.frames, got.quality.bad_frames) == (7.5, None, None)


number = st.none() | st.integers(-(2**31), 2**31)
real = st.none() | st.floats(allow_nan=False, allow_infinity=False)


@given(snr_in_db=real, snr_out_db=real, spl_db=number, mse_db=real, doppler=real, nframes=number, nbad=number)
def test_every_measurement_of_a_modem_fits_the_record(**measured):
    quality = quality_of(ReceptionQuality(**measured))
    assert quality.snr_in_db == measured["snr_in_db"]
    assert quality.frames is None or quality.frames == measured["nframes"] >= 0


def test_full_disk_keeps_packets_in_memory_until_they_can_be_stored(begin, request, full_disk, observed, caplog):
    caplog.set_level("INFO")
    service = begin()
    with full_disk(service):
        for number in range(1, 21):
            service.on_modem_event(packet(preview_frame(number, 220, 256)))
        assert service.health().state == "degraded"
        assert "disk is full" in service.health().detail
        assert service.health().gauges["unsaved"] >= 15
        assert len(observed()) <= 5
    decompressor = request.getfixturevalue("decompressor")
    eventually(lambda: numbers(decompressor) == [(number, 1) for number in range(1, 21)])
    eventually(lambda: [f.packet for f in observed()] == list(range(1, 21)))
    eventually(lambda: "disk is full" not in service.health().detail)
    assert service.health().gauges["unsaved"] == 0
    messages = [r.message for r in caplog.records]
    assert messages.count("Received frames cannot be stored; retrying") == 1
    assert messages.count("Received frames stored again") == 1


def test_packets_of_a_full_disk_are_stored_at_the_stop(begin, runner, decompressor, full_disk):
    service = begin()
    service.stopping.set()  # ends the thread that retries
    with full_disk(service):
        for number in range(1, 21):
            service.on_modem_event(packet(preview_frame(number, 220, 256)))
        assert service.health().gauges["unsaved"] > 0
    runner.stop(service)
    begin()
    eventually(lambda: numbers(decompressor) == [(number, 1) for number in range(1, 21)])


def test_memory_is_bounded_and_dropped_packets_are_counted(begin, monkeypatch, caplog, request, full_disk):
    monkeypatch.setattr(reception, "MAX_UNSAVED", 5)
    service = begin()
    with full_disk(service):
        for number in range(1, 31):
            service.on_modem_event(packet(preview_frame(number, 220, 256)))
        assert service.health().gauges["unsaved"] == 5
        lost = service.health().counters["packets_lost"]
        assert lost >= 15
        assert sum(r.message == "Oldest packet in memory dropped" for r in caplog.records) == lost
    decompressor = request.getfixturevalue("decompressor")
    eventually(lambda: len(decompressor.received) == 30 - lost)
    assert numbers(decompressor)[-1] == (30, 1)


def test_frames_of_a_failed_commit_are_new_when_they_are_processed_again(begin, decompressor, unwritable):
    service = begin()
    with unwritable(service):
        service.on_modem_event(packet(preview_frame(1), preview_frame(2)))
        assert service.health().gauges["unsaved"] == 1
    eventually(lambda: numbers(decompressor) == [(1, 1), (2, 1)])
    assert service.health().counters["images_received"] == 2


def test_rejected_frames_are_counted_and_logged_once_per_interval(begin, caplog, decompressor):
    service = begin()
    service.on_modem_event(packet(b"neither", b"of", b"both formats", preview_frame(2)))
    assert service.health().counters["frames_rejected"] == 3
    eventually(lambda: any(r.message == "Frames rejected" for r in caplog.records))
    [line] = [r for r in caplog.records if r.message == "Frames rejected"]
    assert vars(line)["fields"]["rejected"] == 3
    assert "acoustic frame from modem 3" in vars(line)["fields"]["last_reason"]
    eventually(lambda: numbers(decompressor) == [(2, 1)])


@pytest.mark.parametrize("wire_formats", [("v1",), ("paper",)])
def test_wire_format_that_is_not_configured_is_rejected(wire_formats, begin, decompressor):
    service = begin(wire_formats=wire_formats, pairing_timeout_s=0.2, link="paper")
    service.on_modem_event(packet(preview_frame(2), ContactFrame("00A1", ContactSummary()).pack()))
    assert service.health().counters["frames_rejected"] == 1
    eventually(lambda: len(decompressor.received) == 1)
    assert decompressor.received[0].image_id == (SECOND if wire_formats == ("v1",) else "00A1")


def test_image_of_the_paper_format_is_sent_after_the_timeout_with_class_and_probabilities(begin, decompressor):
    service = begin(pairing_timeout_s=0.3)
    summary = ContactSummary(lat_deg=1.0, lon_deg=2.0, atd_class="structure", p_mine_like=0.07, p_other_object=0.9)
    service.on_modem_event(packet(ContactFrame("00A1", summary).pack()))
    eventually(lambda: len(decompressor.received) == 1)
    [image] = decompressor.received
    assert (image.stream, image.missing_halves, image.complete) == (b"", ("top", "bottom"), False)
    contact = image.contact
    assert (contact.atd_class, contact.p_mine_like, contact.p_other_object) == ("structure", 0.05, 0.9)
    assert (contact.lat_deg, contact.lon_deg) == (1.0, 2.0)
    eventually(lambda: service.health().gauges["images_waiting"] == 0.0)


def test_image_of_the_paper_format_waits_for_its_other_frames(begin):
    service = begin(pairing_timeout_s=3600.0)
    service.on_modem_event(packet(ContactFrame("00A1", ContactSummary()).pack()))
    gauges = service.health().gauges
    assert (gauges["images_waiting"], gauges["images_incomplete"], gauges["outbox"]) == (1.0, 1.0, 0.0)


# Kills


@pytest.fixture
def kill(runner, begin):
    """Stop a service, restore the state that a kill would have left on the disk, and start it again."""

    def restart(service):
        path = service.store.path
        killed = path.with_name("killed")
        with closing(sqlite3.connect(path)) as source, closing(sqlite3.connect(killed)) as copy:
            source.backup(copy)
        runner.stop(service)
        for file in path.parent.glob("op_modem.db*"):
            file.unlink()
        killed.rename(path)
        return begin()

    return restart


def test_kill_between_any_two_packets_loses_and_repeats_no_image(begin, kill, decompressor):
    sender = V1Sender(SenderConfig(frame_bytes=64, channels=(LossChannel(0.2),), frames_per_image=6))
    for number in range(1, 4):
        stream = b"\x20" + np.random.default_rng(number).bytes(150)
        sender.add_image(number, replace(CONTACT, time_utc_s=1_475_568_000.0 + number), stream, 0.0)
    frames = []
    while (data := sender.next_frame(0.0)) is not None:
        frames.append(data)
    receiver = V1Receiver()
    expected = [
        (e.image_id, e.version, e.stream)
        for data in frames
        for e in receiver.accept(3, data, 0.0)
        if isinstance(e, ImageUpdate)
    ]
    service = begin()
    for first in range(0, len(frames), 3):
        service.on_modem_event(packet(*frames[first : first + 3]))
        service = kill(service)
    eventually(lambda: len(decompressor.received) >= len(expected))
    assert [(i.image_id, i.version, i.stream) for i in decompressor.received] == expected
    assert {i.image_id for i in decompressor.received if i.complete} == {image_of_number(n) for n in (1, 2, 3)}


def test_frames_of_an_unfinished_packet_are_lost_with_a_kill_and_the_next_packet_arrives(begin, kill, observed):
    service = begin()
    service.on_modem_event(FrameDecoded(received(b"lost", 1)))
    service = kill(service)
    service.on_modem_event(packet(b"after"))
    eventually(lambda: [f.data for f in observed()] == [b"after"])
    assert service.store.get_state("packets") == b"1"
