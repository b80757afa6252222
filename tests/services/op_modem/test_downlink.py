"""op_modem with v1: commands and feedback reach a vehicle through emulated modems, also after losses and restarts."""

import time
from dataclasses import replace

import pytest
from builders.common import eventually
from builders.records import decision_record
from builders.v1_world import add_message, next_frames
from builders.vessel_frames import CONTACT, packet
from pydantic import ValidationError

from sonarpost import keys, wire
from sonarpost.delivery.store import Store
from sonarpost.errors import ConfigError, PayloadError
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import Direction
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.config import SenderConfig
from sonarpost.link.downlink import messages as dl
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.frame import ContactFrame
from sonarpost.link.frames.v1.frame import Segment, SegmentKind, pack_segments
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.link.receiver import FeedbackReceived, MessageReceived
from sonarpost.messages import Command, DownlinkState, ReceivedMessage
from sonarpost.modem.interface import PacketReceived
from sonarpost.modem.micromodem import CAPABILITIES, MicroModem, MicroModemConfig
from sonarpost.runtime.modem_runner import ModemRunner
from sonarpost.runtime.serial_port import SerialPort
from sonarpost.security.acoustic_key import read_key
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.transmission import TransmitGate

VESSEL = "vessel-1"
RX, IMAGE = keys.acoustic_rx(VESSEL), keys.acoustic_image(VESSEL)
DECISION, STATE = keys.contact_decision(VESSEL), keys.acoustic_downlink(VESSEL)
VERDICT = decision_record("d-1", image_id="0007", image_version=2, confidence=0.5, mlo_class="Manta")


def command(kind="refine", command_id="c-1", vehicle_id="uuv-1", **fields):
    usual = {"image_id": "0007"} if kind != "revisit" else {"lat_deg": 41.5, "lon_deg": -70.5}
    return Command(
        command_id=command_id,
        kind=kind,
        vehicle_id=vehicle_id,
        issued_by="op",
        issued_utc_s=time.time(),
        **(usual | fields),
    )


@pytest.fixture
def console(runner):
    return runner.peer(VESSEL, "console")


@pytest.fixture
def states(watch):
    samples = watch(STATE)

    def of(record_id):
        found = [wire.decode(DownlinkState, s.payload.to_bytes(), str(s.key_expr)) for s in samples]
        return [state for state in found if state.record_id == record_id]

    return of


class Vehicle:
    """The vehicle's end on its own modem.

    Confirms each copy of a command, after the first `silent` ones and when it has `together` different ones: a packet
    sent while the vessel sends more of them would be lost at both ends.
    """

    def __init__(self, port, key=None, *, silent=0, together=1):
        self.commands, self.feedback, self.silent, self.together = [], [], silent, together
        authenticator = None
        if key is not None:
            authenticator = FrameAuthenticator(key, 3, Direction.FROM_VEHICLE)
            authenticator.grant(10_000)
        self.receiver = V1Receiver(protection=authenticator)
        self.sender = V1Sender(
            SenderConfig(frame_bytes=64, channels=(LossChannel(0.1),), feedback=True), protection=authenticator
        )
        link = SerialPort(port, 19200)
        self.modem = ModemRunner(MicroModem(MicroModemConfig(3), port), link, self.on_event)

    def on_event(self, event):
        if not isinstance(event, PacketReceived):
            return
        for frame in event.frames:
            for found in self.receiver.accept(frame.src, frame.data, time.time()):
                if isinstance(found, FeedbackReceived):
                    self.feedback.append(found.feedback)
                elif isinstance(found, MessageReceived):
                    self.take(dl.unpack(found.data))

    def take(self, command):
        first = len(tokens := {each.token for each in self.commands}) < self.together
        self.commands.append(command)
        tokens.add(command.token)
        if len(self.commands) > self.silent and len(tokens) >= self.together:
            for token in sorted(tokens) if first else [command.token]:
                answer = dl.ConfirmationMessage(((token, dl.CommandOutcome.ACCEPTED),))
                add_message(self.sender, dl.pack(answer), time.time(), times=1)
            self.send()

    def send(self):
        self.modem.send_packet(1, 1, next_frames(self.sender, 3, time.time()))


@pytest.fixture
def vehicle(modem_pair):
    made = []

    def make(**options):
        made.append(Vehicle(modem_pair.port(modem_pair.VEHICLE), **options))
        made[-1].modem.start()
        return made[-1]

    yield make
    for each in made:
        each.modem.stop()


