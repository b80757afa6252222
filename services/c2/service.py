"""The shore side: commits what vessels relay, keeps the pictures, shows them to every shore subscriber."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping

import zenoh

from services.c2.config import C2Config
from sonarpost import keys, wire
from sonarpost.errors import PayloadError
from sonarpost.files import write_atomically
from sonarpost.messages import Decision, ReconstructedImage, Record, Relayed
from sonarpost.runtime.logs import kv
from sonarpost.runtime.picture_files import write_picture
from sonarpost.runtime.service import Effects, InterruptedByStopError, Service

log = logging.getLogger(__name__)


class C2Service(Service[C2Config]):
    """Accepts relayed records.

    A record is acknowledged to the vessel when it is in this service's store (that is the commit), and shown to
    subscribers when its files are written. Subscribers may see a record again after a restart; they know it by its
    identifiers.
    """

    NAME = "c2"

    def consumes(self) -> Mapping[str, type[Record]]:
        """Whatever vessels relay."""
        return {keys.shore_inbox_all(): Relayed}

    def check(self, record: Record) -> None:
        """Refuse an envelope whose content would not be understood later, while its sender can still be told."""
        assert isinstance(record, Relayed)
        self._open(record)

    def handle(self, key: str, record: Record, effects: Effects) -> None:
        """Write the record's files and show it."""
        assert isinstance(record, Relayed)
        expected_key = keys.shore_inbox(record.vessel_id)
        if key != expected_key:
            # Access control lets a vessel write under its own key only: no vessel speaks for another.
            raise PayloadError(key, "vessel_id", record.vessel_id, "the vessel in the key")
        inner = self._open(record)
        if isinstance(inner, ReconstructedImage):
            self._keep_image(record.vessel_id, inner, effects)
        else:
            assert isinstance(inner, Decision)
            self._keep_decision(record.vessel_id, inner, effects)

    def _open(self, envelope: Relayed) -> ReconstructedImage | Decision:
        vessel = envelope.vessel_id
        known: Mapping[str, type[ReconstructedImage] | type[Decision]] = {
            keys.image_reconstructed(vessel): ReconstructedImage,
            keys.contact_decision(vessel): Decision,
        }
        record_type = known.get(envelope.key)
        if record_type is None:
            raise PayloadError(keys.shore_inbox(vessel), "key", envelope.key, " or ".join(known))
        inner = wire.decode(record_type, envelope.payload, envelope.key)
        if inner.vessel_id != vessel:
            raise PayloadError(envelope.key, "vessel_id", inner.vessel_id, vessel)
        return inner

    def _keep_image(self, vessel: str, image: ReconstructedImage, effects: Effects) -> None:
        path, new = write_picture(self.config.out_dir / vessel, image)
        effects.count("images_stored" if new else "images_repeated")
        log.info(
            "Picture accepted" if new else "Picture known already",
            extra=kv(vessel=vessel, image_id=image.image_id, version=image.version, file=path),
        )
        self._show(keys.shore_image(vessel), image)

    def _keep_decision(self, vessel: str, decision: Decision, effects: Effects) -> None:
        folder = self.config.out_dir / vessel / "decisions"
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / decision_file_name(decision.decision_id)
        text = (json.dumps(decision.model_dump(), indent=1) + "\n").encode()
        new = not path.is_file()
        if new:
            write_atomically(path, text)
        elif path.read_bytes() != text:
            expected = f"an identifier that no other decision has ({path})"
            raise PayloadError(keys.contact_decision(vessel), "decision_id", decision.decision_id, expected)
        effects.count("decisions_stored" if new else "decisions_repeated")
        log.info("Decision accepted", extra=kv(vessel=vessel, image_id=decision.image_id, verdict=decision.verdict))
        self._show(keys.shore_decision(vessel), decision)

    def _show(self, key: str, record: Record) -> None:
        try:
            self.session.put(key, wire.encode(record), encoding=wire.encoding_of(type(record)))
        except zenoh.ZError as error:
            if self.stopping.is_set():
                # The session closed under us: the record is shown after the next start.
                raise InterruptedByStopError from error
            log.warning("Record not shown to the shore", extra=kv(key=key, error=str(error)))


def decision_file_name(decision_id: str) -> str:
    """Return the file name of a decision.

    The identifier is the operator's text: only its hexadecimal form is safe as a file name. `RecordId` bounds it to 64
    characters of one byte, so that no file system refuses the name for its length.
    """
    return f"{decision_id.encode().hex()}.json"
