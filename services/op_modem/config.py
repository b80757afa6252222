"""Configuration of the vessel's modem: the `[op_modem]` table."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator
from typing_extensions import override

from sonarpost.config import ConsumerName, PlatformConfig
from sonarpost.errors import ConfigError
from sonarpost.link.config import ReceiverConfig
from sonarpost.link.mac import Continuous, Csma, MediumAccess, Tdma
from sonarpost.link.receiver import WireFormat
from sonarpost.messages import Address, PlatformId, RateNumber
from sonarpost.modem.interface import MAX_ADDRESS, ModemCapabilities
from sonarpost.runtime.modem_service import ModemServiceConfig, Seconds


class OpModemConfig(ModemServiceConfig):
    """Configuration of the vessel's modem and of its end of the acoustic link.

    Attributes:
        address: Modem address of the vessel, set at start-up; 1 in the paper.
        link: "v1" sends commands and feedback; "paper" receives only.
        wire_formats: Accepted wire formats; each frame identifies its own. With `acoustic_key_file`, "v1" only.
        pairing_timeout_s: "paper" format: wait for the rest of an image after its last frame.
        other_vessels: Vessels whose frames this lead vessel merges with its own; each has this vessel as `lead_vessel`.
        lead_vessel: Vessel that merges the received frames with its own. With it this vessel receives only: the lead
            vessel sends commands and feedback.
        vehicles: Vehicle names by modem address; a vehicle that is not listed is named modem-{address}.
        max_images_per_hour: New images that are decoded of each vehicle and hour; further ones wait. Vehicles that are
            not in `vehicles` share one allowance.
        max_image_bytes_per_hour: Pixels and coded bytes that are decoded of each vehicle and hour; further versions of
            its images wait.
        image_consumers: Services on the vessel that receive the coded images.
        message_consumers: Services on the vessel that receive the vehicles' messages; without any, messages are
            published only.
        status_interval_s: Minimum time between two published statuses of a vehicle; further ones are dropped. Vehicles
            that are not in `vehicles` share one limit.
        downlink_rate: Rate of sent packets; rate 0 of the Micro-Modem has the longest range. The default is that of the
            Micro-Modem; other drivers have their own.
        retry_s: Wait for a confirmation before a command is repeated; doubled after each repetition from the third on,
            up to eight times this value.
        command_lifetime_s: Time after its issue for which a command is repeated.
        feedback: Whether feedback is sent to the vehicles.
        feedback_interval_s: Minimum time between two feedback messages to a vehicle, unless feedback_interval_frames
            arrive earlier.
        feedback_interval_frames: Number of received frames after which feedback is sent earlier.
        mac: Medium access: "csma" sends after the channel was free for holdoff_s, "tdma" in a time slot, "polled" polls
            each vehicle in turn and sends between the polls.
        holdoff_s: CSMA: minimum time without a received frame before a packet is sent.
        max_defer_s: CSMA: time after which a pending packet is sent between two received packets.
        ranging_period_s: Time between two pings that measure the distance to a vehicle, 0 for none. The vehicles of
            `vehicles` are pinged in turn while the channel is free. Answers are not authenticated.
        sound_speed_mps: Mean sound speed in the water, for distances.
        poll_interval_s: Polled: time between two polls.
        poll_rate: Polled: rate that vehicles are polled with; the default is that of the Micro-Modem.
    """

    TABLE: ClassVar[str] = "[op_modem]"
    UPLINK_RATES: ClassVar[tuple[str, ...]] = ("poll_rate",)
    DOWNLINK_RATES: ClassVar[tuple[str, ...]] = ("downlink_rate",)

    address: Address = 1
    link: Literal["v1", "paper"] = "v1"
    wire_formats: Annotated[tuple[WireFormat, ...], Field(min_length=1)] = ("v1", "paper")
    pairing_timeout_s: Seconds = 120.0
    other_vessels: Annotated[tuple[PlatformId, ...], Field(max_length=16)] = ()
    lead_vessel: PlatformId | None = None
    vehicles: dict[Annotated[str, Field(pattern=r"^[0-9]{1,3}$")], PlatformId] = Field(default_factory=dict)
    max_images_per_hour: Annotated[int, Field(ge=1, le=1_000_000)] = 1000
    max_image_bytes_per_hour: Annotated[int, Field(ge=1 << 20, le=1 << 40)] = 32 << 20
    image_consumers: tuple[ConsumerName, ...] = ("decompressor",)
    message_consumers: tuple[ConsumerName, ...] = ()
    status_interval_s: Annotated[float, Field(ge=1, le=86400)] = 5.0
    downlink_rate: RateNumber = 0
    retry_s: Seconds = 20.0
    command_lifetime_s: Annotated[float, Field(gt=0, le=604800)] = 6 * 3600.0
    feedback: bool = True
    feedback_interval_s: Seconds = 20.0
    feedback_interval_frames: Annotated[int, Field(ge=1, le=65535)] = 48
    mac: Literal["csma", "tdma", "polled"] = "csma"
    holdoff_s: Seconds = 2.0
    max_defer_s: Seconds = 120.0
    tdma_slot_s: tuple[Annotated[float, Field(ge=0)], float] = (50.0, 59.0)
    ranging_period_s: Annotated[float, Field(ge=0, le=86400)] = 0.0
    sound_speed_mps: Annotated[float, Field(ge=1300, le=1700)] = 1500.0
    poll_interval_s: Seconds = 10.0
    poll_rate: RateNumber = 1

    @model_validator(mode="after")
    def _check(self) -> OpModemConfig:
        addresses = [int(address) for address in self.vehicles]
        if len(set(self.vehicles.values())) != len(addresses) or any(address > MAX_ADDRESS for address in addresses):
            raise ValueError(f"addresses 0 to {MAX_ADDRESS}, and each vehicle's name once")
        if self.transmits and "v1" not in self.wire_formats:
            raise ValueError('wire_formats with "v1" where link = "v1"')
        if self.other_vessels and not self.transmits:
            raise ValueError('other_vessels only with link = "v1" and without lead_vessel')
        if len(set(self.other_vessels)) != len(self.other_vessels):
            raise ValueError("each name in other_vessels once")
        if self.ranging_period_s and not self.transmits:
            raise ValueError('ranging_period_s = 0 where link = "paper": such a vessel does not transmit')
        return self

    @override
    def _check_modem(self, capabilities: ModemCapabilities) -> None:
        super()._check_modem(capabilities)
        for address in self.vehicles:
            self._check_address("vehicles", int(address))
        if self.mac == "polled" and self.transmits and not capabilities.polling:
            raise ConfigError(self.TABLE, "mac", self.mac, "another one: this modem does not poll")
        if self.ranging_period_s and not capabilities.ranging:
            raise ConfigError(self.TABLE, "ranging_period_s", self.ranging_period_s, "0: this modem measures no ranges")
        self._check_packet(self.rate_info(self.downlink_rate).airtime_s)

    @override
    def check_with(self, platform: PlatformConfig) -> None:
        """Check the port, the acoustic key and that a wire format can be authenticated.

        Raises:
            ConfigError: As `ModemServiceConfig.check_with`, or no wire format remains that is authenticated.
        """
        if platform.acoustic_auth != "none" and "v1" not in self.wire_formats:
            expected = '"v1", or acoustic_auth = "none" in [platform]: the paper format has no authentication'
            raise ConfigError("[op_modem]", "wire_formats", self.wire_formats, expected)
        partners = {"lead_vessel": self.lead_vessel, "other_vessels": self.other_vessels}
        for field, value in ((field, value) for field, value in partners.items() if value):
            if platform.acoustic_auth == "none":
                expected = "an acoustic key: frames of two vessels are compared by their authenticated counters"
                raise ConfigError("[op_modem]", field, value, expected)
            if platform.id in (value if isinstance(value, tuple) else (value,)):
                raise ConfigError("[op_modem]", field, value, f"other vessels than {platform.id}")
        super().check_with(platform)

    @property
    def transmits(self) -> bool:
        """Whether the vessel sends to vehicles."""
        return self.link == "v1" and self.lead_vessel is None

    def new_mac(self) -> MediumAccess:
        """Return the policy of medium access control; a vessel that polls sends between its polls."""
        match self.mac:
            case "csma":
                return Csma(0.0, holdoff_s=self.holdoff_s)
            case "tdma":
                return Tdma(self.tdma_cycle_s, *self.tdma_slot_s)
            case "polled":
                return Continuous()

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
        is_address = address != vehicle_id and address.isdecimal() and int(address) <= self.capabilities.max_address
        return int(address) if is_address and self.name_of(int(address)) == vehicle_id else None