def confirmation_of(record_id, kind="command", outcome=dl.CommandOutcome.ACCEPTED):
    answer = dl.pack(dl.ConfirmationMessage(((dl.token_of(record_id, kind), outcome),)))
    return pack_segments([Segment(SegmentKind.MESSAGE, b"\x01" + answer)], 32)


@pytest.mark.parametrize("authenticated", [False, True])
def test_commands_are_sent_and_confirmed(authenticated, modem_pair, begin, console, states, vehicle, key_file):
    modem_pair.start()
    far = vehicle(key=read_key(key_file) if authenticated else None, together=8)
    service = begin(key_file=key_file if authenticated else None)
    sent = {
        "c-1": command(),
        "c-2": command("resend", "c-2"),
        "c-3": command("revisit", "c-3"),
        "c-4": command("expand", "c-4"),
        "c-5": command("original", "c-5"),
        "c-6": command("region", "c-6", box=(4, 8, 20, 32), stream_bytes=192),
        "c-7": command("prioritise", "c-7", place="last"),
    }
    for record in sent.values():
        console.send(keys.command(VESSEL, record.kind), "op_modem", record)
    fresh = VERDICT.model_copy(update={"decided_utc_s": time.time()})
    console.send(DECISION, "op_modem", fresh)
    for record_id in (*sent, "d-1"):
        confirmed = lambda r=record_id: states(r) and states(r)[-1].state == "confirmed"  # noqa: E731
        eventually(confirmed, what=f"{record_id} confirmed")
        steps = [state.state for state in states(record_id)]
        assert steps[0] == "asked"
        assert set(steps[1:-1]) == {"sent"}
    by_kind = {type(found): found for found in far.commands}
    region, moved = by_kind[dl.RegionMessage], by_kind[dl.PrioritiseMessage]
    assert (region.box.as_tuple(), region.stream_bytes, region.number) == ((4, 8, 20, 32), 192, 7)
    assert (moved.place, moved.number) == ("last", 7)
    for_images = (dl.RefineMessage, dl.ResendMessage, dl.ExpandMessage, dl.OriginalMessage)
    assert {by_kind[kind].number for kind in for_images} == {7}
    assert (by_kind[dl.RevisitMessage].lat_deg, by_kind[dl.RevisitMessage].lon_deg) == (41.5, -70.5)
    decided = by_kind[dl.DecisionMessage]
    assert (decided.verdict, decided.confidence, decided.version) == ("mine_like", 0.5, 2)
    assert "Manta".startswith(decided.mlo_class)
    eventually(lambda: service.health().gauges["commands_open"] == 0.0)
    if authenticated:
        assert service.health().gauges["frames_genuine"] >= 2


def test_command_is_repeated_until_it_is_confirmed(modem_pair, begin, console, states, vehicle):
    modem_pair.start()
    far = vehicle(silent=2)
    begin()
    console.send(keys.command(VESSEL, "refine"), "op_modem", command())
    eventually(lambda: states("c-1") and states("c-1")[-1].state == "confirmed")
    assert len(far.commands) >= 3
    assert len(set(far.commands)) == 1
    assert states("c-1")[-1].times_sent >= 3


def test_nothing_is_sent_while_the_disk_rejects_the_state(modem_pair, begin, console, states, vehicle, unwritable):
    service = begin()  # no modem yet
    console.send(keys.command(VESSEL, "refine"), "op_modem", command())
    eventually(lambda: service.health().gauges["commands_open"] == 1.0)
    with unwritable(service):
        modem_pair.start()
        far = vehicle()
        eventually(lambda: "DeliveryError" in service.degraded_reason())
        assert not far.commands
        assert states("c-1")[-1].state == "asked"
    eventually(lambda: states("c-1")[-1].state == "confirmed")


def test_command_survives_a_restart_and_the_same_record_is_added_once(
    modem_pair, begin, runner, console, states, vehicle
):
    service = begin()  # no modem yet
    record = command()
    console.send(keys.command(VESSEL, "refine"), "op_modem", record, record)
    eventually(lambda: service.health().counters.get("commands_repeated") == 1)
    runner.stop(service)
    modem_pair.start()
    far = vehicle()
    service = begin()
    eventually(lambda: states("c-1") and states("c-1")[-1].state == "confirmed")
    assert {found.token for found in far.commands} == {dl.token_of("c-1", "command")}
    console.send(keys.command(VESSEL, "refine"), "op_modem", record)  # from a second site
    eventually(lambda: service.health().counters.get("commands_repeated") == 1)
    assert service.health().gauges["commands_open"] == 0.0


