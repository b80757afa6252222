"""decompressor: halves paired, pictures with what is missing, files and record that agree, nothing lost."""

from __future__ import annotations

import hashlib
import json
import time
from datetime import UTC, datetime

import msgpack
import numpy as np
import pytest
from builders.common import eventually
from PIL import Image

from sonarpost import keys
from sonarpost.archive.image_files import image_file_name
from sonarpost.codec.interface import StreamHeader
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.codec.vq.codebook import Codebook, open_codebook, save
from sonarpost.codec.vq.codec import codebook_tag
from sonarpost.codec.vq.tiles import TileDatabase
from sonarpost.errors import CodebookError
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.frame import ContactFrame, parse_frame
from sonarpost.link.frames.paper.sender import plan_packets
from sonarpost.messages import AcousticFrame, ReconstructedImage
from sonarpost.runtime.service import UnitOfWork
from sonarpost.services.decompressor import service as decompressor
from sonarpost.services.decompressor.config import DecompressorConfig
from sonarpost.services.decompressor.service import DecompressorService
from sonarpost.sonar.image_files import read_image

IN, OUT = keys.acoustic_rx("vessel-1"), keys.image_reconstructed("vessel-1")
FRAMES, FRAME_BYTES = 3, 64
CONTACT = ContactSummary(height_px=40, width_px=60, lat_deg=56.4, lon_deg=-5.6, time_utc_s=1_475_568_000.0)


@pytest.fixture(scope="session")
def vq():
    return default_registry().create("vq", CodecResources(open_codebook("nominal-10").tiles))


@pytest.fixture
def stream(vq, texture):
    return lambda seed=1, *size: vq.encode(texture(*(size or (40, 60)), seed=seed))


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"


@pytest.fixture
def begin(runner, platform, out):
    def start(**options):
        usual = {"out_dir": out, "codebooks": ("nominal-10",), "vehicles": {"3": "uuv-1"}, "pairing_timeout_s": 60.0}
        return runner.start(DecompressorService(platform("vessel-1"), DecompressorConfig(**(usual | options))))

    return start


@pytest.fixture
def relay(runner):
    return runner.peer("vessel-1", "relay", {OUT: ReconstructedImage})


@pytest.fixture
def modem(runner):
    return runner.peer("vessel-1", "op_modem")


def frame(data, *, at_utc_s=None, source=3, number=1):
    return AcousticFrame(
        direction="rx",
        platform_id="vessel-1",
        time_utc_s=time.time() if at_utc_s is None else at_utc_s,
        source=source,
        destination=1,
        rate=1,
        packet=1,
        frame_number=number,
        frame_count=FRAMES,
        data=data,
    )


def hear(modem, *frames, **options):
    """What op_modem owes for frames that came out of the water."""
    modem.send(IN, "decompressor", *(frame(data, **options) for data in frames))


def frames_of(image_id, stream, contact=CONTACT):
    return [data for packet in plan_packets(image_id, stream, contact, FRAMES, FRAME_BYTES) for data in packet]


def half(image_id, stream, name):
    """The one frame that carries this half of a small picture."""
    parsed = {data: parse_frame(data) for data in frames_of(image_id, stream, None)}
    [found] = [data for data, half in parsed.items() if half.half == name]
    return found


def test_both_halves_and_the_contact_make_a_picture(begin, modem, relay, stream, vq, out, check_monitoring, watch):
    seen = watch(OUT)
    service = begin()
    data = stream()
    size = StreamHeader.unpack(data).size
    hear(modem, *frames_of("0A1B", data), at_utc_s=1_700_000_000.0)
    eventually(lambda: len(relay.received) == 1)
    image = relay.received[0]
    assert (image.vessel_id, image.vehicle_id, image.image_id, image.version) == ("vessel-1", "uuv-1", "0A1B", 1)
    assert (image.complete, image.missing_fraction, image.missing_halves, image.missing_mask) == (True, 0.0, (), b"")
    assert (image.codec, image.model) == ("vq", vq.model_hash)
    assert (image.bytes_received, image.bytes_total) == (len(data) - size, len(data) - size)
    np.testing.assert_array_equal(image.picture.to_array(), vq.decode(data).image)
    assert (image.contact.contact_id, image.contact.lat_deg) == ("uuv-1/0A1B", 56.4)
    eventually(lambda: service.health().counters.get("images_complete") == 1)
    assert service.health().gauges["images_waiting"] == 0.0
    eventually(lambda: len(seen) == 1, what="the copy for watchers")
    shown = msgpack.unpackb(seen[0].payload.to_bytes())
    assert hashlib.sha256(shown["picture"]["data"]).hexdigest() == shown["picture_sha256"] == image.picture.sha256
    check_monitoring(service)


