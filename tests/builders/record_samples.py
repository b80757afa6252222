"""Samples of every record type: the golden vectors of `tests/golden/zenoh`."""

import json
from typing import Any

from builders.common import GOLDEN_FOLDER
from sonarpost import messages, wire
from sonarpost.messages import Record

FOLDER = GOLDEN_FOLDER / "zenoh"

NEW_SAMPLES: dict[str, Record] = {}
"""Records that `record_vectors.py` is to add to the golden vectors; they can be removed here once it has."""

_CLASSES = {each for each in vars(messages).values() if isinstance(each, type) and issubclass(each, Record)}
RECORD_TYPES: tuple[type[Record], ...] = tuple(sorted(_CLASSES - {Record}, key=lambda t: t.TYPE))


def vectors(of: str) -> dict[str, dict[str, Any]]:
    """Return the golden vectors of a record type or message by name."""
    path = FOLDER / f"{of}.json"
    return dict(json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else {}


SAMPLES: dict[str, Record] = {
    name: wire.decode(record_type, bytes.fromhex(vector["hex"]), name)
    for record_type in RECORD_TYPES
    for name, vector in vectors(record_type.TYPE).items()
} | NEW_SAMPLES

BARE_CONTACT: Any = SAMPLES["contact-unclassified"]
FULL_CONTACT: Any = SAMPLES["contact-classified"]
ACOUSTIC_CONTACT: bytes = SAMPLES["part-whole"].c  # type: ignore[attr-defined]
"""A contact record of the acoustic link."""
COMPLETE_IMAGE: Any = SAMPLES["reconstructed-image-classified"].model_copy(
    update={"codec": "vq", "despeckle_strength": None}
)
DAMAGED_IMAGE: Any = SAMPLES["reconstructed-image-unauthenticated"]