def test_confirmations_and_messages_are_committed_with_their_frame(begin, runner, console, states):
    bridge = runner.peer(VESSEL, "bridge", {keys.message_received(VESSEL): ReceivedMessage})
    service = begin(message_consumers=("bridge",))
    console.send(keys.command(VESSEL, "refine"), "op_modem", command())
    eventually(lambda: service.health().gauges["commands_open"] == 1.0)
    data = pack_segments([Segment(SegmentKind.MESSAGE, b"\x02" + dl.pack(dl.DataMessage(b"battery 80")))], 32)
    elsewhere = confirmation_of("c-1")
    service.on_modem_event(packet(elsewhere, dest=9))  # to another vessel
    assert service.health().gauges["commands_open"] == 1.0
    service.on_modem_event(packet(data, confirmation_of("c-1", outcome=dl.CommandOutcome.UNKNOWN_IMAGE), data))
    eventually(lambda: states("c-1") and states("c-1")[-1].state == "refused")
    assert states("c-1")[-1].reason == "unknown image"
    runner.stop(service)
    service = begin(message_consumers=("bridge",))
    service.on_modem_event(packet(data))
    assert service.health().gauges["commands_open"] == 0.0
    eventually(lambda: [(m.vehicle_id, m.data) for m in bridge.received] == [("uuv-1", b"battery 80")])


def test_messages_without_consumers_are_published(begin, watch):
    seen = watch(keys.message_received(VESSEL))
    service = begin()
    service.on_modem_event(
        packet(pack_segments([Segment(SegmentKind.MESSAGE, b"\x02" + dl.pack(dl.DataMessage(b"x")))], 32), src=5)
    )
    eventually(lambda: len(seen) == 1)
    record = wire.decode(ReceivedMessage, seen[0].payload.to_bytes(), "message")
    assert (record.vehicle_id, record.data) == ("modem-5", b"x")


def test_unconfirmed_command_expires(modem_pair, begin, console, states):
    begin(command_lifetime_s=0.3)
    console.send(keys.command(VESSEL, "refine"), "op_modem", command())
    eventually(lambda: [state.state for state in states("c-1")] == ["asked", "expired"])
    console.send(DECISION, "op_modem", VERDICT)  # an old decision
    eventually(lambda: [state.state for state in states("d-1")] == ["expired"])


def test_feedback_names_the_missing_symbols(modem_pair, begin, vehicle, watch):
    observed = watch(RX)
    modem_pair.start()
    far = vehicle()
    service = begin(feedback_interval_s=0.5)
    eventually(lambda: far.modem.ready and service.modem.ready)
    contact = ContactSummary(height_px=40, width_px=60, time_utc_s=1.0)
    for number in range(1, 5):
        far.sender.add_image(number, contact, bytes([0x20]) + bytes(range(150)), time.time())
    next_frames(far.sender, 2, time.time())  # lost
    far.send()
    eventually(lambda: len(far.feedback) >= 1)
    assert sum(far.feedback[0].missing) > 0
    assert len(observed) == 3
    assert service.health().gauges["feedback_open"] == 1.0
    assert service.health().gauges["images_incomplete"] > 0.0


def test_record_that_can_never_be_sent_is_rejected(begin):
    service = begin()
    refine = keys.command(VESSEL, "refine")
    for key, record, field in [
        (keys.command(VESSEL, "resend"), command(), "kind"),
        (refine, command(vehicle_id="uuv-9"), "vehicle_id"),
        (refine, command(vehicle_id="modem-3"), "vehicle_id"),
        (refine, command(vehicle_id="modem-128"), "vehicle_id"),
        (DECISION, VERDICT.model_copy(update={"vessel_id": "vessel-2"}), "vessel_id"),
        (DECISION, VERDICT.model_copy(update={"decided_utc_s": 5e9}), "time"),
    ]:
        with pytest.raises(PayloadError) as caught:
            service.validate(key, record)
        assert caught.value.field == field
    service.validate(refine, command(vehicle_id="modem-5"))  # a vehicle without a name


