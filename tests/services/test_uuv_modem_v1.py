"""uuv_modem with the v1 link: previews first, other traffic, orders by sound, and nothing lost by a kill."""

from __future__ import annotations

import shutil
import time

import msgpack
import numpy as np
import pytest
from builders.common import eventually
from builders.v1_world import feedback_frame

from sonarpost import keys, wire
from sonarpost.config import PlatformConfig
from sonarpost.delivery.store import Store
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import AcousticKey, Direction
from sonarpost.link.config import SenderConfig
from sonarpost.link.downlink.messages import (
    CommandOutcome,
    ConfirmationMessage,
    DataMessage,
    DecisionMessage,
    ExpandMessage,
    RefineMessage,
    ResendMessage,
    RevisitMessage,
    number_of_image,
    pack,
    unpack,
)
from sonarpost.link.frames.paper.frame import format_image_id
from sonarpost.link.frames.v1.frame import checksum
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.link.receiver import FrameRejected, ImageUpdate, MessageReceived
from sonarpost.messages import (
    AcousticFrame,
    Command,
    Contact,
    Decision,
    EncodedImage,
    OutgoingMessage,
    QueueState,
)
from sonarpost.modem.micromodem import RATES
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.service import OpModemService
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.service import UuvModemService

IN, OUT = keys.image_encoded("uuv-1"), keys.message_outgoing("uuv-1")
RX, QUEUE = keys.acoustic_rx("vessel-1"), keys.acoustic_queue("uuv-1")


def image(number: int, length: int = 300) -> EncodedImage:
    return EncodedImage(
        vehicle_id="uuv-1",
        image_id=format_image_id(number),
        contact=Contact(contact_id=f"c{number}", vehicle_id="uuv-1", lat_deg=56.4, lon_deg=-5.6, atd_confidence=1.5),
        codec="emb",
        model="",
        height_px=80,
        width_px=80,
        stream=b"\x00\x00\x33" + np.random.default_rng(number).bytes(length - 3),
        original_sha256="0" * 64,
    )


def message(name: str, **options) -> OutgoingMessage:
    usual = {"source": "autonomy", "priority": 3, "lifetime_s": 600.0, "data": name.encode()}
    return OutgoingMessage(message_id=name, created_utc_s=time.time(), **(usual | options))


@pytest.fixture
def begin(runner, platform, modem_pair):
    def start(platform_config: PlatformConfig | None = None, **options):
        usual = {
            "port": modem_pair.port(modem_pair.VEHICLE),
            "rate": 1,
            "retry_s": 0.05,
            "rx_window_s": 0.0,
            "group_delay_s": 0.3,
            "holdoff_s": 0.15,
            "queue_interval_s": 0.1,
        }
        return runner.start(UuvModemService(platform_config or platform("uuv-1"), UuvModemConfig(**(usual | options))))

    return start


@pytest.fixture
def programs(runner):
    """Whatever on the vehicle owes something to uuv_modem."""
    return runner.peer("uuv-1", "compressor")


class Vessel:
    """The vessel's modem, what it hears, and the v1 receiver's view of that."""

    def __init__(self, runner, platform, modem_pair) -> None:
        self._hearer = runner.peer("vessel-1", "decompressor", {RX: AcousticFrame})
        self.service = runner.start(
            OpModemService(platform("vessel-1"), OpModemConfig(port=modem_pair.port(modem_pair.VESSEL)))
        )
        self.sender = V1Sender(SenderConfig(frame_bytes=RATES[0].frame_bytes))

    @property
    def frames(self) -> list[AcousticFrame]:
        return self._hearer.received

    def events(self, seal=None):
        receiver = V1Receiver(protection=seal)
        return [e for n, f in enumerate(self.frames) for e in receiver.accept(f.source, f.data, float(n))]

    def messages(self, seal=None) -> list[object]:
        return [unpack(e.data) for e in self.events(seal) if isinstance(e, MessageReceived)]

    def streams(self) -> dict[int, bytes]:
        found: dict[int, bytes] = {}
        for event in self.events():
            if isinstance(event, ImageUpdate):
                number = number_of_image(event.image_id)
                found[number] = max(found.get(number, b""), event.stream, key=len)
        return found

    def say(self, *contents, until, times: int = 20) -> None:
        """Send until something is true: modems are half-duplex, and the vehicle speaks when it wants."""
        for _ in range(times):
            for content in contents:
                self.sender.add_message(pack(content), 0.0, times=1)
            while frame := self.sender.next_frame(0.0):
                self.send(frame)
            if soon(until):
                return
        pytest.fail(f"said {times} times without effect")

    def send(self, *frames: bytes) -> None:
        for frame in frames:
            self.service.modem.send_packet(3, 0, [frame])

    def send_until(self, frame: bytes, until) -> None:
        for _ in range(20):
            self.send(frame)
            if soon(until):
                return
        pytest.fail("sent 20 times without effect")


