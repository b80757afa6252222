"""Burst data of the emulated S2C modem on the simulated channel, and the command sequences of other clients."""

import re

import pytest
from builders.host_sessions import Hosts

from sonarpost.extensions.s2c.emulated_burst import IDLE_LIMIT_S, MAX_BURSTS, TRANSMISSIONS
from sonarpost.extensions.simulation.channel.events import PacketKind, TransmittedPacket

ESCAPED = re.compile(rb"\+\+\+AT([^:]*):(\d+):")


class Water(Hosts):
    """Two emulated modems, and what they have transmitted."""

    def __init__(self, **parameters: float) -> None:
        super().__init__("s2c", **parameters)
        self.transmissions: list[TransmittedPacket] = []

    def say(self, number: int, command: bytes) -> None:
        """Send a command of data mode to a modem."""
        super().say(number, b"+++" + command + b"\n")

    def run(self, duration_s: float) -> None:
        """Let time pass."""
        happened = self.simulator.advance(self.simulator.now + duration_s)
        self.transmissions += [item for item in happened if isinstance(item, TransmittedPacket)]

    def messages(self, number: int) -> list[tuple[bytes, bytes]]:
        """Return the command and the text of each message that a modem has sent to its host since the last call."""
        data = b"".join(output.data for output in self.simulator.take_outputs(number))
        found = []
        while (header := ESCAPED.match(data)) is not None:
            end = header.end() + int(header[2])
            found.append((header[1], data[header.end() : end]))
            data = data[end + 2 :]
        assert data == b""
        return found

    def count(self, number: int, kind: PacketKind) -> int:
        """Return how many packets of a kind a modem has transmitted."""
        return sum(sent.transmitter == number and sent.packet.kind is kind for sent in self.transmissions)


def test_burst_data_is_delivered_in_a_connection_that_stays_open() -> None:
    water = Water()
    water.say(1, b"AT*SEND,6,2,ab\r\nc\n")
    water.say(1, b"AT*SEND,1,2,d")
    water.run(10.0)
    assert water.messages(1) == [(b"*SEND", b"OK"), (b"*SEND", b"OK"), (b"", b"DELIVERED,1,2"), (b"", b"DELIVERED,2,2")]
    assert water.messages(2) == [
        (b"", b"RECV,6,1,2,6500,-40,150,100000,0.0000,ab\r\nc\n"),
        (b"", b"RECV,1,1,2,6500,-40,150,100000,0.0000,d"),
    ]
    request, confirmation, data, ack, *_ = water.transmissions
    assert [sent.transmitter for sent in (request, confirmation, data, ack)] == [1, 2, 1, 2]
    assert (request.packet.kind, data.packet.kind) == (PacketKind.CYCLE, PacketKind.DATA)
    water.say(2, b"AT*SEND,1,1,e")
    water.run(10.0)
    assert water.count(1, PacketKind.CYCLE) + water.count(2, PacketKind.CYCLE) == 1, "the same connection"
    water.run(IDLE_LIMIT_S)
    water.say(1, b"AT*SEND,1,2,f")
    water.run(10.0)
    assert water.count(1, PacketKind.CYCLE) == 2, "a new connection after a pause"


def test_burst_data_to_an_absent_modem_fails() -> None:
    water = Water()
    water.say(1, b"AT*SEND,1,7,a")
    water.run(60.0)
    assert water.messages(1) == [(b"*SEND", b"OK"), (b"", b"FAILED,1,7")]
    assert water.count(1, PacketKind.CYCLE) == TRANSMISSIONS
    assert water.count(1, PacketKind.DATA) == 0


def test_lost_acknowledgement_leads_to_a_retransmission_and_not_to_a_second_reception() -> None:
    water = Water(frame_loss=0.4, seed=5)
    results: list[bytes] = []
    for number in range(60):
        water.say(1, b"AT*SEND,3,2,%03d" % number)
        water.run(100.0)
        results += [text for command, text in water.messages(1) if command == b""]
    received = [text.rpartition(b",")[2] for _, text in water.messages(2)]
    assert len(results) == 60
    delivered = [b"%03d" % number for number in range(60) if results[number].startswith(b"DELIVERED")]
    assert 30 < len(delivered) < 60, "some have failed"
    assert len(received) == len(set(received))
    assert set(delivered) <= set(received)
    assert set(received) - set(delivered), "the data of some has arrived, and none of the acknowledgements"
    assert water.count(1, PacketKind.DATA) > 60


