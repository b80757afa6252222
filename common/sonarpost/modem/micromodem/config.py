"""Configuration of the driver: the modem's address and settings, and every time-out."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from types import MappingProxyType

from sonarpost.errors import ConfigError
from sonarpost.modem.micromodem.nmea import MAX_ADDRESS
from sonarpost.modem.micromodem.rates import RATES


@dataclass(frozen=True, slots=True)
class MicroModemConfig:
    """Configuration of the driver.

    Attributes:
        address: This modem's address (`SRC`), 0..127.
        settings: Optional settings, (name, integer value), sent after `SRC` and `CST`. The modem is used even if it
            does not confirm one of them; a `SettingUnconfirmed` reports it. With `RXP` the modem announces the start of
            a reception, during which the driver does not transmit. With `TXP`, `TXF` and `XST` it reports start, end
            and statistics of a transmission; without them a packet takes longer.
        airtimes_s: Air times by rate, where they differ from the nominal ones in `RATES`.
        airtime_margin: Longest transmission or reception, as a multiple of its air time.
        reply_timeout_s: Wait for the answer to a command; the default is that of Goby3's driver.
        refused_wait_s: Wait before a command is sent again that the modem has rejected with `CAERR`.
        tries: How often a command or a cycle is sent before it has failed.
        retry_cap_s: Upper limit of the wait between tries, which doubles.
        init_pause_s: Pause after a restart of the modem.
        keepalive_s: Time without a valid sentence after which the modem is queried.
        request_timeout_s: Wait for the data request of the next frame.
        start_timeout_s: Wait from the data of the last frame to the start of the transmission.
        statistics_timeout_s: Wait for the statistics at the end of a transmission or reception.
        poll_wait_s: Time for a polled modem's host to fill its packet.
        ack_wait_s: Wait for acknowledgements: two-way travel at the longest range and their own packet.
        dump_quiet_s: A configuration dump ends this long after its last line. Before, the driver starts no packet or
            request, and it waits for an answer at least until then.
        dump_limit_s: Upper limit of each of these waits.
        max_carrier_sense_s: Longest time for which a busy channel delays a packet. If the modem reports a busy channel
            for longer without a pause, the driver transmits.
        failures_before_restart: Number of failed packets or polls in a row after which the driver restarts the modem.
        restart_wait_s: Wait for the modem to report its restart; after it, the modem is configured anyway.
        restart_backoff_s: Shortest time between two restarts; it doubles while the modem does not transmit.
        restart_backoff_cap_s: Upper limit of that time.
        queued_packets: Capacity of the queue.
        max_defer_s: Longest time in the queue; a packet that is older has failed.
    """

    address: int
    settings: tuple[tuple[str, int], ...] = (("RXP", 1), ("TXP", 1), ("TXF", 1), ("XST", 1))
    airtimes_s: Mapping[int, float] = field(default_factory=lambda: MappingProxyType({}))
    airtime_margin: float = 1.5
    reply_timeout_s: float = 5.0
    refused_wait_s: float = 1.0
    tries: int = 3
    retry_cap_s: float = 60.0
    init_pause_s: float = 2.0
    keepalive_s: float = 30.0
    request_timeout_s: float = 5.0
    start_timeout_s: float = 5.0
    statistics_timeout_s: float = 3.0
    poll_wait_s: float = 20.0
    ack_wait_s: float = 20.0
    dump_quiet_s: float = 2.0
    dump_limit_s: float = 60.0
    max_carrier_sense_s: float = 30.0
    failures_before_restart: int = 3
    restart_wait_s: float = 10.0
    restart_backoff_s: float = 60.0
    restart_backoff_cap_s: float = 3600.0
    queued_packets: int = 8
    max_defer_s: float = 120.0

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            ConfigError: An address outside 0..127, a count below 1, or a time that is not positive and finite.
        """
        where = "modem configuration"
        if not 0 <= self.address <= MAX_ADDRESS:
            raise ConfigError(where, "address", self.address, f"0..{MAX_ADDRESS}")
        for name in ("tries", "queued_packets", "failures_before_restart"):
            if getattr(self, name) < 1:
                raise ConfigError(where, name, getattr(self, name), "at least 1")
        if not 1.0 <= self.airtime_margin < math.inf:
            raise ConfigError(where, "airtime_margin", self.airtime_margin, "at least 1")
        if unknown := set(self.airtimes_s) - set(RATES):
            raise ConfigError(where, "airtimes_s", min(unknown), f"rates in {sorted(RATES)}")
        times = {f"airtimes_s[{rate}]": time_s for rate, time_s in self.airtimes_s.items()}
        for name, time_s in (times | {name: getattr(self, name) for name in _TIMES}).items():
            if not 0.0 < time_s < math.inf:
                raise ConfigError(where, name, time_s, "a positive number of seconds")

    def airtime_s(self, rate: int | None) -> float:
        """Return the air time of a packet of a rate; for an unknown rate, the longest of all."""
        if rate is not None and rate in RATES:
            return self.airtimes_s.get(rate, RATES[rate].airtime_s)
        return max(self.airtime_s(known) for known in RATES)

    def on_air_limit_s(self, rate: int | None) -> float:
        """Return the longest duration of a transmission or reception of a rate."""
        return self.airtime_margin * self.airtime_s(rate) + self.statistics_timeout_s

    def reply_wait_s(self, attempt: int) -> float:
        """Return the wait after the given attempt (from 1): doubling, up to the limit."""
        return max(self.reply_timeout_s, min(self.reply_timeout_s * 2.0 ** min(attempt - 1, 30), self.retry_cap_s))


_TIMES = tuple(f.name for f in fields(MicroModemConfig) if f.name.endswith("_s") and f.name != "airtimes_s")
