"""op_modem with v1: orders reach a vehicle through emulated modems and are confirmed, whatever is lost or restarted."""

from __future__ import annotations

import threading
import time

import pytest
from builders.common import eventually
from builders.v1_world import next_frames
from pydantic import ValidationError

from sonarpost import keys, wire
from sonarpost.errors import PayloadError
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import Direction
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.config import SenderConfig
from sonarpost.link.downlink import messages as dl
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.frame import Segment, SegmentKind, pack_segments
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.link.receiver import FeedbackReceived, MessageReceived
from sonarpost.messages import AcousticFrame, Command, Decision, DownlinkState, ReceivedMessage
from sonarpost.modem.micromodem import FrameReceived, MicroModem, MicroModemConfig, PacketReceived
from sonarpost.runtime.modem_runner import ModemRunner
from sonarpost.runtime.serial_port import SerialPort
from sonarpost.security.acoustic_key import read_key
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.service import OpModemService
from sonarpost.services.op_modem.speaking import TransmitGate

VESSEL = "vessel-1"
RX, DECISION, STATE = keys.acoustic_rx(VESSEL), keys.contact_decision(VESSEL), keys.acoustic_downlink(VESSEL)
VERDICT = Decision(
    decision_id="d-1",
    vessel_id=VESSEL,
    vehicle_id="uuv-1",
    image_id="0007",
    image_version=2,
    verdict="mine_like",
    confidence=0.5,
    mlo_class="Manta",
    operator="op",
    decided_utc_s=1.0,
)


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
def key_file(tmp_path):
    path = tmp_path / "acoustic.key"
    path.write_text(bytes(range(32)).hex())
    path.chmod(0o600)
    return path


@pytest.fixture
def begin(runner, platform, modem_pair):
    def start(*, key_file=None, **options):
        usual = {
            "port": modem_pair.port(modem_pair.VESSEL),
            "vehicles": {"3": "uuv-1"},
            "retry_s": 0.5,
            "holdoff_s": 0.05,
        }
        there = platform(VESSEL).model_copy(update={"acoustic_key_file": key_file})
        return runner.start(OpModemService(there, OpModemConfig(**(usual | options))))

    return start


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
    """The far end on its own modem: takes orders, confirms each copy unless it is to be silent."""

    def __init__(self, port, key=None, *, silent=0):
        self.orders, self.reports, self.silent = [], [], silent
        seal = None
        if key is not None:
            seal = FrameAuthenticator(key, 3, Direction.FROM_VEHICLE)
            seal.grant(10_000)
        self.receiver = V1Receiver(protection=seal)
        self.sender = V1Sender(
            SenderConfig(frame_bytes=64, channels=(LossChannel(0.1),), feedback=True), protection=seal
        )
        link = SerialPort(port, 19200)
        self.modem = ModemRunner(MicroModem(MicroModemConfig(3), port), link, self.on_event)

    def on_event(self, event):
        if not isinstance(event, PacketReceived):
            return
        for frame in event.frames:
            for found in self.receiver.accept(frame.src, frame.data, time.time()):
                if isinstance(found, FeedbackReceived):
                    self.reports.append(found.feedback)
                elif isinstance(found, MessageReceived):
                    self.take(dl.unpack(found.data))

    def take(self, order):
        self.orders.append(order)
        if len(self.orders) > self.silent:
            answer = dl.ConfirmationMessage(((order.token, dl.CommandOutcome.ACCEPTED),))
            self.sender.add_message(dl.pack(answer), time.time(), times=1)
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


def packet(*frames, dest=1, src=3):
    heard = tuple(FrameReceived(src, dest, False, n, data, 0.0, 1, None) for n, data in enumerate(frames, start=1))
    return PacketReceived(heard, 0, len(frames), src, dest, 1, None, True)


def confirmation_of(record_id, kind="command", outcome=dl.CommandOutcome.ACCEPTED):
    answer = dl.pack(dl.ConfirmationMessage(((dl.token_of(record_id, kind), outcome),)))
    return pack_segments([Segment(SegmentKind.MESSAGE, b"\x01" + answer)], 32)


