"""`sonarpost record` and `replay`: publications of a router into an MCAP file, to watchers, and into a running c2."""

import signal
import sys
import threading

import numpy as np
import pytest
import zenoh
from builders.common import eventually, publish_once, running
from builders.exports import decision, image
from builders.unreached_router import check_unreached_router
from mcap.reader import make_reader

from sonarpost import keys, wire
from sonarpost.archive.decoder import Decoder
from sonarpost.archive.journal import Accepted
from sonarpost.bus.session import client_config
from sonarpost.cli.main import main
from sonarpost.codec.registry import default_registry
from sonarpost.extensions.mcap.foxglove import COMPRESSED_IMAGE, GEOJSON, LOCATION_FIX
from sonarpost.extensions.mcap.mcap_file import McapRecording, RecordedMessage, read_messages
from sonarpost.extensions.mcap.record import ContactChannels, RecordQueue, paced
from sonarpost.messages import CodedImage, Decision, ReceivedImage, ReconstructedImage
from sonarpost.services.c2.accepted import accepted_fields, payload_of
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service

IMAGES = 3


def record_file(path):
    """A file of a vessel: images, a decision, a message of another key, an invalid image."""
    recording = McapRecording(path)
    encoding = wire.encoding_of(ReconstructedImage)
    for n in range(IMAGES):
        recording.write(keys.image_reconstructed("vessel-1"), encoding, wire.encode(image(f"000{n}")), n)
    key = keys.contact_decision("vessel-1")
    recording.write(key, wire.encoding_of(Decision), wire.encode(decision("0001")), IMAGES)
    recording.write(keys.health("vessel-1", "relay"), "application/msgpack", b"\x80", IMAGES + 1)
    recording.write(keys.image_reconstructed("vessel-1"), encoding, b"rubbish", IMAGES + 2)
    recording.close()
    return path


def test_recorded_file_has_records_and_foxglove_channels(router, client, tmp_path, capsys, monkeypatch):
    path, last = tmp_path / "new" / "a.mcap", "sonarpost/v1/uuv-1/own/key"
    expected = [keys.shore_decision("vessel-1"), keys.shore_image("vessel-1"), last]
    write = McapRecording.write

    def write_until_last(recording, key, *rest):
        is_written = write(recording, key, *rest)
        if key == last:
            signal.raise_signal(signal.SIGINT)
        return is_written

    def publish():
        publish_once(client, expected[1], wire.encode(image()), wire.encoding_of(ReconstructedImage))
        client.put(expected[0], wire.encode(decision()), encoding=wire.encoding_of(Decision))
        client.put("another/key", b"not recorded")
        client.put(last, b"abc")

    monkeypatch.setattr(McapRecording, "write", write_until_last)
    publishing = threading.Thread(target=publish)
    publishing.start()
    assert main(["record", str(path), "--router", router]) == 0
    publishing.join()
    assert "3 records, 0 dropped" in capsys.readouterr().out
    assert sorted(m.key for m in read_messages(path)) == expected
    with path.open("rb") as file:
        names = {schema.name for schema, _, _ in make_reader(file).iter_messages() if schema}
    assert {COMPRESSED_IMAGE, LOCATION_FIX, GEOJSON} <= names


def test_replay_to_c2_stores_every_record_once(platform, router, tmp_path, capsys):
    path = record_file(tmp_path / "a.mcap")
    with running(C2Service(platform("shore-1"), C2Config(out_dir=tmp_path / "live"))) as service:
        arguments = ["replay", str(path), "--router", router, "--to-c2", "--speed", "0"]
        for _ in range(2):
            assert main(arguments) == 0
            assert "4 records sent, 0 refused, 2 of other keys" in capsys.readouterr().out
        eventually(lambda: service.health().counters.get("images_repeated") == IMAGES)
        assert service.health().counters["images_stored"] == IMAGES
        assert service.health().counters["decisions_stored"] == 1
        assert len(list((tmp_path / "live" / "vessel-1").glob("*.png"))) == IMAGES
        assert len(list((tmp_path / "live" / "vessel-1" / "decisions").glob("*.json"))) == 1


