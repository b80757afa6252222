"""The modem of a service: its configuration, and its state in health and log."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Annotated, ClassVar, Self, TypeVar

from pydantic import Field, PrivateAttr, model_validator
from typing_extensions import override

from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.errors import ConfigError
from sonarpost.logs import kv
from sonarpost.messages import AcousticFrame, Address
from sonarpost.modem import interface as ev
from sonarpost.modem.interface import ModemCapabilities, ModemEvent, PacketSent, RateInfo
from sonarpost.modem.registry import ModemSettings, modem_driver
from sonarpost.runtime.modem_port import open_modem_port
from sonarpost.runtime.modem_runner import ModemRunner
from sonarpost.runtime.service import Service
from sonarpost.security.acoustic_key import UNAUTHENTICATED, link_key

log = logging.getLogger(__name__)

Seconds = Annotated[float, Field(gt=0, le=86400)]


class ModemServiceConfig(ServiceConfig):
    """Configuration of a service with a modem.

    Attributes:
        port: Any pyserial URL: /dev/ttyUSB0, socket://host:port, rfc2217://host:port; or udp://group:port.
        baud: Bit rate of the serial line.
        address: The modem's own address, set at start-up.
        reply_timeout_s: Time to wait for the modem's reply before a command is sent again.
        max_carrier_sense_s: Longest time for which a busy channel delays a packet; some times the longest packet.
        mac: Medium access control.
        holdoff_s: Time without a packet of this station after a frame of another one.
        tdma_cycle_s: TDMA: length of the cycle of slots; cycles begin at multiples of it since 1970-01-01 UTC.
        tdma_slot_s: TDMA: start and end of this station's slot in the cycle. Leave time between the slots of two
            stations for the travel time and the difference between clocks.
    """

    TABLE: ClassVar[str] = ""
    """Name of the table in errors."""
    UPLINK_RATES: ClassVar[tuple[str, ...]] = ()
    """Keys whose default is the driver's uplink rate."""
    DOWNLINK_RATES: ClassVar[tuple[str, ...]] = ()
    """Keys whose default is the driver's downlink rate."""

    port: Annotated[str, Field(min_length=1)]
    baud: Annotated[int, Field(ge=300, le=4_000_000)] = 19200
    address: Address
    reply_timeout_s: Annotated[float, Field(gt=0, le=600)] = 5.0
    max_carrier_sense_s: Annotated[float, Field(gt=0, le=3600)] = 30.0
    mac: str = "csma"
    holdoff_s: Annotated[float, Field(ge=0, le=86400)] = 5.0
    tdma_cycle_s: Seconds = 60.0
    tdma_slot_s: tuple[Annotated[float, Field(ge=0)], float] = (0.0, 19.0)
    _capabilities: ModemCapabilities | None = PrivateAttr(default=None)

    @model_validator(mode="after")
    def _check_slot(self) -> Self:
        start_s, end_s = self.tdma_slot_s
        if self.mac == "tdma" and not start_s < end_s <= self.tdma_cycle_s:
            raise ValueError(f"a tdma_slot_s that ends after its start and within tdma_cycle_s = {self.tdma_cycle_s}")
        return self

    @override
    def check_with(self, platform: PlatformConfig) -> None:
        """Check the driver, the kind of the port and the acoustic key.

        Raises:
            ConfigError: Unknown driver, an address or rate that its modem does not have, unsupported kind of URL, no
                acoustic key is configured, or its file cannot be read or is not private to its owner.
        """
        self.for_modem(modem_driver(platform.modem.driver).capabilities)
        open_modem_port(self.port, self.baud)
        link_key(platform)

    def for_platform(self, platform: PlatformConfig) -> Self:
        """Return this table for the modem of a platform, completely checked; see `for_modem`.

        Raises:
            ConfigError: See `check_with`.
        """
        self.check_with(platform)
        return self.for_modem(modem_driver(platform.modem.driver).capabilities)

    @property
    def capabilities(self) -> ModemCapabilities:
        """What the modem can do; that of the default driver before `for_modem`."""
        return self._capabilities or modem_driver().capabilities

    def rate_info(self, number: int) -> RateInfo:
        """Return a rate of the modem.

        Raises:
            KeyError: The modem does not have it; `for_modem` has checked those of the configuration.
        """
        return self.capabilities.rates[number]

    def for_modem(self, capabilities: ModemCapabilities) -> Self:
        """Return this table for a modem: rates that the file does not set have the default of its driver.

        Raises:
            ConfigError: An address or a rate that the modem does not have.
        """
        defaults = dict.fromkeys(self.UPLINK_RATES, capabilities.uplink_rate)
        defaults |= dict.fromkeys(self.DOWNLINK_RATES, capabilities.downlink_rate)
        unset = {name: rate for name, rate in defaults.items() if name not in self.model_fields_set}
        table = self.model_copy(update=unset)
        table._capabilities = capabilities  # noqa: SLF001 - an object of this class
        table._check_modem(capabilities)  # noqa: SLF001 - an object of this class
        return table

    def _check_modem(self, capabilities: ModemCapabilities) -> None:
        """Check the keys that depend on the modem.

        Raises:
            ConfigError: See `for_modem`.
        """
        for name in (*self.UPLINK_RATES, *self.DOWNLINK_RATES):
            self._check_rate(name, getattr(self, name))
        self._check_address("address", self.address)

    def _check_packet(self, packet_s: float) -> None:
        """Check that a packet of a length fits the slot."""
        start_s, end_s = self.tdma_slot_s
        if self.mac == "tdma" and end_s - start_s < packet_s:
            expected = f"a slot of at least {packet_s} s, the longest packet"
            raise ConfigError(self.TABLE, "tdma_slot_s", self.tdma_slot_s, expected)

    def _check_rate(self, name: str, rate: int) -> None:
        if rate not in self.capabilities.rates:
            raise ConfigError(self.TABLE, name, rate, f"one of {sorted(self.capabilities.rates)}")

    def _check_address(self, name: str, address: int) -> None:
        self.capabilities.check_address(address, self.TABLE, name)


