"""decompressor: decodes received images, marks missing pixels, writes files that agree with the record."""

import hashlib
import json
import math
import os
import time
from datetime import UTC, datetime

import msgpack
import numpy as np
import pytest
from builders.common import eventually
from builders.vessel_frames import CONTACT
from PIL import Image

from research.codebook.codebook_file import save
from sonarpost import keys
from sonarpost.archive.decoder import Decoder
from sonarpost.archive.image_files import image_file_name
from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.codec.interface import StreamHeader
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.codec.vq.codebook import Codebook, open_codebook
from sonarpost.codec.vq.codec import codebook_tag
from sonarpost.codec.vq.tiles import TileDatabase
from sonarpost.errors import CodebookError
from sonarpost.link.frames.paper.frame import ContactFrame, parse_frame
from sonarpost.link.frames.paper.receiver import PaperReceiver
from sonarpost.link.frames.paper.sender import plan_packets
from sonarpost.link.receiver import ImageUpdate, received_image
from sonarpost.messages import ReconstructedImage
from sonarpost.runtime import retention
from sonarpost.services.decompressor.config import DecompressorConfig
from sonarpost.services.decompressor.service import DecompressorService
from sonarpost.sonar.image_files import read_image

VESSEL = "vessel-1"
IN, OUT = keys.acoustic_image(VESSEL), keys.image_reconstructed(VESSEL)
START_UTC_S = 1_700_000_000.0


@pytest.fixture(scope="session")
def vq():
    return default_registry().create("vq", CodecResources(open_codebook("nominal-10").tiles))


@pytest.fixture(scope="session")
def emb():
    return default_registry().create("emb", CodecResources())


@pytest.fixture
def stream(vq, texture):
    return lambda seed=1, *size: vq.encode(texture(*(size or (40, 60)), seed=seed))


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"


@pytest.fixture
def unstarted(platform, out):
    def make(**options):
        usual = {"out_dir": out, "codebooks": ("nominal-10",), "image_consumers": ("console",)}
        return DecompressorService(platform(VESSEL), DecompressorConfig(**(usual | options)))

    return make


@pytest.fixture
def begin(runner, unstarted):
    return lambda **options: runner.start(unstarted(**options))


@pytest.fixture
def console(runner):
    return runner.peer(VESSEL, "console", {OUT: ReconstructedImage})


@pytest.fixture
def modem(runner):
    return runner.peer(VESSEL, "op_modem")


@pytest.fixture
def decoded(modem, console):
    """Send records to the service, and return the images that it makes of them."""

    def decode(*records):
        before = len(console.received)
        modem.send(IN, "decompressor", *records)
        eventually(lambda: len(console.received) == before + len(records))
        return console.received[before:]

    return decode


def frames_of(image_id, stream, contact=CONTACT):
    """Return the frames of an image in the paper's format."""
    return [data for packet in plan_packets(image_id, stream, contact, 3, 64) for data in packet]


def half(image_id, stream, name):
    """Return the one frame of a small image that has this half."""
    [found] = [data for data in frames_of(image_id, stream, None) if parse_frame(data).half == name]
    return found


def updates(*frames, source=3):
    """Return the records of op_modem after these frames and the end of their wait."""
    receiver = PaperReceiver(60.0)
    events = [event for data in frames for event in receiver.accept(source, data, START_UTC_S)]
    found = [event for event in [*events, *receiver.poll(math.inf)] if isinstance(event, ImageUpdate)]
    return [received_image(update, VESSEL, "uuv-1") for update in found]


def embedded(stream, *, version=1, image_id="0001", complete=False):
    """Return the record of the beginning of an embedded stream, as the `v1` format delivers it."""
    [contact_only] = updates(ContactFrame(image_id, CONTACT).pack())
    size = len(stream)
    return contact_only.model_copy(
        update={
            "version": version,
            "stream": stream,
            "missing_halves": (),
            "complete": complete,
            "bytes_received": size,
            "bytes_total": size if complete else 0,
            "frames_received": 0,
        }
    )


