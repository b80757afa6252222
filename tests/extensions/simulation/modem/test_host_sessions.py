"""Sessions of hosts with the emulated modems: what public drivers send, and any other bytes.

The sessions were read from the sources of the drivers; the tests replay them without the programs. The pages of the
modems in docs/reference name the programs that were run.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.extensions.simulation.channel.acoustics import LocalPosition
from sonarpost.extensions.simulation.channel.parameters import build_parameters
from sonarpost.extensions.simulation.channel.simulator import ChannelSimulator, PlacedModem
from sonarpost.extensions.simulation.modem.emulated import EMULATED, settings_for
from sonarpost.modem.micromodem import nmea
from sonarpost.modem.udp.datagram import Datagram, DatagramKind


class Hosts:
    """Hosts of two emulated modems, 1 and 2, at 150 m: the travel takes 0.1 s."""

    def __init__(self, driver: str) -> None:
        modems = {
            number: PlacedModem(settings_for(driver, address=number), LocalPosition(150.0 * number))
            for number in (1, 2)
        }
        self.simulator = ChannelSimulator(build_parameters({}, "test"), modems)

    def say(self, number: int, data: bytes) -> None:
        self.simulator.receive(number, data, self.simulator.now)

    def hear(self, number: int, wait_s: float = 0.0) -> bytes:
        """Return what a host has received since the last call, after some simulated time."""
        self.simulator.advance(self.simulator.now + wait_s)
        outputs = self.simulator.take_outputs(number)
        assert all(output.data for output in outputs), "an output without bytes"
        return b"".join(output.data for output in outputs)


@dataclass(frozen=True)
class Step:
    """A host sends bytes; both hosts then receive what the patterns describe.

    Attributes:
        modem: Number of the modem.
        sent: Bytes of its host.
        answer: Pattern of what the modem answers within `wait_s`.
        arrives: Pattern of what the other modem's host receives.
    """

    modem: int
    sent: bytes
    answer: bytes
    arrives: bytes = b""
    wait_s: float = 15.0


def replay(hosts: Hosts, steps: Sequence[Step]) -> None:
    for step in steps:
        hosts.say(step.modem, step.sent)
        answer, arrives = hosts.hear(step.modem, step.wait_s), hosts.hear(3 - step.modem)
        assert re.fullmatch(step.answer, answer, re.DOTALL), (step, answer)
        assert re.fullmatch(step.arrives, arrives, re.DOTALL), (step, arrives)


def lines(modem: int, commands: str, end: bytes = b"\n") -> list[Step]:
    """Return the steps of settings in data mode: each is answered with OK, under its name."""
    return [
        Step(modem, b"+++AT" + command.encode() + end, re.escape(b"+++AT%b:2:OK\r\n" % name(command)))
        for command in commands.split()
    ]


def name(command: str) -> bytes:
    return (command if command.startswith("Z") else command.rstrip("0123456789")).encode()


OK = rb"OK\r\n"
RECVIM = rb"RECVIM,%d,%d,%d,%b,\d+,-?\d+,\d+,0\.0000,%b\r\n"
RECV = rb"RECV,%d,%d,%d,\d+,-?\d+,\d+,100000,0\.0000,%b\r\n"
BURST = bytes(range(256)) * 3

# DESERT Underwater, signetlabdei/evologics-drivers: MdriverS2C_EvoLogics and MinterpreterAT over TCP. The modem's port
# is in command mode, without extended notifications. First the start with a reset of the queue, keep-online mode and
# an address; then instant messages, the travel time and burst data in both directions.
DESERT = [
    *(Step(number, b"+++ATC\n", rb"\+\+\+ATC:2:OK\r\n") for number in (1, 2)),
    *(Step(1, command, OK) for command in (b"ATZ4\n", b"AT!KO0\n", b"AT!AL1\n")),
    *(Step(2, command, OK) for command in (b"ATZ4\n", b"AT!KO0\n", b"AT!AL2\n")),
    Step(1, b"AT*SENDIM,5,2,noack,hello\n", OK, RECVIM % (5, 1, 2, b"noack", b"hello")),
    Step(1, b"AT*SENDIM,5,2,ack,hello\n", OK + rb"DELIVEREDIM,2\r\n", RECVIM % (5, 1, 2, b"ack", b"hello")),
    Step(1, b"AT?T\n", rb"100000\r\n"),
    Step(1, b"AT*SENDIM,5,9,ack,hello\n", OK + rb"FAILEDIM,9\r\n"),
    Step(1, b"AT*SEND,768,2," + BURST + b"\n", OK + rb"DELIVERED,1,2\r\n", RECV % (768, 1, 2, re.escape(BURST))),
    Step(2, b"AT*SEND,3,1,abc\n", OK + rb"DELIVERED,1,1\r\n", RECV % (3, 2, 1, b"abc")),
    Step(1, b"AT*SEND,3,9,abc\n", OK + rb"FAILED,2,9\r\n", wait_s=60.0),
    Step(1, b"AT*SENDPBM,5,2,hello\n", rb"ERROR WRONG FORMAT\r\n"),
    Step(1, b"AT*SENDIM,5,2,ack,again\n", OK + rb"DELIVEREDIM,2\r\n", RECVIM % (5, 1, 2, b"ack", b"again")),
]

# GSO-soslab evologics_driver and evologics_ros, a Goby driver in data mode: its start, and frames as raw data. The
# driver ends a frame and a command with the end of line of its port.
GSO_START = "Z4 !L0 !LC1 !G0 !C0 !AL{own} !AR{remote} !AM2 !ZC10 !ZP750 !RC3 !RT4000 !KO0 !ZI120 !ZS0 !CA1500"
FRAME = (b"temperature 12.5 +++\n" + bytes(range(14, 256)) * 2)[:500]
GSO = [
    *lines(1, GSO_START.format(own=1, remote=2)),
    *lines(2, GSO_START.format(own=2, remote=1)),
    Step(1, b"hello\n\n", b"", rb"hello\n\n"),
    Step(2, FRAME + b"\n", b"", re.escape(FRAME + b"\n")),
    Step(1, FRAME * 5 + b"\n", b"", re.escape(FRAME * 5 + b"\n"), wait_s=60.0),
]
GSO_SERIAL = [
    *lines(1, GSO_START.format(own=1, remote=2), b"\r\n"),
    *lines(2, GSO_START.format(own=2, remote=1), b"\r\n"),
    Step(1, b"hello\n\r\n", b"", rb"hello\n\r\n"),
]

# A public driver for LCM in data mode: it selects the destination before raw data, which has no end of line.
LCM = [
    *lines(1, "Z1"),
    Step(1, b"+++AT*SENDIM,5,2,ack,00002\n", rb".*:DELIVEREDIM,2\r\n", rb"\+\+\+AT:\d+:RECVIM,5,1,2,ack,.*00002\r\n"),
    Step(1, b"+++AT?T\n", rb"\+\+\+AT\?T:6:100000\r\n"),
    *lines(1, "Z4 !AR2"),
    Step(1, b"+++AT?AR\n", rb"\+\+\+AT\?AR:1:2\r\n"),
    Step(1, b"LCM\x04name\x00\x01data\xff\xfeLE", b"", rb"LCM\x04name\x00\x01data\xff\xfeLE"),
    Step(1, b"+++AT?S\n", rb"\+\+\+AT\?S:17:INITIATION LISTEN\r\n"),
]

# dccomms_utils, EvologicsBridge: settings are read back.
DCCOMMS = [
    *lines(1, "Z4 !RP0 @ZU0 @ZX0 !ZC30 !AL1 !AR2 !KO0 !RI0 !DW0 @ZL8096"),
    *(
        Step(1, b"+++AT?%b\n" % query, rb"\+\+\+AT\?%b:\d+:%b\r\n" % (query, value))
        for query, value in ((b"RP", b"0"), (b"ZU", b"0"), (b"ZX", b"0"), (b"ZC", b"30"), (b"AL", b"1"), (b"AR", b"2"))
    ),
]

# oceansystemslab evologics_driver, evologics_driver.py, over TCP in command mode.
OCEANS = [
    Step(1, b"+++ATC\n", rb"\+\+\+ATC:2:OK\r\n"),
    *(Step(1, command, OK) for command in (b"AT!L3\n", b"AT@ZU1\n", b"AT@ZX1\n")),
    Step(1, b"AT?BV\n", rb"\d+\.\d+\r\n"),
]

STATUS = (b"$?", rb"#A001V\d{5}\r\n")
# nm3driver.py of the modem's developer: it waits 0.5 s for an answer. The last commands are not in the emulated modem.
NM3 = [
    Step(1, *STATUS, wait_s=0.5),
    Step(1, b"$A001", rb"#A001\r\n", wait_s=0.5),
    Step(1, b"$P002", rb"\$P002\r\n#R002T03200\r\n"),
    Step(1, b"$P009", rb"\$P009\r\n#TO\r\n"),
    Step(1, b"$B05hello", rb"\$B05\r\n", rb"#B00105hello\r\n"),
    Step(1, b"$U00205hello", rb"\$U00205\r\n", rb"#U05hello\r\n"),
    Step(1, b"$M00264" + BURST[:64], rb"\$M00264\r\n#R002T03200\r\n", rb"#U64" + re.escape(BURST[:64]) + rb"\r\n"),
    Step(1, b"$B02abT00000000012345", rb"\$B02\r\n", rb"#B00102ab\r\n"),
    *(
        step
        for command in (b"$N", b"$S", b"$XTG", b"$XTE", b"$XTD", b"$XTC", b"$CM002", b"$CC002", b"$R")
        for step in (Step(1, command, rb"E\r\n", wait_s=0.5), Step(1, *STATUS, wait_s=0.5))
    ),
    *(Step(1, command + b"$?", rb"E\r\n" + STATUS[1], wait_s=0.0) for command in (b"$N", b"$XTG", b"$R")),
]

SESSIONS = {
    "desert": ("s2c", DESERT),
    "gso": ("s2c", GSO),
    "gso serial": ("s2c", GSO_SERIAL),
    "lcm": ("s2c", LCM),
    "dccomms": ("s2c", DCCOMMS),
    "oceansystemslab": ("s2c", OCEANS),
    "nm3driver": ("nano", NM3),
}


@pytest.mark.parametrize("session", SESSIONS)
def test_session_of_a_public_driver_is_answered(session: str) -> None:
    driver, steps = SESSIONS[session]
    replay(Hosts(driver), steps)


def test_raw_data_arrives_in_any_parts_and_as_a_notification_in_command_mode() -> None:
    hosts = Hosts("s2c")
    for part in (b"a+", b"+", b"+b\r", b"+++A", b"C", b"+++"):
        hosts.say(1, part)
        hosts.hear(1, 0.1)
    assert hosts.hear(2, 15.0) == b"a+++b\r+++AC+++"
    replay(hosts, [Step(2, b"+++ATC\n", rb"\+\+\+ATC:2:OK\r\n"), Step(1, b"raw", b"", RECV % (3, 1, 2, b"raw"))])


def test_raw_data_has_no_report_but_dropped_bytes_are_counted() -> None:
    hosts = Hosts("s2c")
    replay(
        hosts,
        [
            *lines(1, "!AR9"),
            Step(1, b"lost", rb"\+\+\+AT:9:DROPCNT,4\r\n", wait_s=60.0),
            Step(1, bytes(65537), rb"\+\+\+AT:9:DROPCNT,5\r\n", wait_s=1.0),
            Step(1, b"+++AT?ZD\n", rb"\+\+\+AT\?ZD:1:5\r\n", wait_s=0.0),
            *lines(1, "Z4"),
            Step(1, b"+++AT!AR255\n", rb"\+\+\+AT!AR:18:ERROR OUT OF RANGE\r\n"),
            *lines(1, "!AR2"),
            Step(1, b"found", b"", b"found"),
        ],
    )


@pytest.mark.parametrize(("command", "delivered"), [("Z1", b"IM,2"), ("Z3", b",1,2"), ("Z4", None)])
def test_dropped_messages_have_no_report(command: str, delivered: bytes | None) -> None:
    hosts = Hosts("s2c")
    hosts.say(1, b"+++AT*SEND,1,2,b\n+++AT*SENDIM,1,2,ack,m\n+++AT" + command.encode() + b"\n")
    answers = rb"\+\+\+AT\*SEND:2:OK\r\n\+\+\+AT\*SENDIM:2:OK\r\n\+\+\+AT%b:2:OK\r\n" % command.encode()
    report = b"" if delivered is None else rb"\+\+\+AT:\d+:DELIVERED%b\r\n" % delivered
    assert re.fullmatch(answers + report, hosts.hear(1, 60.0))


def status(driver: str) -> tuple[bytes, Callable[[Hosts], bool]]:
    """Return a command, and a function that tells whether it was answered."""
    if driver == "udp":
        datagram = Datagram(DatagramKind.DATA, 1, 2, 0, 7, (b"status",)).pack()
        return datagram, lambda hosts: datagram in hosts.hear(2, 10.0)
    command, answer = {
        "micromodem": (nmea.format("CCCFQ", "DTO"), rb"\$CACFG,DTO,\d+\*"),
        "s2c": (b"+++AT?S\n", rb"INITIATION LISTEN\r\n\Z"),
        "nano": (b"$?", rb"#A\d{3}V\d{5}\r\n\Z"),
    }[driver]
    return command, lambda hosts: re.search(answer, hosts.hear(1)) is not None


COMMANDS = {
    "micromodem": [
        nmea.format(kind, *fields)
        for kind, *fields in (
            ("CCMSC", 1, 1, 0),
            ("CCCYC", 0, 1, 2, 1, 1, 3),
            ("CCCYC", 0, 2, 1, 0, 0, 1),
            ("CCTXD", 1, 2, 1, "00FF"),
            ("CCMPC", 1, 2),
            ("CCTDP", 2, 1, 0, 0, "00FF"),
            ("CCCFG", "REV", 0),
            ("CCCFG", "DTO", 99999),
            ("CCCFG", "SRC", 5),
            ("CCPDT", 1, 1, 0, 0, 60000, 1, 1, 1, 1),
        )
    ],
    "s2c": [
        *(b"+++ATC\n", b"ATO\n", b"+++ATZ0\n", b"ATZ4\n", b"+++AT*SEND,1000,2,a", b"AT*SENDIM,64,2,ack,", b"AT"),
        *(b"AT*SEND,1,9,a\n", b"+++AT*SENDIM,1,2,ack,a\r\n", b"+++AT@ZX1\n", b"AT!AL7\n", b"+++AT!AR1\n", b"+++"),
    ],
    "nano": [b"$N", b"$XTG", b"$R", b"$A0", b"$A005", b"$P002", b"$B64", b"$M00205hello", b"$U0026", b"$"],
    "udp": [
        Datagram(DatagramKind.DATA_WITH_ACK, 1, 2, 1, 3, (b"a" * 200,) * 3).pack(),
        Datagram(DatagramKind.ACK, 1, 2, 0, 3, (b"",)).pack(),
        Datagram(DatagramKind.DATA, 1, 2, 0, 3, (bytes(2000),)).pack()[:40],
        b"SPM1\x0f\xff",
    ],
}


@pytest.mark.parametrize("driver", EMULATED)
@given(data=st.data())
def test_no_bytes_of_a_host_make_a_modem_silent(driver: str, data: st.DataObject) -> None:
    command = st.sampled_from(COMMANDS[driver])
    part = st.one_of(command, command, st.binary(max_size=20), st.tuples(command, st.integers(1, 20)).map(cut))
    parts = data.draw(st.lists(st.tuples(part, st.sampled_from((0.0, 0.0, 0.1, 3.0))), max_size=12))
    assert_answered_after(driver, parts)


INCOMPLETE = {
    "micromodem": nmea.format("CCMSC", 1, 1, 0).rstrip(),
    "s2c": b"+++AT*SEND,1000,2,a",
    "nano": b"$B64a",
    "udp": COMMANDS["udp"][2],
}


@pytest.mark.parametrize("driver", EMULATED)
def test_incomplete_input_is_given_up_after_a_pause(driver: str) -> None:
    assert_answered_after(driver, [(INCOMPLETE[driver], 0.0)])


def assert_answered_after(driver: str, parts: Sequence[tuple[bytes, float]]) -> None:
    hosts = Hosts(driver)
    for sent, pause_s in parts:
        hosts.say(1, sent)
        hosts.hear(1, pause_s)
    hosts.hear(1, 30.0)
    question, is_answered = status(driver)
    hosts.say(1, question)
    assert is_answered(hosts)


def cut(arguments: tuple[bytes, int]) -> bytes:
    command, count = arguments
    return command[:-count]
