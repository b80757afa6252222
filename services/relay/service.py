"""Carries what the vessel knows ashore, over a link that comes and goes."""

from __future__ import annotations

import time
from collections.abc import Mapping

from services.relay.config import RelayConfig
from sonarpost import keys
from sonarpost.errors import PayloadError
from sonarpost.messages import Decision, ReconstructedImage, Record, Relayed
from sonarpost.runtime.service import Effects, Service

# A decision is a few bytes that somebody waits for; a picture can wait behind it.
PRIORITIES: Mapping[type[Record], int] = {Decision: 2, ReconstructedImage: 6}


class RelayService(Service[RelayConfig]):
    """Takes the vessel's records and owes them to c2 on the shore until it has committed them."""

    NAME = "relay"
    # c2 shows accepted records to the shore's subscribers; a second copy would only load the radio link.
    PUBLISH = False

    def consumes(self) -> Mapping[str, type[Record]]:
        """Pictures and decisions of this vessel."""
        vessel = self.platform.id
        return {keys.image_reconstructed(vessel): ReconstructedImage, keys.contact_decision(vessel): Decision}

    def check(self, record: Record) -> None:
        """Refuse another vessel's record, which c2 would refuse in its turn."""
        assert isinstance(record, (ReconstructedImage, Decision))
        if record.vessel_id != self.platform.id:
            raise PayloadError(record.TYPE, "vessel_id", record.vessel_id, self.platform.id)

    def handle(self, key: str, record: Record, effects: Effects) -> None:
        """Put the record into an envelope for c2."""
        envelope = Relayed(vessel_id=self.platform.id, key=key, payload=effects.payload, relayed_utc_s=time.time())
        effects.send(keys.shore_inbox(self.platform.id), "c2", envelope, priority=PRIORITIES[type(record)])
        effects.count(f"{record.TYPE}s_relayed")

    def gauges(self) -> Mapping[str, float]:
        """Return how many records c2 has not acknowledged."""
        return {"waiting_for_shore": float(self.store.outbox_depth())}
