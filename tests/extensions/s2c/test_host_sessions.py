"""Sessions of public drivers with the emulated S2C modem.

The sessions were read from the sources of the drivers; the tests replay them without the programs.
docs/reference/modem-s2c.md names those that were run.
"""

import re

import pytest
from builders.host_sessions import Hosts, Step, replay

OK = rb"OK\r\n"
RECVIM = rb"RECVIM,%d,%d,%d,%b,\d+,-?\d+,\d+,0\.0000,%b\r\n"
RECV = rb"RECV,%d,%d,%d,\d+,-?\d+,\d+,100000,0\.0000,%b\r\n"
BURST = bytes(range(256)) * 3


def lines(modem: int, commands: str, end: bytes = b"\n") -> list[Step]:
    """Return the steps of settings in data mode: each is answered with OK, under its name."""
    return [
        Step(modem, b"+++AT" + command.encode() + end, re.escape(b"+++AT%b:2:OK\r\n" % name(command)))
        for command in commands.split()
    ]


def name(command: str) -> bytes:
    return (command if command.startswith("Z") else command.rstrip("0123456789")).encode()


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

SESSIONS = {
    "desert": DESERT,
    "gso": GSO,
    "gso serial": GSO_SERIAL,
    "lcm": LCM,
    "dccomms": DCCOMMS,
    "oceansystemslab": OCEANS,
}


@pytest.mark.parametrize("session", SESSIONS)
def test_session_of_a_public_driver_is_answered(session: str) -> None:
    replay(Hosts("s2c"), SESSIONS[session])


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
