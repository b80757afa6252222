"""MCAP files of records: read by the `mcap` library, cut off, damaged, hostile."""

import base64
import contextlib
import io
import json
import struct

import jsonschema
import pytest
from builders.exports import decision, image, mission
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from PIL import Image

from sonarpost import keys, wire
from sonarpost.export.contacts import load_contacts
from sonarpost.export.live import LiveContacts
from sonarpost.extensions.mcap import mcap_file
from sonarpost.extensions.mcap.foxglove import (
    COMPRESSED_IMAGE,
    GEOJSON,
    LOCATION_FIX,
    SCHEMAS,
    compressed_image,
    contact_map,
    location_fix,
)
from sonarpost.extensions.mcap.mcap_file import McapFileError, McapRecording, RecordedMessage, read_messages
from sonarpost.messages import Decision, ReconstructedImage

IMAGE_KEY = keys.shore_image("vessel-1")
ENCODING = wire.encoding_of(ReconstructedImage)
TIME_NS = 1_700_000_000_123_456_789


def samples():
    records = [(IMAGE_KEY, image(f"{n:04}")) for n in range(5)]
    found = [RecordedMessage(key, ENCODING, wire.encode(r), TIME_NS + n) for n, (key, r) in enumerate(records)]
    verdict = RecordedMessage(
        keys.shore_decision("vessel-1"), wire.encoding_of(Decision), wire.encode(decision()), TIME_NS + 9
    )
    return [*found, verdict, RecordedMessage("sonarpost/v1/uuv-1/own/key", "text/plain", b"x" * 40_000, TIME_NS + 10)]


def written(path):
    recording = McapRecording(path)
    for message in samples():
        assert recording.write(message.key, message.encoding, message.payload, message.time_ns)
    recording.write_json("/contacts", GEOJSON, {"geojson": "{}"}, TIME_NS)
    recording.close()
    return path


def test_mcap_library_reads_channels_schemas_and_index(tmp_path):
    assert list(read_messages(written(tmp_path / "a.mcap"))) == samples(), "without derived channels"
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        found = list(reader.iter_messages(topics=[IMAGE_KEY]))
    assert summary.statistics.message_count == 8
    assert len(summary.chunk_indexes) >= 1
    schema, channel, message = found[0]
    assert (schema.name, schema.encoding) == ("sonarpost.reconstructed_image.v1", "jsonschema")
    jsonschema.Draft202012Validator.check_schema(json.loads(schema.data))
    assert (channel.message_encoding, message.log_time) == ("msgpack", TIME_NS)
    assert wire.decode(ReconstructedImage, message.data, IMAGE_KEY) == image("0000")


def test_a_recording_that_was_never_closed_is_readable_up_to_its_last_chunk(tmp_path):
    recording = McapRecording(tmp_path / "a.mcap")
    payload = bytes(mcap_file.CHUNK_BYTES)
    for n in range(3):
        recording.write(IMAGE_KEY, ENCODING, payload, n)
        recording.flush()
    recording.write(IMAGE_KEY, ENCODING, b"in memory", 3)
    recording.flush()
    copy = tmp_path / "crashed.mcap"
    copy.write_bytes((tmp_path / "a.mcap").read_bytes())
    recording.close()
    found = []
    with pytest.raises(McapFileError, match="cut off"):
        found.extend(read_messages(copy))
    messages = read_messages(copy)
    assert [next(messages).time_ns for _ in range(3)] == [0, 1, 2]


def test_recording_continues_in_a_new_file(tmp_path, monkeypatch):
    monkeypatch.setattr(mcap_file, "PART_BYTES", 2000)
    recording = McapRecording(tmp_path / "a.mcap")
    for message in samples():
        recording.write(message.key, message.encoding, message.payload, message.time_ns)
        recording.flush()
    recording.close()
    assert [path.name for path in recording.paths[:2]] == ["a.mcap", "a.0002.mcap"]
    assert [message for path in recording.paths for message in read_messages(path)] == samples()
    with pytest.raises(FileExistsError):
        McapRecording(tmp_path / "a.mcap")
    assert [message for path in recording.paths for message in read_messages(path)] == samples(), "not replaced"


def test_channels_are_limited(tmp_path, monkeypatch):
    monkeypatch.setattr(mcap_file, "MAX_CHANNELS", 2)
    recording = McapRecording(tmp_path / "a.mcap")
    assert [recording.write(f"sonarpost/v1/a/{n}", "", b"", 0) for n in range(4)] == [True, True, False, False]
    recording.close()
    path = other_writer(tmp_path / "b.mcap", CompressionType.NONE, channels=3)
    with pytest.raises(McapFileError, match="channels: got 3, expected at most 2"):
        list(read_messages(path))


def other_writer(path, compression, channels=1):
    """A file of another program: no metadata, one large chunk."""
    with path.open("wb") as file:
        writer = Writer(file, compression=compression)
        writer.start()
        for n in range(channels):
            channel = writer.register_channel(f"sonarpost/v1/a/{n}", "", 0)
            writer.add_message(channel, n, bytes(1000), n)
        other = writer.register_channel("/rosout", "cdr", 0)
        writer.add_message(other, 5, b"log", 5)
        wild = writer.register_channel("sonarpost/v1/**", "", 0)
        writer.add_message(wild, 6, b"all", 6)
        writer.finish()
    return path