def coded(number):
    """A coded image and its decoded form, the first one with a contact and a range that has not arrived."""
    pixels = (np.arange(48 * 40).reshape(48, 40) * (number + 1) % 251).astype(np.uint8)
    stream = default_registry().create("emb").encode(pixels, 300)
    missing = ((200, len(stream)),) if number == 0 else ()
    received = ReceivedImage(
        vessel_id="vessel-1",
        vehicle_id="uuv-1",
        image_id=f"00C{number}",
        version=number + 1,
        contact=image().contact if number == 0 else None,
        height_px=48,
        width_px=40,
        stream=stream[:200] + bytes(len(stream) - 200) if missing else stream,
        missing=missing,
        missing_halves=(),
        complete=not missing,
        bytes_received=200 if missing else len(stream),
        bytes_total=len(stream),
        frames_received=4,
        conflicts=number,
        first_frame_utc_s=1000.0 + number,
        last_frame_utc_s=1010.3 + number,
    )
    decoder = Decoder(["nominal-10"])
    decoded = decoder.decode(received)
    return decoder.coded_image(received, decoded), decoded


def test_replay_to_c2_delivers_coded_images_once(platform, router, client, tmp_path, capsys):
    """From a vessel, which also has the decoded form, and from a shore site, whose publications have a number."""
    path, encoding = tmp_path / "a.mcap", wire.encoding_of(CodedImage)
    recording = McapRecording(path)
    sent = [coded(number) for number in range(IMAGES)]
    for n, (record, decoded) in enumerate(sent):
        recording.write(keys.image_reconstructed("vessel-1"), wire.encoding_of(type(decoded)), wire.encode(decoded), n)
        recording.write(keys.image_coded("vessel-1"), encoding, wire.encode(record), n)
        published = payload_of(accepted_fields(wire.unpack_map(wire.encode(record), ""), Accepted("0a1b2c3d", n, 1.0)))
        recording.write(keys.shore_coded("vessel-1"), encoding, published, n)
    recording.write(keys.shore_coded("vessel-1"), encoding, b"rubbish", IMAGES)
    recording.close()
    seen = []
    client.declare_subscriber(keys.shore_coded("vessel-1"), seen.append)
    with running(C2Service(platform("shore-1"), C2Config(out_dir=tmp_path / "live"))) as service:
        for _ in range(2):
            assert main(["replay", str(path), "--router", router, "--to-c2", "--speed", "0"]) == 0
            assert f"{3 * IMAGES} records sent, 0 refused, 1 of other keys" in capsys.readouterr().out
        eventually(lambda: service.health().counters.get("images_accepted", 0) == 4 * IMAGES)
        eventually(lambda: service.health().gauges["images_undecoded"] == 0)
        # The decoded form is repeated; the same coded image is decoded once while it waits.
        eventually(lambda: service.health().counters.get("images_repeated", 0) >= IMAGES)
        counters = service.health().counters
        assert (counters["images_stored"], counters["images_accepted"]) == (IMAGES, 4 * IMAGES)
        assert counters["images_repeated"] <= 5 * IMAGES
        assert "images_conflicting" not in counters
        assert "images_differing" not in counters
        # Published again under the same number, with the content of the recording.
        records = [wire.decode(CodedImage, sample.payload.to_bytes(), "k") for sample in seen]
        assert {record.image_id: record for record in records} == {record.image_id: record for record, _ in sent}
        numbers = {wire.unpack_map(s.payload.to_bytes(), "k")["accepted"]["seq"] for s in seen}
        assert len(numbers) == IMAGES


def test_replay_for_watchers_is_not_handled_by_services(platform, router, tmp_path, capsys):
    """A publication without attachment is accepted by the consumer of its key; a replayed one has an attachment."""
    path = tmp_path / "a.mcap"
    recording = McapRecording(path)
    key = keys.tasking_comment("vessel-1")
    recording.write(key, "application/msgpack", b"\x80", 1)
    recording.close()
    service = C2Service(platform("shore-1"), C2Config(out_dir=tmp_path / "live"))
    assert service.start()
    watcher = zenoh.open(client_config([router]))
    try:
        received = []
        watcher.declare_subscriber(key, lambda sample: received.append(sample.payload.to_bytes()))
        eventually(
            lambda: main(["replay", str(path), "--router", router, "--speed", "0"]) == 0 and bool(received),
            what="replayed record",
        )
        assert set(received) == {b"\x80"}
        # An invalid publication that the service accepts would be counted as refused.
        assert service.health().counters.get("records_refused", 0) == 0
    finally:
        watcher.close()
        service.stop()
    capsys.readouterr()


