"""The vehicle's status: which one is sent and when, on its way to the vessel, and hostile ones there."""

from dataclasses import replace

import msgpack
import pytest
from builders.common import eventually
from builders.joined_surveys import FEW_CANDIDATES, split, survey_of
from builders.records import outgoing_message
from builders.vessel_frames import packet
from hypothesis import given
from hypothesis import strategies as st

from sonarpost import keys, wire
from sonarpost.errors import BadInputError, FrameError, PayloadError
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import AcousticKey, Direction
from sonarpost.link.config import QueueConfig
from sonarpost.link.downlink import messages as dl
from sonarpost.link.downlink.status_message import StatusMessage
from sonarpost.link.frames.v1.frame import Segment, SegmentKind, pack_segments, parse_frame, segments_room
from sonarpost.link.queue.transmit_queue import TransmitQueue
from sonarpost.messages import ReceivedStatus, VehicleStatus
from sonarpost.modem.micromodem import RATES
from sonarpost.security.acoustic_key import create_key, read_key
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.service import AtdStubService
from sonarpost.services.op_modem.reception import StatusLimiter, status_record
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.status_beacon import FRESH_S, StatusBeacon

VESSEL = "vessel-1"
RECEIVED = keys.acoustic_status(VESSEL)
STATUS = VehicleStatus(
    vehicle_id="uuv-1",
    time_utc_s=1_790_000_000.9,
    lat_deg=41.5251,
    lon_deg=-70.6712,
    heading_deg=271.4,
    speed_mps=1.52,
    depth_m=12.31,
    altitude_m=3.4,
    swath_m=74.6,
    battery=0.634,
)


@pytest.fixture
def published(watch):
    """Return the statuses that the vessel has published so far."""
    samples = watch(RECEIVED)
    return lambda: [wire.decode(ReceivedStatus, s.payload.to_bytes(), RECEIVED) for s in samples]


def frame_of(status, number=0, authenticator=None):
    data = status if isinstance(status, bytes) else dl.pack(status)
    return pack_segments([Segment(SegmentKind.MESSAGE, bytes([number]) + data)], 32, authenticator)


# Message


def test_a_status_fits_the_smallest_frame_with_a_tag():
    packed = dl.pack(StatusMessage(time_utc_s=0))
    assert len(packed) == 22
    authenticator = FrameAuthenticator(AcousticKey(bytes(range(32))), 3, Direction.FROM_VEHICLE)
    segment = Segment(SegmentKind.MESSAGE, b"\0" + packed)
    assert segment.size <= segments_room(32, authenticator)


@given(st.binary(min_size=21, max_size=21))
def test_any_bytes_are_a_status_within_its_bounds_or_an_error(body):
    try:
        status = StatusMessage.unpack(body)
    except FrameError:
        return
    record = status_record(status, VESSEL, "uuv-1", 0.0, authenticated=False)
    assert wire.decode(ReceivedStatus, wire.encode(record), RECEIVED) == record
    assert StatusMessage.unpack(status.pack()) == status


def test_error_names_the_invalid_field():
    for offset, value, field in [
        (4, b"\x7f\xff\xff\xff", "lat_deg"),
        (8, b"\x7f\xff\xff\xff", "lon_deg"),
        (8, b"\x80\0\0\0", "lon_deg"),
        (12, b"\xf0", "heading_deg"),
        (18, b"\x65", "battery"),
    ]:
        body = bytearray(StatusMessage(time_utc_s=1, lat_deg=1.0, lon_deg=2.0).pack())
        body[offset : offset + len(value)] = value
        with pytest.raises(FrameError) as caught:
            dl.unpack(b"\x11" + bytes(body))
        assert caught.value.field == field
    for length in (0, 20, 22):
        with pytest.raises(FrameError, match="length"):
            dl.unpack(b"\x11" + bytes(length))


def test_values_are_limited_to_what_the_message_holds():
    status = StatusMessage(
        time_utc_s=1,
        speed_mps=-40,
        depth_m=-3.0,
        altitude_m=9000,
        swath_m=9000,
        images_waiting=10**6,
        disk_free_bytes=5,
    )
    received = StatusMessage.unpack(status.pack())
    assert (received.speed_mps, received.depth_m, received.altitude_m) == (-12.7, 0.0, 127.0)
    assert (received.swath_m, received.images_waiting, received.disk_free_bytes) == (508.0, 254, 0)


