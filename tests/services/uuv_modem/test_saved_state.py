"""State of uuv_modem: failed commits, state of version 0.1, and a change of the wire format."""

from __future__ import annotations

from contextlib import contextmanager
from itertools import groupby
from operator import itemgetter

import msgpack
import pytest
from builders.common import eventually
from builders.records import encoded_image, outgoing_message

from sonarpost import keys, wire
from sonarpost.errors import RetryLaterError
from sonarpost.link.config import SenderConfig
from sonarpost.link.downlink.messages import CommandOutcome, ResendMessage, pack
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.messages import AcousticFrame, Command, QueueState
from sonarpost.modem.interface import FrameReceived
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.service import OpModemService
from sonarpost.services.uuv_modem import service as uuv_modem

IMAGES, MESSAGES = keys.image_encoded("uuv-1"), keys.message_outgoing("uuv-1")
QUEUE, RX = keys.acoustic_queue("uuv-1"), keys.acoustic_rx("vessel-1")
LINKS = pytest.mark.parametrize("link", ["v1", "paper"])


@contextmanager
def unwritable(store):
    """Make every write to a store fail."""
    with store._lock:
        store._db.execute("PRAGMA query_only=ON")
    yield
    with store._lock:
        store._db.execute("PRAGMA query_only=OFF")


def resend_command(token: int, image_number: int) -> FrameReceived:
    """Return the modem's event for a frame with the command to send an image again."""
    sender = V1Sender(SenderConfig(frame_bytes=32))
    sender.add_message(pack(ResendMessage(token, 1000, image_number)), 0.0, times=1)
    return FrameReceived(1, 3, False, 1, sender.next_frame(0.0), 0.0, 0, None)


@LINKS
def test_failed_commit_leaves_records_in_the_inbox_and_the_state_is_reloaded(link, start_service, compressor, watch):
    published = watch(QUEUE)
    service = start_service(link=link)  # no modem replies: everything waits
    compressor.send(IMAGES, "uuv_modem", encoded_image(1))
    eventually(lambda: service._endpoint.images_accepted == 1)
    with service._endpoint.step():
        compressor.send(IMAGES, "uuv_modem", *[encoded_image(n) for n in (2, 3, 4)])
        eventually(lambda: service.store.inbox_depth() == 3)
        refusing = unwritable(service.store)
        refusing.__enter__()
    eventually(lambda: "readonly database" in service.health().detail)
    with service._endpoint.step():
        assert service._endpoint.images_accepted == 1
        assert service._endpoint.queue.images_waiting == 1
    assert service.store.inbox_depth() == 3
    refusing.__exit__(None, None, None)
    eventually(lambda: service._endpoint.images_accepted == 4 and service.store.inbox_depth() == 0)
    assert [e.image_id for e in service._endpoint.queue.expected(0.0)] == ["0001", "0002", "0003", "0004"]
    eventually(lambda: "readonly" not in service.health().detail)
    eventually(lambda: [state.images_waiting for state in decoded(published)[-1:]] == [4])
    counts = [state.images_accepted for state in decoded(published)]
    assert counts == sorted(counts)
    assert set(counts) <= {0, 1, 4}


def decoded(samples) -> list[QueueState]:
    return [wire.decode(QueueState, sample.payload.to_bytes(), QUEUE) for sample in samples]


@LINKS
def test_packets_sent_while_the_store_fails_are_not_repeated(
    link, start_service, compressor, modem_pair, runner, platform
):
    modem_pair.start()
    vessel = runner.peer("vessel-1", "decompressor", {RX: AcousticFrame})
    receiver = OpModemConfig(port=modem_pair.port(modem_pair.VESSEL))
    op_modem = runner.start(OpModemService(platform("vessel-1"), receiver))
    service = start_service(link=link, group_delay_s=0.0)
    eventually(lambda: op_modem.modem.ready and service.modem.ready)
    compressor.send(IMAGES, "uuv_modem", *[encoded_image(n) for n in range(1, 5)])
    eventually(lambda: len(vessel.received) > 3)
    with unwritable(service.store):
        eventually(lambda: "readonly database" in service.health().detail)
        packets_before = service.health().counters["packets_sent"]
        eventually(lambda: len(service._unsaved) > 0)
        assert service.health().counters["packets_sent"] <= packets_before + 1
    eventually(lambda: service._endpoint.queue.is_idle)
    eventually(lambda: len(vessel.received) == service.health().counters.get("frames_sent", 0))
    frames = [(frame.packet, frame.data) for frame in vessel.received]
    packets = [tuple(data for _, data in packet) for _, packet in groupby(frames, key=itemgetter(0))]
    assert len(set(packets)) == len(packets) == service.health().counters["packets_sent"]
    assert service.health().counters["images_sent"] == 4


