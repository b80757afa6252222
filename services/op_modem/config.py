"""Configuration of the vessel's modem: the `[op_modem]` table."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from sonarpost.link.config import ReceiverConfig
from sonarpost.link.mac import Tdma
from sonarpost.messages import PlatformId
from sonarpost.modem.micromodem import RATES
from sonarpost.runtime.modem_service import ModemServiceConfig

ConsumerName = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,39}$")]
RateNumber = Annotated[int, Field(ge=min(RATES), le=max(RATES))]
Seconds = Annotated[float, Field(gt=0, le=86400)]


class OpModemConfig(ModemServiceConfig):
    """The operator's modem: what it hears, and what it says to the vehicles.

    Attributes:
        address: Set at start-up; 1 as in the paper.
        link: "v1", or "paper" for listening only.
        vehicles: Names of the vehicles by the modem addresses they send from; an address that is not listed has the
            name modem-{address}.
        downlink_rate: v1: Micro-Modem rate of what is sent; 0 carries farthest.
        retry_s: v1: wait for a confirmation before an order is sent again; doubled each time, up to eightfold.
        command_lifetime_s: v1: how long after it was issued an order is repeated.
        feedback: v1: whether vehicles are told what is lacking of their pictures.
        feedback_interval_s: v1: least time between two reports while something is lacking, ...
        feedback_interval_frames: v1: ... and so many frames.
        mac: v1: "csma" speaks when no vehicle has been heard for a while, "tdma" in its slot, "polled" asks each
            vehicle in turn, and speaks between.
        holdoff_s: v1: how long nothing must have been heard.
        max_defer_s: v1: after so long without a quiet moment it speaks between two packets.
        tdma_cycle_s: TDMA: length of the frame of slots; it begins at multiples of this since 1970-01-01 UTC.
        slot_start_s: TDMA: where in the frame the slot begins.
        slot_s: TDMA: length of the slot.
        guard_s: TDMA: end of the slot that stays silent.
        poll_interval_s: Poll: from one question to the next.
        poll_rate: Poll: rate that is asked for.
        message_consumers: v1: services on the vessel that take messages of vehicles.
    """

    address: Annotated[int, Field(ge=0, le=127)] = 1
    link: Literal["v1", "paper"] = "v1"
    vehicles: dict[Annotated[str, Field(pattern=r"^[0-9]{1,3}$")], PlatformId] = Field(default_factory=dict)
    downlink_rate: RateNumber = 0
    retry_s: Seconds = 60.0
    command_lifetime_s: Annotated[float, Field(gt=0, le=604800)] = 6 * 3600.0
    feedback: bool = True
    feedback_interval_s: Seconds = 60.0
    feedback_interval_frames: Annotated[int, Field(ge=1, le=65535)] = 48
    mac: Literal["csma", "tdma", "polled"] = "csma"
    holdoff_s: Seconds = 2.0
    max_defer_s: Seconds = 120.0
    tdma_cycle_s: Seconds = 60.0
    slot_start_s: Annotated[float, Field(ge=0, le=86400)] = 50.0
    slot_s: Seconds = 10.0
    guard_s: Annotated[float, Field(ge=0, le=86400)] = 1.0
    poll_interval_s: Seconds = 10.0
    poll_rate: RateNumber = 1
    message_consumers: tuple[ConsumerName, ...] = ()

    @model_validator(mode="after")
    def _is_possible(self) -> OpModemConfig:
        addresses = [int(address) for address in self.vehicles]
        if len(set(self.vehicles.values())) != len(addresses) or any(address > 127 for address in addresses):
            raise ValueError("addresses 0 to 127, and each vehicle's name once")
        if self.mac != "tdma":
            return self
        if self.slot_start_s + self.slot_s > self.tdma_cycle_s:
            raise ValueError(f"a slot that ends within tdma_cycle_s = {self.tdma_cycle_s}")
        packet_s = RATES[self.downlink_rate].airtime_s
        if self.slot_s - self.guard_s < packet_s:
            raise ValueError(f"slot_s - guard_s of at least {packet_s} s, a packet of downlink_rate")
        return self

    def slots(self) -> Tdma:
        """Return the slots of "tdma"."""
        return Tdma(self.tdma_cycle_s, self.slot_start_s, self.slot_s, self.guard_s)

    def receiver_config(self) -> ReceiverConfig:
        """Return when reports are due."""
        return ReceiverConfig(
            feedback_interval_s=self.feedback_interval_s, feedback_interval_frames=self.feedback_interval_frames
        )

    def name_of(self, address: int) -> str:
        """Return the name of the vehicle with a modem address."""
        return self.vehicles.get(str(address), f"modem-{address}")

    def address_of(self, vehicle_id: str) -> int | None:
        """Return the modem address of a vehicle, None where nobody has that name."""
        for address, name in self.vehicles.items():
            if name == vehicle_id:
                return int(address)
        address = vehicle_id.removeprefix("modem-")
        is_address = address != vehicle_id and address.isdecimal() and int(address) <= 127
        return int(address) if is_address and self.name_of(int(address)) == vehicle_id else None
