"""The vessel's end of the v1 link with its records: what becomes an order, what becomes of one, what is kept."""

from __future__ import annotations

import msgpack

from sonarpost.errors import FrameError, PayloadError
from sonarpost.link import migration
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.downlink import messages as dl
from sonarpost.link.downlink.commands import MAX_PENDING, CommandTracker, PendingCommand
from sonarpost.link.downlink.vessel_endpoint import VesselEndpoint
from sonarpost.link.frames.v1.frame import segments_room
from sonarpost.link.state import Parts, below, prefixed, unpack_plain
from sonarpost.messages import Command, Decision, DownlinkState
from sonarpost.modem.micromodem import RATES
from sonarpost.services.op_modem.config import OpModemConfig

_LINK, _AUTHENTICATION = "link/", "authentication/"
_MESSAGE_OVERHEAD_BYTES = 3  # kind, length and number of a message segment
LATEST_UTC_S = 2**32 - 1


class VesselStation:
    """Owns the link, its orders and its seal. Belongs to whoever holds the service's lock.

    Args:
        vessel_id: Name of the vessel in records.
        config: The service's.
        seal: Authenticates frames, if there is a key.
    """

    def __init__(self, vessel_id: str, config: OpModemConfig, seal: FrameAuthenticator | None = None) -> None:
        self._vessel_id = vessel_id
        self._config = config
        self.seal = seal
        book = CommandTracker(config.retry_s)
        self.link = VesselEndpoint(book, config.receiver_config(), protection=seal, feedback=config.feedback)

    @property
    def book(self) -> CommandTracker:
        """The orders."""
        return self.link.commands

    def check(self, record: Command | Decision, where: str) -> None:
        """Refuse what can never be sent.

        Raises:
            PayloadError: No modem address is known for the vehicle, the time does not fit the link, or there are too
                many orders.
        """
        if self._config.address_of(record.vehicle_id) is None:
            raise PayloadError(where, "vehicle_id", record.vehicle_id, "a vehicle of [op_modem] vehicles")
        issued = _issued_utc_s(record)
        if issued > LATEST_UTC_S:
            raise PayloadError(where, "time", issued, f"a time to {LATEST_UTC_S} s")
        if len(self.book.open_commands) >= MAX_PENDING:
            raise PayloadError(where, "", f"{MAX_PENDING} open orders", "one at most fewer")

    def ask(self, record: Command | Decision, now: float) -> PendingCommand | None:
        """Take a command or a decision; None when it is known already.

        Raises:
            FrameError: It does not fit the link.
            PayloadError: As `check`.
        """
        kind = record.kind if isinstance(record, Command) else "decision"
        record_id = record.command_id if isinstance(record, Command) else record.decision_id
        if self.book.find(kind, record_id) is not None:
            return None
        self.check(record, f"{kind} {record_id}")
        address = self._config.address_of(record.vehicle_id)
        assert address is not None
        token = self.book.free_token(kind, record_id)
        message = dl.pack(order_of(record, token), self.message_room)
        # A clock ashore that is ahead of ours must not make an order last longer.
        expires_at = min(_issued_utc_s(record), now) + self._config.command_lifetime_s
        order = PendingCommand(kind, record_id, record.vehicle_id, address, token, message, now, expires_at)
        return self.book.add(order, now)

    @property
    def message_room(self) -> int:
        """Bytes of a message in one frame."""
        frame_bytes = RATES[self._config.downlink_rate].frame_bytes
        return min(255, segments_room(frame_bytes, self.seal)) - _MESSAGE_OVERHEAD_BYTES

    def state_of(self, order: PendingCommand, now: float) -> DownlinkState:
        """Return the record of how far an order has come."""
        return DownlinkState.model_validate(
            {
                "vessel_id": self._vessel_id,
                "vehicle_id": order.vehicle,
                "kind": order.kind,
                "record_id": order.record_id,
                "state": str(order.state),
                "times_sent": order.times_sent,
                "expires_utc_s": max(0.0, order.expires_s),
                "changed_utc_s": now,
                "reason": order.reason,
            }
        )

    def parts(self) -> dict[str, bytes]:
        """Return what has to be kept."""
        parts = prefixed(_LINK, self.link.parts())
        return parts if self.seal is None else {**parts, **prefixed(_AUTHENTICATION, self.seal.parts())}

    def restore(self, parts: Parts) -> dict[str, FrameError]:
        """Take up what `parts` returned; return why parts were skipped. The state of another key is left alone."""
        errors = {_LINK + name: error for name, error in self.link.restore(below(_LINK, parts)).items()}
        if self.seal is not None:
            skipped = self.seal.restore(below(_AUTHENTICATION, parts))
            errors |= {_AUTHENTICATION + name: error for name, error in skipped.items()}
        return errors

    def restore_old(self, kept: bytes) -> None:
        """Take up the state of version 0.1.

        Raises:
            FrameError: It is none.
        """
        state = unpack_plain(dict, kept, "op_modem state")
        if not isinstance(state.get("link"), dict):
            raise FrameError("op_modem state", "link", kept[:20], "a map")
        parts = prefixed(_LINK, migration.endpoint_parts(msgpack.packb(state["link"])))
        if isinstance(state.get("seal"), dict):
            parts |= prefixed(_AUTHENTICATION, migration.authentication_parts(msgpack.packb(state["seal"])))
        self.restore(parts)


def order_of(record: Command | Decision, token: int) -> dl.DownlinkCommand:
    """Return what goes through the water.

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
    if record.kind == "refine":
        return dl.RefineMessage(token, issued, number)
    return (dl.ExpandMessage if record.kind == "wider" else dl.ResendMessage)(token, issued, number)


def _issued_utc_s(record: Command | Decision) -> float:
    return record.decided_utc_s if isinstance(record, Decision) else record.issued_utc_s
