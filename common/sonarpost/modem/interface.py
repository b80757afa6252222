"""Interface of a modem driver: what every driver can do, its events, and its rates.

A driver is sans-I/O: bytes from the port and the present time go in, events and bytes for the port come out. It does
no input or output and reads no clock; all times are seconds of one monotonic clock. Every wait is limited. A driver
accepts any bytes: those that it cannot read become `SentenceRejected`.

`src` and `dest` are modem addresses, `peer` is the address of the other modem, and `rate` is a key of
`ModemCapabilities.rates`; None where unknown. `packet_id` and `request_id` are the numbers returned when the packet or
request was queued. A driver may add events of its own, as subclasses of `ModemEvent`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from sonarpost.errors import ConfigError, FrameError, SentenceError

MAX_ADDRESS: Final = 255
"""Greatest modem address of any driver: the acoustic authentication has one byte for it."""
MAX_RATE: Final = 255
"""Greatest rate number of any driver."""
MAX_FRAMES: Final = 255
"""Greatest number of frames in a packet of any driver."""


@dataclass(frozen=True, slots=True)
class RateInfo:
    """One rate of a modem: the size of its packets and how long they take.

    Attributes:
        number: Number in configuration and records, 0..255; a modem with numbered rates uses its own numbers.
        modulation: Name of modulation and code.
        frames: Greatest number of frames in a packet. Each frame is received or lost by itself.
        frame_bytes: Greatest length of a frame.
        airtime_s: Nominal duration of a packet on the channel, however full its frames are.
        range_m: Nominal range in metres, None where the sources give none.
    """

    number: int
    modulation: str
    frames: int
    frame_bytes: int
    airtime_s: float
    range_m: float | None = None

    @property
    def packet_bytes(self) -> int:
        """Bytes in a packet with every frame full."""
        return self.frames * self.frame_bytes

    @property
    def throughput_bps(self) -> float:
        """Bits per second during a full packet."""
        return 8 * self.packet_bytes / self.airtime_s


@dataclass(frozen=True, slots=True)
class ModemCapabilities:
    """What a driver and its modem can do.

    Attributes:
        rates: Every rate by its number.
        uplink_rate: Rate of a vehicle whose configuration names none.
        downlink_rate: Rate of a vessel whose configuration names none.
        min_address: Least address of a modem.
        max_address: Greatest address of a modem, at most 255.
        broadcast: Destination address of all modems, None if the modem has no broadcast.
        acknowledgements: Whether `ack` requests acoustic acknowledgements of frames.
        ranging: Whether `ping` measures the travel time to another modem.
        polling: Whether `request_packet` polls another modem.
        short_messages: Whether the modem receives `ShortMessageReceived` between packets.
    """

    rates: Mapping[int, RateInfo]
    uplink_rate: int
    downlink_rate: int
    min_address: int = 0
    max_address: int = MAX_ADDRESS
    broadcast: int | None = None
    acknowledgements: bool = False
    ranging: bool = False
    polling: bool = False
    short_messages: bool = False

    def check_address(self, address: int, where: str, field: str = "address") -> None:
        """Check the address of a modem; `where` and `field` name it in the error.

        Raises:
            ConfigError: The modem does not have it.
        """
        if not self.min_address <= address <= self.max_address:
            raise ConfigError(where, field, address, f"{self.min_address}..{self.max_address}")

    def check_packet(self, destination: int, rate: int, frames: Sequence[bytes]) -> None:
        """Check a packet before it is queued.

        Raises:
            FrameError: An address, a rate or frames that the modem cannot send.
        """
        where = "packet to send"
        if not (self.min_address <= destination <= self.max_address or destination == self.broadcast):
            raise FrameError(where, "destination", destination, f"{self.min_address}..{self.max_address}")
        if rate not in self.rates:
            raise FrameError(where, "rate", rate, f"one of {sorted(self.rates)}")
        limit = self.rates[rate]
        if not 1 <= len(frames) <= limit.frames:
            raise FrameError(where, "frames", len(frames), f"1..{limit.frames} frames at rate {rate}")
        for number, frame in enumerate(frames, start=1):
            if len(frame) > limit.frame_bytes:
                expected = f"at most {limit.frame_bytes} bytes at rate {rate}"
                raise FrameError(where, f"length of frame {number}", len(frame), expected)


@dataclass(frozen=True, slots=True)
class ReceptionQuality:
    """Measurements of a received packet; None where the modem does not report a value.

    Attributes:
        snr_in_db: SNR at the receiver's input, dB.
        snr_out_db: SNR after equalisation, dB.
        spl_db: Sound pressure level, dB re 1 µPa.
        mse_db: Mean squared error of the equalizer, dB.
        doppler: Doppler, in the modem's own unit.
        nframes: Number of frames in the packet.
        nbad: Number of frames that failed their check.
    """

    snr_in_db: float | None = None
    snr_out_db: float | None = None
    spl_db: float | None = None
    mse_db: float | None = None
    doppler: float | None = None
    nframes: int | None = None
    nbad: int | None = None


@dataclass(frozen=True, slots=True)
class ModemEvent:
    """Base class of the events, which a driver returns in order of time."""


@dataclass(frozen=True, slots=True)
class ModemReady(ModemEvent):
    """The modem has confirmed its address and settings.

    Attributes:
        firmware: Version that the modem reported, or None.
    """

    address: int
    firmware: str | None


@dataclass(frozen=True, slots=True)
class ModemUnresponsive(ModemEvent):
    """The modem does not answer. Reported once until the next `ModemReady`; the driver keeps trying.

    Attributes:
        waiting_for: The command without a correct answer.
        attempts: How often it was sent.
        silent_s: Time since the last valid answer, None when there was none yet.
    """

    waiting_for: str
    attempts: int
    silent_s: float | None


@dataclass(frozen=True, slots=True)
class ModemRebooted(ModemEvent):
    """The modem has restarted; the driver configures it again."""

    firmware: str


@dataclass(frozen=True, slots=True)
class TransmissionStarted(ModemEvent):
    """The modem has begun to transmit: a packet, a request or an automatic reply.

    Attributes:
        airtime_s: Nominal duration.
    """

    airtime_s: float


@dataclass(frozen=True, slots=True)
class TransmissionEnded(ModemEvent):
    """The modem has ended a transmission. The report of its start may have been lost.

    Attributes:
        airtime_s: Nominal duration.
    """

    airtime_s: float


@dataclass(frozen=True, slots=True)
class TransmissionFailing(ModemEvent):
    """The modem answers, but several packets in a row have failed. Reported once until `TransmissionRecovered`.

    Attributes:
        failures: Number of failed packets and polls in a row.
        reason: Why the last one failed.
    """

    failures: int
    reason: str


@dataclass(frozen=True, slots=True)
class TransmissionRecovered(ModemEvent):
    """The modem transmits again.

    Attributes:
        failures: Number of packets and polls that failed before.
        failing_s: Time since the first of them.
    """

    failures: int
    failing_s: float


@dataclass(frozen=True, slots=True)
class RestartRequested(ModemEvent):
    """The driver has sent the command to restart, because the modem does not transmit."""


@dataclass(frozen=True, slots=True)
class CarrierSenseIgnored(ModemEvent):
    """The modem has reported a busy channel for too long; the driver transmits in spite of it.

    Attributes:
        busy_s: How long the channel has been busy without a pause.
    """

    busy_s: float


@dataclass(frozen=True, slots=True)
class CarrierSenseRestored(ModemEvent):
    """The modem reports a free channel again, and the driver defers to receptions.

    Attributes:
        busy_s: How long the channel was busy without a pause.
    """

    busy_s: float


@dataclass(frozen=True, slots=True)
class SettingUnconfirmed(ModemEvent):
    """The modem did not confirm an optional setting or the clock; the driver continues without."""

    command: str


@dataclass(frozen=True, slots=True)
class ModemError(ModemEvent):
    """The modem has reported an error.

    Attributes:
        text: The report as the modem gave it.
    """

    text: str


@dataclass(frozen=True, slots=True)
class SentenceRejected(ModemEvent):
    """Bytes from the port that are not a valid message of the modem, or a message with a wrong field."""

    error: SentenceError


@dataclass(frozen=True, slots=True)
class PacketSent(ModemEvent):
    """A packet was transmitted.

    Attributes:
        acknowledged: Numbers (from 1) of the frames that the far modem has acknowledged; empty without `ack`.
        started_s: Start of the transmission's commands.
        finished_s: End of the transmission, acknowledgements included.
        end_reported: Whether the modem has reported the end of the transmission. If not, it has accepted the data, the
            air time has passed, and the modem answers.
    """

    packet_id: int
    dest: int
    rate: int
    frames: tuple[bytes, ...]
    acknowledged: tuple[int, ...]
    started_s: float
    finished_s: float
    end_reported: bool = True


@dataclass(frozen=True, slots=True)
class PacketFailed(ModemEvent):
    """A packet was not transmitted, or the driver cannot determine whether it was.

    Attributes:
        reason: Text for people; a driver may use a StrEnum.
        maybe_sent: Whether all or part of it may have been transmitted.
    """

    packet_id: int
    dest: int
    rate: int
    frames: tuple[bytes, ...]
    reason: str
    maybe_sent: bool


@dataclass(frozen=True, slots=True)
class FrameReceived(ModemEvent):
    """One good frame. A modem may have padded the data of a short frame.

    Attributes:
        dest: Destination address, possibly of another modem.
        frame_number: From 1.
        received_s: Time of reception.
        statistics: Measurements of its packet, None when the modem did not report them.
    """

    src: int
    dest: int
    ack: bool
    frame_number: int
    data: bytes
    received_s: float
    rate: int | None
    statistics: ReceptionQuality | None


@dataclass(frozen=True, slots=True)
class FrameDecoded(ModemEvent):
    """A good frame of a packet that may not be complete yet, so that it can be stored at once.

    The same frame follows as `FrameReceived` at the end of its packet.
    """

    frame: FrameReceived


@dataclass(frozen=True, slots=True)
class PacketReceived(ModemEvent):
    """The end of a received packet; its `FrameReceived` events come just before.

    Attributes:
        bad_frames: Number of frames that the modem reported as damaged.
        nframes: Number of frames in the packet, None when unknown.
        statistics: None when the modem did not report them.
        complete: Whether all announced frames were received and the modem reported the end of the packet.
    """

    frames: tuple[FrameReceived, ...]
    bad_frames: int
    nframes: int | None
    src: int | None
    dest: int | None
    rate: int | None
    statistics: ReceptionQuality | None
    complete: bool


@dataclass(frozen=True, slots=True)
class RangeMeasured(ModemEvent):
    """The answer of `src` to a ping of `dest`.

    Attributes:
        travel_s: One-way travel time, None where the modem did not report it.
    """

    src: int
    dest: int
    travel_s: float | None


@dataclass(frozen=True, slots=True)
class ShortMessageReceived(ModemEvent):
    """A few bits that a modem carries outside its packets.

    Attributes:
        bits: 0..0x1FFF.
    """

    src: int
    dest: int
    bits: int


@dataclass(frozen=True, slots=True)
class RequestDone(ModemEvent):
    """A request other than a packet is complete: a ping was answered, a polled modem has sent its packet.

    Attributes:
        kind: "ping", "poll", or a kind of the driver's own.
    """

    request_id: int
    kind: str
    peer: int


@dataclass(frozen=True, slots=True)
class RequestFailed(ModemEvent):
    """A request failed; it may have been transmitted."""

    request_id: int
    kind: str
    peer: int
    reason: str


@dataclass(frozen=True, slots=True)
class PollReceived(ModemEvent):
    """Another modem requests a packet of at most `frames` frames; `PacketSent` or `PacketFailed` reports the result."""

    dest: int
    rate: int
    frames: int
    frame_bytes: int
    ack: bool


PollHandler = Callable[[PollReceived], Sequence[bytes]]
"""Returns the frames for a poll. It is called inside `receive` and must not call the driver."""


class Modem(Protocol):
    """A driver of one modem. Drivers name this class as their base: the last three methods have defaults."""

    @property
    def capabilities(self) -> ModemCapabilities:
        """What the driver and its modem can do."""

    @property
    def ready(self) -> bool:
        """Whether the modem is configured and, as far as known, answers."""

    @property
    def queued(self) -> int:
        """Number of packets and requests that are queued or in progress."""

    @property
    def receiving(self) -> bool:
        """Whether a packet is being received, as far as known."""

    def port_opened(self, now: float) -> None:
        """Configure the modem: the port was opened, possibly again."""

    def port_lost(self, now: float) -> None:
        """Fail what is in progress and return received frames; queued packets wait for the next port."""

    def receive(self, data: bytes, now: float) -> list[ModemEvent]:
        """Process bytes from the port, in parts of any size; a datagram is one part. Invalid bytes give events."""

    def poll(self, now: float) -> list[ModemEvent]:
        """Do what is due; call at `next_wakeup` or at any other time."""

    def next_wakeup(self) -> float | None:
        """Return when `poll` has something to do, or None; a time in the past means immediately."""

    def bytes_to_send(self) -> bytes:
        """Remove and return bytes for one write to the port; call until the result is empty."""

    def send_packet(
        self, destination: int, rate: int, frames: Sequence[bytes], *, ack: bool = False, now: float
    ) -> int:
        """Queue a packet and return its number, which its `PacketSent` or `PacketFailed` carries.

        Args:
            destination: Address of the receiving modem, or the broadcast address.
            rate: A rate number.
            frames: At least one, at most as many and as long as the rate allows; an empty frame is allowed.
            ack: Request acoustic acknowledgements and wait for them; ignored without this capability.
            now: Time on the driver's clock.

        Raises:
            FrameError: See `ModemCapabilities.check_packet`.
        """

    def ping(self, destination: int, now: float) -> int:
        """Queue a ping and return its number; `RangeMeasured` carries the travel time, then `RequestDone` follows.

        Raises:
            FrameError: The modem does not measure ranges, or an address that it does not have.
        """
        raise FrameError("modem", "ping", destination, "a modem that measures ranges")

    def request_packet(
        self, source: int, rate: int, frames: int | None = None, *, ack: bool = False, now: float
    ) -> int:
        """Queue a poll: another modem is requested to send a packet. `RequestDone` follows the received packet.

        Raises:
            FrameError: The modem does not poll, or an address, a rate or frames that it cannot request.
        """
        raise FrameError("modem", "poll", source, "a modem that polls")

    def set_poll_handler(self, handler: PollHandler | None) -> None:
        """Set the function that returns the frames when another modem polls this one; no effect without polling."""