def test_commands_received_while_the_store_fails_are_executed_once(start_service, runner):
    service = start_service()
    compressor = runner.peer("uuv-1", "compressor", {keys.command_all("uuv-1"): Command})
    eventually(lambda: not service._endpoint.changed)
    with unwritable(service.store):
        for token in (1, 2, 1):
            service.on_modem_event(resend_command(token, 7))
        eventually(lambda: "readonly database" in service._link_error)
        assert "commands_received" not in service.health().counters
    eventually(lambda: len(compressor.received) == 2)
    assert service.health().counters["commands_received"] == 2
    assert set(service._endpoint._commands._known.values()) == {CommandOutcome.ACCEPTED}


def test_frames_are_dropped_when_too_many_events_wait_for_the_store(start_service, monkeypatch):
    monkeypatch.setattr(uuv_modem, "MAX_UNSAVED", 2)
    service = start_service()
    eventually(lambda: not service._endpoint.changed)
    with unwritable(service.store):
        for token in range(5):
            service.on_modem_event(resend_command(token, 7))
        eventually(lambda: service.health().counters.get("frames_dropped") == 3)
    eventually(lambda: service.health().counters.get("commands_received") == 2)


def test_records_that_version_0_1_held_before_its_queue_are_queued(start_service, runner, platform):
    service = start_service()
    runner.stop(service)
    records = [encoded_image(1), outgoing_message("m"), encoded_image(2)]
    again = uuv_modem.UuvModemService(platform("uuv-1"), service.config)
    with again.store.transaction() as tx:
        for number, record in enumerate(records, start=1):
            tx.put_state(f"arrival/{number:016d}", wire.encode(record))
        tx.put_state("progress", msgpack.packb({"image_id": "0001", "rate": 1, "of": 2, "done": 1}))
    again.store.close()
    again = start_service()
    eventually(lambda: again.store.inbox_depth() == 0)
    assert [e.image_id for e in again._endpoint.queue.expected(0.0)] == ["0001", "0002"]
    assert again._endpoint.queue.messages_waiting == 1
    assert again._endpoint.images_accepted == 2
    assert again.store.state_names("arrival/") == again.store.state_names("progress") == ()


def test_images_of_the_paper_queue_are_sent_with_v1_after_a_change_of_the_format(
    start_service, compressor, runner, refused
):
    service = start_service(link="paper")
    compressor.send(IMAGES, "uuv_modem", encoded_image(1), encoded_image(2), encoded_image(3))
    eventually(lambda: service._endpoint.images_accepted == 3)
    with service._endpoint.step(), service.store.transaction() as tx:
        tx.put_state("paper/queue/image/3", b"\xc1")
    runner.stop(service)
    again = start_service(link="v1")
    eventually(lambda: again.store.state_names("paper/") == ())
    assert [e.image_id for e in again._endpoint.queue.expected(0.0)] == ["0001", "0002"]
    assert [key for key, _ in refused(again)] == ["state paper/queue/image/3"]
    assert again._endpoint.images_accepted == 3


def test_records_are_not_accepted_below_the_disk_reserve(start_service):
    service = start_service()
    service.check_capacity(IMAGES)
    service._disk_reserve._reserve_bytes = 1 << 62
    with pytest.raises(RetryLaterError, match="below the reserve"):
        service.check_capacity(IMAGES)
