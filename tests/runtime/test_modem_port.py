"""UDP multicast ports on the loopback interface, and two stations that use them."""

import queue

import pytest
from builders.common import WAIT_S, eventually, free_port

from sonarpost.errors import ConfigError, PortError
from sonarpost.runtime.modem_port import UdpPort, open_modem_port
from sonarpost.runtime.serial_modem import SerialModem
from sonarpost.runtime.serial_port import PortEvent, PortLost, PortOpened, SerialPort

URL = f"udp://239.255.77.1:{free_port()}?interface=127.0.0.1&ttl=0"


def test_each_write_is_one_datagram_for_all():
    events: list[queue.SimpleQueue[PortEvent]] = [queue.SimpleQueue(), queue.SimpleQueue()]
    ports = [UdpPort(URL), UdpPort(URL)]
    with pytest.raises(PortError, match="not open"):
        ports[0].write(b"x")
    for port, own in zip(ports, events, strict=True):
        port.start(own.put)
        assert isinstance(own.get(timeout=WAIT_S), PortOpened)
    with pytest.raises(PortError, match="already started"):
        ports[0].start(events[0].put)
    for data in (b"one", b"two"):
        ports[0].write(data)
    for own in events:
        assert [own.get(timeout=WAIT_S), own.get(timeout=WAIT_S)] == [b"one", b"two"]
    for port in ports:
        port.close()
        eventually(lambda port=port: not port.is_open)


def test_unexpected_exception_counts_as_a_lost_port(monkeypatch):
    read = UdpPort._read
    errors = [AttributeError("a defect")]

    def failing(*arguments):
        if errors:
            raise errors.pop()
        read(*arguments)

    monkeypatch.setattr(UdpPort, "_read", staticmethod(failing))
    port, events = UdpPort(URL), queue.SimpleQueue[PortEvent]()
    port.start(events.put)
    assert [events.get(timeout=WAIT_S) for _ in range(3)] == [PortOpened(), PortLost("a defect"), PortOpened()]
    port.close()


def test_two_stations_exchange_packets():
    with SerialModem(URL, address=1, driver="udp") as vessel, SerialModem(URL, address=3, driver="udp") as vehicle:
        sent = vehicle.send([b"hello", b"again"], destination=1, rate=1, ack=True)
        assert sent.acknowledged == (1, 2)
        packet = vessel.receive(timeout_s=WAIT_S)
        assert packet is not None
        assert [frame.data for frame in packet.frames] == [b"hello", b"again"]


INVALID = """192.0.2.1:5000 239.255.7.1 239.255.7.1:99999 radio:5000 239.255.7.1:5000/x 239.255.7.1:5000?interface=eth0
239.255.7.1:5000?ttl=256 239.255.7.1:5000?speed=1 239.255.7.1:5000?ttl"""


@pytest.mark.parametrize("address", INVALID.split())
def test_invalid_url_is_refused(address):
    with pytest.raises(ConfigError, match="modem port: url"):
        open_modem_port(f"udp://{address}", 19200)


def test_other_urls_are_serial_ports():
    assert isinstance(open_modem_port("/dev/ttyUSB0", 19200), SerialPort)