M = TypeVar("M", bound=ModemServiceConfig)


class ServiceModem(ModemRunner):
    """The modem of a service: logs, counts and reports what happens to it.

    Attributes:
        key: Authenticates acoustic frames; None with `acoustic_auth = "none"`.

    Args:
        service: The service; its configuration has passed `for_platform`.
        on_event: Called with each event of the driver, in the thread of the modem.
    """

    def __init__(self, service: Service[M], on_event: Callable[[ModemEvent], None]) -> None:
        config, platform = service.config, service.platform
        port = open_modem_port(config.port, config.baud)
        settings = ModemSettings(config.address, config.reply_timeout_s, config.max_carrier_sense_s, port.STREAM)
        driver = modem_driver(platform.modem.driver).create(settings, config.port)
        super().__init__(driver, port, self.report)
        self.key = link_key(platform)
        self._url = config.port
        self._on_service_event = on_event
        self._count = service.count
        self._error = f"{config.port}: no reply from the modem yet"
        self._transmit_failure = ""
        self._carrier_warning = ""
        self._report_warning = ""
        self._rejected_lines = service.interval_log(log, logging.WARNING, "Line from the modem rejected")
        self._modem_errors = service.interval_log(log, logging.WARNING, "Modem reports an error")
        self._unreported_packets = service.interval_log(
            log, logging.WARNING, "Modem does not report the end of a transmission; the air time is used"
        )
        self._ignored_receptions = service.interval_log(
            log, logging.WARNING, "Modem reports a busy channel without a pause; transmitting"
        )

    @override
    def start(self) -> None:
        """Open the port, and log how acoustic frames are authenticated."""
        if self.key is None:
            log.warning("Acoustic link is unauthenticated", extra=kv(reason=UNAUTHENTICATED))
        else:
            log.info("Acoustic frames are authenticated", extra=kv(key_fingerprint=self.key.fingerprint))
        super().start()

    def gauges(self) -> dict[str, float]:
        """Return whether the modem is ready, and whether the link is unauthenticated."""
        return {
            "modem_ready": float(self.ready),
            "modem_driver_failures": float(self.failures),
            "unauthenticated": float(self.key is None),
        }

    def degraded_reason(self) -> str:
        """Return why the port or the modem does not work."""
        if not self._port.is_open:
            return f"{self._url}: {self._port.error or 'not open yet'}"
        if self.failure:
            return f"{self._url}: {self.failure}"
        return self._transmit_failure or ("" if self.ready else self._error)

    def warning(self) -> str:
        """Return what the modem reports wrongly. The gauge `unauthenticated` states that the link has no key."""
        return "; ".join(text for text in (self._carrier_warning, self._report_warning) if text)

    def report(self, event: ModemEvent) -> None:
        """Log, count and store for health an event of the driver, and pass it to the service."""
        match event:
            case ev.ModemReady():
                log.info("Modem ready", extra=kv(port=self._url, address=event.address, firmware=event.firmware))
            case ev.ModemUnresponsive():
                self._error = f"{self._url}: no valid reply to {event.waiting_for}"
                self._count("modem_unresponsive")
                log.error("Modem does not reply", extra=kv(port=self._url, waiting_for=event.waiting_for))
            case ev.ModemRebooted():
                self._count("modem_restarts")
                log.warning("Modem restarted", extra=kv(firmware=event.firmware))
            case ev.SettingUnconfirmed():
                log.warning("Modem did not confirm a setting", extra=kv(command=event.command))
            case ev.ModemError():
                self._count("modem_errors")
                self._modem_errors.log(error=event.text)
            case ev.SentenceRejected():
                self._count("sentences_rejected")
                self._rejected_lines.log(reason=str(event.error))
            case _:
                self._on_transmit_event(event)
        self._on_service_event(event)

    def _on_transmit_event(self, event: ModemEvent) -> None:
        """Log, count and store for health whether the modem transmits."""
        port = self._url
        match event:
            case ev.TransmissionFailing():
                self._transmit_failure = f"{port}: the modem does not transmit: {event.reason}"
                self._count("modem_transmit_failures")
                log.error(
                    "Modem does not transmit", extra=kv(port=port, failures=event.failures, reason=str(event.reason))
                )
            case ev.RestartRequested():
                self._count("modem_restarts_requested")
                log.warning("Restarting the modem", extra=kv(port=port))
            case ev.TransmissionRecovered():
                self._transmit_failure = ""
                log.info("Modem transmits again", extra=kv(port=port, failures=event.failures, after_s=event.failing_s))
            case ev.CarrierSenseIgnored():
                self._carrier_warning = f"{port}: the modem reports a busy channel without a pause"
                self._count("carrier_sense_ignored")
                self._ignored_receptions.log(port=port, busy_s=event.busy_s)
            case ev.CarrierSenseRestored():
                self._carrier_warning = ""
                log.info("Modem reports a free channel again", extra=kv(port=port, busy_s=event.busy_s))
            case ev.PacketSent():
                self._report_warning = ""
                if not event.end_reported:
                    self._report_warning = f"{port}: the modem does not report the end of transmissions"
                    self._count("packets_unreported")
                    self._unreported_packets.log(port=port)
            case _:
                pass


def sent_frames(
    platform_id: str, config: ModemServiceConfig, packet: PacketSent, number: int, sent_utc_s: float
) -> list[AcousticFrame]:
    """Return the records of the frames of a packet that was sent.

    Args:
        platform_id: Name of the platform.
        config: Its configuration.
        packet: The packet.
        number: Number of the packet on this platform.
        sent_utc_s: End of the packet.
    """
    return [
        AcousticFrame(
            direction="tx",
            platform_id=platform_id,
            time_utc_s=sent_utc_s,
            source=config.address,
            destination=packet.dest,
            rate=packet.rate,
            packet=number,
            frame_number=frame_number,
            frame_count=len(packet.frames),
            data=data,
            airtime_s=config.rate_info(packet.rate).airtime_s,
        )
        for frame_number, data in enumerate(packet.frames, start=1)
    ]
