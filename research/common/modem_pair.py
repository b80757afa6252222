"""Two modem drivers with emulated modems in a simulated channel, on a simulated clock."""

from typing import Final

from sonarpost.extensions.simulation.channel.acoustics import LocalPosition
from sonarpost.extensions.simulation.channel.events import TransmittedPacket
from sonarpost.extensions.simulation.channel.parameters import ChannelParameters
from sonarpost.extensions.simulation.channel.simulator import ChannelSimulator, PlacedModem
from sonarpost.extensions.simulation.modem.settings import EmulatedModemConfig
from sonarpost.modem.interface import ModemEvent
from sonarpost.modem.micromodem import MicroModem, MicroModemConfig

VESSEL: Final = 1
_MIN_STEP_S: Final = 0.001


class ModemPair:
    """A vessel and a vehicle, each a driver with an emulated modem.

    Args:
        channel: Parameters of the channel.
        vehicle: Number of the vehicle's modem; the vessel's is 1.
        range_m: Distance of the modems.
        depth_m: Depth of both modems.
        serial_baud: Speed of both serial lines; None for no delay.
    """

    def __init__(
        self,
        channel: ChannelParameters,
        vehicle: int,
        range_m: float,
        *,
        depth_m: float = 0.0,
        serial_baud: float | None = None,
    ) -> None:
        modems = {
            number: PlacedModem(EmulatedModemConfig(number), LocalPosition(east_m, depth_m=depth_m))
            for number, east_m in ((VESSEL, 0.0), (vehicle, range_m))
        }
        self._simulator = ChannelSimulator(channel, modems, serial_baud=serial_baud)
        self.drivers = {number: MicroModem(MicroModemConfig(number)) for number in modems}
        self.transmissions: list[TransmittedPacket] = []
        self.now = 0.0
        for driver in self.drivers.values():
            driver.port_opened(0.0)

    @property
    def ready(self) -> bool:
        """Whether both modems are configured."""
        return all(driver.ready for driver in self.drivers.values())

    def step(self) -> list[tuple[int, ModemEvent]]:
        """Process everything that is due now; return the events of the drivers with the number of the modem."""
        events: list[tuple[int, ModemEvent]] = []
        for number, driver in self.drivers.items():
            events += [(number, event) for event in driver.poll(self.now)]
            self._simulator.receive(number, driver.bytes_to_send(), self.now)
        self.transmissions += [t for t in self._simulator.advance(self.now) if isinstance(t, TransmittedPacket)]
        for number, driver in self.drivers.items():
            for output in self._simulator.take_outputs(number):
                events += [(number, event) for event in driver.receive(output.data, self.now)]
            # The answer to the modem is sent at once: the modem requires it within a short time.
            self._simulator.receive(number, driver.bytes_to_send(), self.now)
        return events

    def advance(self, stop_s: float) -> None:
        """Advance the clock to the next deadline, at most to `stop_s`."""
        wakeups_s = [time_s for d in self.drivers.values() if (time_s := d.next_wakeup()) is not None]
        next_s = min([self._simulator.next_deadline_s(), *wakeups_s])
        self.now = min(stop_s, max(next_s, self.now + _MIN_STEP_S))
