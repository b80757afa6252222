"""The vessel's link endpoint in terms of records: commands in, image and state records out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from sonarpost.codec.region import RegionBox
from sonarpost.errors import FrameError, PayloadError
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.merging import FrameMerger
from sonarpost.link.downlink import messages as dl
from sonarpost.link.downlink.commands import MAX_PENDING, CommandTracker, PendingCommand
from sonarpost.link.downlink.vessel_endpoint import VesselEndpoint
from sonarpost.link.frames.v1.frame import segments_room
from sonarpost.link.receiver import ImageUpdate, received_image
from sonarpost.link.state import Parts, below, prefixed
from sonarpost.messages import Command, CommandKind, Decision, DownlinkState, ReceivedImage
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.image_limiter import ImageLimiter

_LINK, _AUTHENTICATION, _LIMITS, _MERGING = "link/", "authentication/", "limits/", "merging/"
_MESSAGE_OVERHEAD_BYTES = 3  # kind, length and number of a message segment
LATEST_UTC_S = 2**32 - 1


class VesselLink:
    """The endpoint with its commands and its authentication. Not thread-safe.

    Args:
        vessel_id: Name of the vessel in records.
        config: Configuration of op_modem.
        authenticator: Authenticates frames; None without a key.
        authenticated_since_s: UTC in seconds; an image whose first frame is older counts as unauthenticated.
        merger: Merges the frames of `other_vessels`; None without any.
    """

    def __init__(
        self,
        vessel_id: str,
        config: OpModemConfig,
        authenticator: FrameAuthenticator | None = None,
        authenticated_since_s: float = 0.0,
        merger: FrameMerger | None = None,
    ) -> None:
        self._vessel_id = vessel_id
        self._config = config
        self.authenticator = authenticator
        self._merger = merger
        self._authenticated_since_s = authenticated_since_s
        self.limiter = ImageLimiter(
            config.max_images_per_hour, config.max_image_bytes_per_hour, frozenset(config.vehicles.values())
        )
        self.commands = CommandTracker(config.retry_s)
        self.endpoint = VesselEndpoint(
            self.commands,
            config.receiver_config(),
            protection=authenticator,
            merger=merger,
            feedback=config.feedback and config.transmits,
            wire_formats=config.wire_formats,
            pairing_timeout_s=config.pairing_timeout_s,
        )

    def check(self, record: Command | Decision, where: str) -> None:
        """Reject a record that can never be sent.

        Raises:
            PayloadError: The modem address of the vehicle is unknown, the time does not fit the link, or too many
                of its commands are open.
        """
        address = self._config.address_of(record.vehicle_id)
        if address is None:
            raise PayloadError(where, "vehicle_id", record.vehicle_id, "a vehicle of [op_modem] vehicles")
        issued = _issued_utc_s(record)
        if issued > LATEST_UTC_S:
            raise PayloadError(where, "time", issued, f"a time to {LATEST_UTC_S} s")
        if self.commands.is_full(address):
            raise PayloadError(where, "", f"{MAX_PENDING} open commands", "one at most fewer")

    def add(self, record: Command | Decision, now: float) -> PendingCommand | None:
        """Add a command or a decision; return None if it was added before.

        Raises:
            FrameError: It does not fit a frame.
            PayloadError: See `check`.
        """
        kind = record.kind if isinstance(record, Command) else "decision"
        record_id = record.command_id if isinstance(record, Command) else record.decision_id
        if self.commands.find(kind, record_id) is not None:
            return None
        self.check(record, f"{kind} {record_id}")
        address = self._config.address_of(record.vehicle_id)
        assert address is not None
        token = self.commands.free_token(kind, record_id)
        message = dl.pack(message_of(record, token), self._message_bytes)
        # The lifetime begins now if the clock of the sender is ahead of this one.
        expires_at = min(_issued_utc_s(record), now) + self._config.command_lifetime_s
        command = PendingCommand(kind, record_id, record.vehicle_id, address, token, message, now, expires_at)
        return self.commands.add(command, now)

    @property
    def _message_bytes(self) -> int:
        """Maximum length of a message in one frame."""
        frame_bytes = self._config.rate_info(self._config.downlink_rate).frame_bytes
        return min(255, segments_room(frame_bytes, self.authenticator)) - _MESSAGE_OVERHEAD_BYTES

    def state_record(self, command: PendingCommand, now: float) -> DownlinkState:
        """Return the record of a command's progress."""
        return DownlinkState.model_validate(
            {
                "vessel_id": self._vessel_id,
                "vehicle_id": command.vehicle,
                "kind": command.kind,
                "record_id": command.record_id,
                "state": str(command.state),
                "times_sent": command.times_sent,
                "expires_utc_s": max(0.0, command.expires_s),
                "changed_utc_s": now,
                "reason": command.reason,
            }
        )

    def image_record(self, update: ImageUpdate) -> ReceivedImage:
        """Return the record of an image's received content."""
        authenticated = self.authenticator is not None and update.first_frame_s >= self._authenticated_since_s
        return received_image(update, self._vessel_id, self._config.name_of(update.source), authenticated=authenticated)

    def gauges(self) -> dict[str, float]:
        """Return the state of commands, images and authentication."""
        endpoint = self.endpoint
        gauges = {
            "commands_open": float(len(self.commands.open_commands)),
            "images_incomplete": float(endpoint.incomplete_images),
            "images_waiting": float(endpoint.next_deadline() is not None),
            "images_held": float(self.limiter.held),
        }
        if self.authenticator is not None:
            counts = self.authenticator.counts
            gauges |= {"frames_forged": float(counts.forged), "frames_replayed": float(counts.replayed)}
            gauges |= {
                "frames_genuine": float(counts.genuine),
                "key_frames_left": float(self.authenticator.frames_left),
            }
        if self._merger is not None:
            merged = endpoint.v1.counts
            gauges |= {"frames_duplicate": float(merged.duplicates), "frames_late": float(merged.late)}
        return gauges

    def parts(self) -> dict[str, bytes]:
        """Return the state to save, see `sonarpost.link.state`."""
        parts = {**prefixed(_LINK, self.endpoint.parts()), **prefixed(_LIMITS, self.limiter.parts())}
        if self.authenticator is None:
            return parts
        if self._merger is not None:
            parts |= prefixed(_MERGING, self._merger.parts())
        return {**parts, **prefixed(_AUTHENTICATION, self.authenticator.parts())}

    def restore(self, parts: Parts) -> dict[str, FrameError]:
        """Replace the state by saved parts; return why parts were skipped. The state of another key is ignored."""
        errors = prefixed(_LINK, self.endpoint.restore(below(_LINK, parts)))
        errors |= prefixed(_LIMITS, self.limiter.restore(below(_LIMITS, parts)))
        if self.authenticator is not None:
            errors |= prefixed(_AUTHENTICATION, self.authenticator.restore(below(_AUTHENTICATION, parts)))
        if self._merger is not None:
            errors |= prefixed(_MERGING, self._merger.restore(below(_MERGING, parts)))
        return errors