def test_complete_image_is_decoded(begin, decoded, stream, vq, check_monitoring, watch):
    seen = watch(OUT)
    service = begin()
    data = stream()
    size = StreamHeader.unpack(data).size
    [image] = decoded(*updates(*frames_of("0A1B", data)))
    assert (image.vessel_id, image.vehicle_id, image.image_id, image.version) == (VESSEL, "uuv-1", "0A1B", 1)
    assert (image.complete, image.missing_fraction, image.missing_halves, image.missing_mask) == (True, 0.0, (), b"")
    assert (image.codec, image.model) == ("vq", vq.model_hash)
    assert (image.bytes_received, image.bytes_total) == (len(data) - size, len(data) - size)
    assert (image.frames_received, image.first_frame_utc_s) == (len(frames_of("0A1B", data, None)), START_UTC_S)
    np.testing.assert_array_equal(image.pixels.to_array(), vq.decode(data).image)
    assert (image.contact.contact_id, image.contact.lat_deg) == ("uuv-1/0A1B", 56.4)
    eventually(lambda: service.health().counters.get("images_complete") == 1)
    eventually(lambda: len(seen) == 1, what="the publication for subscribers")
    shown = msgpack.unpackb(seen[0].payload.to_bytes())
    assert hashlib.sha256(shown["pixels"]["data"]).hexdigest() == shown["pixels_sha256"] == image.pixels.sha256
    check_monitoring(service)


def test_files_and_record_hold_the_same_image(begin, runner, decoded, stream, out):
    service = begin()
    records = updates(*frames_of("0A1B", stream()))
    [image] = decoded(*records)
    name = f"uuv-1_{datetime.fromtimestamp(START_UTC_S, UTC):%Y%m%dT%H%M%SZ}_0A1B_v1"
    assert image_file_name(image) == name
    assert {p.name for p in out.iterdir()} == {f"{name}.{kind}" for kind in ("tiff", "png", "json")}
    tiff, png = read_image(out / f"{name}.tiff"), np.asarray(Image.open(out / f"{name}.png"))
    np.testing.assert_array_equal(tiff, png)
    assert hashlib.sha256(tiff.tobytes()).hexdigest() == image.pixels_sha256
    whole = (out / f"{name}.json").read_bytes()
    side = json.loads(whole)
    assert side["pixels_sha256"] == image.pixels_sha256
    assert (side["image_id"], side["contact"]["lat_deg"], side["missing_runs"]) == ("0A1B", 56.4, "")
    assert (side["height_px"], side["width_px"], side["bits"]) == (40, 60, 8)
    # A damaged side car is written again.
    runner.stop(service)
    (out / f"{name}.json").write_bytes(b"\xff\xfe half of it")
    begin()
    decoded(*records)
    assert (out / f"{name}.json").read_bytes() == whole


def test_missing_half_is_black_and_marked(begin, decoded, stream, vq):
    begin()
    for image_id, arrived, missing in (("AAAA", "top", "bottom"), ("BBBB", "bottom", "top")):
        [image] = decoded(*updates(half(image_id, stream(1), arrived)))
        assert (image.image_id, image.complete, image.missing_halves) == (image_id, False, (missing,))
        assert image.missing_fraction == pytest.approx(0.5, abs=0.1)
        pixels, black = image.pixels.to_array(), image.missing()
        assert (pixels[black] == 0).all()
        np.testing.assert_array_equal(pixels[~black], vq.decode(stream(1)).image[~black])
        rows = np.flatnonzero(black.any(axis=1))
        assert (rows.min() >= 20) if missing == "bottom" else (rows.max() < 20)


def test_versions_of_an_embedded_stream_become_finer(begin, decoded, emb, texture, out):
    begin()
    whole = emb.encode(texture(), 192)
    lengths = (40, 96, len(whole))
    records = (embedded(whole[:n], version=v, complete=n == len(whole)) for v, n in enumerate(lengths, start=1))
    images = decoded(*records)
    for length, image in zip(lengths, images, strict=True):
        np.testing.assert_array_equal(image.pixels.to_array(), emb.decode(whole[:length]).image)
        assert (image.missing_fraction, image.missing_halves, image.frames_received) == (0.0, (), 0)
        assert (image.bytes_received, image.bytes_total) == (length, length if image.complete else 0)
    assert [(image.version, image.complete) for image in images] == [(1, False), (2, False), (3, True)]
    assert (images[0].codec, images[0].model) == ("emb", emb.model_hash)
    assert len(list(out.glob("*.tiff"))) == 3


