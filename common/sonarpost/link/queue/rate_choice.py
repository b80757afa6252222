"""Which of the modem's rates to use, by the loss that was measured at each and what packets cost in seconds. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from sonarpost.errors import ConfigError
from sonarpost.link.coding.redundancy_plan import best_rate
from sonarpost.modem.micromodem import RATES, Rate


@dataclass(eq=False)
class RateSelector:
    """Chooses the rate with the most payload through per second, and tries the others now and then.

    The loss at a rate that was not used of late is not known. It is taken to be that of the next slower rate that is
    known, so a faster one is tried once in `memory_s` and given up as soon as its loss is measured.

    Args:
        open_rates: Numbers of the rates that may be used.
        current: The one in use.
        memory_s: How long a measure holds.
        losses: Loss and time of the measure, by rate.

    Raises:
        ConfigError: No such rate, or the current one is not open.
    """

    open_rates: Sequence[int]
    current: int
    memory_s: float = 1800.0
    losses: dict[int, tuple[float, float]] = field(default_factory=dict)
    rates: Mapping[int, Rate] = field(default_factory=lambda: RATES)

    def __post_init__(self) -> None:
        wrong = [number for number in (*self.open_rates, self.current) if number not in self.rates]
        if wrong or self.current not in self.open_rates:
            raise ConfigError(
                "rate choice", "rates", tuple(self.open_rates), f"some of {sorted(self.rates)}, with the first"
            )

    def measured(self, loss: float, now: float) -> None:
        """Note the loss at the current rate, 0..1."""
        self.losses[self.current] = (min(max(loss, 0.0), 1.0), now)

    def choose(self, now: float) -> int:
        """Return the rate to use from now on, and make it the current one."""
        by_speed = sorted(self.open_rates, key=lambda number: self.rates[number].throughput_bps)
        known: dict[int, float] = {}
        assumed = 0.0
        for number in by_speed:
            loss, at = self.losses.get(number, (assumed, -1.0))
            if number in self.losses and not 0 <= now - at <= self.memory_s:
                del self.losses[number]
                loss = assumed
            known[number] = loss
            assumed = max(assumed, loss) if number in self.losses else assumed
        if self.current not in self.losses:
            return self.current  # what is being tried stays until it is measured
        self.current = best_rate(known, self.rates).number
        return self.current
