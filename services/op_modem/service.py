"""op_modem: receives the vehicles' frames, assembles images from them, and sends commands and feedback."""

from __future__ import annotations

import logging
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager

from typing_extensions import override

from sonarpost import keys
from sonarpost.config import PlatformConfig
from sonarpost.delivery.queue_sender import QueuePolicy
from sonarpost.delivery.store import Store
from sonarpost.errors import PayloadError
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import Direction
from sonarpost.link.auth.merging import FrameMerger
from sonarpost.link.downlink.commands import PendingCommand
from sonarpost.logs import kv
from sonarpost.messages import AcousticFrame, Command, Decision, ReceivedMessage, Record
from sonarpost.modem.interface import (
    FrameDecoded,
    ModemEvent,
    PacketFailed,
    PacketReceived,
    PacketSent,
    RangeMeasured,
    RequestDone,
    RequestFailed,
)
from sonarpost.runtime.modem_service import ServiceModem
from sonarpost.runtime.saved_endpoint import SavedEndpoint, stored_authenticator
from sonarpost.runtime.service import Service, UnitOfWork
from sonarpost.security.acoustic_key import key_warning
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.reception import Reception
from sonarpost.services.op_modem.transmission import VesselTransmitter
from sonarpost.services.op_modem.vessel_endpoint import VesselLink

log = logging.getLogger(__name__)

_PARTS = "vehicle/"
_AUTHENTICATED_SINCE = "authenticated-since"
_UNFINISHED_BLOCKS = ("link/v1/block", "link/v1/rival")
TICK_S = 0.1
SAVE_RETRY_S = 1.0


