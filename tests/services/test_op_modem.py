"""op_modem: whatever the modem hears is on the disk and handed on, also what was sent to somebody else."""

from __future__ import annotations

import pytest
from builders.common import eventually
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarpost import keys
from sonarpost.messages import AcousticFrame
from sonarpost.modem.micromodem import FrameReceived, LinkStatistics, PacketReceived, nmea
from sonarpost.services.op_modem import service as op_modem
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.service import OpModemService, quality_of

RX = keys.acoustic_rx("vessel-1")


@pytest.fixture
def begin(runner, platform, modem_pair):
    def start(**options):
        usual = {"port": modem_pair.port(modem_pair.VESSEL)}
        return runner.start(OpModemService(platform("vessel-1"), OpModemConfig(**(usual | options))))

    return start


@pytest.fixture
def decompressor(runner):
    return runner.peer("vessel-1", "decompressor", {RX: AcousticFrame})


def frame(number=1, data=b"x", src=3, rate=1):
    return FrameReceived(src, 1, False, number, data, 0.0, rate, None)


def packet(*frames, bad=0, nframes=None, rate=1, statistics=None):
    return PacketReceived(frames, bad, len(frames) if nframes is None else nframes, 3, 1, rate, statistics, not bad)


def sentences(number, data, src=3, dest=1):
    """The sentences of a received packet of one frame."""
    clock = "20161012000000.000000,0,21286,38,0125,0141,07,00,00,00,00"
    quality = "141,12.5,9.50,-100,-9.50,-01,0.00,51,25000,5000"
    statistics = f"6,0,{clock},1,{src:03d},{dest:03d},0,3,1,0,{quality}"
    return nmea.format("CARXD", src, dest, 0, number, data.hex().upper()) + nmea.format("CACST", *statistics.split(","))


def test_packets_are_handed_on_with_their_numbers(modem_pair, begin, decompressor, check_monitoring):
    modem_pair.start()
    service = begin()
    eventually(lambda: service.health().state == "ok")
    for n in range(3):
        service.on_modem_event(packet(frame(1, bytes([n])), frame(2, bytes([n, n])), bad=1, nframes=3))
    eventually(lambda: len(decompressor.received) == 6)
    assert [(f.packet, f.frame_number, f.data) for f in decompressor.received] == [
        (n + 1, k, bytes([n] * k)) for n in range(3) for k in (1, 2)
    ]
    assert {(f.frame_count, f.rate, f.source, f.destination) for f in decompressor.received} == {(3, 1, 3, 1)}
    counters = service.health().counters
    assert (counters["packets_received"], counters["frames_received"], counters["frames_bad"]) == (3, 6, 3)
    check_monitoring(service)


def test_packets_are_numbered_on_after_a_restart(modem_pair, begin, runner, decompressor):
    for number in range(1, 4):
        service = begin()
        service.on_modem_event(packet(frame()))
        eventually(lambda n=number: len(decompressor.received) == n)
        runner.stop(service)
    assert [f.packet for f in decompressor.received] == [1, 2, 3]


def test_frames_of_a_packet_whose_end_a_killed_process_did_not_see_are_handed_on(
    modem_pair, begin, runner, decompressor, serial_cable
):
    modem_pair.start()
    line = serial_cable(modem_pair.port(modem_pair.VESSEL))
    service = begin(port=line.port)
    eventually(lambda: service.health().state == "ok")
    line.say(nmea.format("CARXP", 1) + nmea.format("CACYC", 0, 3, 1, 1, 0, 3))
    for n, data in enumerate((b"first", b"second"), start=1):
        line.say(nmea.format("CARXD", 3, 1, 0, n, data.hex()))
    eventually(lambda: b"second" in (service.store.get_state("arriving") or b""), what="frames on the disk")
    assert decompressor.received == []
    killed = service.store.get_state("arriving")
    runner.stop(service)  # which writes the packet down as it is, so the disk is put back as a kill leaves it
    service = OpModemService(service.platform, service.config)
    with service.store.transaction() as tx:
        tx.put_state("arriving", killed)
    runner.start(service)
    eventually(lambda: [f.packet for f in decompressor.received] == [1, 1, 2, 2])
    del decompressor.received[:2]
    assert [(f.data, f.frame_number, f.rate, f.quality, f.frame_count) for f in decompressor.received] == [
        (b"first", 1, 1, None, None),
        (b"second", 2, 1, None, None),
    ]
    assert b"second" not in service.store.get_state("arriving")
    line.say(sentences(1, b"after"))
    eventually(lambda: len(decompressor.received) == 3)
    assert decompressor.received[2].data == b"after"


def test_frames_heard_while_nobody_takes_them_wait_over_a_restart(begin, runner):
    service = begin()
    service.on_modem_event(packet(frame(1, b"kept")))
    assert service.health().gauges["outbox"] == 1
    runner.stop(service)
    begin()
    late = runner.peer("vessel-1", "decompressor", {RX: AcousticFrame})
    eventually(lambda: [f.data for f in late.received] == [b"kept"])


def test_a_frame_for_somebody_else_is_taken_and_link_quality_with_it(modem_pair, begin, decompressor, serial_cable):
    modem_pair.start()
    line = serial_cable(modem_pair.port(modem_pair.VESSEL))
    service = begin(port=line.port)
    eventually(lambda: service.modem.ready)
    line.say(sentences(1, b"overheard", dest=9))
    eventually(lambda: len(decompressor.received) == 1)
    got = decompressor.received[0]
    assert (got.destination, got.data, got.rate, got.frame_count) == (9, b"overheard", 1, 1)
    assert (got.quality.snr_in_db, got.quality.frames, got.quality.bad_frames) == (12.5, 1, 0)


