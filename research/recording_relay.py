"""`python -m research.recording_relay --config FILE`: the relay, which also records every acknowledgement of a site.

It appends one JSON object for each record to `acknowledged.jsonl` in its state folder: `bytes` of the record, whether
the site has `refused` it, the image (`vehicle_id`, `image_id`, `version`), `queued_utc_s`, the arrival of the image's
last frame, and `acknowledged_utc_s`, when the relay starts to remove the record. The object is written in the
transaction that removes the record: if that is repeated, a second object has the same `seq`.
"""

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from typing_extensions import override

from sonarpost import wire
from sonarpost.archive.image_parts import TIME_STEPS
from sonarpost.config import PlatformConfig
from sonarpost.delivery.records import OutboxItem
from sonarpost.delivery.transaction import Transaction
from sonarpost.messages import ImagePart
from sonarpost.runtime.process import main
from sonarpost.services.relay.config import RelayConfig
from sonarpost.services.relay.service import RelayService
from sonarpost.stop_signals import exit_process

FILE_NAME = "acknowledged.jsonl"


class RecordingRelay(RelayService):
    """A relay that records acknowledged images."""

    def __init__(self, platform: PlatformConfig, config: RelayConfig) -> None:
        super().__init__(platform, config)
        self._file = (platform.state_dir / FILE_NAME).open("a", buffering=1, encoding="utf-8")

    @override
    def on_acknowledged(self, tx: Transaction, item: OutboxItem, reason: str | None) -> bool:
        """Record the acknowledgement of an image, then react to it as the relay does."""
        fields = _image_fields(item)
        if fields is not None:
            entry = {"seq": item.seq, "bytes": len(item.payload), "refused": reason is not None, **fields}
            print(json.dumps(entry | {"acknowledged_utc_s": time.time()}), file=self._file)
        return super().on_acknowledged(tx, item, reason)

    @override
    def stop(self) -> None:
        """Stop the relay, then close the file."""
        super().stop()
        self._file.close()


def _image_fields(item: OutboxItem) -> dict[str, Any] | None:
    """Return what identifies a coded image; None for another record."""
    fields: dict[str, Any] = dict(wire.unpack_map(item.payload, item.key))
    if fields["type"] != ImagePart.TYPE:
        return None
    queued_utc_s = fields.get("l") or fields["t"] + fields.get("d", 0) / TIME_STEPS
    return {
        "vehicle_id": fields["u"],
        "image_id": fields["i"],
        "version": fields["n"],
        "queued_utc_s": queued_utc_s,
    }


def acknowledged(state_dir: Path) -> Iterator[dict[str, Any]]:
    """Yield the recorded acknowledgements of one relay, each record once."""
    seen: set[int] = set()
    for line in (state_dir / FILE_NAME).read_text(encoding="utf-8").splitlines():
        entry: dict[str, Any] = json.loads(line)
        if entry["seq"] not in seen:
            seen.add(entry["seq"])
            yield entry


if __name__ == "__main__":
    exit_process(main(RecordingRelay, RelayConfig))