@pytest.mark.parametrize("sealed", [False, True])
def test_orders_go_through_the_water_and_are_confirmed(sealed, modem_pair, begin, console, states, vehicle, key_file):
    modem_pair.start()
    far = vehicle(key=read_key(key_file) if sealed else None)
    service = begin(key_file=key_file if sealed else None)
    sent = {
        "c-1": command(),
        "c-2": command("resend", "c-2"),
        "c-3": command("revisit", "c-3"),
        "c-4": command("wider", "c-4"),
    }
    for record in sent.values():
        console.send(keys.command(VESSEL, record.kind), "op_modem", record)
    fresh = VERDICT.model_copy(update={"decided_utc_s": time.time()})
    console.send(DECISION, "op_modem", fresh)
    for record_id in (*sent, "d-1"):
        eventually(
            lambda r=record_id: states(r) and states(r)[-1].state == "confirmed",
            timeout_s=60,
            what=f"{record_id} confirmed",
        )
        steps = [state.state for state in states(record_id)]
        assert steps[0] == "asked"
        assert set(steps[1:-1]) == {"sent"}
    by_kind = {type(order): order for order in far.orders}
    assert by_kind[dl.RefineMessage].number == by_kind[dl.ResendMessage].number == by_kind[dl.ExpandMessage].number == 7
    assert (by_kind[dl.RevisitMessage].lat_deg, by_kind[dl.RevisitMessage].lon_deg) == (41.5, -70.5)
    judged = by_kind[dl.DecisionMessage]
    assert (judged.verdict, judged.confidence, judged.version) == ("mine_like", 0.5, 2)
    assert "Manta".startswith(judged.mlo_class)
    eventually(lambda: service.health().gauges["orders_open"] == 0.0)
    if sealed:
        assert service.health().gauges["frames_genuine"] >= 4


def test_an_order_is_repeated_until_it_is_confirmed(modem_pair, begin, console, states, vehicle):
    modem_pair.start()
    far = vehicle(silent=2)
    begin()
    console.send(keys.command(VESSEL, "refine"), "op_modem", command())
    eventually(lambda: states("c-1") and states("c-1")[-1].state == "confirmed", timeout_s=60)
    assert len(far.orders) >= 3
    assert len(set(far.orders)) == 1
    assert states("c-1")[-1].times_sent >= 3


def test_an_order_waits_over_a_kill_and_the_same_record_is_one_order(
    modem_pair, begin, runner, console, states, vehicle
):
    service = begin()  # no modem yet
    asked = command()
    console.send(keys.command(VESSEL, "refine"), "op_modem", asked, asked)
    eventually(lambda: service.health().counters.get("orders_repeated") == 1)
    runner.stop(service)
    modem_pair.start()
    far = vehicle()
    service = begin()
    eventually(lambda: states("c-1") and states("c-1")[-1].state == "confirmed", timeout_s=60)
    assert {order.token for order in far.orders} == {dl.token_of("c-1", "command")}
    console.send(keys.command(VESSEL, "refine"), "op_modem", asked)  # a second site asks the same
    eventually(lambda: service.health().counters.get("orders_repeated") == 1)
    assert service.health().gauges["orders_open"] == 0.0


def test_confirmations_and_messages_are_kept_with_the_frame_they_came_in(begin, runner, console, states):
    takes = runner.peer(VESSEL, "bridge", {keys.message_received(VESSEL): ReceivedMessage})
    service = begin(message_consumers=("bridge",))
    console.send(keys.command(VESSEL, "refine"), "op_modem", command())
    eventually(lambda: service.health().gauges["orders_open"] == 1.0)
    data = pack_segments([Segment(SegmentKind.MESSAGE, b"\x02" + dl.pack(dl.DataMessage(b"battery 80")))], 32)
    elsewhere = confirmation_of("c-1")
    service.on_modem_event(packet(elsewhere, dest=9))  # overheard: not for this vessel
    assert service.health().gauges["orders_open"] == 1.0
    service.on_modem_event(packet(data, confirmation_of("c-1", outcome=dl.CommandOutcome.UNKNOWN_IMAGE), data))
    eventually(lambda: states("c-1") and states("c-1")[-1].state == "refused")
    assert states("c-1")[-1].reason == "unknown image"
    runner.stop(service)
    service = begin(message_consumers=("bridge",))
    service.on_modem_event(packet(data))
    assert service.health().gauges["orders_open"] == 0.0
    eventually(lambda: [(m.vehicle_id, m.data) for m in takes.received] == [("uuv-1", b"battery 80")])


