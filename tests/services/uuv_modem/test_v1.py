"""uuv_modem with the `v1` wire format: previews first, messages, commands, authentication, restarts and full disks."""

import sqlite3
import time
from contextlib import closing
from itertools import count

import msgpack
import pytest
from builders.common import eventually
from builders.records import encoded_image, outgoing_message
from builders.v1_world import add_message, feedback_frame

from sonarpost import keys, wire
from sonarpost.codec.region import RegionBox
from sonarpost.delivery.store import Store
from sonarpost.errors import ConfigError
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import AcousticKey, Direction
from sonarpost.link.config import SenderConfig
from sonarpost.link.downlink import messages as dl
from sonarpost.link.frames.v1.frame import checksum
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.link.receiver import FrameRejected, ImageUpdate, MessageReceived
from sonarpost.messages import AcousticFrame, Command, Decision, QueueState
from sonarpost.modem.micromodem import CAPABILITIES, RATES
from sonarpost.services.uuv_modem.config import UuvModemConfig

IN, OUT = keys.image_encoded("uuv-1"), keys.message_outgoing("uuv-1")
RX, QUEUE = keys.acoustic_rx("vessel-1"), keys.acoustic_queue("uuv-1")


class Vessel:
    """The vessel's modem, the frames that it received, and what a v1 receiver makes of them."""

    def __init__(self, runner, start_vessel):
        self._receiver = runner.peer("vessel-1", "decompressor", {RX: AcousticFrame})
        self.service = start_vessel()
        self.sender = V1Sender(SenderConfig(frame_bytes=RATES[0].frame_bytes))
        self.polls = 0

    @property
    def frames(self):
        return self._receiver.received

    def events(self, protection=None):
        receiver = V1Receiver(protection=protection)
        return [e for n, f in enumerate(self.frames) for e in receiver.accept(f.source, f.data, float(n))]

    def messages(self, protection=None):
        return [dl.unpack(e.data) for e in self.events(protection) if isinstance(e, MessageReceived)]

    def streams(self):
        found: dict[int, bytes] = {}
        for event in self.events():
            if isinstance(event, ImageUpdate):
                number = dl.number_of_image(event.image_id)
                found[number] = max(found.get(number, b""), event.stream, key=len)
        return found

    def send_messages(self, *contents, until):
        """Send until a condition is true; modems are half-duplex, so the vehicle can miss a packet while it sends."""

        def send():
            for content in contents:
                add_message(self.sender, dl.pack(content), 0.0, times=1)
            while frame := self.sender.next_frame(0.0):
                self.send(frame)

        repeat(send, until)

    def send(self, *frames):
        for frame in frames:
            self.service.modem.send_packet(3, 0, [frame])

    def poll(self):
        self.polls += 1
        self.service.modem.request_packet(3, 1)


def repeat(action, until):
    """Repeat an action every half a second until a condition is true."""
    evaluations = count()

    def reached():
        if next(evaluations) % 50 == 0:
            action()
        return until()

    eventually(reached)


@pytest.fixture
def vessel(runner, start_vessel, modem_pair):
    modem_pair.start()
    vessel = Vessel(runner, start_vessel)
    eventually(lambda: vessel.service.modem.ready)
    return vessel


def sent(service):
    return service.health().counters.get("packets_sent", 0)


def idle(service):
    gauges = service.health().gauges
    return gauges["images_waiting"] == gauges["messages_waiting"] == gauges["inbox"] == 0


def test_all_previews_arrive_before_any_detail(vessel, start_service, compressor):
    start_service()
    images = [encoded_image(n) for n in range(1, 9)]
    compressor.send(IN, "uuv_modem", *images)
    eventually(lambda: len(vessel.streams()) == 8)
    eventually(lambda: all(len(s) > 150 for s in vessel.streams().values()), what="most of every image")
    for number, stream in vessel.streams().items():
        assert images[number - 1].stream.startswith(stream)
    seen, first_detail = set(), None
    for event in vessel.events():
        if isinstance(event, ImageUpdate):
            seen.add(event.image_id)
            if len(event.stream) > 60 and first_detail is None:
                first_detail = len(seen)
    assert first_detail == 8


