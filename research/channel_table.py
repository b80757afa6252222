"""`python -m research.channel_table --preset sea-trial`: received packets and frames by range and rate, as a table.

All figures are counts of packets sent one after the other through the simulated channel.
"""

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sonarpost.cli.progress import ProgressDisplay
from sonarpost.extensions.simulation.channel.acoustics import LocalPosition
from sonarpost.extensions.simulation.channel.events import AcousticPacket, ArrivalEnded, FrameOutcome, PacketKind
from sonarpost.extensions.simulation.channel.model import ChannelModel
from sonarpost.extensions.simulation.channel.parameters import (
    PRESETS,
    ChannelParameters,
    build_parameters,
    read_parameters,
)
from sonarpost.modem.micromodem import RATES

RANGES_M = (2, 30, 60, 90, 110, 120, 130, 140, 160, 200, 250, 300)
GAP_S = 10.0


@dataclass(frozen=True, slots=True)
class Delivery:
    """Fractions of complete packets and of frames received at one range."""

    range_m: float
    snr_db: float
    packets: float
    frames: float


def deliver(config: ChannelParameters, rate: int, range_m: float, packets: int) -> Delivery:
    """Send full packets at a rate over a range, ten seconds apart, and count the received ones."""
    channel = ChannelModel(config, {1: LocalPosition(), 2: LocalPosition(east_m=range_m)})
    packet_format = RATES[rate]
    frames = tuple(bytes([number]) * packet_format.frame_bytes for number in range(1, packet_format.frames + 1))
    complete = received = 0
    for number in range(packets):
        channel.transmit(
            1, AcousticPacket(PacketKind.DATA, 1, 2, rate, packet_format.airtime_s, frames), number * GAP_S
        )
        for event in channel.poll((number + 1) * GAP_S):
            if isinstance(event, ArrivalEnded):
                arrived = sum(frame.outcome in {FrameOutcome.DELIVERED, FrameOutcome.DAMAGED} for frame in event.frames)
                received += arrived
                complete += arrived == packet_format.frames
    return Delivery(range_m, channel.snr_db(range_m), complete / packets, received / packets / packet_format.frames)


def table(config: ChannelParameters, packets: int) -> str:
    """Return the table: complete packets and frames received, in percent, for each range and rate."""
    lines = [
        "| range m | SNR dB | " + " | ".join(f"rate {rate}" for rate in RATES) + " |",
        "|" + "---|" * (len(RATES) + 2),
    ]
    for range_m in RANGES_M:
        cells: Mapping[int, Delivery] = {rate: deliver(config, rate, range_m, packets) for rate in RATES}
        percentages = [f"{100 * cell.packets:.0f} / {100 * cell.frames:.0f}" for cell in cells.values()]
        lines.append(f"| {range_m} | {cells[0].snr_db:.1f} | " + " | ".join(percentages) + " |")
    return "\n".join(lines)


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description="Complete packets / frames received, in percent.")
    parser.add_argument("--preset", choices=list(PRESETS), default="still")
    parser.add_argument("--water", type=Path, metavar="FILE", help="TOML file with parameters that override the preset")
    parser.add_argument("--packets", type=int, default=500, help="packets for each cell (500)")
    parsed = parser.parse_args()
    values = {"preset": parsed.preset} | (read_parameters(parsed.water) if parsed.water else {})
    print(table(build_parameters(values, str(parsed.water or "command line")), parsed.packets))


if __name__ == "__main__":
    with ProgressDisplay(step="channel_table"):
        main()