def test_without_consumers_messages_are_shown(begin, watch):
    seen = watch(keys.message_received(VESSEL))
    service = begin()
    service.on_modem_event(
        packet(pack_segments([Segment(SegmentKind.MESSAGE, b"\x02" + dl.pack(dl.DataMessage(b"x")))], 32), src=5)
    )
    eventually(lambda: len(seen) == 1)
    record = wire.decode(ReceivedMessage, seen[0].payload.to_bytes(), "message")
    assert (record.vehicle_id, record.data) == ("modem-5", b"x")


def test_an_order_that_nobody_confirms_expires(modem_pair, begin, console, states):
    begin(command_lifetime_s=0.3)
    console.send(keys.command(VESSEL, "refine"), "op_modem", command())
    eventually(lambda: [state.state for state in states("c-1")] == ["asked", "expired"])
    console.send(DECISION, "op_modem", VERDICT)  # decided long ago
    eventually(lambda: [state.state for state in states("d-1")] == ["expired"])


def test_reports_tell_the_vehicle_what_is_lacking(modem_pair, begin, vehicle, runner):
    decompressor = runner.peer(VESSEL, "decompressor", {RX: AcousticFrame})
    modem_pair.start()
    far = vehicle()
    service = begin(feedback_interval_s=0.5)
    eventually(lambda: far.modem.ready and service.modem.ready)
    contact = ContactSummary(height_px=40, width_px=60, time_utc_s=1.0)
    for number in range(1, 5):
        far.sender.add_image(number, contact, bytes([0x20]) + bytes(range(150)), time.time())
    next_frames(far.sender, 2, time.time())  # lost
    far.send()
    eventually(lambda: len(far.reports) >= 1, timeout_s=60)
    assert sum(far.reports[0].missing) > 0
    assert len(decompressor.received) == 3


@pytest.mark.parametrize(
    ("key", "record", "field"),
    [
        (keys.command(VESSEL, "resend"), command(), "kind"),
        (keys.command(VESSEL, "refine"), command(vehicle_id="uuv-9"), "vehicle_id"),
        (keys.command(VESSEL, "refine"), command(vehicle_id="modem-3"), "vehicle_id"),
        (keys.command(VESSEL, "refine"), command(vehicle_id="modem-128"), "vehicle_id"),
        (DECISION, VERDICT.model_copy(update={"vessel_id": "vessel-2"}), "vessel_id"),
        (DECISION, VERDICT.model_copy(update={"decided_utc_s": 5e9}), "time"),
    ],
)
def test_what_can_never_be_sent_is_refused(key, record, field, begin):
    service = begin()
    with pytest.raises(PayloadError) as caught:
        service.validate(key, record)
    assert caught.value.field == field


def test_an_order_is_checked_while_the_station_is_busy(begin, console, states):
    service = begin()
    with service._station_lock:
        # Taken into the inbox, within a transaction, while a thread that will want a transaction has the station.
        console.send(keys.command(VESSEL, "refine"), "op_modem", command())
        eventually(lambda: service.store.inbox_depth() == 1, timeout_s=10, what="order in the inbox")
    eventually(lambda: [state.state for state in states("c-1")] == ["asked"])


def test_vehicles_without_a_name_can_be_told_too(begin):
    begin().validate(keys.command(VESSEL, "refine"), command(vehicle_id="modem-5"))


