"""Stores of version 0.1: their frames and receiver state become received images, once."""

from __future__ import annotations

import json

import pytest
from builders.common import GOLDEN_FOLDER, eventually
from builders.vessel_frames import CONTACT, preview_frame

from sonarpost import keys, wire
from sonarpost.link import migration
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import Direction
from sonarpost.link.config import SenderConfig
from sonarpost.link.frames.v1.frame import Segment, SegmentKind, pack_segments
from sonarpost.link.frames.v1.payload_objects import ENTRY_HEAD_BYTES, Preview
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.messages import AcousticFrame
from sonarpost.security.acoustic_key import create_key, read_key
from sonarpost.services.decompressor.config import DecompressorConfig
from sonarpost.services.decompressor.service import DecompressorService

VESSEL = "vessel-1"


def golden(name):
    return json.loads((GOLDEN_FOLDER / "link-state-0.1" / f"{name}.json").read_text(encoding="utf-8"))


def fill(service, states, frames):
    """Fill the store of a service that is not started as version 0.1 did: states, and (source, frame, time)."""
    with service.store.transaction() as tx:
        for name, data in states.items():
            tx.put_state(name, data)
        for source, data, time_utc_s in frames:
            record = AcousticFrame(
                direction="rx", platform_id=VESSEL, time_utc_s=time_utc_s, source=source, destination=1, rate=1,
                packet=1, frame_number=1, frame_count=1, data=data,
            )  # fmt: skip
            tx.accept(keys.acoustic_rx(VESSEL), wire.encode(record))


@pytest.fixture
def migrated(platform, tmp_path, runner, monkeypatch):
    """Fill a store as version 0.1 did, start the service, and return it and the images it found."""

    def make(states, frames, **settings):
        there = platform(VESSEL).model_copy(update=settings)
        service = DecompressorService(there, DecompressorConfig(out_dir=tmp_path / "out"))
        fill(service, states, frames)
        found = []
        monkeypatch.setattr(DecompressorService, "handle", lambda self, key, record, effects: found.append(record))
        return runner.start(service), found

    return make


def test_state_and_frames_of_the_v1_receiver_are_converted(migrated):
    state = bytes.fromhex(golden("v1_receiver")["state"])
    receiver = V1Receiver()
    receiver.restore(migration.v1_receiver_parts(state))
    known = receiver._sources[4].images[3]
    prefix = bytes(known.stream.data[: known.stream.prefix_bytes]) + bytes(15)
    entry = Preview(3, known.contact, prefix, ended=False).pack(ENTRY_HEAD_BYTES + len(prefix))
    frame = pack_segments([Segment(SegmentKind.PREVIEW, entry)], 128)
    service, found = migrated({"receiver-v1": state}, [(4, frame, 1300.0), (3, preview_frame(9), 1301.0)])
    eventually(lambda: len(found) == 2)
    assert [(image.vehicle_id, image.image_id, image.version) for image in found] == [
        ("modem-4", "0003", known.version + 1),
        ("modem-3", "0009", 1),
    ]
    assert (found[0].stream, found[0].first_frame_utc_s, found[0].last_frame_utc_s) == (
        prefix,
        known.first_frame_s,
        1300.0,
    )
    assert service.store.get_state("receiver-v1") is None


def test_incomplete_images_of_the_paper_format_are_converted_as_they_are(migrated):
    case = golden("paper_receiver")
    steps = [step for step in case["steps"] if "frame" in step and step["at"] < 1184.0]
    before = [(e["image_id"], e["version"], e["stream"]) for s in steps for e in s["events"] if "stream" in e]
    service, found = migrated(
        {"receiver": bytes.fromhex(case["state"])},
        [(step["source"], bytes.fromhex(step["frame"]), step["at"]) for step in steps],
    )
    eventually(lambda: len(found) == len(before) + 3)
    assert [(image.image_id, image.version, image.stream.hex()) for image in found[: len(before)]] == before
    assert [(image.image_id, image.version, image.complete) for image in found[len(before) :]] == [
        ("00ZZ", 1, False),
        ("0006", 1, False),
        ("0007", 1, False),
    ]
    assert service.store.get_state("receiver") is None
    eventually(lambda: service.store.inbox_depth() == 0)  # the handler runs before its transaction is committed


def test_unreadable_old_state_is_discarded_and_frames_are_converted(migrated, caplog):
    frames = [(3, preview_frame(number), 1e9) for number in (1, 2)]
    service, found = migrated({"receiver": b"\xc1", "receiver-v1": b"\xc1", "seal": b"\xc1"}, frames)
    eventually(lambda: [image.image_id for image in found] == ["0001", "0002"])
    skipped = [vars(r)["fields"]["part"] for r in caplog.records if "Discarding an unreadable part" in r.message]
    assert skipped == ["receiver", "receiver-v1", "seal"]
    assert all(service.store.get_state(name) is None for name in skipped)


def test_authenticated_frames_of_an_old_store_are_converted(migrated, tmp_path):
    key_file = tmp_path / "acoustic.key"
    create_key(key_file)
    authenticator = FrameAuthenticator(read_key(key_file), 3, Direction.FROM_VEHICLE)
    authenticator.grant(100)
    sender = V1Sender(SenderConfig(frame_bytes=64), protection=authenticator)
    sender.add_image(1, CONTACT, b"\x20" + bytes(60), 0.0)
    frames = [(3, sender.next_frame(0.0), 1e9), (3, preview_frame(2), 1e9)]
    service, found = migrated({}, frames, acoustic_auth="key", acoustic_key_file=key_file)
    eventually(lambda: [image.image_id for image in found] == ["0001"])
    eventually(lambda: service.store.inbox_depth() == 0)  # the handler runs before its transaction is committed