def test_files_and_record_are_the_same_picture(begin, modem, relay, stream, out):
    begin()
    hear(modem, *frames_of("0A1B", stream()), at_utc_s=1_700_000_000.0)
    eventually(lambda: len(relay.received) == 1)
    image = relay.received[0]
    name = f"uuv-1_{datetime.fromtimestamp(1_700_000_000, UTC):%Y%m%dT%H%M%SZ}_0A1B_v1"
    assert image_file_name(image) == name
    assert {p.name for p in out.iterdir()} == {f"{name}.{kind}" for kind in ("tiff", "png", "json")}
    tiff, png = read_image(out / f"{name}.tiff"), np.asarray(Image.open(out / f"{name}.png"))
    np.testing.assert_array_equal(tiff, png)
    assert hashlib.sha256(tiff.tobytes()).hexdigest() == image.picture_sha256
    side = json.loads((out / f"{name}.json").read_text())
    assert side["picture_sha256"] == image.picture_sha256
    assert (side["image_id"], side["contact"]["lat_deg"], side["missing_pixels"]) == ("0A1B", 56.4, 0)
    assert (side["height_px"], side["width_px"], side["bits"]) == (40, 60, 8)


@pytest.mark.parametrize(("heard", "missing"), [("top", "bottom"), ("bottom", "top")])
def test_a_half_of_the_next_image_flushes_the_one_before(heard, missing, begin, modem, relay, stream, vq):
    begin()
    first = stream(1)
    hear(modem, half("AAAA", first, heard), half("BBBB", stream(2), "top"))
    eventually(lambda: len(relay.received) == 1)
    image = relay.received[0]
    assert (image.image_id, image.complete, image.missing_halves) == ("AAAA", False, (missing,))
    assert image.missing_fraction == pytest.approx(0.5, abs=0.1)
    pixels, black = image.picture.to_array(), image.missing()
    assert (pixels[black] == 0).all()
    np.testing.assert_array_equal(pixels[~black], vq.decode(first).image[~black])
    rows = np.flatnonzero(black.any(axis=1))
    assert (rows.min() >= 20) if missing == "bottom" else (rows.max() < 20)


def test_a_contact_of_another_image_flushes_nothing(begin, modem, relay, stream):
    service = begin()
    data = stream(1)
    hear(modem, half("AAAA", data, "top"), ContactFrame("BBBB", CONTACT).pack(), half("AAAA", data, "bottom"))
    eventually(lambda: len(relay.received) == 1)
    assert relay.received[0].complete
    assert service.health().gauges["images_waiting"] == 1.0


def test_two_vehicles_do_not_flush_each_other(begin, modem, relay, stream):
    begin()
    one, two = stream(1), stream(2)
    hear(modem, half("AAAA", one, "top"), source=3)
    hear(modem, half("AAAA", two, "top"), source=9)
    hear(modem, half("AAAA", two, "bottom"), source=9)
    hear(modem, half("AAAA", one, "bottom"), source=3)
    eventually(lambda: len(relay.received) == 2)
    assert [(i.vehicle_id, i.complete) for i in relay.received] == [("modem-9", True), ("uuv-1", True)]


def test_a_half_that_stays_alone_is_given_out_after_the_time_out(begin, modem, relay, stream):
    begin(pairing_timeout_s=0.3)
    hear(modem, half("AAAA", stream(), "bottom"))
    eventually(lambda: len(relay.received) == 1)
    assert relay.received[0].missing_halves == ("top",)