class OpModemService(Service[OpModemConfig]):
    """The vessel's end of the acoustic link.

    The service processes every frame that the modem delivers. It sends the coded content of each image to
    `image_consumers`, again after more of it arrived. One commit follows from each packet, received or sent. The frames
    of an unfinished packet are in memory only: a kill loses them, as the water would.

    A vessel with a `lead_vessel` also sends the frames that it accepted to that vessel. The lead vessel processes the
    frames of `other_vessels` as its own.

    With `link = "v1"` the service also sends commands, decisions and feedback to the vehicles.

    Attributes:
        modem: The modem.

    Raises:
        ConfigError: See `OpModemConfig.check_with`.
    """

    NAME = "op_modem"
    PAGE_BYTES = 512

    def __init__(self, platform: PlatformConfig, config: OpModemConfig) -> None:
        # Before the store is opened, so that a configuration error leaves no open store.
        config = config.for_platform(platform)
        super().__init__(platform, config)
        self.modem = ServiceModem(self, self.on_modem_event)
        is_authenticated = self.modem.key is not None
        self._authenticated_since_s = _begin_authentication(self.store, is_authenticated=is_authenticated)
        self._link = SavedEndpoint(self.store, _PARTS, self._new_link)
        self._transmitter = VesselTransmitter(self, self._link, self.modem)
        self._reception = Reception(self, self._link, self._transmitter.publish_states, authenticated=is_authenticated)
        # What the record in `handle` has changed, to publish after the commit.
        self._changed_commands: tuple[PendingCommand, ...] = ()
        self._merged_messages: list[ReceivedMessage] = []

    def _new_link(self) -> VesselLink:
        authenticator, merger, key = None, None, self.modem.key
        if key is not None:
            address = self.config.address
            authenticator = stored_authenticator(self.store, key, address, Direction.TO_VEHICLE)
            if self.config.other_vessels:
                verifiers = {
                    vessel: FrameAuthenticator(key, address, Direction.TO_VEHICLE)
                    for vessel in self.config.other_vessels
                }
                merger = FrameMerger(authenticator, verifiers)
        return VesselLink(self.platform.id, self.config, authenticator, self._authenticated_since_s, merger)

    @override
    def on_start(self) -> None:
        """Publish the states of open commands, and open the port."""
        with self._link.step() as link:
            open_commands = link.commands.open_commands
        if self.config.transmits:
            self._transmitter.publish_states(open_commands)
        self.modem.start()
        self.start_thread(self._run, "link")

    @override
    def on_stop(self) -> None:
        """Close the port and process the packets in memory."""
        self.modem.stop()
        self._reception.process()
        self._reception.log_rejections()
        if unsaved := self._reception.unsaved:
            log.error("Packets lost: the disk rejected them until the stop", extra=kv(packets=unsaved))

    def _run(self) -> None:
        next_report_s = 0.0
        while not self.stopping.wait(SAVE_RETRY_S if self._reception.error else TICK_S):
            self._reception.process()
            self._transmitter.transmit()
            if time.monotonic() >= next_report_s:
                self._reception.log_rejections()
                next_report_s = time.monotonic() + self.platform.health_interval_s

    def on_modem_event(self, event: ModemEvent) -> None:
        """Process a received packet, or record the end of a transmission; called in the modem's thread."""
        match event:
            case PacketSent() | PacketFailed():
                self._transmitter.packet_ended(event)
            case RangeMeasured() | RequestDone() | RequestFailed():
                self._transmitter.range_event(event)
            case FrameDecoded():
                self._transmitter.frame_received(ends_packet=False)
            case PacketReceived():
                self._transmitter.frame_received(ends_packet=True)
                self._reception.packet_received(event)
            case _:
                pass

    # Commands, and frames of other vessels

    @override
    def consumed_keys(self) -> Mapping[str, type[Record]]:
        """Return commands and decisions for vehicles if the vessel transmits, and the frames of other vessels."""
        found: dict[str, type[Record]] = {}
        if self.config.transmits:
            found = {keys.command_all(self.platform.id): Command, keys.contact_decision(self.platform.id): Decision}
        return {**found, **dict.fromkeys(self.delivery_only_keys(), AcousticFrame)}

    @override
    def delivery_only_keys(self) -> Collection[str]:
        """Return the keys of the frames of other vessels."""
        return [keys.vessel_frames(self.platform.id, vessel) for vessel in self.config.other_vessels]

    @override
    def queue_policy(self, queue: str) -> QueuePolicy:
        """Return that frames for the lead vessel are not published, and leave the platform."""
        is_local = queue != self.NAME
        return QueuePolicy(publish=self.PUBLISH and is_local, is_local=is_local)

    @override
    def validate(self, key: str, record: Record) -> None:
        """Reject a record that can never be sent, or a frame that the vessel in its key did not receive."""
        if isinstance(record, AcousticFrame):
            self._check_frame(key, record)
            return
        assert isinstance(record, (Command, Decision))
        if isinstance(record, Command) and key != keys.command(self.platform.id, record.kind):
            raise PayloadError(key, "kind", record.kind, "the kind in the key")
        if isinstance(record, Decision) and record.vessel_id != self.platform.id:
            raise PayloadError(key, "vessel_id", record.vessel_id, self.platform.id)
        # Without the lock: this runs inside a transaction, and the holder of the lock may be waiting for one.
        self._link.current.check(record, key)

    def _check_frame(self, key: str, record: AcousticFrame) -> None:
        vessel = keys.frames_vessel(key)
        if record.platform_id != vessel:
            raise PayloadError(key, "platform_id", record.platform_id, vessel)
        if record.direction != "rx":
            raise PayloadError(key, "direction", record.direction, "rx")
        modem = self.config.capabilities
        if not modem.min_address <= record.source <= modem.max_address:
            raise PayloadError(key, "source", record.source, f"{modem.min_address}..{modem.max_address}")

    @override
    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Add a command or a decision, or process a frame of another vessel; a repeated command changes nothing."""
        with self._link.step() as link:
            if isinstance(record, AcousticFrame):
                self._merged_messages, self._changed_commands = self._reception.merge(record, effects)
                return
            assert isinstance(record, (Command, Decision))
            command = link.add(record, time.time())
            effects.count("commands_repeated" if command is None else "commands_received")
            self._changed_commands = () if command is None else (command,)

    @override
    @contextmanager
    def handling(self, *, wait: bool = True) -> Iterator[bool]:
        """Enclose the handling in a step of the endpoint; then publish what has changed."""
        self._merged_messages, self._changed_commands = [], ()
        with self._link.step(), super().handling(wait=wait) as is_held:
            yield is_held
        self._reception.publish_messages(self._merged_messages)
        self._transmitter.publish_states(self._changed_commands)

    @override
    def further_effects(self) -> Sequence[UnitOfWork]:
        """Return the changes of the endpoint; called in its step."""
        return (self._link.changes(),)

    # Health

    @override
    def gauges(self) -> Mapping[str, float]:
        """Return the state of the modem, of the packets in memory, of the link and of its authentication."""
        with self._link.lock:
            feedback_open = max(self._link.current.endpoint.feedback_open, self._transmitter.has_feedback_in_flight)
            link = {**self._link.current.gauges(), "feedback_open": float(feedback_open)}
        return {**self.modem.gauges(), **self._reception.gauges(), **link}

    @override
    def warning(self) -> str:
        """Return what concerns the modem and the key of the link, and which vehicles exceed their limits."""
        with self._link.lock:
            link = self._link.current
            names = ", ".join(link.limiter.held_names)
        limits = f"images wait, max_images_per_hour or max_image_bytes_per_hour is reached: {names}" if names else ""
        return "; ".join(text for text in (self.modem.warning(), key_warning(link.authenticator), limits) if text)

    @override
    def degraded_reason(self) -> str:
        """Return why the store, the port, the modem or the transmission does not work."""
        return self._reception.error or self.modem.degraded_reason() or self._transmitter.error


def _begin_authentication(store: Store, *, is_authenticated: bool) -> float:
    """Return the time from which on the store holds content of authenticated frames only, UTC in seconds.

    When authentication is switched on, the symbols of unfinished blocks are deleted: together with later frames they
    would make images of which a part is not authenticated. Images that have begun are kept; their records say that they
    are not authenticated.
    """
    saved_s = store.read_state(_AUTHENTICATED_SINCE, float, None)
    if is_authenticated and saved_s is not None:
        return saved_s
    with store.transaction() as tx:
        if not is_authenticated:
            tx.delete_state(_AUTHENTICATED_SINCE)
            return 0.0
        names = store.state_names(_PARTS)
        since_s = time.time() if names else 0.0
        for name in names if since_s else ():
            if name.removeprefix(_PARTS).startswith(_UNFINISHED_BLOCKS):
                tx.delete_state(name)
        tx.put_state(_AUTHENTICATED_SINCE, str(since_s).encode())
    return since_s
