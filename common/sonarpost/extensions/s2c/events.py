"""Events of the S2C driver that other drivers do not have."""

from __future__ import annotations

from dataclasses import dataclass

from sonarpost.modem.interface import ModemEvent


@dataclass(frozen=True, slots=True)
class UsblPosition(ModemEvent):
    """A USBL modem has measured the position of another modem.

    Attributes:
        address: Address of the other modem.
        east_m: Distance east of the USBL modem.
        north_m: Distance north of it.
        up_m: Distance above it.
        travel_s: One-way travel time.
        accuracy_m: Accuracy as the modem estimates it.
    """

    address: int
    east_m: float
    north_m: float
    up_m: float
    travel_s: float
    accuracy_m: float