def test_a_late_half_makes_the_next_version(begin, modem, relay, stream, out):
    begin(pairing_timeout_s=0.3)
    data = stream()
    hear(modem, half("AAAA", data, "top"))
    eventually(lambda: len(relay.received) == 1)
    hear(modem, half("AAAA", data, "bottom"))
    eventually(lambda: len(relay.received) == 2)
    assert [(i.version, i.complete) for i in relay.received] == [(1, False), (2, True)]
    assert len(list(out.glob("*.tiff"))) == 2


def test_only_the_contact_record_arrives(begin, modem, relay, out):
    begin(pairing_timeout_s=0.3)
    hear(modem, ContactFrame("AAAA", CONTACT).pack())
    eventually(lambda: len(relay.received) == 1)
    image = relay.received[0]
    assert (image.contact.lat_deg, image.contact.time_utc_s) == (56.4, 1_475_568_000.0)
    assert (image.codec, image.bytes_total, image.missing_fraction, image.complete) == ("", 0, 1.0, False)
    assert image.missing_halves == ("top", "bottom")
    assert not image.picture.to_array().any()
    assert "only the contact record arrived" in image.notes
    assert len(list(out.glob("*.json"))) == 1


def test_an_index_beyond_the_codebook_is_a_black_tile(begin, modem, relay, stream, vq):
    begin()
    data = bytearray(stream())
    assert len(vq.tiles) < 1 << 14
    start = StreamHeader.unpack(data).size
    data[start : start + 2] = b"\xff\xff"
    hear(modem, *frames_of("AAAA", bytes(data)))
    eventually(lambda: len(relay.received) == 1)
    image, whole = relay.received[0], vq.decode(stream()).image
    pixels, black = image.picture.to_array(), image.missing()
    assert black[:10, :10].all()
    assert (pixels[black] == 0).all()
    assert 1 <= black.sum() / 100 <= 2, "that tile, and the one that shares its bits"
    np.testing.assert_array_equal(pixels[~black][200:], whole[~black][200:])
    assert not image.complete
    assert image.notes


def test_a_picture_of_another_codebook_is_kept_apart_by_name(begin, modem, relay, texture, refused, vq, stream):
    service = begin()
    other = default_registry().create("vq", CodecResources(open_codebook("nominal-20").tiles))
    hear(modem, *frames_of("AAAA", other.encode(texture())), *frames_of("BBBB", stream()))
    eventually(lambda: [i.image_id for i in relay.received] == ["BBBB"])
    [(key, reason)] = refused(service)
    assert key == "image uuv-1/AAAA"
    for codec in (other, vq):
        assert f"{codebook_tag(codec.tiles):#06x}" in reason
    assert service.health().counters["images_undecodable"] == 1
    assert service.health().state == "ok"


def test_every_configured_codebook_is_used(begin, modem, relay, texture, stream):
    begin(codebooks=("nominal-10", "nominal-20"))
    other = default_registry().create("vq", CodecResources(open_codebook("nominal-20").tiles))
    hear(modem, *frames_of("AAAA", other.encode(texture())), *frames_of("BBBB", stream()))
    eventually(lambda: len(relay.received) == 2)
    assert [i.complete for i in relay.received] == [True, True]
    assert relay.received[0].model == other.model_hash != relay.received[1].model


def test_repeated_frames_change_nothing(begin, modem, relay, stream):
    service = begin()
    frames = frames_of("AAAA", stream())
    hear(modem, *frames, *frames, *reversed(frames))
    eventually(lambda: service.health().counters.get("records_handled") == 3 * len(frames))
    assert [(i.version, i.complete) for i in relay.received[:1]] == [(1, True)]
    assert service.health().counters["images_reconstructed"] == 1


@pytest.mark.parametrize("data", [b"", b"X", b"T", b"Tabcd" + bytes(20), b"T0000", b"C0000" + bytes(27)])
def test_a_frame_that_is_none_is_counted_and_passed_over(data, begin, modem, relay, stream, caplog):
    service = begin()
    hear(modem, data, *frames_of("AAAA", stream()))
    eventually(lambda: len(relay.received) == 1)
    assert relay.received[0].complete
    assert service.health().counters["frames_rejected"] == 1
    told = next(r for r in caplog.records if r.message == "Frame rejected")
    assert "acoustic frame from modem 3" in str(vars(told)["fields"])


