"""State of uuv_modem: failed commits, and a change of the wire format."""

from itertools import groupby
from operator import itemgetter

import pytest
from builders.common import eventually
from builders.records import encoded_image
from builders.v1_world import add_message

from sonarpost import keys, wire
from sonarpost.errors import RetryLaterError
from sonarpost.link.config import SenderConfig
from sonarpost.link.downlink.messages import ResendMessage, pack
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.messages import AcousticFrame, Command, QueueState
from sonarpost.modem.interface import FrameReceived, PacketFailed
from sonarpost.services.uuv_modem import service as uuv_modem
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.received_commands import ReceivedCommands
from sonarpost.services.uuv_modem.vehicle_endpoint import VehicleEndpoint

IMAGES, MESSAGES = keys.image_encoded("uuv-1"), keys.message_outgoing("uuv-1")
QUEUE, RX = keys.acoustic_queue("uuv-1"), keys.acoustic_rx("vessel-1")
LINKS = pytest.mark.parametrize("link", ["v1", "paper"])


@pytest.fixture
def queue_states(watch):
    samples = watch(QUEUE)
    return lambda: [wire.decode(QueueState, sample.payload.to_bytes(), QUEUE) for sample in samples]


@pytest.fixture
def queued(queue_states):
    """Return the identifiers of the images in the latest state of the queue."""
    return lambda: [image.image_id for state in queue_states()[-1:] for image in state.images]


def fill(service, *records, **states):
    """Put records into the inbox of a service that does not run, and states into its store."""
    stopped = uuv_modem.UuvModemService(service.platform, service.config)
    with stopped.store.transaction() as tx:
        for record in records:
            tx.accept(IMAGES, wire.encode(record))
        for name, data in states.items():
            tx.put_state(name, data)
    stopped.store.close()


@LINKS
def test_failed_commit_leaves_records_in_the_inbox_and_the_state_is_reloaded(
    link, start_service, runner, compressor, queue_states, queued, unwritable
):
    service = start_service(link=link)  # no modem replies: everything waits
    compressor.send(IMAGES, "uuv_modem", encoded_image(1))
    eventually(lambda: queued() == ["0001"])
    runner.stop(service)
    fill(service, *(encoded_image(n) for n in (2, 3, 4)))
    again = uuv_modem.UuvModemService(service.platform, service.config)
    with unwritable(again):
        runner.start(again)
        eventually(lambda: "readonly database" in again.health().detail)
        assert again.health().gauges["inbox"] == 3
    eventually(lambda: queued() == ["0001", "0002", "0003", "0004"])
    eventually(lambda: again.health().gauges["inbox"] == 0)
    eventually(lambda: "readonly" not in again.health().detail)
    counts = [state.images_accepted for state in queue_states()]
    assert counts == sorted(counts)
    assert set(counts) <= {0, 1, 4}


@LINKS
def test_packets_sent_while_the_store_fails_are_not_repeated(
    link, start_service, start_vessel, compressor, modem_pair, runner, unwritable
):
    modem_pair.start()
    vessel = runner.peer("vessel-1", "decompressor", {RX: AcousticFrame})
    op_modem = start_vessel()
    service = start_service(link=link, group_delay_s=0.0)
    eventually(lambda: op_modem.modem.ready and service.modem.ready)
    compressor.send(IMAGES, "uuv_modem", *[encoded_image(n) for n in range(1, 5)])
    eventually(lambda: len(vessel.received) > 3)
    with unwritable(service):
        eventually(lambda: "readonly database" in service.health().detail)
        packets_before = service.health().counters["packets_sent"]
    assert service.health().counters["packets_sent"] <= packets_before + 1
    eventually(lambda: service.health().counters.get("images_sent") == 4)
    eventually(lambda: len(vessel.received) == service.health().counters.get("frames_sent", 0))
    frames = [(frame.packet, frame.data) for frame in vessel.received]
    packets = [tuple(data for _, data in packet) for _, packet in groupby(frames, key=itemgetter(0))]
    assert len(set(packets)) == len(packets) == service.health().counters["packets_sent"]