def test_command_is_validated_while_the_link_is_locked(begin, console, states):
    service = begin()
    with service._link.lock:
        # The inbox validates inside a transaction while another thread holds the lock and will open a transaction.
        console.send(keys.command(VESSEL, "refine"), "op_modem", command())
        eventually(lambda: service.store.inbox_depth() == 1, what="command in the inbox")
    eventually(lambda: [state.state for state in states("c-1")] == ["asked"])


def test_service_with_the_paper_link_does_not_transmit(begin):
    service = begin(link="paper")
    assert service.consumed_keys() == {}
    service.on_modem_event(packet(confirmation_of("c-1")))
    assert service.health().counters["messages_received"] == 0
    assert service.health().gauges["feedback_open"] == 0.0


def test_frames_without_authentication_change_nothing(begin, console, key_file):
    service = begin(key_file=key_file)
    console.send(keys.command(VESSEL, "refine"), "op_modem", command())
    eventually(lambda: service.health().gauges["commands_open"] == 1.0)
    service.on_modem_event(packet(confirmation_of("c-1")))
    assert service.health().gauges["commands_open"] == 1.0
    assert service.health().counters["frames_rejected"] == 1


def vehicle_frames(numbers, authenticator=None):
    """Return all frames of some images, in the order of transmission."""
    config = SenderConfig(frame_bytes=64, channels=(LossChannel(0.3),), frames_per_image=6)
    sender = V1Sender(config, protection=authenticator)
    for number in numbers:
        sender.add_image(number, replace(CONTACT, time_utc_s=1e9 + number), b"\x20" + bytes([number] * 150), 0.0)
    frames = []
    while (data := sender.next_frame(0.0)) is not None:
        frames.append(data)
    return frames


def vehicle_authenticator(key_file, first_counter=0):
    authenticator = FrameAuthenticator(read_key(key_file), 3, Direction.FROM_VEHICLE, first_counter=first_counter)
    authenticator.grant(authenticator.settings.lifetime_frames)
    return authenticator


def test_both_wire_formats_are_received_side_by_side(begin, decompressor, complete):
    service = begin(pairing_timeout_s=0.2)
    contact_frame = ContactFrame("0A1B", CONTACT).pack()
    for data in vehicle_frames([1, 2]):
        service.on_modem_event(packet(data, contact_frame))
    eventually(lambda: complete() == {1, 2})
    eventually(lambda: "0A1B" in {image.image_id for image in decompressor.received})
    assert service.health().counters["frames_rejected"] == 0


def test_only_authenticated_frames_count_and_each_once(begin, runner, decompressor, complete, key_file):
    service = begin(key_file=key_file)
    genuine = vehicle_frames([1, 2], vehicle_authenticator(key_file))
    forged = vehicle_frames([3, 4])
    for data in (*forged, *genuine):
        service.on_modem_event(packet(data))
    eventually(lambda: complete() == {1, 2})
    for data in genuine:
        service.on_modem_event(packet(data, src=4))  # with the address of another vehicle
    assert service.health().counters["frames_rejected"] == len(forged) + len(genuine)
    runner.stop(service)
    service = begin(key_file=key_file)
    for data in genuine:
        service.on_modem_event(packet(data))  # replayed after a restart
    assert service.health().counters["frames_rejected"] == len(genuine)
    for data in vehicle_frames([5], vehicle_authenticator(key_file, len(genuine))):
        service.on_modem_event(packet(data))
    eventually(lambda: complete() == {1, 2, 5})
    assert {int(image.image_id, 36) for image in decompressor.received} == {1, 2, 5}


def test_authenticated_frame_of_a_failed_commit_is_no_replay(begin, complete, key_file, unwritable):
    service = begin(key_file=key_file)
    with unwritable(service):
        for data in vehicle_frames([1], vehicle_authenticator(key_file)):
            service.on_modem_event(packet(data))
        assert service.health().gauges["unsaved"] > 1
    eventually(lambda: complete() == {1})
    assert service.health().gauges["frames_replayed"] == 0.0
    assert service.health().counters["frames_rejected"] == 0