@pytest.mark.parametrize("compression", list(CompressionType))
def test_files_of_other_programs(compression, tmp_path):
    path = other_writer(tmp_path / "a.mcap", compression)
    assert list(read_messages(path)) == [RecordedMessage("sonarpost/v1/a/0", "", bytes(1000), 0)]


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_chunk_that_expands_beyond_its_size_is_rejected(compression, tmp_path, monkeypatch):
    path = tmp_path / "bomb.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=compression, chunk_size=1 << 22)
        writer.start()
        writer.add_message(writer.register_channel("sonarpost/v1/a/0", "", 0), 0, bytes(1 << 20), 0)
        writer.finish()
    data = bytearray(path.read_bytes())
    # The chunk states another size: its field follows opcode, length and two times.
    at = data.index(b"\x06", 40)
    stated = struct.unpack_from("<Q", data, at + 25)[0]
    assert stated > 1 << 20
    struct.pack_into("<Q", data, at + 25, 1000)
    path.write_bytes(data)
    with pytest.raises(McapFileError, match="other than 1000 bytes"):
        list(read_messages(path))
    monkeypatch.setattr(mcap_file, "MAX_RECORD_BYTES", 1 << 19)
    struct.pack_into("<Q", data, at + 25, stated)
    path.write_bytes(data)
    with pytest.raises(McapFileError, match="more than 524288"):
        list(read_messages(path))


def test_other_files_are_rejected(tmp_path):
    path = tmp_path / "a.mcap"
    for data in (b"", b"\x89MCAP", b"SQLite format 3\x00" * 10):
        path.write_bytes(data)
        with pytest.raises(McapFileError, match=r"a\.mcap"):
            list(read_messages(path))


@given(st.integers(8, 4000), st.binary(min_size=1, max_size=12))
def test_damaged_file_gives_messages_or_the_documented_error(tmp_path, at, junk):
    path = tmp_path / "a.mcap"
    path.unlink(missing_ok=True)
    data = bytearray(written(path).read_bytes())
    at = min(at, len(data) - 1)
    data[at : at + len(junk)] = junk
    path.write_bytes(data)
    with contextlib.suppress(McapFileError):
        assert len(list(read_messages(path))) <= len(samples()) + 1


# Foxglove


def test_derived_messages_match_their_schemas(tmp_path):
    record = image()
    fix = location_fix(record, TIME_NS)
    compressed = compressed_image(record, TIME_NS)
    contacts = load_contacts(mission(tmp_path / "out")).contacts
    document = contact_map(contacts)
    for name, message in ((COMPRESSED_IMAGE, compressed), (LOCATION_FIX, fix), (GEOJSON, document)):
        jsonschema.Draft202012Validator.check_schema(SCHEMAS[name])
        jsonschema.validate(json.loads(json.dumps(message)), SCHEMAS[name])
    with Image.open(io.BytesIO(base64.b64decode(str(compressed["data"])))) as png:
        assert (png.format, png.size) == ("PNG", (24, 16))
    assert compressed["timestamp"] == {"sec": 1_700_000_000, "nsec": 123_456_789}
    assert (fix["latitude"], fix["longitude"]) == (41.52513339, -70.67124561)
    assert fix["position_covariance"] == [20.25, 0, 0, 0, 20.25, 0, 0, 0, 0]
    collection = json.loads(str(document["geojson"]))
    assert len(collection["features"]) == len([c for c in contacts if c.position])
    assert all(f["properties"]["style"]["color"].startswith("#") for f in collection["features"])
    assert location_fix(image(contact={"lat_deg": None}), TIME_NS) is None


def test_live_contacts_equal_those_of_the_archive(tmp_path):
    stored = load_contacts(mission(tmp_path / "out"))
    live = LiveContacts()
    for contact in stored.contacts:
        live._add_image(contact.image)
        for one in contact.decisions:
            live._add_decision(one)
    assert [c.uid for c in live.located(100)] == [c.uid for c in stored.located]
    assert [c.review for c in live.located(100)] == [c.review for c in stored.located]
    assert len(live.located(2)) == 2
    again = image("0002", {"lat_deg": 41.5261}, version=2, notes=("a note",))
    assert live.add(again) is None  # repeated
    newer = live.add(again.model_copy(update={"version": 3}))
    assert (newer.image.version, newer.review) == (3, "mine_like")


def test_live_contacts_are_limited_and_join_early_decisions():
    live = LiveContacts(max_names=2)
    assert live.add(decision("0001")) is None
    joined = live.add(image("0001"))
    assert joined.review == "mine_like"
    changed = live.add(decision("0001", decision_id="d-2", verdict="not_mine_like", operator="B"))
    assert changed.review == "disputed"
    live.add(image("0002"))
    live.add(image("0003"))
    assert [c.image.image_id for c in live.located(10)] == ["0002", "0003"]
