"""Whatever a modem or a line does, the driver raises nothing, keeps its memory and works again afterwards."""

from builders.fake_modem import FakeModem
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.modem.micromodem import MicroModem, MicroModemConfig, PacketFailed, PacketSent, nmea

KINDS = ["CAREV", "CACFG", "CACLK", "CACYC", "CADRQ", "CATXD", "CATXP", "CATXF", "CAXST", "CARXP", "CARXD", "CAMSG",
         "CACST", "CAACK", "CAERR", "CAMPR"]  # fmt: skip
values = st.sampled_from(["", "0", "1", "2", "3", "-1", "127", "256", "AB", "INIT", "SRC", "BAD_CRC", "DATA_TIMEOUT"])
lines = st.builds(lambda kind, fields: nmea.format(kind, *fields), st.sampled_from(KINDS), st.lists(values, max_size=9))
inputs = st.binary(max_size=80) | lines
CONFIG = MicroModemConfig(address=3)


@given(st.lists(st.tuples(inputs, st.floats(0.0, 30.0)), max_size=40), st.booleans())
def test_survives_and_sends_the_next_packet(script: list[tuple[bytes, float]], sending: bool) -> None:
    modem = FakeModem(MicroModem(CONFIG))
    modem.driver.start(0.0)
    ids = []
    for data, pause_s in script:
        if sending:
            ids.append(modem.driver.send_packet(1, 4, [b"x", b"y"], ack=len(ids) % 2 == 1, now=modem.now))
        modem.raw(data)
        modem.run(modem.now + pause_s)
        assert modem.driver.queued <= CONFIG.queued_packets + 1
    modem.raw(b"\r\n")
    modem.run(modem.now + 400.0)
    assert sorted(event.packet_id for event in modem.of(PacketSent, PacketFailed)) == ids
    assert modem.driver.ready
    last = modem.driver.send_packet(1, 4, [b"last"], now=modem.now)
    modem.run(modem.now + 60.0)
    sent = [event for event in modem.of(PacketSent) if event.packet_id == last]
    assert [event.frames for event in sent] == [(b"last",)]