def test_feedback_is_open_until_everything_arrived(begin, complete):
    service = begin()
    frames = vehicle_frames([1, 2])
    assert service.health().gauges["feedback_open"] == 0.0
    service.on_modem_event(packet(frames[0]))
    assert service.health().gauges["feedback_open"] == 1.0
    assert service.health().gauges["images_incomplete"] >= 1.0
    for data in frames[1:]:
        service.on_modem_event(packet(data))
    eventually(lambda: complete() == {1, 2})
    assert service.health().gauges["images_incomplete"] == 0.0


def test_vehicle_of_another_vessel_gets_no_feedback(begin, runner, complete):
    service = begin()
    first, *others = vehicle_frames([1, 2])
    service.on_modem_event(packet(first, dest=9))
    assert service.health().gauges["feedback_open"] == 0.0
    runner.stop(service)
    service = begin()
    assert service.health().gauges["feedback_open"] == 0.0
    service.on_modem_event(packet(others[0]))
    assert service.health().gauges["feedback_open"] == 1.0
    for data in others[1:]:
        service.on_modem_event(packet(data, dest=9))
    assert service.health().gauges["feedback_open"] == 0.0
    eventually(lambda: complete() == {1, 2})


def test_unreadable_state_is_discarded_and_counted(begin, runner, caplog):
    service = begin()
    runner.stop(service)
    store = Store(service.store.path)
    with store.transaction() as tx:
        tx.put_state("vehicle/link/endpoint", b"\xc1")
    store.close()
    service = begin()
    assert service.health().counters["states_discarded"] == 1
    assert service.health().gauges["commands_open"] == 0.0


def gate(**options):
    return TransmitGate(OpModemConfig(port="x", **options))


def test_csma_sends_after_the_holdoff_or_the_maximum_wait():
    mine = gate(holdoff_s=2.0, max_defer_s=60.0)
    ask = {"receiving": False, "pending": True}
    mine.frame_received(100.0)
    assert not mine.may_transmit(101.0, 0.0, **ask)
    assert mine.may_transmit(102.0, 0.0, **ask)
    assert not mine.may_transmit(102.0, 0.0, receiving=True, pending=True)
    assert not mine.may_transmit(102.0, 0.0, receiving=False, pending=False)
    mine.failed(102.0)
    assert not mine.may_transmit(103.0, 0.0, **ask)
    for now_s in range(103, 163):
        mine.frame_received(float(now_s))
        assert not mine.may_transmit(now_s + 0.5, 0.0, **ask)
    mine.frame_received(164.0)
    assert mine.may_transmit(164.1, 0.0, **ask)


def test_tdma_sends_in_its_slot_only():
    mine = gate(mac="tdma", tdma_cycle_s=60.0, tdma_slot_s=(50.0, 59.0))
    sent = [at for at in range(120) if mine.may_transmit(float(at), float(at), receiving=False, pending=True)]
    assert sent == [50, 51, 52, 53, 54, 110, 111, 112, 113, 114]


def test_vehicles_are_polled_in_turn():
    mine = gate(mac="polled", poll_interval_s=10.0)
    polls = [(at, mine.vehicle_to_poll(float(at), [3, 5])) for at in range(0, 40, 5)]
    assert [pair for pair in polls if pair[1] is not None] == [(0, 3), (10, 5), (20, 3), (30, 5)]
    assert gate().vehicle_to_poll(0.0, [3]) is None


@pytest.mark.parametrize(
    "options",
    [
        {"vehicles": {"3": "uuv-1", "4": "uuv-1"}},
        {"vehicles": {"300": "uuv-1"}},
        {"mac": "tdma", "tdma_slot_s": (50.0, 61.0)},
        {"mac": "tdma", "tdma_slot_s": (0.0, 2.0)},
        {"vehicles": {"200": "uuv-1"}},
        {"downlink_rate": 9},
        {"address": 128},
        {"wire_formats": ("paper",)},
    ],
)
def test_invalid_configuration_is_rejected(options):
    with pytest.raises((ValidationError, ConfigError)):
        OpModemConfig(port="x", **options).for_modem(CAPABILITIES)


def test_polled_vehicle_sends_a_packet(modem_pair, begin, vehicle, watch):
    observed = watch(RX)
    modem_pair.start()
    far = vehicle()
    far.modem.set_poll_handler(lambda polled: (b"polled",))
    eventually(lambda: far.modem.ready)
    begin(mac="polled", poll_interval_s=0.2)
    eventually(lambda: any(b"polled" in sample.payload.to_bytes() for sample in observed))
