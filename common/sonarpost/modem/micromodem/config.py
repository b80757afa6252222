"""The driver's configuration: the modem's address and settings, and every time-out."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from types import MappingProxyType

from sonarpost.errors import ConfigError
from sonarpost.modem.micromodem.fields import MAX_ADDRESS
from sonarpost.modem.micromodem.rates import RATES


@dataclass(frozen=True, slots=True)
class MicroModemConfig:
    """How the driver treats its modem.

    Attributes:
        address: This modem's address (`SRC`), 0..127.
        settings: More settings, (name, integer value), sent after `SRC` and `CST`. A modem that does not confirm
            one of them is used all the same, and a `SettingRefused` says so. `RXP` makes the modem announce a
            reception at its start, which keeps the driver from talking into it.
        airtimes_s: Air time by rate, where it differs from the nominal one in `RATES`.
        airtime_margin: A transmission or reception may take this many times its air time.
        reply_timeout_s: Wait for the answer to a command; what Goby3's driver has found to be enough.
        tries: How often a command or a cycle is sent before it counts as failed.
        retry_cap_s: The wait between tries doubles up to this.
        init_pause_s: Silence kept after a restart of the modem.
        keepalive_s: After this long without a valid sentence the modem is asked for its address.
        request_timeout_s: Wait for the request of the next frame.
        start_timeout_s: Wait between the last frame's data and the start of the transmission.
        statistics_timeout_s: Wait for the statistics at the end of a transmission or reception.
        poll_wait_s: What a polled modem's host may take to fill its packet.
        ack_wait_s: Wait for acknowledgements: the way there and back at the longest range and their own packet.
        dump_quiet_s: While the modem dumps its configuration, the wait for an answer goes on until this long
            after the last line of it, but
        dump_limit_s: no longer than this in all.
        queued_packets: How many packets may wait.
        max_defer_s: How long one may wait before it fails.
    """

    address: int
    settings: tuple[tuple[str, int], ...] = (("RXP", 1),)
    airtimes_s: Mapping[int, float] = field(default_factory=lambda: MappingProxyType({}))
    airtime_margin: float = 1.5
    reply_timeout_s: float = 5.0
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
    dump_limit_s: float = 30.0
    queued_packets: int = 8
    max_defer_s: float = 120.0

    def __post_init__(self) -> None:
        """Check every field.

        Raises:
            ConfigError: An address outside 0..127, a count below 1, or a time that is not positive and
            finite.
        """
        where = "modem configuration"
        if not 0 <= self.address <= MAX_ADDRESS:
            raise ConfigError(where, "address", self.address, f"0..{MAX_ADDRESS}")
        for name in ("tries", "queued_packets"):
            if getattr(self, name) < 1:
                raise ConfigError(where, name, getattr(self, name), "at least 1")
        if not 1.0 <= self.airtime_margin < math.inf:
            raise ConfigError(where, "airtime_margin", self.airtime_margin, "at least 1")
        for rate, airtime_s in self.airtimes_s.items():
            if rate not in RATES:
                raise ConfigError(where, "airtimes_s", rate, f"rates in {sorted(RATES)}")
            _check_time(where, f"airtimes_s[{rate}]", airtime_s)
        for name in _TIMES:
            _check_time(where, name, getattr(self, name))

    def airtime_s(self, rate: int | None) -> float:
        """Return how long a packet of a rate occupies the water; of an unknown one, the longest of all."""
        if rate is not None and rate in RATES:
            return self.airtimes_s.get(rate, RATES[rate].airtime_s)
        return max(self.airtime_s(known) for known in RATES)

    def on_air_limit_s(self, rate: int | None) -> float:
        """Return how long a transmission or reception of a rate may take before it is given up."""
        return self.airtime_margin * self.airtime_s(rate) + self.statistics_timeout_s

    def reply_wait_s(self, attempt: int) -> float:
        """Return the wait after the given attempt (from 1): doubling, up to the cap."""
        return max(self.reply_timeout_s, min(self.reply_timeout_s * 2.0 ** min(attempt - 1, 30), self.retry_cap_s))

    def scaled(self, factor: float) -> MicroModemConfig:
        """Return a copy with every time multiplied, for a simulated water that runs faster or slower."""
        airtimes_s = {rate: factor * self.airtime_s(rate) for rate in RATES}
        times = {name: factor * getattr(self, name) for name in _TIMES}
        return replace(self, airtimes_s=MappingProxyType(airtimes_s), **times)


_TIMES = tuple(f.name for f in fields(MicroModemConfig) if f.name.endswith("_s") and f.name != "airtimes_s")


def _check_time(where: str, name: str, value_s: float) -> None:
    if not 0.0 < value_s < math.inf:
        raise ConfigError(where, name, value_s, "a positive number of seconds")
