"""Limits on the images of each vehicle and hour: what exceeds them waits, and is neither lost nor reordered."""

from builders.acoustic_attack import LONDON, PREFIX, forged_contact
from builders.common import eventually
from builders.vessel_frames import packet

from sonarpost import wire
from sonarpost.link.receiver import ImageUpdate, received_image
from sonarpost.messages import ReceivedImage
from sonarpost.services.op_modem import image_limiter
from sonarpost.services.op_modem.image_limiter import UNLISTED, ImageLimiter, decoded_pixels

VESSEL = "vessel-1"
PIXELS = 512 * 512
COST_BYTES = PIXELS + len(PREFIX)


def image(number, version=1, vehicle_id="uuv-1", stream=PREFIX):
    update = ImageUpdate(3, f"{number:04d}", version, LONDON, stream, (), False, len(stream), 0, 0, 0, 1e9, 1e9)
    return received_image(update, VESSEL, vehicle_id)


def limiter(images=1000, image_bytes=1 << 40):
    return ImageLimiter(images, image_bytes, frozenset({"uuv-1", "uuv-2"}))


def add(limits, *images):
    return [limits.add(each, wire.encode(each)) for each in images]


def released(limits, now):
    found = [wire.decode(ReceivedImage, payload, "here") for payload in limits.release(now)]
    return [(each.vehicle_id, each.image_id, each.version) for each in found]


def test_images_beyond_the_hourly_number_wait_and_follow_as_the_allowance_grows():
    limits = limiter(images=60)
    add(limits, *(image(number) for number in range(1, 101)))
    assert len(released(limits, 0.0)) == 60
    assert limits.held == 40
    assert limits.held_names == ("uuv-1",)
    assert not limits.can_release(59.0)
    assert limits.can_release(60.5)
    assert released(limits, 60.5) == [("uuv-1", "0061", 1)]
    assert [name for _, name, _ in released(limits, 3700.0)] == [f"{n:04d}" for n in range(62, 101)]
    assert limits.held == 0


def test_byte_limit_counts_pixels_and_coded_bytes_of_every_version():
    limits = limiter(image_bytes=3 * COST_BYTES)
    add(limits, image(1), image(2))
    assert len(released(limits, 0.0)) == 2
    add(limits, image(1, version=2), image(3))
    assert released(limits, 0.0) == [("uuv-1", "0001", 2)]
    assert limits.held == 1
    assert released(limits, 1201.0) == [("uuv-1", "0003", 1)]


def test_newer_version_replaces_the_one_that_waits_and_keeps_its_place():
    limits = limiter(images=1)
    add(limits, image(1), image(2), image(3))
    assert released(limits, 0.0) == [("uuv-1", "0001", 1)]
    add(limits, image(2, version=2), image(2, version=3))
    assert limits.held == 2
    assert released(limits, 3600.0) == [("uuv-1", "0002", 3)]
    assert released(limits, 7200.0) == [("uuv-1", "0003", 1)]


def test_vehicles_have_separate_allowances_and_unlisted_ones_share_one():
    limits = limiter(images=2)
    add(
        limits, *(image(n, vehicle_id=vehicle) for vehicle in ("uuv-1", "modem-9", "modem-10", "uuv-2") for n in (1, 2))
    )
    vehicles = [vehicle for vehicle, _, _ in released(limits, 0.0)]
    assert vehicles == ["uuv-1"] * 2 + ["modem-9"] * 2 + ["uuv-2"] * 2
    assert limits.held_names == (UNLISTED,)


def test_saved_state_keeps_waiting_images_and_allowances():
    limits = limiter(images=2)
    add(limits, *(image(n) for n in range(1, 5)))
    assert len(released(limits, 100.0)) == 2
    again = limiter(images=2)
    assert again.restore(limits.parts()) == {}
    assert again.held == 2
    assert again.parts() == limits.parts()
    assert released(again, 101.0) == []
    assert released(again, 100.0 + 1800.5) == [("uuv-1", "0003", 1)]
    add(again, image(5))
    assert [name for _, name, _ in released(again, 100.0 + 3 * 3600)] == ["0004", "0005"]


def test_damaged_part_is_reported_and_the_rest_is_used():
    limits = limiter(images=1)
    add(limits, *(image(n) for n in range(1, 4)))
    limits.release(0.0)
    names = [name for name in limits.parts() if name.startswith("held/")]
    again = limiter(images=1)
    assert set(again.restore({**limits.parts(), names[0]: b"\xc1"})) == {names[0]}
    assert again.held == 1


def test_memory_of_waiting_images_is_bounded(monkeypatch):
    monkeypatch.setattr(image_limiter, "MAX_HELD_IMAGES", 3)
    limits = limiter(images=1)
    assert add(limits, image(1)) == [True]
    limits.release(0.0)
    assert add(limits, *(image(n) for n in range(2, 7))) == [True] * 3 + [False] * 2
    assert add(limits, image(2, version=2)) == [True]
    monkeypatch.setattr(image_limiter, "MAX_HELD_BYTES", 2000)
    assert add(limits, image(3, version=2, stream=bytes(3000))) == [False]
    assert limits.held == 3


def test_clock_that_is_set_back_grants_nothing():
    limits = limiter(images=1)
    add(limits, image(1), image(2))
    assert len(released(limits, 1e6)) == 1
    assert released(limits, 0.0) == []
    assert released(limits, 1e6 + 3601.0) == [("uuv-1", "0002", 1)]


def test_decoded_size_is_that_of_the_stream_header_or_of_the_contact_record():
    assert decoded_pixels(image(1)) == PIXELS
    assert decoded_pixels(image(1, stream=b"")) == PIXELS
    bare = image(1, stream=b"").model_copy(update={"height_px": None, "width_px": None})
    assert decoded_pixels(bare) == 256
    header = image(1).model_copy(update={"height_px": 16, "width_px": 16})
    assert decoded_pixels(header) == PIXELS


def test_frames_of_a_faulty_vehicle_do_not_become_hundreds_of_megabytes(begin, decompressor, caplog):
    """Without authentication: 200 frames of 60 bytes announce 52 MB of pixels; the limit is 4 MB an hour."""
    limit_bytes = 16 * COST_BYTES
    service = begin(max_image_bytes_per_hour=limit_bytes)
    for number in range(1, 201):
        service.on_modem_event(packet(forged_contact(number)))
    eventually(lambda: len(decompressor.received) >= 16)
    health = service.health()
    assert health.counters["images_received"] == 200
    assert health.gauges["images_held"] + len(decompressor.received) >= 200
    # The allowance grows while the test runs, by one image in four minutes.
    assert 16 <= len(decompressor.received) <= 20
    assert health.counters["images_limited"] >= 180
    assert "uuv-1" in health.detail
    assert "max_image_bytes_per_hour" in health.detail
    assert sum("Image limit reached" in record.message for record in caplog.records) == 1
    assert all(each.authenticated is False for each in decompressor.received)


def test_waiting_images_survive_a_restart_and_follow_later(begin, runner, decompressor):
    service = begin(max_images_per_hour=3)
    for number in range(1, 6):
        service.on_modem_event(packet(forged_contact(number)))
    eventually(lambda: len(decompressor.received) == 3)
    assert service.health().gauges["images_held"] == 2.0
    runner.stop(service)
    service = begin(max_images_per_hour=1_000_000)
    eventually(lambda: {each.image_id for each in decompressor.received} == {f"{n:04d}" for n in range(1, 6)})
    assert service.health().gauges["images_held"] == 0.0
    assert len(decompressor.received) == 5