def test_a_malformed_record_is_refused_and_the_next_taken(begin, modem, relay, stream, refused):
    service = begin()
    modem.send_bytes(IN, "decompressor", b"\x80")
    hear(modem, *frames_of("AAAA", stream()))
    eventually(lambda: len(relay.received) == 1)
    assert refused(service) == refused(modem)
    assert "expected 'acoustic_frame'" in refused(service)[0][1]


def test_a_stop_in_the_middle_of_an_image_changes_nothing(begin, runner, modem, relay, stream, vq):
    data = stream(1, 80, 140)
    for number, one in enumerate(frames_of("AAAA", data, None), start=1):
        service = begin()
        hear(modem, one)
        eventually(lambda n=number, s=service: s.health().counters.get("records_handled") == 1)
        runner.stop(service)
    begin()
    eventually(lambda: len(relay.received) == 1)
    assert (relay.received[0].complete, relay.received[0].version, relay.received[0].frames_received) == (
        True,
        1,
        number,
    )
    np.testing.assert_array_equal(relay.received[0].picture.to_array(), vq.decode(data).image)


def test_frames_that_waited_long_are_looked_at_before_time_is_up(begin, modem, relay, stream, monkeypatch, platform):
    """After the service was down for hours, halves that came seconds apart still make one whole picture."""
    monkeypatch.setattr(decompressor, "POLL_S", 0.0005)
    monkeypatch.setattr(decompressor, "QUIET_S", 2.0)
    streams = {f"{n:04d}": stream(n) for n in range(30)}
    for image_id, data in streams.items():
        modem.send(IN, "decompressor", *(frame(f, at_utc_s=1_700_000_000.0) for f in frames_of(image_id, data)))
    eventually(lambda: modem.store.outbox_depth() > 60)
    begin(pairing_timeout_s=5.0)
    eventually(lambda: len(relay.received) >= len(streams))
    assert [(i.image_id, i.version, i.complete) for i in relay.received] == [(name, 1, True) for name in streams]


def test_pictures_wait_while_the_folder_takes_none(begin, modem, relay, stream, tmp_path):
    blocker = tmp_path / "disk"
    blocker.write_text("not mounted")
    service = begin(out_dir=blocker / "out")
    hear(modem, *frames_of("AAAA", stream(1)), *frames_of("BBBB", stream(2)))
    eventually(lambda: service.health().state == "degraded")
    assert str(blocker) in service.health().detail
    assert relay.received == []
    blocker.unlink()
    eventually(lambda: [i.image_id for i in relay.received] == ["AAAA", "BBBB"])
    assert all(i.complete and i.version == 1 for i in relay.received)
    assert len(list((blocker / "out").glob("*.json"))) == 2
    eventually(lambda: service.health().state == "ok")


def test_health_stays_degraded_while_a_picture_whose_time_is_up_cannot_be_written(
    begin, modem, relay, stream, tmp_path, caplog
):
    blocker = tmp_path / "disk"
    blocker.write_text("not mounted")
    service = begin(out_dir=blocker / "out", pairing_timeout_s=0.2)
    hear(modem, half("AAAA", stream(), "top"))
    eventually(lambda: service.health().state == "degraded")
    tries = sum(r.message == "Picture not given out, trying again" for r in caplog.records)
    states = []

    def tried_again():
        states.append(service.health().state)
        told = sum(r.message == "Picture not given out, trying again" for r in caplog.records)
        return told > tries + 5

    eventually(tried_again)
    assert set(states) == {"degraded"}
    blocker.unlink()
    eventually(lambda: len(relay.received) == 1)
    eventually(lambda: service.health().state == "ok")


