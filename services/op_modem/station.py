"""The vessel's end of the v1 link with its records: what becomes an order, what becomes of one, what is kept."""

from __future__ import annotations

import msgpack

from sonarpost.errors import FrameError, PayloadError
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.downlink import messages as dl
from sonarpost.link.downlink.commands import MAX_PENDING, CommandTracker, PendingCommand
from sonarpost.link.downlink.vessel_endpoint import VesselEndpoint
from sonarpost.link.frames.v1.frame import segments_room
from sonarpost.messages import Command, Decision, DownlinkState
from sonarpost.modem.micromodem import RATES
from sonarpost.services.op_modem.config import OpModemConfig

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
        self.link = VesselEndpoint(book, config.receiver_config(), seal=seal, feedback=config.feedback)

    @property
    def book(self) -> CommandTracker:
        """The orders."""
        return self.link.book

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
        if len(self.book.open_orders) >= MAX_PENDING:
            raise PayloadError(where, "", f"{MAX_PENDING} open orders", "one at most fewer")

    def ask(self, record: Command | Decision, now: float) -> PendingCommand | None:
        """Take a command or a decision; None when it is known already.

        Raises:
            FrameError: It does not fit the link.
            PayloadError: As `check`.
        """
        kind = record.kind if isinstance(record, Command) else "decision"
        record_id = record.command_id if isinstance(record, Command) else record.decision_id
        if self.book.known(kind, record_id) is not None:
            return None
        self.check(record, f"{kind} {record_id}")
        address = self._config.address_of(record.vehicle_id)
        assert address is not None
        token = self.book.free_token(kind, record_id)
        message = dl.pack(order_of(record, token), self.message_room)
        # A clock ashore that is ahead of ours must not make an order last longer.
        expires_at = min(_issued_utc_s(record), now) + self._config.command_lifetime_s
        order = PendingCommand(kind, record_id, record.vehicle_id, address, token, message, now, expires_at)
        return self.book.ask(order, now)

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
                "expires_utc_s": max(0.0, order.expires_at),
                "changed_utc_s": now,
                "reason": order.reason,
            }
        )

    def snapshot(self) -> bytes:
        """Return what has to be kept."""
        state = {"link": self.link.snapshot(), "seal": None if self.seal is None else self.seal.snapshot()}
        return bytes(msgpack.packb(state))

    def restore(self, kept: bytes) -> None:
        """Take up what `snapshot` returned. The state of a seal with another key is left alone.

        Raises:
            FrameError: It did not return this.
        """
        try:
            state = msgpack.unpackb(kept, strict_map_key=False)
        except (ValueError, msgpack.exceptions.UnpackException) as error:
            raise FrameError("op_modem state", "", kept[:20], "msgpack") from error
        if not isinstance(state, dict) or not isinstance(state.get("link"), dict):
            raise FrameError("op_modem state", "link", kept[:20], "a map")
        self.link.restore(state["link"])
        seal = state.get("seal")
        if self.seal is not None and isinstance(seal, dict) and seal.get("key") == self.seal.snapshot()["key"]:
            self.seal.restore(seal)


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