def test_with_the_papers_link_it_only_listens(begin):
    service = begin(link="paper")
    assert service.consumed_keys() == {}
    service.on_modem_event(packet(confirmation_of("c-1")))
    assert "frames_foreign" not in service.health().counters


def test_frames_without_the_key_change_nothing(begin, console, key_file):
    service = begin(key_file=key_file)
    console.send(keys.command(VESSEL, "refine"), "op_modem", command())
    eventually(lambda: service.health().gauges["orders_open"] == 1.0)
    service.on_modem_event(packet(confirmation_of("c-1")))
    assert service.health().gauges["orders_open"] == 1.0
    assert service.health().counters["frames_foreign"] == 1


def test_a_state_that_cannot_be_read_is_left_and_said(begin, runner, caplog):
    service = begin()
    with service.store.transaction() as tx:
        tx.put_state("station", b"\xc1")
    runner.stop(service)
    service = begin()
    assert service.health().counters["states_discarded"] == 1
    assert service.health().gauges["orders_open"] == 0.0


def turn(**options):
    return TransmitGate(OpModemConfig(port="x", **options))


def test_it_speaks_when_it_has_been_quiet_or_it_has_waited_long():
    mine = turn(holdoff_s=2.0, max_defer_s=60.0)
    ask = {"receiving": False, "wanted": True}
    mine.heard(100.0)
    assert not mine.may_speak(101.0, 0.0, **ask)
    assert mine.may_speak(102.0, 0.0, **ask)
    assert not mine.may_speak(102.0, 0.0, receiving=True, wanted=True)
    assert not mine.may_speak(102.0, 0.0, receiving=False, wanted=False)
    mine.failed(102.0)
    assert not mine.may_speak(103.0, 0.0, **ask)
    for now_s in range(103, 163):
        mine.heard(float(now_s))
        assert not mine.may_speak(now_s + 0.5, 0.0, **ask)
    mine.heard(164.0)
    assert mine.may_speak(164.1, 0.0, **ask)


def test_it_speaks_in_its_slot_only():
    mine = turn(mac="tdma", tdma_cycle_s=60.0, slot_start_s=50.0, slot_s=10.0, guard_s=1.0)
    spoken = [at for at in range(120) if mine.may_speak(float(at), float(at), receiving=False, wanted=True)]
    assert spoken == [50, 51, 52, 53, 54, 110, 111, 112, 113, 114]


def test_vehicles_are_polled_in_turn():
    mine = turn(mac="polled", poll_interval_s=10.0)
    asked = [(at, mine.vehicle_to_poll(float(at), [3, 5])) for at in range(0, 40, 5)]
    assert [pair for pair in asked if pair[1] is not None] == [(0, 3), (10, 5), (20, 3), (30, 5)]
    assert turn().vehicle_to_poll(0.0, [3]) is None


@pytest.mark.parametrize(
    "options",
    [
        {"vehicles": {"3": "uuv-1", "4": "uuv-1"}},
        {"vehicles": {"300": "uuv-1"}},
        {"mac": "tdma", "slot_start_s": 55.0},
        {"mac": "tdma", "slot_start_s": 0.0, "slot_s": 3.0},
    ],
)
def test_configurations_that_cannot_work_are_refused(options):
    with pytest.raises(ValidationError):
        OpModemConfig(port="x", **options)


def test_a_vehicle_is_asked_for_a_packet_and_answers(modem_pair, begin, vehicle, runner):
    decompressor = runner.peer(VESSEL, "decompressor", {RX: AcousticFrame})
    modem_pair.start()
    far = vehicle()
    asked = threading.Event()

    def uplink(polled):
        asked.set()
        return (b"polled",)

    far.modem.set_poll_handler(uplink)
    eventually(lambda: far.modem.ready)
    begin(mac="polled", poll_interval_s=0.2)
    assert asked.wait(30)
    eventually(lambda: any(frame.data.startswith(b"polled") for frame in decompressor.received), timeout_s=30)
