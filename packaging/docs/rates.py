"""Tables of the page on modem rates, computed from the modem driver, the frame formats and the channel model."""

from sonarpost.extensions.simulation.channel.acoustics import LocalPosition, frame_error_rate
from sonarpost.extensions.simulation.channel.model import ChannelModel
from sonarpost.extensions.simulation.channel.parameters import build_parameters
from sonarpost.link.auth.key import AuthenticationSettings
from sonarpost.link.frames.contact_record import RECORD_SIZE
from sonarpost.link.frames.v1.frame import HEADER_BYTES
from sonarpost.modem.micromodem import RATES

PUBLISHED_ERROR_RATES = (1, 3, 5)
"""Rates whose frame error rates are published; the channel model replaces the others by the nearest of these."""
IMAGE_BYTES = (64, 128, 200, 512)


def rate_rows() -> list[tuple[str, ...]]:
    """Return the rows of the table of rates."""
    return [
        (
            str(rate.number),
            rate.modulation,
            f"{rate.frames} x {rate.frame_bytes}",
            str(rate.packet_bytes),
            f"{rate.airtime_s:g}",
            f"{rate.packet_bytes / rate.airtime_s:.0f}",
            f"{needed_snr_db(rate.number):.1f}" if rate.number in PUBLISHED_ERROR_RATES else "not published",
            f"{reach_m(rate.number):.0f}" if rate.number in PUBLISHED_ERROR_RATES else "not published",
        )
        for rate in RATES.values()
    ]


RATE_HEADER = (
    "rate",
    "modulation and code",
    "frames x B",
    "packet, B",
    "air time, s",
    "throughput, B/s",
    "SNR for half of the frames, dB",
    "reach in the sea-trial channel, m",
)


def needed_snr_db(rate: int) -> float:
    """Return the signal-to-noise ratio at which half of the frames arrive."""
    low, high = -20.0, 20.0
    while high - low > 0.001:
        middle = (low + high) / 2
        low, high = (middle, high) if frame_error_rate(rate, middle) > 0.5 else (low, middle)
    return high


def reach_m(rate: int) -> float:
    """Return the range at which half of the frames arrive in the preset `sea-trial`, without fades, rounded to 5 m."""
    channel = ChannelModel(build_parameters({"preset": "sea-trial"}, "rates"), {1: LocalPosition()})
    return max(5.0 * step for step in range(1, 100) if channel.snr_db(5.0 * step) >= needed_snr_db(rate))


def image_rows() -> list[tuple[str, ...]]:
    """Return the rows of the table of images a minute: authenticated v1 frames without loss, pause or feedback."""
    overhead = HEADER_BYTES + AuthenticationSettings().overhead_bytes
    rows = []
    for rate in RATES.values():
        payload_per_s = rate.frames * (rate.frame_bytes - overhead) / rate.airtime_s
        cells = (f"{60 * payload_per_s / (size + RECORD_SIZE):.1f}" for size in IMAGE_BYTES)
        rows.append((str(rate.number), f"{payload_per_s:.0f}", *cells))
    return rows


IMAGE_HEADER = ("rate", "payload, B/s", *(f"images of {size} B a minute" for size in IMAGE_BYTES))