def test_missing_end_of_a_stream_that_is_not_embedded_is_marked(begin, decoded, stream, vq):
    begin()
    [image] = decoded(embedded(stream()[:24]))
    whole = vq.decode(stream()).image
    assert 0.2 < image.missing_fraction < 0.8
    assert not image.complete
    black = image.missing()
    assert (image.pixels.to_array()[black] == 0).all()
    np.testing.assert_array_equal(image.pixels.to_array()[~black], whole[~black])


def test_contact_record_alone_gives_an_image_of_missing_pixels(begin, decoded, out):
    begin()
    [record] = updates(ContactFrame("AAAA", CONTACT).pack())
    of_unknown_size = record.model_copy(update={"version": 2, "height_px": None, "width_px": None})
    for image, shape in zip(decoded(record, of_unknown_size), ((40, 60), (16, 16)), strict=True):
        assert (image.contact.lat_deg, image.contact.time_utc_s) == (56.4, 1_475_568_000.0)
        assert (image.codec, image.bytes_total, image.missing_fraction, image.complete) == ("", 0, 1.0, False)
        assert (image.missing_halves, image.despeckle_strength) == (("top", "bottom"), None)
        assert image.pixels.to_array().shape == shape
        assert not image.pixels.to_array().any()
        assert "only the contact record arrived" in image.notes
    assert len(list(out.glob("*.json"))) == 2


def test_contradicting_frames_are_noted(begin, decoded, stream):
    begin()
    [image] = decoded(*updates(half("AAAA", stream(1), "top"), half("AAAA", stream(2), "top")))
    assert image.notes[-1] == "1 frames disagreed with others of this image"


def test_index_beyond_the_codebook_is_a_black_tile(begin, decoded, stream, vq):
    begin()
    data = bytearray(stream())
    assert len(vq.tiles) < 1 << 14
    start = StreamHeader.unpack(data).size
    data[start : start + 2] = b"\xff\xff"
    [image] = decoded(*updates(*frames_of("AAAA", bytes(data))))
    whole = vq.decode(stream()).image
    pixels, black = image.pixels.to_array(), image.missing()
    assert black[:10, :10].all()
    assert (pixels[black] == 0).all()
    assert 1 <= black.sum() / 100 <= 2, "this tile, and the one that shares its bits"
    np.testing.assert_array_equal(pixels[~black][200:], whole[~black][200:])
    assert not image.complete
    assert image.notes


