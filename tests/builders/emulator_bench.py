"""Emulated modems and their channel on simulated time, with the output of each modem."""

from datetime import UTC, datetime

from sonarpost.extensions.simulation.channel.acoustics import LocalPosition
from sonarpost.extensions.simulation.channel.events import TransmittedPacket
from sonarpost.extensions.simulation.channel.parameters import ChannelParameters
from sonarpost.extensions.simulation.channel.simulator import ChannelSimulator, PlacedModem
from sonarpost.extensions.simulation.modem.receiver import PacketReport
from sonarpost.extensions.simulation.modem.settings import EmulatedModemConfig
from sonarpost.modem.micromodem import nmea

START_UTC_S = datetime(2016, 10, 12, 9, 0, 0, tzinfo=UTC).timestamp()
RANGE_M = 150.0


class EmulatorBench:
    """Modems 150 m apart, with their output for the hosts."""

    def __init__(self, modems: int = 2, serial_baud: float | None = None, **config: object) -> None:
        parameters = {name: config.pop(name) for name in list(config) if name in ChannelParameters.model_fields}
        places = {
            n: PlacedModem(
                EmulatedModemConfig(n, utc_at_zero_s=START_UTC_S, **config), LocalPosition(RANGE_M * (n - 1))
            )  # type: ignore[arg-type]
            for n in range(1, modems + 1)
        }
        self.simulator = ChannelSimulator(ChannelParameters(**parameters), places, serial_baud)  # type: ignore[arg-type]
        self.output = dict.fromkeys(places, b"")
        self.reports: list[PacketReport] = []
        self.transmissions: list[TransmittedPacket] = []
        self.now = 0.0
        self.advance(1.0)
        self.clear_output()

    def advance(self, now: float) -> None:
        self.now = now
        for happened in self.simulator.advance(now):
            (self.reports if isinstance(happened, PacketReport) else self.transmissions).append(happened)  # type: ignore[arg-type]
        for n in self.output:
            for output in self.simulator.take_outputs(n):
                self.output[n] += output.data
                if output.report:
                    self.reports.append(output.report)

    def send(self, modem: int, *sentences: tuple[str | int, ...]) -> None:
        for kind, *fields in sentences:
            self.simulator.receive(modem, nmea.format(str(kind), *fields), self.now)
            self.advance(self.now)

    def clear_output(self) -> None:
        self.output = dict.fromkeys(self.output, b"")

    def sentences(self, modem: int) -> list[str]:
        """Return the sentences for the host since the last call, without `CAREV`; checksums are checked and removed."""
        sentences, self.output[modem] = self.output[modem], b""
        assert sentences == b"" or sentences.endswith(b"\r\n")
        shown = []
        for line in sentences.split(b"\r\n")[:-1]:
            body, _, digits = line[1:].partition(b"*")
            assert digits == b"%02X" % nmea.checksum(body), line
            shown.append(body.decode())
        return [line for line in shown if not line.startswith("CAREV")]


def cst(clock: str, rate: int, *, kind: int = 3, frames: int, bad: int = 0, mode: int = 0) -> str:
    """Return the statistics of the first packet from 1 to 2 at 150 m; its draw determines the levels."""
    psk = kind == 3
    error = 3 if bad and psk else 0
    snr = "15.4,12.41,-100,-12.41,-01" if psk else "15.4,-100,-100,-100,195"
    head = f"CACST,6,{mode},{clock},05,25158,40,0131,0141,07,00,00,00,00,{rate},001,002"
    return f"{head},{error},{kind},{frames},{bad},141,{snr},0.00,51,25000,5000"