# Vehicle


def test_a_status_is_due_once_a_period_and_after_the_clock_was_set_back():
    beacon = StatusBeacon("uuv-1", 60.0)
    assert beacon.is_due(1000.0)
    beacon.queued(1000.0)
    assert [beacon.is_due(now) for now in (1000.0, 1059.9, 1060.0, 999.0)] == [False, False, True, True]
    assert not StatusBeacon("uuv-1", 0.0).is_due(1000.0)


def test_an_older_status_replaces_a_newer_one_only_after_a_minute():
    beacon = StatusBeacon("uuv-1", 60.0)
    assert beacon.message(5.7, 0, None) == StatusMessage(time_utc_s=5, images_waiting=0)
    older = STATUS.model_copy(update={"time_utc_s": 1000.0})
    beacon.set_status(STATUS, 100.0)
    beacon.set_status(older, 101.0)
    assert beacon.message(0.0, 3, 10**9).lat_deg == STATUS.lat_deg
    assert beacon.message(0.0, 3, 10**9).time_utc_s == 1_790_000_000
    beacon.set_status(older, 100.0 + FRESH_S)
    assert beacon.message(0.0, 3, 10**9).time_utc_s == 1000
    with pytest.raises(PayloadError, match="vehicle_id"):
        beacon.set_status(STATUS.model_copy(update={"vehicle_id": "uuv-2"}), 200.0)


def test_a_status_is_sent_in_one_packet_and_dropped_when_it_expires():
    queue = TransmitQueue(QueueConfig(rates=(RATES[1],), first_rate=1, expected_loss=0.4))
    data = dl.pack(StatusMessage(time_utc_s=7))
    assert queue.add_message("s1", "uuv_modem status", data, 0.0, priority=5, lifetime_s=60.0, once=True)
    sent = []
    for step in range(10):
        if (out := queue.next_packet(float(step))) is not None:
            sent += out.frames
            queue.sent(out.frames, 6.0)
    restored = TransmitQueue(QueueConfig(rates=(RATES[1],), first_rate=1))
    found = [
        s for frame in sent for s in parse_frame(frame) if isinstance(s, Segment) and s.kind == SegmentKind.MESSAGE
    ]
    assert [s.data[1:] for s in found] == [data] * 2, "one packet, with a copy in a free frame"
    queue.add_message("s2", "uuv_modem status", data, 100.0, priority=5, lifetime_s=60.0, once=True)
    assert restored.restore(queue.parts()) == {}
    assert restored.next_packet(161.0) is None


@pytest.mark.parametrize("options", [{"status_period_s": 2.0}, {"status_period_s": 60.0, "link": "paper"}])
def test_invalid_period_is_rejected(options):
    with pytest.raises(ValueError, match="status_period_s"):
        UuvModemConfig(port="/dev/null", **options)


def test_status_reaches_the_vessel(start_service, start_vessel, published, modem_pair, client):
    modem_pair.start()
    start_vessel()
    vehicle = start_service(status_period_s=5.0)
    key = keys.vehicle_status("uuv-1")

    def received():
        client.put(key, b"malformed")
        client.put(key, wire.encode(STATUS.model_copy(update={"vehicle_id": "uuv-2"})))
        client.put(key, wire.encode(STATUS))
        return [each for each in published() if each.status.lat_deg is not None]

    eventually(lambda: bool(received()), what="a status with a position")
    record = received()[0]
    assert (record.vessel_id, record.vehicle_id, record.authenticated) == (VESSEL, "uuv-1", False)
    status = record.status
    assert (status.vehicle_id, status.time_utc_s) == ("uuv-1", 1_790_000_000.0)
    assert (status.lat_deg, status.lon_deg, status.heading_deg) == (41.5251, -70.6712, 271.5)
    assert (status.speed_mps, status.depth_m, status.altitude_m) == (1.5, 12.4, 3.5)
    assert (status.swath_m, status.battery, status.images_waiting) == (74.0, 0.63, 0)
    assert status.disk_free_bytes is not None
    assert vehicle.health().counters["statuses_ignored"] >= 2