def test_a_frame_whose_commit_failed_is_new_when_it_is_handled_again(platform, out, stream):
    """Also the very first one, when no state has been committed to go back to."""
    service = DecompressorService(platform("vessel-1"), DecompressorConfig(out_dir=out))
    for data in frames_of("AAAA", stream())[:2]:
        for _ in range(3):
            service.handle(IN, frame(data), UnitOfWork())  # and no commit: the disk was full
        effects = UnitOfWork()
        service.handle(IN, frame(data), effects)
        service.commit(effects)
    assert (service._hearing.paper.counts.frames, service._hearing.paper.counts.duplicates) == (2, 0)
    service.store.close()


def test_a_full_disk_keeps_the_frames_with_the_modem(begin, modem, relay, stream):
    service = begin()
    service.store._db.execute("PRAGMA max_page_count=1")
    hear(modem, *frames_of("AAAA", stream(1, 200, 200)))
    eventually(lambda: service.health().state == "degraded")
    assert relay.received == []
    service.store._db.execute("PRAGMA max_page_count=1000000")
    eventually(lambda: len(relay.received) == 1)
    assert (relay.received[0].complete, relay.received[0].version) == (True, 1)
    eventually(lambda: service.health().state == "ok")


@pytest.mark.parametrize("path", ["complete", "time-out"])
def test_a_defect_in_decoding_costs_one_image(path, begin, modem, relay, stream, monkeypatch, refused):
    service = begin(pairing_timeout_s=0.2)
    decode = service._decoder.image
    monkeypatch.setattr(
        service._decoder, "image", lambda event, name: 1 // 0 if event.image_id == "AAAA" else decode(event, name)
    )
    first = stream(1)
    hear(modem, *(frames_of("AAAA", first) if path == "complete" else [half("AAAA", first, "top")]))
    eventually(lambda: len(refused(service)) == 1)
    assert refused(service)[0][0] == "image uuv-1/AAAA"
    assert "ZeroDivisionError" in refused(service)[0][1]
    hear(modem, *frames_of("BBBB", stream(2)))
    eventually(lambda: [i.image_id for i in relay.received] == ["BBBB"])
    assert not service.failed


def test_a_codebook_that_cannot_be_read_is_said_at_the_start(platform, tmp_path):
    config = DecompressorConfig(codebooks=("nominal-10", str(tmp_path / "absent.tiles")))
    with pytest.raises(CodebookError, match=r"absent\.tiles"):
        DecompressorService(platform("vessel-1"), config)


def test_two_codebooks_that_look_alike_on_the_link_are_refused(platform, tmp_path, monkeypatch):
    names = []
    for number in range(2):
        rng = np.random.default_rng(number)
        tiles = rng.integers(0, 256, (3, 100), dtype=np.uint8)
        database = TileDatabase(10, tiles, np.zeros(100, np.uint8), np.ones((1, 100), np.int16))
        names.append(str(tmp_path / f"{number}.tiles"))
        save(tmp_path / f"{number}.tiles", Codebook(database, {}))
    monkeypatch.setattr("sonarpost.services.decompressor.decoder.codebook_tag", lambda tiles: 0x1234)
    with pytest.raises(CodebookError, match="0x1234"):
        DecompressorService(platform("vessel-1"), DecompressorConfig(codebooks=tuple(names)))
    DecompressorService(platform("vessel-1"), DecompressorConfig(codebooks=(names[0], names[0]))).store.close()


def test_a_damaged_side_car_is_written_anew(begin, runner, modem, relay, stream, out, tmp_path):
    service = begin()
    frames = frames_of("AAAA", stream())
    hear(modem, *frames, at_utc_s=1_700_000_000.0)
    eventually(lambda: len(relay.received) == 1)
    [side] = out.glob("*.json")
    whole = side.read_bytes()
    runner.stop(service)
    side.write_bytes(b"\xff\xfe half of it")
    (service.platform.state_dir / "decompressor.db").unlink()
    for suffix in ("-wal", "-shm"):
        (service.platform.state_dir / f"decompressor.db{suffix}").unlink(missing_ok=True)
    begin()
    hear(modem, *frames, at_utc_s=1_700_000_000.0)
    eventually(lambda: len(relay.received) == 2)
    assert side.read_bytes() == whole
