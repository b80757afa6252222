"""Serial line of the emulated modem: errors, arbitrary input, timing."""

import pytest
from builders.emulator_bench import START_UTC_S, EmulatorBench
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.extensions.simulation.channel.events import TransmittedPacket
from sonarpost.extensions.simulation.channel.simulator import SerialLine
from sonarpost.extensions.simulation.modem.emulator import EmulatedMicroModem
from sonarpost.extensions.simulation.modem.settings import EmulatedModemConfig
from sonarpost.modem.micromodem import nmea


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        (b"$CCCFQ,SRC*00\r\n", "NMEA,1,bad checksum"),
        (b"hello\r\n", "NMEA,1,bad sentence"),
        (b"$CCXYZ,1*00\r\n", "NMEA,1,bad checksum"),
        (b"$CCXYZ,1\r\n", "NMEA,2,unknown CCXYZ"),
        (b"$CCCYC,0,1,2,9,0,1\r\n", "NMEA,3,CCCYC bad rate"),
        (b"$CCCYC,0,1,2,1,0,4\r\n", "NMEA,3,CCCYC bad frames"),
        (b"$CCCYC,0,1,2,1,0,0\r\n", "NMEA,3,CCCYC bad frames"),
        (b"$CCMPC,5,2\r\n", "NMEA,3,CCMPC bad source"),
        (b"$CCCYC,0,1,128,1,0,1\r\n", "NMEA,3,CCCYC bad destination"),
        (b"$CCCYC\r\n", "NMEA,3,CCCYC bad rate"),
        (b"$CCCFG,SRC,128\r\n", "NMEA,3,CCCFG bad SRC"),
        (b"$CCCFG,SRC,x\r\n", "NMEA,3,CCCFG bad value"),
        (b"$CCCFG,,1\r\n", "NMEA,3,CCCFG bad name"),
        (b"$CCCFG,ALL,1\r\n", "NMEA,3,CCCFG bad ALL"),
        (b"$CCMSC,1,1,5\r\n", "NMEA,3,CCMSC bad minutes"),
        (b"$CCMUC,1,2,2000\r\n", "NMEA,3,CCMUC bad bits"),
        (b"$CCTXD,1,2,0,ABC\r\n", "NMEA,3,CCTXD bad data"),
    ],
)
def test_invalid_sentence_is_answered_with_an_error(line: bytes, answer: str):
    modem = EmulatedMicroModem(EmulatedModemConfig(1, utc_at_zero_s=START_UTC_S))
    modem.bytes_to_send()
    modem.receive(line, 2.0)
    assert modem.bytes_to_send() == nmea.format("CAERR", "090002", *answer.split(","))
    assert modem.packets_to_transmit() == []


KINDS = ["CCCFG", "CCCFQ", "CCMSC", "CCCLK", "CCCLQ", "CCTMS", "CCTMQ", "CCCYC",
         "CCTXD", "CCTXA", "CCMPC", "CCMUC", "CCTDP", "CCPDT", "CCPNT", "CCALQ"]  # fmt: skip

SENTENCES = st.tuples(
    st.sampled_from(KINDS),
    st.lists(
        st.one_of(st.integers(-2, 130).map(str), st.sampled_from(["", "SRC", "ALL", "DTO", "AABB", "1e5", "٣"[:0]])),
        max_size=8,
    ),
).map(lambda s: nmea.format(s[0], *s[1]))


@given(st.lists(st.tuples(st.sampled_from([1, 2]), st.one_of(st.binary(max_size=80), SENTENCES), st.floats(0, 5))))
def test_modem_answers_after_any_input(steps: list[tuple[int, bytes, float]]):
    bench = EmulatorBench(frame_loss=0.2, tail_damage=0.2)
    for modem, data, pause_s in steps:
        bench.simulator.receive(modem, data, bench.now)
        bench.advance(bench.now + pause_s)
    bench.advance(bench.now + 400.0)
    for modem in (1, 2):
        assembler = nmea.LineAssembler()
        items = assembler.feed(bench.output[modem])
        assert all(isinstance(item, nmea.Sentence) for item in items)
        assert assembler.pending_bytes == 0
    # The modem answers a query: a reboot, if any, has ended.
    bench.clear_output()
    bench.simulator.receive(1, b"\r\n" + nmea.format("CCCFQ", "SRC"), bench.now)
    bench.advance(bench.now)
    assert bench.sentences(1)[-1].startswith("CACFG,SRC,")


@given(st.integers(1, 7), st.integers(0, 2**32))
def test_result_is_independent_of_the_step_size(steps: int, seed: int):
    def run(advances: int) -> tuple[dict[int, bytes], list[TransmittedPacket]]:
        bench = EmulatorBench(frame_loss=0.3, seed=seed)
        bench.send(1, ("CCCYC", 0, 1, 2, 5, 1, 3), *(("CCTXD", 1, 2, 1, f"{n:02X}" * 20) for n in range(3)))
        for n in range(1, advances + 1):
            bench.advance(1.0 + 24.0 * n / advances)
        return bench.output, bench.transmissions

    assert run(steps) == run(1)


def test_serial_line_delays_by_its_baud_rate():
    bench = EmulatorBench(serial_baud=19200)
    query = nmea.format("CCCFQ", "SRC")
    bench.simulator.receive(1, query, 1.0)
    answer = b"$CACFG,SRC,1*33\r\n"
    arrives_s = 1.0 + (len(query) + len(answer)) * 10 / 19200
    bench.advance(arrives_s - 0.0001)
    assert bench.output[1] == b""
    bench.advance(arrives_s + 0.0001)
    assert bench.output[1] == answer


def test_serial_line_keeps_order_and_discards():
    line: SerialLine[str] = SerialLine(100)
    line.put("a", 10, 0.0)
    line.put("b", 10, 0.0)
    line.put("c", 10, 5.0)
    assert line.next_s() == 1.0
    assert line.take(1.99) == ["a"]
    assert line.take(5.5) == ["b"]
    assert line.discard() == ["c"]
    assert line.next_s() is None