def test_without_a_period_no_status_is_sent(start_service, start_vessel, published, modem_pair, runner, client):
    modem_pair.start()
    vessel = start_vessel()
    vehicle = start_service()
    client.put(keys.vehicle_status("uuv-1"), wire.encode(STATUS))
    runner.peer("uuv-1", "autonomy").send(keys.message_outgoing("uuv-1"), "uuv_modem", outgoing_message("m1"))
    eventually(lambda: vessel.health().counters.get("messages_received") == 1)
    assert published() == []
    assert vehicle.health().counters.get("statuses_queued", 0) == 0


# Vessel


def test_a_vehicle_that_sends_too_many_is_limited():
    limiter = StatusLimiter(5.0, [3, 4])
    first, second = StatusMessage(time_utc_s=1), StatusMessage(time_utc_s=2)
    assert limiter.latest(3, [], 100.0) is None
    assert limiter.latest(3, [first, second], 100.0) == second
    assert [limiter.latest(3, [first], now) for now in (100.0, 104.9)] == [None, None]
    assert limiter.latest(4, [first], 104.9) == first, "the limit is for each vehicle"
    assert limiter.latest(3, [first], 105.0) == first
    assert [limiter.latest(source, [first], 105.0) for source in (5, 6)] == [first, None], "others share one limit"
    assert limiter.latest(3, [second], 50.0) == second, "the clock was set back"


def test_a_flood_of_statuses_is_published_at_the_limited_rate(start_vessel, published):
    service = start_vessel(status_interval_s=3600.0)
    for number in range(50):
        service.on_modem_event(packet(frame_of(StatusMessage(time_utc_s=number), number)))
    service.on_modem_event(packet(frame_of(b"\x11" + bytes(5), 60)))
    service.on_modem_event(packet(frame_of(StatusMessage(time_utc_s=99), 61), src=4))  # has a limit of its own
    eventually(lambda: [status.status.time_utc_s for status in published()] == [0.0, 99.0])
    counters = service.health().counters
    assert (counters["statuses_received"], counters["statuses_dropped"], counters["frames_rejected"]) == (51, 49, 1)


def test_a_station_without_the_key_cannot_inject_a_status(start_vessel, published, tmp_path):
    key_file = tmp_path / "acoustic.key"
    create_key(key_file)
    service = start_vessel(key_file=key_file)
    genuine = StatusMessage(time_utc_s=77)
    for key in (None, AcousticKey(bytes(range(32)))):
        forger = None if key is None else FrameAuthenticator(key, 3, Direction.FROM_VEHICLE)
        if forger is not None:
            forger.grant(64)
        service.on_modem_event(packet(frame_of(replace(genuine, time_utc_s=1), 1, forger)))
    assert service.health().counters["frames_rejected"] == 2
    owner = FrameAuthenticator(read_key(key_file), 3, Direction.FROM_VEHICLE)
    owner.grant(64)
    frame = frame_of(genuine, 2, owner)
    service.on_modem_event(packet(frame))
    service.on_modem_event(packet(frame))
    eventually(lambda: len(published()) == 1)
    assert (published()[0].status.time_utc_s, published()[0].authenticated) == (77.0, True)
    assert service.health().counters["frames_rejected"] == 3, "the replay"


# Navigation from a survey


def test_the_detector_publishes_the_status_of_the_newest_ping(runner, platform, tmp_path, watch):
    samples = watch(keys.vehicle_status("uuv-1"))
    survey = survey_of(100)
    (tmp_path / "incoming").mkdir()
    split(tmp_path / "incoming", survey, (0, 100))
    config = AtdStubConfig(input_dir=tmp_path / "incoming", poll_s=0.02, settle_s=0.0, detector=FEW_CANDIDATES)
    runner.start(AtdStubService(platform("uuv-1"), config))
    eventually(lambda: len(samples) >= 2, what="a repeated status")
    status = wire.decode(VehicleStatus, samples[-1].payload.to_bytes(), "status")
    last = survey.pings[-1]
    assert status.vehicle_id == "uuv-1"
    assert status.time_utc_s == pytest.approx(last.time_utc_s, abs=0.02)
    assert (status.lat_deg, status.lon_deg) == (pytest.approx(last.lat_deg), pytest.approx(last.lon_deg))
    assert status.swath_m is not None
    assert status.swath_m <= last.max_slant_range_m()


def test_a_record_with_half_a_position_is_rejected():
    payload = wire.encode(STATUS)
    fields = wire.unpack_map(payload, "status") | {"lon_deg": None}
    with pytest.raises(BadInputError, match="lon_deg"):
        wire.decode(VehicleStatus, msgpack.packb(fields), "status")