def soon(condition, within_s: float = 0.5) -> bool:
    deadline = time.monotonic() + within_s
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.01)
    return condition()


@pytest.fixture
def vessel(runner, platform, modem_pair):
    modem_pair.start()
    vessel = Vessel(runner, platform, modem_pair)
    eventually(lambda: vessel.service.modem.ready)
    return vessel


def sent(service) -> int:
    return service.health().counters.get("packets_sent", 0)


def idle(service) -> bool:
    return service._line.queue.is_idle and service._line.queue.in_flight is None and not service._line.accepted()


def test_pictures_arrive_with_the_preview_of_each_before_the_detail_of_any(vessel, begin, programs):
    begin()
    images = [image(n) for n in range(1, 9)]
    programs.send(IN, "uuv_modem", *images)
    eventually(lambda: len(vessel.streams()) == 8)
    eventually(lambda: all(len(s) > 150 for s in vessel.streams().values()), what="most of every picture")
    for number, stream in vessel.streams().items():
        assert images[number - 1].stream.startswith(stream)
    seen, first_detail = set(), None
    for event in vessel.events():
        if isinstance(event, ImageUpdate):
            seen.add(event.image_id)
            if len(event.stream) > 60 and first_detail is None:
                first_detail = len(seen)
    assert first_detail == 8


