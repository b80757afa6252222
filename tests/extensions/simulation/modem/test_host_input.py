"""Any bytes of a host: after a pause every emulated modem answers."""

from collections.abc import Sequence

import pytest
from builders.extensions import modules
from builders.host_sessions import HostInput, Hosts, hears
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.extensions.simulation.modem.emulated import emulated_drivers
from sonarpost.modem.micromodem import nmea
from sonarpost.modem.udp.datagram import Datagram, DatagramKind

DATAGRAM = Datagram(DatagramKind.DATA, 1, 2, 0, 7, (b"status",)).pack()
INCOMPLETE_DATAGRAM = Datagram(DatagramKind.DATA, 1, 2, 0, 3, (bytes(2000),)).pack()[:40]
INPUT = {
    "micromodem": HostInput(
        commands=[
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
        incomplete=nmea.format("CCMSC", 1, 1, 0).rstrip(),
        question=nmea.format("CCCFQ", "DTO"),
        is_answered=hears(rb"\$CACFG,DTO,\d+\*"),
    ),
    "udp": HostInput(
        commands=[
            Datagram(DatagramKind.DATA_WITH_ACK, 1, 2, 1, 3, (b"a" * 200,) * 3).pack(),
            Datagram(DatagramKind.ACK, 1, 2, 0, 3, (b"",)).pack(),
            INCOMPLETE_DATAGRAM,
            b"SPM1\x0f\xff",
        ],
        incomplete=INCOMPLETE_DATAGRAM,
        question=DATAGRAM,
        is_answered=lambda hosts: DATAGRAM in hosts.hear(2, 10.0),
    ),
} | {driver: found for module in modules("modem_subjects") for driver, found in module.INPUT.items()}


@pytest.mark.parametrize("driver", emulated_drivers())
@given(data=st.data())
def test_no_bytes_of_a_host_make_a_modem_silent(driver: str, data: st.DataObject) -> None:
    command = st.sampled_from(INPUT[driver].commands)
    part = st.one_of(command, command, st.binary(max_size=20), st.tuples(command, st.integers(1, 20)).map(cut))
    parts = data.draw(st.lists(st.tuples(part, st.sampled_from((0.0, 0.0, 0.1, 3.0))), max_size=12))
    assert_answered_after(driver, parts)


@pytest.mark.parametrize("driver", emulated_drivers())
def test_incomplete_input_is_given_up_after_a_pause(driver: str) -> None:
    assert_answered_after(driver, [(INPUT[driver].incomplete, 0.0)])


def assert_answered_after(driver: str, parts: Sequence[tuple[bytes, float]]) -> None:
    hosts = Hosts(driver)
    for sent, pause_s in parts:
        hosts.say(1, sent)
        hosts.hear(1, pause_s)
    hosts.hear(1, 30.0)
    hosts.say(1, INPUT[driver].question)
    assert INPUT[driver].is_answered(hosts)


def cut(arguments: tuple[bytes, int]) -> bytes:
    command, count = arguments
    return command[:-count]
