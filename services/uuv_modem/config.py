"""Configuration of the service: the `[uuv_modem]` table."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator
from typing_extensions import override

from sonarpost.config import ConsumerName, PlatformConfig
from sonarpost.errors import ConfigError
from sonarpost.link.config import QueueConfig
from sonarpost.link.mac import Continuous, Csma, MediumAccess, Polled, Tdma
from sonarpost.messages import Address, RateNumber
from sonarpost.modem.interface import ModemCapabilities
from sonarpost.runtime.modem_service import ModemServiceConfig, Seconds

MIN_STATUS_PERIOD_S = 5.0


class UuvModemConfig(ModemServiceConfig):
    """Destination, rate, redundancy, medium access and consumers of the acoustic link.

    Attributes:
        address: Address of the vehicle's modem.
        destination: Address of the vessel's modem; 1 in the paper.
        link: Wire format: "v1", or "paper" for the paper's.
        rate: Number of the rate, see the driver; of the Micro-Modem, the paper uses 4 in a tank and 1 at sea. The
            default is that of the Micro-Modem; other drivers have their own.
        retry_s: Wait before a packet that the modem could not send is sent again.
        allowed_rates: v1: further rates that are used when they are faster at the measured loss.
        expected_loss: v1: share of frames lost, until feedback has measured it.
        feedback: v1: "auto" sends what feedback requests while feedback arrives, "never" ignores feedback.
        frames_per_image: v1: average frames for an image without feedback.
        stream_bytes: v1: with feedback, maximum bytes of an image's stream that are sent without a command.
        group_delay_s: v1: how long an announced image waits for others, to be coded in one group with them.
        max_defer_s: v1: time without feedback after which more symbols of an image are sent, in case all were lost.
        image_airtime_share: v1: share of frames for images, however many messages wait.
        aging_s: v1: a message becomes one level more urgent each time it has waited so long.
        max_messages: v1: maximum number of waiting messages; further ones stay with their senders.
        mac: v1: "continuous" sends at once, "tdma" in slots, "polled" on request, "csma" after random waits.
        tx_burst_s: Continuous: time of transmission between two receive windows.
        rx_window_s: Continuous: length of a receive window, 0 for none. A packet that begins in it is received to its
            end, so it must cover the vessel's `holdoff_s`, the two-way travel time and one second.
        holdoff_s: Continuous, csma: silence of other stations before this one sends.
        mean_backoff_s: CSMA: mean of the random waits.
        stop_on_decision: v1: whether a decision for `mine_like` or `not_mine_like` stops the rest of its image; a later
            decision for `unsure` queues the rest again.
        queue_interval_s: Maximum time between two publications of the queue state.
        status_period_s: v1: time between two statuses of the vehicle (position, depth, images waiting, free disk space)
            that are sent to the vessel, 0 for none.
        refine_consumers: v1: services that receive the commands refine, resend, expand, original and region.
        revisit_consumers: v1: services that receive the command revisit.
        decision_consumers: v1: services that receive operators' decisions.
    """

    TABLE: ClassVar[str] = "[uuv_modem]"
    UPLINK_RATES: ClassVar[tuple[str, ...]] = ("rate",)

    address: Address = 3
    destination: Address = 1
    link: Literal["v1", "paper"] = "v1"
    rate: RateNumber = 1
    retry_s: Annotated[float, Field(gt=0, le=600)] = 2.0
    allowed_rates: tuple[RateNumber, ...] = ()
    expected_loss: Annotated[float, Field(ge=0, le=0.95)] = 0.2
    feedback: Literal["auto", "never"] = "auto"
    frames_per_image: Annotated[float, Field(ge=1, le=255)] = 6.0
    stream_bytes: Annotated[int, Field(ge=16, le=65535)] = 512
    group_delay_s: Annotated[float, Field(ge=0, le=86400)] = 20.0
    max_defer_s: Seconds = 120.0
    image_airtime_share: Annotated[float, Field(ge=0, le=1)] = 0.25
    aging_s: Seconds = 600.0
    max_messages: Annotated[int, Field(ge=1, le=100_000)] = 2000
    mac: Literal["continuous", "tdma", "polled", "csma"] = "continuous"
    tx_burst_s: Seconds = 90.0
    rx_window_s: Annotated[float, Field(ge=0, le=86400)] = 5.0
    holdoff_s: Annotated[float, Field(ge=0, le=600)] = 5.0
    mean_backoff_s: Annotated[float, Field(ge=0, le=86400)] = 10.0
    queue_interval_s: Annotated[float, Field(ge=0.05, le=3600)] = 5.0
    status_period_s: Annotated[float, Field(ge=0, le=86400)] = 0.0
    stop_on_decision: bool = True
    refine_consumers: tuple[ConsumerName, ...] = ("compressor",)
    revisit_consumers: tuple[ConsumerName, ...] = ()
    decision_consumers: tuple[ConsumerName, ...] = ()

    @model_validator(mode="after")
    def _check_status_period(self) -> UuvModemConfig:
        if 0 < self.status_period_s < MIN_STATUS_PERIOD_S:
            raise ValueError(f"status_period_s of 0 or at least {MIN_STATUS_PERIOD_S:g} s")
        if self.status_period_s and self.link != "v1":
            raise ValueError('status_period_s = 0 where link = "paper", which has no messages')
        return self

    @override
    def _check_modem(self, capabilities: ModemCapabilities) -> None:
        super()._check_modem(capabilities)
        self._check_address("destination", self.destination)
        for number in self.allowed_rates:
            self._check_rate("allowed_rates", number)
        if self.mac == "polled" and self.link == "v1" and not capabilities.polling:
            raise ConfigError(self.TABLE, "mac", self.mac, "another one: this modem does not poll")
        self._check_packet(max(self.rate_info(number).airtime_s for number in (self.rate, *self.allowed_rates)))

    @override
    def check_with(self, platform: PlatformConfig) -> None:
        """Check the port, the acoustic key and that the wire format can be authenticated.

        Raises:
            ConfigError: As `ModemServiceConfig.check_with`, or `link` is "paper" and frames are to be authenticated.
        """
        if self.link == "paper" and platform.acoustic_auth != "none":
            expected = '"v1", or acoustic_auth = "none" in [platform]: the paper format has no authentication'
            raise ConfigError("[uuv_modem]", "link", self.link, expected)
        super().check_with(platform)

    def new_mac(self) -> MediumAccess:
        """Return the policy of medium access control; the `paper` format always sends at once."""
        if self.link == "paper":
            return Continuous()
        match self.mac:
            case "continuous":
                return Continuous(self.tx_burst_s, self.rx_window_s, self.holdoff_s)
            case "tdma":
                return Tdma(self.tdma_cycle_s, *self.tdma_slot_s)
            case "polled":
                return Polled()
            case "csma":
                return Csma(self.mean_backoff_s, holdoff_s=self.holdoff_s, seed=self.address)

    def queue_config(self) -> QueueConfig:
        """Return the configuration of the `v1` transmit queue."""
        return QueueConfig(
            rates=tuple(self.rate_info(number) for number in sorted({self.rate, *self.allowed_rates})),
            first_rate=self.rate,
            expected_loss=self.expected_loss,
            feedback=self.feedback,
            max_defer_s=self.max_defer_s,
            image_airtime_share=self.image_airtime_share,
            aging_s=self.aging_s,
            max_messages=self.max_messages,
            frames_per_image=self.frames_per_image,
            stream_bytes=self.stream_bytes,
            group_delay_s=self.group_delay_s,
        )
