"""Configuration of the vehicle's modem: the `[uuv_modem]` table."""

from typing import Annotated

from pydantic import Field

from sonarpost.modem.rates import RATES
from sonarpost.runtime.modem_service import ModemServiceConfig


class UuvModemConfig(ModemServiceConfig):
    """Where pictures go, and how fast.

    Attributes:
        address: The vehicle's modem.
        destination: The vessel's modem; 1 in the paper.
        rate: Micro-Modem rate 0 to 6; the paper uses 4 in a tank and 1 at sea.
        retry_s: Wait before a packet that the modem could not send is tried again.
    """

    address: Annotated[int, Field(ge=0, le=127)] = 3
    destination: Annotated[int, Field(ge=0, le=127)] = 1
    rate: Annotated[int, Field(ge=min(RATES), le=max(RATES))] = 1
    retry_s: Annotated[float, Field(gt=0, le=600)] = 2.0