_NUMBER_MESSAGES: Final[Mapping[CommandKind, type[dl.ResendMessage | dl.ExpandMessage | dl.OriginalMessage]]] = {
    "resend": dl.ResendMessage,
    "expand": dl.ExpandMessage,
    "original": dl.OriginalMessage,
}
"""Messages that have only the number of the contact."""


def message_of(record: Command | Decision, token: int) -> dl.DownlinkCommand:
    """Return the acoustic message of a record.

    Raises:
        FrameError: A field does not fit.
    """
    issued = int(_issued_utc_s(record))
    if isinstance(record, Decision):
        number = dl.number_of_image(record.image_id)
        return dl.DecisionMessage(
            token, issued, number, record.image_version, record.verdict, record.confidence, record.mlo_class or ""
        )
    if record.kind == "revisit":
        assert record.lat_deg is not None
        assert record.lon_deg is not None
        return dl.RevisitMessage(token, issued, record.lat_deg, record.lon_deg)
    assert record.image_id is not None
    number = dl.number_of_image(record.image_id)
    if record.kind == "region":
        assert record.box is not None
        assert record.stream_bytes is not None
        return dl.RegionMessage(token, issued, number, RegionBox(*record.box), record.stream_bytes)
    if record.kind == "prioritise":
        assert record.place is not None
        return dl.PrioritiseMessage(token, issued, number, record.place)
    if record.kind == "refine":
        return dl.RefineMessage(token, issued, number)
    return _NUMBER_MESSAGES[record.kind](token, issued, number)


def _issued_utc_s(record: Command | Decision) -> float:
    return record.decided_utc_s if isinstance(record, Decision) else record.issued_utc_s
