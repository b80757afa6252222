"""Requests of the driver: pings and polls, and short packets of other modems."""

import pytest

from sonarpost.errors import FrameError
from sonarpost.modem.interface import (
    FrameReceived,
    PacketFailed,
    PacketReceived,
    PacketSent,
    PollReceived,
    RangeMeasured,
    RequestDone,
    RequestFailed,
    SentenceRejected,
    ShortMessageReceived,
    TransmissionEnded,
    TransmissionStarted,
)
from sonarpost.modem.micromodem import (
    RATES,
    FailureReason,
    MicroModem,
    MicroModemConfig,
    nmea,
)


def sentence(text: str) -> nmea.Sentence:
    kind, *fields = text.split(",")
    return nmea.Sentence(kind, tuple(fields))


def ready() -> MicroModem:
    driver = MicroModem(MicroModemConfig(1, settings=()))
    driver.port_opened(0.0)
    for name in ("SRC", "CST") * 2:
        driver.receive(nmea.format("CACFG", name, 1), 0.0)
    assert driver.ready
    driver.bytes_to_send()
    return driver


def receive(driver: MicroModem, *texts: str, now: float = 1.0) -> list[object]:
    return [event for text in texts for event in driver.receive(sentence(text).encode(), now)]


def test_unsolicited_short_packets_are_reported() -> None:
    driver = ready()
    events = receive(driver, "CAMPA,2,1", "CAMUA,2,1,1ABC", "CAMPR,2,1,0.1000", "CAMUR,2,1")
    assert events == [ShortMessageReceived(2, 1, 0x1ABC), RangeMeasured(2, 1, 0.1)]
    (rejected,) = receive(driver, "CAMUA,2,1,FFFF")
    assert isinstance(rejected, SentenceRejected)


def test_bytes_and_events_of_each_request() -> None:
    driver = ready()
    on_air = [TransmissionStarted(RATES[0].airtime_s), TransmissionEnded(RATES[0].airtime_s)]
    driver.ping(2, 1.0)
    assert driver.bytes_to_send() == b"$CCMPC,1,2*5D\r\n"
    assert receive(driver, "CAMPC,1,2", "CATXP,0", "CATXF,0", "CARXP,0") == on_air
    assert receive(driver, "CAMPR,2,1,0.0667") == [RangeMeasured(2, 1, 0.0667), RequestDone(1, "ping", 2)]
    assert receive(driver, "CACST,6,0,20250606230123.348554") == []
    driver.request_packet(2, 4, now=4.0)
    assert driver.bytes_to_send().startswith(b"$CCCYC,0,2,1,4,0,2*")
    assert receive(driver, "CACYC,0,2,1,4,0,2", "CATXP,0", "CATXF,0") == on_air
    events = receive(driver, "CARXP,1", "CACYC,0,2,1,4,0,2", "CARXD,2,1,0,1,AA", "CACST,6,0,,,,,,,,,,,,4,2,1,0,3,1,0")
    assert [type(e) for e in events[1:]] == [FrameReceived, PacketReceived, RequestDone]


def test_request_fails_without_an_answer() -> None:
    driver = ready()
    driver.ping(2, 1.0)
    receive(driver, "CAMPC,1,2", "CATXF,0")
    assert driver.poll(20.9) == []
    assert driver.poll(21.1) == [RequestFailed(1, "ping", 2, FailureReason.NO_ANSWER)]
    driver.request_packet(2, 1, now=30.0)
    receive(driver, "CACYC,0,2,1,1,0,3", "CATXF,0", now=31.0)
    events = receive(driver, "CAMSG,PACKET_TIMEOUT,1", now=45.0)
    assert events[-1] == RequestFailed(2, "poll", 2, FailureReason.NO_ANSWER)