def test_replay_selects_keys(router, tmp_path, capsys):
    path = record_file(tmp_path / "a.mcap")
    assert main(["replay", str(path), "--router", router, "--speed", "0", "--key", "sonarpost/v1/*/health/*"]) == 0
    assert "1 records sent" in capsys.readouterr().out


def test_invalid_input_is_one_error(router, tmp_path, capsys):
    path = tmp_path / "a.mcap"
    path.write_bytes(record_file(tmp_path / "whole.mcap").read_bytes()[:3000])
    assert main(["replay", str(path), "--router", router, "--speed", "0"]) == 2
    assert "a complete and valid MCAP record" in capsys.readouterr().err
    assert main(["replay", str(path), "--router", router, "--speed", "-1"]) == 2
    assert "--speed" in capsys.readouterr().err
    assert main(["replay", str(tmp_path / "none.mcap"), "--router", router]) == 2
    assert "none.mcap" in capsys.readouterr().err
    assert main(["record", str(tmp_path / "b.mcap"), "--router", router, "--key", "/a"]) == 2
    assert "a Zenoh key expression" in capsys.readouterr().err
    assert main(["record", str(path), "--router", router, "--duration", "0"]) == 2
    assert "exists" in capsys.readouterr().err


def test_replay_to_an_absent_c2_is_an_error(router, tmp_path, capsys):
    path = record_file(tmp_path / "a.mcap")
    arguments = ["replay", str(path), "--router", router, "--to-c2", "--speed", "0", "--timeout", "0.5"]
    assert main(arguments) == 2
    assert "not delivered to c2 within 0.5 s" in capsys.readouterr().err


def message(time_ns, payload=b""):
    return RecordedMessage("sonarpost/v1/a/b", "", payload, time_ns)


@pytest.mark.parametrize(("speed", "expected_s"), [(1, 10), (2, 5), (0, 0)])
def test_pauses_are_those_of_the_recording(speed, expected_s):
    now = [100.0]

    def wait(pause_s):
        now[0] += pause_s
        return False

    times = []
    for found in paced([message(int(5e9)), message(int(4e9)), message(int(15e9))], speed, wait, lambda: now[0]):
        times.append((found.time_ns, now[0] - 100.0))
    assert [t for t, _ in times] == [5e9, 4e9, 15e9]
    assert [at for _, at in times] == pytest.approx([0, 0, expected_s])


def test_a_stopped_replay_ends():
    assert list(paced([message(0), message(1)], 1.0, lambda _: True)) == []


def test_full_queue_drops_and_counts(monkeypatch):
    monkeypatch.setattr("sonarpost.extensions.mcap.record.MAX_QUEUED_BYTES", 10)
    waiting = RecordQueue()
    for n in range(4):
        waiting.add(message(n, b"1234"))
    assert (len(waiting.take(0)), waiting.dropped) == (2, 2)
    waiting.add(message(5, b"1234567890"))
    assert len(waiting.take(0)) == 1
    assert waiting.take(0) == []


def test_map_is_written_at_most_every_ten_seconds(tmp_path):
    path = tmp_path / "a.mcap"
    recording = McapRecording(path)
    channels = ContactChannels(recording)
    for n in range(30):
        payload = wire.encode(image(f"00{n:02}"))
        channels.add(RecordedMessage(keys.shore_image("vessel-1"), "", payload, n * 1_000_000_000))
    channels.write_map(31_000_000_000, now=True)
    recording.close()
    with path.open("rb") as file:
        maps = [m.log_time // 1_000_000_000 for _, _, m in make_reader(file).iter_messages(topics=["/contacts"])]
    assert maps == [0, 10, 20, 31]


@pytest.mark.parametrize("missing", ["mcap", "zstandard"])
def test_missing_extra_is_one_line(missing, tmp_path, monkeypatch, capsys):
    for name in [
        n for n in sys.modules if n.partition(".")[0] == missing or n == "sonarpost.extensions.mcap.mcap_file"
    ]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, missing, None)
    assert main(["replay", str(tmp_path / "a.mcap")]) == 2
    expected = "sonarpost replay: needs the extra mcap: pip install 'sonarpost[mcap]'\n"
    assert capsys.readouterr().err == expected


@pytest.mark.parametrize("arguments", ["record {}/new.mcap", "replay {}/a.mcap", "replay {}/a.mcap --to-c2"])
def test_reason_is_printed_without_verbosity(arguments, tmp_path):
    check_unreached_router(arguments.format(tmp_path))