def test_commands_received_while_the_store_fails_are_executed_once_and_too_many_are_dropped(
    start_service, runner, modem_pair, monkeypatch, unwritable
):
    monkeypatch.setattr(uuv_modem, "MAX_UNSAVED", 3)
    modem_pair.start()
    service = start_service()
    compressor = runner.peer("uuv-1", "compressor", {keys.command_all("uuv-1"): Command})
    eventually(lambda: service.health().state == "ok")
    with unwritable(service):
        for token in (1, 2, 1, 3, 4):
            sender = V1Sender(SenderConfig(frame_bytes=32))
            add_message(sender, pack(ResendMessage(token, 1000, 7)), 0.0, times=1)
            service.on_modem_event(FrameReceived(1, 3, False, 1, sender.next_frame(0.0), 0.0, 0, None))
        eventually(lambda: service.health().counters.get("frames_dropped") == 2)
        eventually(lambda: "readonly database" in service.health().detail)
        assert "commands_received" not in service.health().counters
    eventually(lambda: len(compressor.received) == 2)
    assert service.health().counters["commands_received"] == 2


def test_events_that_wait_for_the_link_are_limited_but_the_end_of_a_packet_is_kept(platform, monkeypatch):
    monkeypatch.setattr(uuv_modem, "MAX_EVENTS", 3)
    stopped = uuv_modem.UuvModemService(platform("uuv-1"), UuvModemConfig(port="udp://239.255.0.1:5000", rate=1))
    for _ in range(5):
        stopped.on_modem_event(FrameReceived(1, 3, False, 1, b"frame", 0.0, 0, None))
    stopped.on_modem_event(PacketFailed(1, 1, 1, (), "no answer", maybe_sent=False))
    waiting = [stopped._events.get_nowait() for _ in range(stopped._events.qsize())]
    assert [type(event) for event in waiting] == 3 * [FrameReceived] + [PacketFailed]
    stopped.store.close()


def test_images_of_the_paper_queue_are_sent_with_v1_after_a_change_of_the_format(
    start_service, compressor, runner, refused, queue_states, queued
):
    service = start_service(link="paper")
    compressor.send(IMAGES, "uuv_modem", encoded_image(1), encoded_image(2), encoded_image(3))
    eventually(lambda: queued() == ["0001", "0002", "0003"])
    runner.stop(service)
    fill(service, **{"link/paper/queue/image/3": b"\xc1"})
    again = start_service(link="v1")
    eventually(lambda: again.store.state_names("link/paper/") == ())
    eventually(lambda: queued() == ["0001", "0002"])
    assert [key for key, _ in refused(again)] == ["state link/paper/queue/image/3"]
    assert queue_states()[-1].images_accepted == 3


def test_records_are_not_accepted_below_the_disk_reserve(start_service, runner, monkeypatch):
    service = start_service()
    service.check_capacity(IMAGES)
    runner.stop(service)
    monkeypatch.setattr("sonarpost.runtime.service.HANDLING_RESERVE_BYTES", 1 << 62)
    with pytest.raises(RetryLaterError, match="below the reserve"):
        start_service().check_capacity(IMAGES)


def test_unexpected_exception_about_a_frame_loses_that_frame_only(start_service, monkeypatch):
    receive, frames = VehicleEndpoint.receive, []

    def fail_on_one(self, source, frame, now):
        if frame == b"bad":
            raise ZeroDivisionError
        frames.append(frame)
        receive(self, source, frame, now)

    monkeypatch.setattr(VehicleEndpoint, "receive", fail_on_one)
    service = start_service()
    for data in (b"first", b"bad", b"last"):
        service.on_modem_event(FrameReceived(1, service.config.address, False, 1, data, 0.0, 1, None))
    eventually(lambda: frames[-1:] == [b"last"])
    eventually(lambda: service.health().counters.get("frames_failed") == 1)
    assert not service.failed


def test_count_that_cannot_be_read_does_not_stop_the_service(start_service, runner, refused):
    service = start_service()
    runner.stop(service)
    fill(service, **{"link/images_accepted": b"many"})
    again = start_service()
    eventually(lambda: again.health().counters.get("states_discarded") == 1)
    assert [key for key, _ in refused(again)] == ["state link/images_accepted"]


def test_repeated_commands_are_recognised_by_shares_of_the_modems():
    commands = ReceivedCommands("uuv-1", UuvModemConfig(port="unused"))
    own = ResendMessage(0, 1_700_000_000, 1)
    assert commands.accept(1, own, "0001")[1] is not None
    for token in range(600):
        commands.accept(9, ResendMessage(token, 1_700_000_000, 1), "0001")
    assert commands.accept(1, own, "0001")[1] is None
    assert len(commands.export()["known"]) == 512