def test_unknown_command_fails_after_its_tries() -> None:
    driver = ready()
    driver.ping(2, 1.0)
    events: list[object] = []
    for second in range(1, 4):
        assert driver.bytes_to_send().startswith(b"$CCMPC")
        events += receive(driver, "CAERR,120000,NMEA,2,unknown CCMPC", now=float(second))
        assert driver.bytes_to_send() == b"", "the command is sent again after a pause"
        events += driver.poll(second + 1.0)
    assert RequestFailed(1, "ping", 2, FailureReason.REFUSED) in events
    assert driver.queued == 0


def test_reboot_or_lost_port_ends_a_request() -> None:
    driver = ready()
    driver.ping(2, 1.0)
    assert RequestFailed(1, "ping", 2, FailureReason.REBOOTED) in receive(driver, "CAREV,120000,INIT,2.0.27087")
    driver = ready()
    driver.ping(2, 1.0)
    driver.port_lost(2.0)
    assert driver.poll(2.0) == [RequestFailed(1, "ping", 2, FailureReason.PORT_LOST)]


@pytest.mark.parametrize(
    ("command", "field"),
    [
        (lambda d: d.ping(128, 0.0), "address"),
        (lambda d: d.request_packet(2, 9, now=0.0), "rate"),
        (lambda d: d.request_packet(2, 1, 4, now=0.0), "frames"),
        (lambda d: d.request_packet(-1, 1, now=0.0), "address"),
    ],
)
def test_invalid_request_is_rejected(command, field: str) -> None:  # type: ignore[no-untyped-def]
    driver = ready()
    with pytest.raises(FrameError) as caught:
        command(driver)
    assert caught.value.field == field
    assert driver.bytes_to_send() == b""


def test_poll_is_answered_with_the_frames_of_the_handler() -> None:
    driver = ready()
    polls: list[PollReceived] = []

    def handler(polled: PollReceived) -> list[bytes]:
        polls.append(polled)
        return [b"one"]

    driver.set_poll_handler(handler)
    events = receive(driver, "CARXP,0", "CACYC,0,1,2,1,1,3", "CADRQ,120000,1,2,1,64,1")
    assert polls == [PollReceived(2, 1, 3, 64, True)] == [e for e in events if isinstance(e, PollReceived)]
    assert driver.bytes_to_send() == nmea.format("CCTXD", 1, 2, 1, "6F6E65")
    receive(driver, "CATXD,1,2,1,3", "CADRQ,120000,1,2,1,64,2")
    assert driver.bytes_to_send() == nmea.format("CCTXD", 1, 2, 1, ""), "there is no second frame"
    events = receive(driver, "CATXD,1,2,1,0", "CATXP,3", "CATXF,3", "CAXST,6,20250606,230117.336548", "CAACK,2,1,1,1")
    (sent,) = [e for e in events if isinstance(e, PacketSent)]
    assert (sent.dest, sent.frames, sent.acknowledged) == (2, (b"one",), (1,))


def test_poll_without_frames_gets_an_empty_answer() -> None:
    driver = ready()
    driver.set_poll_handler(lambda polled: [])
    receive(driver, "CACYC,0,1,2,1,0,3", "CADRQ,120000,1,2,0,64,1")
    assert driver.bytes_to_send() == nmea.format("CCTXD", 1, 2, 0, "")
    driver.set_poll_handler(lambda polled: [b"x" * 65])
    with pytest.raises(FrameError):
        receive(driver, "CACYC,0,1,2,1,0,3")


def test_polled_packet_that_is_not_requested_fails() -> None:
    driver = ready()
    driver.set_poll_handler(lambda polled: [b"one"])
    receive(driver, "CACYC,0,1,2,1,0,1")
    (failed,) = [e for e in driver.poll(100.0) if isinstance(e, PacketFailed)]
    assert failed.reason is FailureReason.NO_DATA_REQUEST


def test_text_frame_is_received() -> None:
    events = receive(ready(), "CARXP,1", "CACYC,0,2,1,1,0,1", "CARXA,2,1,0,1,hello, sea", "CACST,6,0")
    assert [e.data for e in events if isinstance(e, FrameReceived)] == [b"hello, sea"]
