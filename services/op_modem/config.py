"""Configuration of the vessel's modem: the `[op_modem]` table."""

from typing import Annotated

from pydantic import Field

from sonarpost.runtime.modem_service import ModemServiceConfig


class OpModemConfig(ModemServiceConfig):
    """The operator's modem.

    Attributes:
        address: Set at start-up; 1 as in the paper.
    """

    address: Annotated[int, Field(ge=0, le=127)] = 1