def test_two_modems_that_send_at_the_same_time_both_deliver() -> None:
    water = Water()
    for number in (1, 2):
        water.say(number, b"AT*SEND,1,%d,a" % (3 - number))
    water.run(60.0)
    for number in (1, 2):
        texts = [text for _, text in water.messages(number)]
        assert b"DELIVERED,1,%d" % (3 - number) in texts
        assert sum(text.startswith(b"RECV,") for text in texts) == 1


def test_instant_message_is_accepted_between_packets_of_burst_data() -> None:
    water = Water()
    water.say(1, b"AT*SEND,1,7,a")
    water.run(3.0)
    water.say(1, b"AT*SENDIM,1,2,ack,b")
    water.run(3.0)
    assert water.messages(1) == [(b"*SEND", b"OK"), (b"*SENDIM", b"OK"), (b"", b"DELIVEREDIM,2")]


@pytest.mark.parametrize("command", [b"ATZ0", b"ATZ1"])
def test_dropped_burst_data_has_no_report(command: bytes) -> None:
    water = Water()
    water.say(1, b"AT*SEND,1,2,a\n+++" + command)
    water.run(0.1)
    water.say(1, b"AT*SEND,1,2,b")
    water.run(60.0)
    assert [text for _, text in water.messages(1) if text.startswith(b"DELIVERED")] == [
        b"DELIVERED,2,2" if command == b"ATZ1" else b"DELIVERED,1,2"
    ]
    assert [text[-1:] for _, text in water.messages(2)] == [b"b"]


def test_modem_stores_a_limited_number_of_bursts() -> None:
    water = Water()
    for _ in range(MAX_BURSTS + 1):
        water.say(1, b"AT*SEND,1,7,a")
    water.run(0.0)
    texts = [text for _, text in water.messages(1)]
    assert texts == [b"OK"] * MAX_BURSTS + [b"BUSY DELIVERING MESSAGE"]


# The commands that other public clients send, as their source code forms them, with the answers that they wait for.
# The sequences were read from the sources; docs/reference/modem-s2c.md says which of the programs were run.
CLIENTS = {
    # EvoLogics EviNS, src/fsm_nl_burst.erl and src/role_at.erl: the number of the last burst is read before and after.
    "evins burst": (
        b"+++AT?PC\n+++AT*SEND,p0,5,2,hello\n+++AT?PC\n+++AT?S\n",
        (
            rb"\+\+\+AT\?PC:1:0\r\n\+\+\+AT\*SEND:2:OK\r\n\+\+\+AT\?PC:1:1\r\n"
            rb"\+\+\+AT\?S:\d+:INITIATION LISTEN\r\n\+\+\+AT:13:DELIVERED,1,2\r\n"
        ),
    ),
    # LSTS DUNE, src/Transports/Evologics: burst data in command mode, one line as the answer.
    "dune burst": (b"+++ATC\nAT@CTRL\nAT*SEND,5,2,hello\n", rb"\+\+\+ATC:2:OK\r\nOK\r\nOK\r\nDELIVERED,1,2\r\n"),
    # oceansystemslab evologics_driver, src/evologics_driver.py, over a serial port.
    "oceansystemslab": (
        b"+++ATC\rAT!L3\rAT@ZU1\rAT*SENDIM,5,2,ack,hello\rAT*SEND,5,2,world\rAT?T\r",
        rb"\+\+\+ATC:2:OK\r\n(OK\r\n){4}\d+\r\n(DELIVEREDIM,2\r\n|DELIVERED,1,2\r\n){2}",
    ),
    # DESERT Underwater, mdriverS2C_EvoLogics and minterpreterAT: set the address, send a burst.
    "desert burst": (b"+++ATC\nAT!AL1\nAT*SEND,5,2,hello\n", rb"\+\+\+ATC:2:OK\r\n(OK\r\n){2}DELIVERED,1,2\r\n"),
}


@pytest.mark.parametrize("client", CLIENTS)
def test_commands_of_other_clients_are_answered(client: str) -> None:
    commands, answers = CLIENTS[client]
    water = Water()
    water.simulator.receive(1, commands, 0.0)
    water.run(60.0)
    output = b"".join(item.data for item in water.simulator.take_outputs(1))
    assert re.fullmatch(answers, output), output
    received = [text for _, text in water.messages(2)]
    assert all(text.startswith((b"RECV,5,1,2,", b"RECVIM,5,1,2,ack,")) for text in received)
    assert len(received) == commands.count(b"*SEND")