def test_images_that_cannot_be_decoded_are_quarantined(
    begin, modem, console, texture, refused, vq, emb, stream, monkeypatch
):
    service = begin()
    decode = Decoder.decode
    monkeypatch.setattr(Decoder, "decode", lambda self, r: 1 // 0 if r.image_id == "CCCC" else decode(self, r))
    other = default_registry().create("vq", CodecResources(open_codebook("nominal-20").tiles))
    modem.send(IN, "decompressor", *updates(*frames_of("AAAA", other.encode(texture()))))
    modem.send(IN, "decompressor", embedded(b"\xee" + emb.encode(texture(), 192)[1:]))
    for image_id in ("CCCC", "BBBB"):
        modem.send(IN, "decompressor", *updates(*frames_of(image_id, stream())))
    eventually(lambda: [i.image_id for i in console.received] == ["BBBB"])
    assert [key for key, _ in refused(service)] == ["image uuv-1/AAAA", "image uuv-1/0001", "image uuv-1/CCCC"]
    (_, unknown), _, (_, defect) = refused(service)
    for codec in (other, vq):
        assert f"{codebook_tag(codec.tiles):#06x}" in unknown
    assert "ZeroDivisionError" in defect
    assert service.health().counters["images_undecodable"] == 3
    assert service.health().state == "ok"
    assert not service.failed


def test_every_configured_codebook_is_used(begin, decoded, texture, stream):
    begin(codebooks=("nominal-10", "nominal-20"))
    other = default_registry().create("vq", CodecResources(open_codebook("nominal-20").tiles))
    first, second = decoded(
        *updates(*frames_of("AAAA", other.encode(texture()))), *updates(*frames_of("BBBB", stream()))
    )
    assert first.complete
    assert second.complete
    assert first.model == other.model_hash != second.model


def test_malformed_and_foreign_records_are_refused(begin, modem, console, stream, refused):
    service = begin()
    modem.send_bytes(IN, "decompressor", b"\x80")
    [record] = updates(*frames_of("AAAA", stream()))
    modem.send(IN, "decompressor", record.model_copy(update={"vessel_id": "vessel-2"}), record)
    eventually(lambda: len(console.received) == 1)
    assert refused(service) == refused(modem)
    (_, malformed), (_, foreign) = refused(service)
    assert "expected 'received_image'" in malformed
    assert "vessel_id: got 'vessel-2', expected vessel-1" in foreign


def test_images_wait_while_the_folder_is_not_writable(begin, runner, modem, console, stream, tmp_path):
    blocker = tmp_path / "disk"
    blocker.write_text("not mounted")
    service = begin(out_dir=blocker / "out")
    for seed, image_id in enumerate(("AAAA", "BBBB"), start=1):
        modem.send(IN, "decompressor", *updates(*frames_of(image_id, stream(seed))))
    eventually(lambda: service.health().state == "degraded")
    assert str(blocker) in service.health().detail
    runner.stop(service)
    assert console.received == []
    blocker.unlink()
    service = begin(out_dir=blocker / "out")
    eventually(lambda: [i.image_id for i in console.received] == ["AAAA", "BBBB"])
    assert all(i.complete and i.version == 1 for i in console.received)
    assert len(list((blocker / "out").glob("*.json"))) == 2
    eventually(lambda: service.health().state == "ok")


def test_unreadable_codebook_is_an_error_at_the_start(platform, tmp_path):
    config = DecompressorConfig(codebooks=("nominal-10", str(tmp_path / "absent.tiles")))
    with pytest.raises(CodebookError, match=r"absent\.tiles"):
        DecompressorService(platform(VESSEL), config)


def test_two_codebooks_with_one_tag_are_rejected(platform, tmp_path, monkeypatch):
    names = []
    for number in range(2):
        rng = np.random.default_rng(number)
        tiles = rng.integers(0, 256, (3, 100), dtype=np.uint8)
        database = TileDatabase(10, tiles, np.zeros(100, np.uint8), np.ones((1, 100), np.int16))
        names.append(str(tmp_path / f"{number}.tiles"))
        save(tmp_path / f"{number}.tiles", Codebook(database, {}))
    monkeypatch.setattr("sonarpost.archive.decoder.codebook_tag", lambda tiles: 0x1234)
    with pytest.raises(CodebookError, match="0x1234"):
        DecompressorService(platform(VESSEL), DecompressorConfig(codebooks=tuple(names)))
    DecompressorService(platform(VESSEL), DecompressorConfig(codebooks=(names[0], names[0]))).store.close()


@pytest.mark.parametrize(("authenticated", "strength"), [(True, 0.5), (False, 0.0), (None, None)])
def test_record_and_side_car_state_authentication_and_despeckling(
    authenticated, strength, begin, decoded, stream, texture, out
):
    begin()
    # The streams of vq do not state a strength.
    coded = stream() if strength is None else EmbCodec(strength=strength).encode(texture(40, 60), 200)
    record = updates(*frames_of("00A7", coded))[-1]
    [image] = decoded(record.model_copy(update={"authenticated": authenticated}))
    assert (image.authenticated, image.despeckle_strength) == (authenticated, strength)
    side_car = json.loads((out / f"{image_file_name(image)}.json").read_text())
    for name, value in {"authenticated": authenticated, "despeckle_strength": strength}.items():
        assert side_car[name] == value


def test_old_image_files_are_removed_by_default(begin, decoded, runner, stream, out, monkeypatch):
    monkeypatch.setattr(retention, "FOLLOW_AFTER_S", 0.0)
    service = begin()
    decoded(*(record for name in ("AAAA", "BBBB") for record in updates(*frames_of(name, stream()))))
    runner.stop(service)
    past_s = time.time() - 366 * 86400.0
    for path in out.glob("*_AAAA_v1.*"):
        os.utime(path, (past_s, past_s))
    service = begin()
    # The files of an image are removed one after another.
    eventually(lambda: {path.stem.split("_")[-2] for path in out.iterdir()} == {"BBBB"})
    eventually(lambda: service.health().counters.get("images_removed") == 1)