def test_killed_process_continues_without_loss(vessel, start_service, compressor, runner, tmp_path):
    service = start_service()
    images = [encoded_image(n) for n in range(1, 13)]
    compressor.send(IN, "uuv_modem", *images)
    compressor.send(OUT, "uuv_modem", *[outgoing_message(f"m{n}", priority=6) for n in range(5)])
    eventually(lambda: compressor.store.outbox_depth() == 0 and sent(service) >= 6)
    # A copy of the store is what a process that is killed now leaves on the disk. It holds all records: what is
    # accepted between the copy and the stop would be lost with the copy.
    killed = tmp_path / "killed"
    killed.mkdir()
    path = service.store.path
    received_before = len(vessel.frames)
    with closing(sqlite3.connect(path)) as source, closing(sqlite3.connect(killed / path.name)) as copy:
        source.backup(copy)
    runner.stop(service)
    time_of_stop = len(vessel.frames)
    again = start_service(service.platform.model_copy(update={"state_dir": killed}))
    texts = {b"m%d" % n for n in range(5)}

    def messages():
        return {m.data for m in vessel.messages() if isinstance(m, dl.DataMessage)}

    eventually(lambda: idle(again) and messages() == texts and len(vessel.streams()) == 12, what="all records")
    eventually(lambda: idle(again) and all(len(s) > 150 for s in vessel.streams().values()), what="all images")
    repeated = len(vessel.frames) - len({f.data for f in vessel.frames})
    # The first process ran for a moment after the copy; the packets that it sent then are sent again.
    assert repeated <= 3 * (1 + (time_of_stop - received_before + 2) // 3) + 3


def test_messages_are_sent_by_priority_and_expired_ones_counted_and_not_sent(vessel, start_service, compressor):
    service = start_service(aging_s=86400.0)
    compressor.send(IN, "uuv_modem", *[encoded_image(n) for n in range(1, 9)])
    old = outgoing_message("old", created_utc_s=time.time() - 3600.0)
    urgent, log = outgoing_message("urgent", priority=1), outgoing_message("log", priority=7)
    compressor.send(OUT, "uuv_modem", old, urgent, log)
    eventually(lambda: dl.DataMessage(b"urgent") in vessel.messages())
    eventually(lambda: dl.DataMessage(b"log") in vessel.messages(), what="the message that fills frames")
    eventually(lambda: service.health().gauges["messages_expired"] == 1)
    assert dl.DataMessage(b"old") not in vessel.messages()


def test_queue_state_has_expected_times(start_service, compressor, watch):
    published = watch(QUEUE)
    start_service()  # no modem replies: everything waits
    compressor.send(IN, "uuv_modem", *[encoded_image(n) for n in range(1, 9)])

    def states_of_all():
        states = [wire.decode(QueueState, s.payload.to_bytes(), QUEUE) for s in published]
        return [s for s in states if s.images_waiting == 8]

    eventually(lambda: len(states_of_all()) > 0, what="the state of a queue of eight images")
    for state in states_of_all():
        assert state.packet_interval_s > 0
        assert state.rate == 1
        assert {i.contact_id for i in state.images} == {f"c{n}" for n in range(1, 9)}
        assert all(i.expected_utc_s >= state.time_utc_s for i in state.images)


def test_messages_beyond_the_limit_stay_with_their_sender(start_service, compressor, runner):
    service = start_service(max_messages=3)  # no modem replies: nothing is sent
    autonomy = runner.peer("uuv-1", "autonomy")
    autonomy.send(OUT, "uuv_modem", *[outgoing_message(f"m{n}") for n in range(3)])
    eventually(lambda: service.health().gauges["messages_waiting"] == 3)
    autonomy.send(OUT, "uuv_modem", outgoing_message("m3"))
    compressor.send(IN, "uuv_modem", encoded_image(1))
    eventually(lambda: service.health().gauges["images_waiting"] == 1)
    eventually(lambda: (compressor.store.outbox_depth(), autonomy.store.outbox_depth()) == (0, 1))
    assert service.health().gauges["messages_waiting"] == 3


COMMANDS = [
    (dl.RefineMessage(1, 1000, 2, 400), "refine", "0002"),
    (dl.ResendMessage(2, 1001, 3), "resend", "0003"),
    (dl.RevisitMessage(3, 1002, 56.5, -5.25), "revisit", None),
    (dl.ExpandMessage(5, 1004, 4), "expand", "0004"),
    (dl.OriginalMessage(6, 1005, 5), "original", "0005"),
    (dl.RegionMessage(7, 1006, 6, RegionBox(4, 8, 20, 32), 192), "region", "0006"),
]


def test_commands_become_one_record_each_and_are_confirmed_each_time(vessel, start_service, runner):
    service = start_service(revisit_consumers=("autonomy",), decision_consumers=("autonomy",))
    compressor = runner.peer("uuv-1", "compressor", {keys.command_all("uuv-1"): Command})
    consumed = {keys.command("uuv-1", "revisit"): Command, keys.command("uuv-1", "decision"): Decision}
    autonomy = runner.peer("uuv-1", "autonomy", consumed)
    eventually(lambda: service.modem.ready)
    decision_message = dl.DecisionMessage(4, 1003, 2, 1, "mine_like", 0.5, "sphere")
    commands = [*[command for command, _, _ in COMMANDS], decision_message]

    def outcomes():
        return [o for m in vessel.messages() if isinstance(m, dl.ConfirmationMessage) for o in m.outcomes]

    vessel.send_messages(*commands, until=lambda: {token for token, _ in outcomes()} == {1, 2, 3, 4, 5, 6, 7})
    before = outcomes().count((1, dl.CommandOutcome.ACCEPTED))
    vessel.send_messages(commands[0], until=lambda: outcomes().count((1, dl.CommandOutcome.ACCEPTED)) > before)
    eventually(lambda: len(compressor.received) == 5 and len(autonomy.received) == 2)
    assert {outcome for _, outcome in outcomes()} == {dl.CommandOutcome.ACCEPTED}
    assert {(c.kind, c.image_id) for c in compressor.received} == {
        ("refine", "0002"),
        ("resend", "0003"),
        ("expand", "0004"),
        ("original", "0005"),
        ("region", "0006"),
    }
    (region,) = [c for c in compressor.received if c.kind == "region"]
    assert (region.box, region.stream_bytes) == ((4, 8, 20, 32), 192)
    revisit, decision = sorted(autonomy.received, key=lambda r: r.TYPE)
    assert (revisit.lat_deg, revisit.lon_deg, revisit.command_id) == (56.5, -5.25, "a1-00000003")
    assert (decision.verdict, decision.mlo_class, decision.image_id) == ("mine_like", "sphere", "0002")
    assert service.health().counters["commands_received"] == 7
    runner.stop(service)
    start_service()  # without a consumer
    unsupported = dl.ConfirmationMessage(((9, dl.CommandOutcome.UNSUPPORTED),))
    vessel.send_messages(dl.RevisitMessage(9, 1000, 1.0, 2.0), until=lambda: unsupported in vessel.messages())


def test_missing_symbols_are_sent_after_feedback(vessel, start_service, compressor):
    service = start_service(stream_bytes=300, tx_burst_s=0.2, rx_window_s=0.2)
    compressor.send(IN, "uuv_modem", *[encoded_image(n) for n in range(1, 5)])
    eventually(lambda: len(vessel.frames) > 10)

    def send_feedback():
        receiver = V1Receiver()
        for number, frame in enumerate(vessel.frames):
            receiver.accept(3, frame.data, float(number))
        vessel.send(feedback_frame(receiver.feedback(3, 1e3)))

    repeat(send_feedback, lambda: service.health().counters.get("feedback_received", 0) > 0)
    # Further images are sent up to stream_bytes; what is lost of them is sent until feedback confirms it.
    compressor.send(IN, "uuv_modem", *[encoded_image(n) for n in range(5, 9)])
    repeat(send_feedback, lambda: all(len(vessel.streams().get(n, b"")) == 300 for n in range(5, 9)))


def test_invalid_frames_and_frames_for_other_modems_are_ignored(vessel, start_service, compressor):
    service = start_service()
    eventually(lambda: service.modem.ready)
    vessel.send(b"not a frame of this format")
    vessel.service.modem.send_packet(5, 0, [b"for another modem"])
    eventually(lambda: service.health().counters.get("frames_rejected", 0) == 1)
    compressor.send(IN, "uuv_modem", encoded_image(1))
    eventually(lambda: 1 in vessel.streams())


@pytest.fixture
def key(tmp_path):
    key = AcousticKey(bytes(range(100, 132)))
    (tmp_path / "acoustic.key").write_text(key.secret.hex() + "\n", encoding="utf-8")
    (tmp_path / "acoustic.key").chmod(0o600)
    return key


def test_with_a_key_only_authentic_frames_are_accepted_and_no_counter_is_used_twice(
    vessel, start_service, compressor, runner, platform, key, tmp_path
):
    configured = platform("uuv-1").model_copy(
        update={"acoustic_auth": "key", "acoustic_key_file": tmp_path / "acoustic.key"}
    )
    service = start_service(configured)
    eventually(lambda: service.modem.ready)
    authenticator = FrameAuthenticator(key, 1, Direction.TO_VEHICLE)
    authenticator.grant(authenticator.requested_limit)
    sender = V1Sender(SenderConfig(frame_bytes=32), protection=authenticator)
    add_message(sender, dl.pack(dl.ResendMessage(1, 1000, 3)), 0.0, times=1)
    frame = sender.next_frame(0.0)
    counters = lambda: service.health().counters  # noqa: E731
    repeat(lambda: vessel.send(frame), lambda: counters().get("commands_received") == 1)
    repeat(lambda: vessel.send(frame), lambda: counters().get("frames_replayed", 0) > 0)
    body = frame[2:-1] + bytes([frame[-1] ^ 1])
    repeat(
        lambda: vessel.send(checksum(body).to_bytes(2, "big") + body), lambda: counters().get("frames_forged", 0) > 0
    )
    forged = counters()["frames_forged"]
    vessel.send_messages(dl.ResendMessage(2, 1000, 4), until=lambda: counters()["frames_forged"] > forged)
    assert counters()["commands_received"] == 1
    compressor.send(IN, "uuv_modem", *[encoded_image(n) for n in range(1, 9)])
    eventually(lambda: len(vessel.frames) > 6)
    runner.stop(service)
    again = start_service(configured)
    eventually(lambda: idle(again))
    received = lambda: {e.image_id for e in vessel.events(authenticator_of(key)) if isinstance(e, ImageUpdate)}  # noqa: E731
    eventually(lambda: len(received()) == 8)
    runner.stop(again)
    rejected = [e for e in vessel.events(authenticator_of(key)) if isinstance(e, FrameRejected)]
    repeated = len(vessel.frames) - len({f.data for f in vessel.frames})
    assert len(rejected) == repeated <= 3, "the packet in flight, byte for byte"
    assert {e.reason.field for e in rejected} <= {"counter"}


def authenticator_of(key):
    return FrameAuthenticator(key, 1, Direction.TO_VEHICLE)


def test_polled_modem_sends_only_requested_packets(vessel, start_service, compressor):
    service = start_service(mac="polled", group_delay_s=0.0)
    eventually(lambda: service.modem.ready)
    compressor.send(IN, "uuv_modem", encoded_image(1), encoded_image(2))
    eventually(lambda: service.health().gauges["images_waiting"] == 2)
    for n in range(1, 4):
        # A poll is answered with nothing until the next packet is ready.
        repeat(vessel.poll, lambda n=n: sent(service) >= n)
    polls = sent(service)
    eventually(lambda: len(vessel.frames) == service.health().counters.get("frames_sent", 0))
    assert len({f.data for f in vessel.frames}) == len(vessel.frames)
    assert sent(service) == polls <= vessel.polls


@pytest.mark.parametrize("damaged", [msgpack.packb({"format": 99}), b"\xc1 no msgpack"])
def test_unreadable_parts_of_the_state_are_quarantined_and_the_rest_is_sent(
    damaged, start_service, compressor, runner, vessel, refused
):
    service = start_service(group_delay_s=3600.0)  # the images wait
    compressor.send(IN, "uuv_modem", *[encoded_image(n) for n in range(1, 4)])
    compressor.send(OUT, "uuv_modem", outgoing_message("kept", priority=6))
    eventually(lambda: (service.health().gauges["images_waiting"], compressor.store.outbox_depth()) == (3, 0))
    runner.stop(service)
    store = Store(service.platform.state_dir / "uuv_modem.db")
    with store.transaction() as tx:
        tx.put_state("link/v1/queue/sender", damaged)
        tx.put_state("link/v1/commands", b"\x01")
        tx.put_state("link/v1/queue/image/2", msgpack.packb({"number": 2}))
    store.close()
    again = start_service()
    eventually(lambda: again.health().counters.get("states_discarded") == 3)
    # Only the announcement of the second image was sent.
    eventually(lambda: min(len(vessel.streams().get(n, b"")) for n in (1, 3)) > 100)
    assert len(vessel.streams().get(2, b"")) < 60
    quarantined = {key for key, _ in refused(again)}
    assert {"state link/v1/queue/sender", "state link/v1/commands", "state link/v1/queue/image/2"} <= quarantined
    compressor.send(IN, "uuv_modem", encoded_image(4))
    eventually(lambda: 4 in vessel.streams())


@pytest.mark.parametrize(
    "slot", [{"tdma_cycle_s": 10.0}, *({"tdma_slot_s": slot} for slot in ((0.0, 5.0), (50.0, 70.0), (9.0, 1.0)))]
)
def test_slot_without_space_for_a_packet_is_a_configuration_error(slot):
    with pytest.raises((ValueError, ConfigError), match="slot"):
        UuvModemConfig(port="x", mac="tdma", **slot).for_modem(CAPABILITIES)
