"""Configuration of the vehicle's modem: the `[uuv_modem]` table."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from sonarpost.link.config import QueueConfig
from sonarpost.link.mac import Continuous, Csma, MediumAccess, Polled, Tdma
from sonarpost.modem.micromodem import RATES
from sonarpost.runtime.modem_service import ModemServiceConfig

ConsumerName = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,39}$")]
RateNumber = Annotated[int, Field(ge=min(RATES), le=max(RATES))]
Seconds = Annotated[float, Field(gt=0, le=86400)]


class UuvModemConfig(ModemServiceConfig):
    """Where pictures and messages go, how fast, and when.

    Attributes:
        address: The vehicle's modem.
        destination: The vessel's modem; 1 in the paper.
        link: Wire format: "v1", or "paper" for the paper's.
        rate: Micro-Modem rate 0 to 6; the paper uses 4 in a tank and 1 at sea.
        retry_s: Wait before a packet that the modem could not send is tried again.
        allowed_rates: v1: other rates that may be used when the measured loss makes them better.
        expected_loss: v1: share of frames lost, until reports tell.
        feedback: v1: "auto" sends what reports ask for as long as reports come, "never" ignores them.
        frames_per_image: v1: frames a picture costs on average without reports.
        stream_bytes: v1: most bytes of a picture's stream that are sent unasked with reports.
        group_delay_s: v1: how long an image waits, after its preview, for others to be coded together with it.
        image_airtime_share: v1: share of frames that pictures get however many messages wait.
        aging_s: v1: a message becomes one level more urgent for each such time that it waits.
        max_messages: v1: most messages that wait; more stay with their programs.
        mac: v1: "continuous" sends at once, "tdma" in slots, "polled" when asked, "csma" after random waits.
        tx_burst_s: Continuous: time of transmission between two receive windows.
        rx_window_s: Continuous: length of a receive window, 0 for none. A packet that begins in it is received to its
            end, so it must cover the vessel's `holdoff_s`, the two-way travel time and one second.
        holdoff_s: Continuous and random: how long after others were heard it does not begin; they may go on.
        tdma_cycle_s: TDMA: length of the frame of slots; it begins at multiples of this since 1970-01-01 UTC.
        slot_start_s: TDMA: where in the frame the slot begins.
        slot_s: TDMA: length of the slot.
        guard_s: TDMA: end of the slot that stays silent.
        mean_backoff_s: Random: mean of the waits.
        queue_interval_s: v1: how often the state of the queue is published.
        refine_consumers: v1: services that take commands to refine, resend or widen a picture.
        revisit_consumers: v1: services that take commands to revisit a position.
        decision_consumers: v1: services that take operators' decisions.
    """

    address: Annotated[int, Field(ge=0, le=127)] = 3
    destination: Annotated[int, Field(ge=0, le=127)] = 1
    link: Literal["v1", "paper"] = "v1"
    rate: RateNumber = 1
    retry_s: Annotated[float, Field(gt=0, le=600)] = 2.0
    allowed_rates: tuple[RateNumber, ...] = ()
    expected_loss: Annotated[float, Field(ge=0, le=0.95)] = 0.2
    feedback: Literal["auto", "never"] = "auto"
    frames_per_image: Annotated[float, Field(ge=1, le=255)] = 6.0
    stream_bytes: Annotated[int, Field(ge=16, le=65535)] = 512
    group_delay_s: Annotated[float, Field(ge=0, le=86400)] = 20.0
    image_airtime_share: Annotated[float, Field(ge=0, le=1)] = 0.25
    aging_s: Seconds = 600.0
    max_messages: Annotated[int, Field(ge=1, le=100_000)] = 2000
    mac: Literal["continuous", "tdma", "polled", "csma"] = "continuous"
    tx_burst_s: Seconds = 150.0
    rx_window_s: Annotated[float, Field(ge=0, le=86400)] = 5.0
    holdoff_s: Annotated[float, Field(ge=0, le=600)] = 5.0
    tdma_cycle_s: Seconds = 60.0
    slot_start_s: Annotated[float, Field(ge=0, le=86400)] = 0.0
    slot_s: Seconds = 20.0
    guard_s: Annotated[float, Field(ge=0, le=86400)] = 1.0
    mean_backoff_s: Annotated[float, Field(ge=0, le=86400)] = 10.0
    queue_interval_s: Annotated[float, Field(ge=0.05, le=3600)] = 5.0
    refine_consumers: tuple[ConsumerName, ...] = ("compressor",)
    revisit_consumers: tuple[ConsumerName, ...] = ()
    decision_consumers: tuple[ConsumerName, ...] = ()

    @model_validator(mode="after")
    def _packets_fit_the_slot(self) -> UuvModemConfig:
        if self.mac != "tdma":
            return self
        if self.slot_start_s + self.slot_s > self.tdma_cycle_s:
            raise ValueError(f"a slot that ends within tdma_cycle_s = {self.tdma_cycle_s}")
        longest_s = max(RATES[number].airtime_s for number in (self.rate, *self.allowed_rates))
        if self.slot_s - self.guard_s < longest_s:
            raise ValueError(f"slot_s - guard_s of at least {longest_s} s, the longest packet")
        return self

    def new_mac(self) -> MediumAccess:
        """Return the medium access control (MAC) policy."""
        match self.mac:
            case "continuous":
                return Continuous(self.tx_burst_s, self.rx_window_s, self.holdoff_s)
            case "tdma":
                return Tdma(self.tdma_cycle_s, self.slot_start_s, self.slot_s, self.guard_s)
            case "polled":
                return Polled()
            case "csma":
                return Csma(self.mean_backoff_s, holdoff_s=self.holdoff_s, seed=self.address)

    def queue_config(self) -> QueueConfig:
        """Return how the queue behaves."""
        return QueueConfig(
            rates=tuple(sorted({self.rate, *self.allowed_rates})),
            first_rate=self.rate,
            expected_loss=self.expected_loss,
            feedback=self.feedback,
            image_airtime_share=self.image_airtime_share,
            aging_s=self.aging_s,
            max_messages=self.max_messages,
            frames_per_image=self.frames_per_image,
            stream_bytes=self.stream_bytes,
            group_delay_s=self.group_delay_s,
        )