def test_garbage_on_the_line_is_counted_and_frames_after_it_are_taken(modem_pair, begin, decompressor, serial_cable):
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
    eventually(lambda: [f.data for f in decompressor.received] == [b"good"])
    assert service.health().state == "ok"


@pytest.mark.parametrize("bad", [frame(9), frame(200), frame(1, bytes(2049))], ids=["number", "number-200", "length"])
def test_a_frame_no_modem_sends_is_kept_apart_and_jams_nothing(bad, begin, decompressor, refused, caplog):
    service = begin()
    service.on_modem_event(packet(frame(1, b"before"), bad))
    service.on_modem_event(packet(frame(1, b"after")))
    eventually(lambda: [f.data for f in decompressor.received] == [b"before", b"after"])
    [(key, reason)] = refused(service)
    assert key == RX
    assert f"frame {bad.frame_number} of {len(bad.data)} bytes" in reason
    assert service.health().counters["frames_refused"] == 1
    assert service.health().gauges["unsaved"] == 0
    assert any(r.message == "Frame refused" for r in caplog.records)


def test_impossible_circumstances_of_a_good_frame_are_unknown(begin, decompressor):
    service = begin()
    odd = LinkStatistics(mode=0, arrival_time="", clock="", nframes=-5, nbad=-1, snr_in_db=7.5)
    service.on_modem_event(packet(frame(1, b"good", rate=77), nframes=200, rate=77, statistics=odd))
    eventually(lambda: len(decompressor.received) == 1)
    got = decompressor.received[0]
    assert (got.data, got.rate, got.frame_count) == (b"good", None, None)
    assert (got.quality.snr_in_db, got.quality.frames, got.quality.bad_frames) == (7.5, None, None)


number = st.none() | st.integers(-(2**31), 2**31)
real = st.none() | st.floats(allow_nan=False, allow_infinity=False)


@settings(max_examples=200, deadline=None)
@given(snr_in_db=real, snr_out_db=real, spl_db=number, mse_db=real, doppler=real, nframes=number, nbad=number)
def test_whatever_a_modem_measures_fits_the_record(**measured):
    quality = quality_of(LinkStatistics(mode=0, arrival_time="", clock="", **measured))
    assert quality.snr_in_db == measured["snr_in_db"]
    assert quality.frames is None or quality.frames == measured["nframes"] >= 0


def test_a_port_that_is_not_there_is_named_and_used_when_it_comes(modem_pair, begin):
    service = begin()
    eventually(lambda: modem_pair.port(modem_pair.VESSEL) in service.health().detail)
    assert service.health().state == "degraded"
    modem_pair.start()
    eventually(lambda: service.health().state == "ok")
    modem_pair.stop()
    eventually(lambda: service.health().state == "degraded")
    assert modem_pair.port(modem_pair.VESSEL) in service.health().detail
    modem_pair.start()
    eventually(lambda: service.health().state == "ok")


def test_a_full_disk_keeps_frames_in_memory_and_saves_them_later(begin, decompressor):
    service = begin()
    service.store._db.execute("PRAGMA max_page_count=1")
    frames = [bytes([n]) * 2000 for n in range(20)]
    for data in frames:
        service.on_modem_event(packet(frame(1, data)))
    assert service.health().state == "degraded"
    assert "disk is full" in service.health().detail
    unsaved = service.health().gauges["unsaved"]
    assert unsaved >= 15
    service.store._db.execute("PRAGMA max_page_count=1000000")
    eventually(lambda: len(decompressor.received) == len(frames))
    assert [f.data for f in decompressor.received] == frames
    assert [f.packet for f in decompressor.received] == list(range(1, 21))
    assert service.health().gauges["unsaved"] == 0
    eventually(lambda: "disk is full" not in service.health().detail)


def test_frames_of_a_full_disk_are_saved_at_the_stop(begin, runner):
    service = begin()
    # Nobody tries again by itself any more: only the stop is left.
    service.stopping.set()
    service.store._db.execute("PRAGMA max_page_count=1")
    for n in range(20):
        service.on_modem_event(packet(frame(1, bytes([n]) * 2000)))
    assert service.health().gauges["unsaved"] > 0
    service.store._db.execute("PRAGMA max_page_count=1000000")
    runner.stop(service)
    begin()
    late = runner.peer("vessel-1", "decompressor", {RX: AcousticFrame})
    eventually(lambda: [f.data[0] for f in late.received] == list(range(20)))


def test_memory_is_bounded_and_what_it_drops_is_said(begin, monkeypatch, caplog, decompressor):
    monkeypatch.setattr(op_modem, "MAX_UNSAVED", 5)
    service = begin()
    service.store._db.execute("PRAGMA max_page_count=1")
    for n in range(30):
        service.on_modem_event(packet(frame(1, bytes([n]) * 2000)))
    assert service.health().gauges["unsaved"] == 5
    lost = service.health().counters["packets_lost"]
    assert lost >= 15
    assert sum(r.message == "The oldest unsaved packet is lost" for r in caplog.records) == lost
    service.store._db.execute("PRAGMA max_page_count=1000000")
    eventually(lambda: len(decompressor.received) == 30 - lost)
    assert decompressor.received[-1].data[0] == 29