def test_a_killed_process_goes_on_where_it_was(vessel, begin, programs, runner, tmp_path):
    service = begin()
    images = [image(n) for n in range(1, 13)]
    programs.send(IN, "uuv_modem", *images)
    programs.send(OUT, "uuv_modem", *[message(f"m{n}", priority=6) for n in range(5)])
    eventually(lambda: sent(service) >= 6)
    # What a process that is killed at this moment leaves on the disk.
    killed = tmp_path / "killed"
    with service.store._lock:
        for file in service.store.path.parent.glob("uuv_modem.db*"):
            if not file.name.endswith(".lock"):
                killed.mkdir(exist_ok=True)
                shutil.copy(file, killed / file.name)
        at_kill = sent(service)
    heard_before = len(vessel.frames)
    runner.stop(service)
    place = service.platform.model_copy(update={"state_dir": killed})
    time_of_stop = len(vessel.frames)
    again = begin(place)
    assert at_kill >= 6
    eventually(lambda: idle(again) and all(len(s) > 150 for s in vessel.streams().values()), what="all of it")
    assert set(vessel.streams()) == set(range(1, 13))
    assert {m.data for m in vessel.messages() if isinstance(m, DataMessage)} == {b"m%d" % n for n in range(5)}
    repeated = len(vessel.frames) - len({f.data for f in vessel.frames})
    # The first process lived on for a moment after the copy was made; what it sent then goes again.
    assert repeated <= 3 * (1 + (time_of_stop - heard_before + 2) // 3) + 3


def test_a_stop_repeats_one_packet_at_most(vessel, begin, programs, runner):
    service = begin()
    programs.send(IN, "uuv_modem", *[image(n) for n in range(1, 13)])
    for stop_at in (2, 5, 9):
        eventually(lambda at=stop_at: len(vessel.frames) >= 3 * at)
        runner.stop(service)
        service = begin()
    eventually(lambda: idle(service))
    eventually(lambda: len(vessel.streams()) == 12)
    assert len(vessel.frames) - len({f.data for f in vessel.frames}) <= 3 * 3


def test_other_traffic_goes_by_priority(vessel, begin, programs):
    begin(aging_s=86400.0)
    programs.send(IN, "uuv_modem", *[image(n) for n in range(1, 9)])
    programs.send(OUT, "uuv_modem", message("urgent", priority=1), message("log", priority=7))
    eventually(lambda: DataMessage(b"urgent") in vessel.messages())
    eventually(lambda: DataMessage(b"log") in vessel.messages(), what="the rest, when pictures leave room")


def test_what_waits_is_told_with_the_time_it_is_expected(begin, programs, watch):
    shown = watch(QUEUE)
    begin()  # no modem answers: everything waits
    programs.send(IN, "uuv_modem", *[image(n) for n in range(1, 9)])

    def told():
        states = [wire.decode(QueueState, s.payload.to_bytes(), QUEUE) for s in shown]
        return [s for s in states if s.images_waiting == 8]

    eventually(lambda: len(told()) > 0, what="the state of a queue of eight pictures")
    for state in told():
        assert state.packet_interval_s > 0
        assert state.rate == 1
        assert {i.contact_id for i in state.images} == {f"c{n}" for n in range(1, 9)}
        assert all(i.expected_utc_s >= state.time_utc_s for i in state.images)


def test_what_has_expired_is_counted_and_not_sent(vessel, begin, programs):
    service = begin()
    old = message("old").model_copy(update={"created_utc_s": time.time() - 3600.0})
    programs.send(OUT, "uuv_modem", old, message("new"))
    eventually(lambda: DataMessage(b"new") in vessel.messages())
    eventually(lambda: service.health().gauges["messages_expired"] == 1)
    assert DataMessage(b"old") not in vessel.messages()


def test_messages_beyond_the_limit_stay_with_their_program(begin, programs, runner):
    service = begin(max_messages=3)  # no modem answers: nothing goes
    autonomy = runner.peer("uuv-1", "autonomy")
    autonomy.send(OUT, "uuv_modem", *[message(f"m{n}") for n in range(3)])
    eventually(lambda: service.health().gauges["messages_waiting"] == 3)
    autonomy.send(OUT, "uuv_modem", message("m3"))
    programs.send(IN, "uuv_modem", image(1))
    eventually(lambda: [e.image_id for e in service._line.queue.expected(0.0)] == ["0001"])
    eventually(lambda: programs.store.outbox_depth() == 0)
    assert autonomy.store.outbox_depth() == 1
    assert service.health().gauges["messages_waiting"] == 3


ORDERS = [
    (RefineMessage(1, 1000, 2, 400), "refine", "0002"),
    (ResendMessage(2, 1001, 3), "resend", "0003"),
    (RevisitMessage(3, 1002, 56.5, -5.25), "revisit", None),
    (ExpandMessage(5, 1004, 4), "wider", "0004"),
]


def test_orders_by_sound_are_handed_on_once_and_confirmed_each_time(vessel, begin, runner):
    service = begin(revisit_consumers=("autonomy",), decision_consumers=("autonomy",))
    compressor = runner.peer("uuv-1", "compressor", {keys.command_all("uuv-1"): Command})
    takes = {keys.command("uuv-1", "revisit"): Command, keys.command("uuv-1", "decision"): Decision}
    autonomy = runner.peer("uuv-1", "autonomy", takes)
    eventually(lambda: service.modem.ready)
    judgement = DecisionMessage(4, 1003, 2, 1, "mine_like", 0.5, "sphere")
    orders = [*[order for order, _, _ in ORDERS], judgement]

    def told() -> list[tuple[int, CommandOutcome]]:
        return [o for m in vessel.messages() if isinstance(m, ConfirmationMessage) for o in m.outcomes]

    vessel.say(*orders, until=lambda: {token for token, _ in told()} == {1, 2, 3, 4, 5})
    before = told().count((1, CommandOutcome.ACCEPTED))
    vessel.say(orders[0], until=lambda: told().count((1, CommandOutcome.ACCEPTED)) > before)
    eventually(lambda: len(compressor.received) == 3 and len(autonomy.received) == 2)
    assert {outcome for _, outcome in told()} == {CommandOutcome.ACCEPTED}
    assert {(c.kind, c.image_id) for c in compressor.received} == {
        ("refine", "0002"),
        ("resend", "0003"),
        ("wider", "0004"),
    }
    revisit, decision = sorted(autonomy.received, key=lambda r: r.TYPE)
    assert (revisit.lat_deg, revisit.lon_deg, revisit.command_id) == (56.5, -5.25, "a1-00000003")
    assert (decision.verdict, decision.mlo_class, decision.image_id) == ("mine_like", "sphere", "0002")
    assert service.health().counters["orders_taken"] == 5


def test_an_order_that_nobody_takes_is_told(vessel, begin):
    service = begin()
    eventually(lambda: service.modem.ready)
    unsupported = ConfirmationMessage(((9, CommandOutcome.UNSUPPORTED),))
    vessel.say(RevisitMessage(9, 1000, 1.0, 2.0), until=lambda: unsupported in vessel.messages())


def test_what_a_report_lacks_is_sent(vessel, begin, programs):
    service = begin(stream_bytes=300, tx_burst_s=0.2, rx_window_s=0.2)
    programs.send(IN, "uuv_modem", *[image(n) for n in range(1, 5)])
    eventually(lambda: len(vessel.frames) > 10)

    def report() -> bool:
        receiver = V1Receiver()
        for number, frame in enumerate(vessel.frames):
            receiver.accept(3, frame.data, float(number))
        vessel.send(feedback_frame(receiver.feedback(3, 1e3)))
        return soon(lambda: service.health().counters.get("reports_received", 0) > 0)

    assert any(report() for _ in range(20))
    assert service._line.queue.sender.config.feedback
    # Pictures that come now are sent as far as configured, and what is lost of them until a report says it is there.
    programs.send(IN, "uuv_modem", *[image(n) for n in range(5, 9)])

    def done() -> bool:
        report()
        return soon(lambda: all(len(vessel.streams().get(n, b"")) == 300 for n in range(5, 9)))

    eventually(done, timeout_s=30.0)


def test_frames_for_others_and_damaged_ones_do_no_harm(vessel, begin, programs):
    service = begin()
    eventually(lambda: service.modem.ready)
    vessel.send(b"no frame of this format")
    vessel.service.modem.send_packet(5, 0, [b"for somebody else"])
    eventually(lambda: service.health().counters.get("frames_refused", 0) == 1)
    programs.send(IN, "uuv_modem", image(1))
    eventually(lambda: 1 in vessel.streams())


@pytest.fixture
def key(tmp_path) -> AcousticKey:
    key = AcousticKey(bytes(range(100, 132)))
    (tmp_path / "acoustic.key").write_text(key.secret.hex() + "\n", encoding="utf-8")
    (tmp_path / "acoustic.key").chmod(0o600)
    return key


def test_with_a_key_only_sealed_frames_count_and_a_restart_uses_no_counter_twice(
    vessel, begin, programs, runner, platform, key, tmp_path
):
    place = platform("uuv-1").model_copy(update={"acoustic_key_file": tmp_path / "acoustic.key"})
    service = begin(place)
    eventually(lambda: service.modem.ready)
    seal = FrameAuthenticator(key, 1, Direction.TO_VEHICLE)
    seal.grant(seal.requested_limit)
    sealed = V1Sender(SenderConfig(frame_bytes=32), protection=seal)
    sealed.add_message(pack(ResendMessage(1, 1000, 3)), 0.0, times=1)
    frame = sealed.next_frame(0.0)
    counters = lambda: service.health().counters  # noqa: E731
    vessel.send_until(frame, lambda: counters().get("orders_taken") == 1)
    vessel.send_until(frame, lambda: counters().get("frames_replayed", 0) > 0)
    body = frame[2:-1] + bytes([frame[-1] ^ 1])
    vessel.send_until(checksum(body).to_bytes(2, "big") + body, lambda: counters().get("frames_forged", 0) > 0)
    forged = counters()["frames_forged"]
    vessel.say(ResendMessage(2, 1000, 4), until=lambda: counters()["frames_forged"] > forged)
    assert counters()["orders_taken"] == 1
    programs.send(IN, "uuv_modem", *[image(n) for n in range(1, 9)])
    eventually(lambda: len(vessel.frames) > 6)
    runner.stop(service)
    again = begin(place)
    eventually(lambda: idle(again))
    eventually(lambda: len({e.image_id for e in vessel.events(ears_of(key)) if isinstance(e, ImageUpdate)}) == 8)
    refused = [e for e in vessel.events(ears_of(key)) if isinstance(e, FrameRejected)]
    repeated = len(vessel.frames) - len({f.data for f in vessel.frames})
    assert len(refused) == repeated <= 3, "the packet that was under way, word for word"
    assert {e.reason.field for e in refused} <= {"counter"}


def ears_of(key: AcousticKey) -> FrameAuthenticator:
    return FrameAuthenticator(key, 1, Direction.TO_VEHICLE)


def test_polled_it_sends_what_it_is_asked_for_and_nothing_else(vessel, begin, programs):
    service = begin(mac="polled", group_delay_s=0.0)
    programs.send(IN, "uuv_modem", image(1), image(2))
    eventually(lambda: bool(service._runner._offered))
    assert sent(service) == 0
    for n in range(1, 4):
        vessel.service.modem.request_packet(3, 1)
        eventually(lambda n=n: sent(service) >= n)
        eventually(lambda: bool(service._runner._offered), what="the next packet")
    eventually(lambda: len(vessel.frames) == service.health().counters["frames_sent"])
    assert len({f.data for f in vessel.frames}) == len(vessel.frames)
    assert sent(service) == 3


@pytest.mark.parametrize("spoilt", [msgpack.packb({"format": 99}), b"\xc1 no msgpack"])
def test_of_a_state_that_cannot_be_read_pictures_and_messages_are_queued_anew(
    spoilt, begin, programs, runner, vessel, refused
):
    service = begin(group_delay_s=3600.0)  # the pictures wait
    programs.send(IN, "uuv_modem", *[image(n) for n in range(1, 4)])
    programs.send(OUT, "uuv_modem", message("kept", priority=6))
    eventually(lambda: len(service._line.queue.sender.kept) == 3 and not service._line.accepted())
    eventually(lambda: programs.store.outbox_depth() == 0)
    runner.stop(service)
    store = Store(service.platform.state_dir / "uuv_modem.db")
    with store.transaction() as tx:
        tx.put_state("v1/queue/sender", spoilt)
        tx.put_state("v1/orders", b"\x01")
        tx.put_state("v1/queue/image/2", msgpack.packb({"number": 2}))
    store.close()
    again = begin()
    eventually(lambda: again.health().counters.get("states_discarded") == 1)
    assert {n: image.contact_id for n, image in again._line.queue.sender.kept.items()} == {1: "c1", 3: "c3"}
    # The second had been announced, no more.
    eventually(lambda: min(len(vessel.streams().get(n, b"")) for n in (1, 3)) > 100, 60)
    assert len(vessel.streams().get(2, b"")) < 60
    apart = {key for key, _ in refused(again)}
    assert {"state v1/queue/sender", "state v1/orders", "state v1/queue/image/2"} <= apart
    programs.send(IN, "uuv_modem", image(4))
    eventually(lambda: 4 in vessel.streams(), 60)


@pytest.mark.parametrize(
    ("change", "said"),
    [({"stream": b"\x10\x00"}, "stream"), ({"height_px": 700}, "height_px"), ({"stream": b"\xee" * 20}, "stream")],
)
def test_a_picture_that_can_never_be_sent_is_refused_to_its_sender(change, said, begin, programs, refused):
    service = begin()
    programs.send_bytes(IN, "uuv_modem", msgpack.packb(msgpack.unpackb(wire.encode(image(1))) | change))
    eventually(lambda: len(refused(programs)) == 1)
    assert said in refused(programs)[0][1]
    assert refused(service) == refused(programs)


@pytest.mark.parametrize(
    "slot", [{"tdma_cycle_s": 10.0, "slot_s": 20.0}, {"slot_s": 6.0}, {"slot_s": 20.0, "slot_start_s": 50.0}]
)
def test_a_slot_that_no_packet_fits_is_refused_at_once(slot):
    with pytest.raises(ValueError, match="slot"):
        UuvModemConfig(port="x", mac="tdma", **slot)
