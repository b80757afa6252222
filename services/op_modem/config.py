"""Configuration of the vessel's modem: the `[op_modem]` table."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from sonarpost.config import ConsumerName, PlatformConfig
from sonarpost.errors import ConfigError
from sonarpost.link.config import ReceiverConfig
from sonarpost.link.mac import Tdma
from sonarpost.link.receiver import WireFormat
from sonarpost.messages import PlatformId
from sonarpost.modem.micromodem import RATES
from sonarpost.runtime.modem_service import ModemServiceConfig

RateNumber = Annotated[int, Field(ge=min(RATES), le=max(RATES))]
Seconds = Annotated[float, Field(gt=0, le=86400)]


class OpModemConfig(ModemServiceConfig):
    """Configuration of the vessel's modem and of its end of the acoustic link.

    Attributes:
        address: Modem address of the vessel, set at start-up; 1 in the paper.
        link: "v1" sends commands and feedback; "paper" receives only.
        wire_formats: Accepted wire formats; each frame identifies its own. With `acoustic_key_file`, "v1" only.
        pairing_timeout_s: "paper" format: wait for the rest of an image after its last frame.
        vehicles: Vehicle names by modem address; a vehicle that is not listed is named modem-{address}.
        max_images_per_hour: New images that are decoded of each vehicle and hour; further ones wait. Vehicles that are
            not in `vehicles` share one allowance.
        max_image_bytes_per_hour: Pixels and coded bytes that are decoded of each vehicle and hour; further versions of
            its images wait.
        image_consumers: Services on the vessel that receive the coded images.
        message_consumers: Services on the vessel that receive the vehicles' messages; without any, messages are
            published only.
        downlink_rate: Micro-Modem rate of sent packets; rate 0 has the longest range.
        retry_s: Wait for a confirmation before a command is repeated; doubled after each repetition, up to eight times
            this value.
        command_lifetime_s: Time after its issue for which a command is repeated.
        feedback: Whether feedback is sent to the vehicles.
        feedback_interval_s: Minimum time between two feedback messages to a vehicle, unless feedback_interval_frames
            arrive earlier.
        feedback_interval_frames: Number of received frames after which feedback is sent earlier.
        mac: Medium access: "csma" sends after the channel was free for holdoff_s, "tdma" in a time slot, "polled" polls
            each vehicle in turn and sends between the polls.
        holdoff_s: CSMA: minimum time without a received frame before a packet is sent.
        max_defer_s: CSMA: time after which a pending packet is sent between two received packets.
        tdma_cycle_s: TDMA: length of the cycle of slots; cycles begin at multiples of it since 1970-01-01 UTC.
        slot_start_s: TDMA: start of the vessel's slot in the cycle.
        slot_s: TDMA: length of the slot.
        guard_s: TDMA: guard time at the end of the slot.
        poll_interval_s: Polled: time between two polls.
        poll_rate: Polled: Micro-Modem rate that vehicles are polled with.
    """

    address: Annotated[int, Field(ge=0, le=127)] = 1
    link: Literal["v1", "paper"] = "v1"
    wire_formats: Annotated[tuple[WireFormat, ...], Field(min_length=1)] = ("v1", "paper")
    pairing_timeout_s: Seconds = 120.0
    vehicles: dict[Annotated[str, Field(pattern=r"^[0-9]{1,3}$")], PlatformId] = Field(default_factory=dict)
    max_images_per_hour: Annotated[int, Field(ge=1, le=1_000_000)] = 1000
    max_image_bytes_per_hour: Annotated[int, Field(ge=1 << 20, le=1 << 40)] = 32 << 20
    image_consumers: tuple[ConsumerName, ...] = ("decompressor",)
    message_consumers: tuple[ConsumerName, ...] = ()
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

    @model_validator(mode="after")
    def _check(self) -> OpModemConfig:
        addresses = [int(address) for address in self.vehicles]
        if len(set(self.vehicles.values())) != len(addresses) or any(address > 127 for address in addresses):
            raise ValueError("addresses 0 to 127, and each vehicle's name once")
        if self.transmits and "v1" not in self.wire_formats:
            raise ValueError('wire_formats with "v1" where link = "v1"')
        if self.mac != "tdma":
            return self
        if self.slot_start_s + self.slot_s > self.tdma_cycle_s:
            raise ValueError(f"a slot that ends within tdma_cycle_s = {self.tdma_cycle_s}")
        packet_s = RATES[self.downlink_rate].airtime_s
        if self.slot_s - self.guard_s < packet_s:
            raise ValueError(f"slot_s - guard_s of at least {packet_s} s, a packet of downlink_rate")
        return self

    def check_with(self, platform: PlatformConfig) -> None:
        """Check the port, the acoustic key and that a wire format can be authenticated.

        Raises:
            ConfigError: As `DownlinkService`.
        """
        if platform.acoustic_auth != "none" and "v1" not in self.wire_formats:
            expected = '"v1", or acoustic_auth = "none" in [platform]: the paper format has no authentication'
            raise ConfigError("[op_modem]", "wire_formats", self.wire_formats, expected)
        super().check_with(platform)

    @property
    def transmits(self) -> bool:
        """Whether the vessel sends to vehicles."""
        return self.link == "v1"

    def slots(self) -> Tdma:
        """Return the slots of "tdma"."""
        return Tdma(self.tdma_cycle_s, self.slot_start_s, self.slot_s, self.guard_s)

    def receiver_config(self) -> ReceiverConfig:
        """Return the configuration of the `v1` receiver."""
        return ReceiverConfig(
            feedback_interval_s=self.feedback_interval_s, feedback_interval_frames=self.feedback_interval_frames
        )

    def name_of(self, address: int) -> str:
        """Return the name of the vehicle with a modem address."""
        return self.vehicles.get(str(address), f"modem-{address}")

    def address_of(self, vehicle_id: str) -> int | None:
        """Return the modem address of a vehicle, None if no vehicle has this name."""
        for address, name in self.vehicles.items():
            if name == vehicle_id:
                return int(address)
        address = vehicle_id.removeprefix("modem-")
        is_address = address != vehicle_id and address.isdecimal() and int(address) <= 127
        return int(address) if is_address and self.name_of(int(address)) == vehicle_id else None
