"""Cache of recently encoded images, used to answer refine, resend, expand and original commands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import msgpack

from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.errors import PayloadError

_INDEX = "kept"
_ENTRY = "kept/"


@dataclass(frozen=True, slots=True)
class CachedImage:
    """A cache entry.

    Attributes:
        image: The `encoded_image` record, encoded, with the complete stream.
        snippet: The `snippet` record it was made of, encoded.
        expanded_id: Identifier of the image that shows more seabed around it; empty where none was made.
        original_id: Identifier of the image without despeckling; empty where none was made.
    """

    image: bytes
    snippet: bytes
    expanded_id: str = ""
    original_id: str = ""


class EncodeCache:
    """Encoded images with their snippets, by image identifier, in the service's store.

    Args:
        store: The service's store.
        max_images: Maximum number of entries; the oldest are deleted.
        max_age_s: Maximum age of an entry.
    """

    def __init__(self, store: Store, max_images: int, max_age_s: float) -> None:
        self._store = store
        self._max_images = max_images
        self._max_age_s = max_age_s

    def _index(self) -> dict[str, float]:
        packed = self._store.get_state(_INDEX)
        return {} if packed is None else {str(name): float(at) for name, at in msgpack.unpackb(packed)}

    def put(self, effects: UnitOfWork, images: Mapping[str, CachedImage], now_utc_s: float) -> None:
        """Store entries, and delete those that are too old or too many, in one transaction.

        Args:
            effects: Receives the writes; call `put` once for each unit of work.
            images: New entries by image identifier, the oldest first.
            now_utc_s: Current time.
        """
        index = self._index()
        for image_id in images:
            index.pop(image_id, None)
            index[image_id] = now_utc_s
        expired = [image_id for image_id, at in index.items() if now_utc_s - at > self._max_age_s]
        remaining = [image_id for image_id in index if image_id not in expired]
        expired += remaining[: max(0, len(remaining) - self._max_images)]
        for image_id in expired:
            del index[image_id]
            effects.delete_state(_ENTRY + image_id)
        effects.put_state(_INDEX, msgpack.packb(list(index.items())))
        for image_id, cached in images.items():
            if image_id in index:
                entry = msgpack.packb([cached.image, cached.snippet, cached.expanded_id, cached.original_id])
                effects.put_state(_ENTRY + image_id, entry)

    def get(self, image_id: str) -> CachedImage | None:
        """Return the entry of an image, None if there is none.

        Raises:
            PayloadError: The stored entry is malformed.
        """
        packed = self._store.get_state(_ENTRY + image_id)
        if packed is None:
            return None
        match msgpack.unpackb(packed):
            case [bytes(image), bytes(snippet)]:  # written before expanded images existed
                return CachedImage(image, snippet)
            case [bytes(image), bytes(snippet), str(expanded_id)]:
                # written before images without despeckling existed
                return CachedImage(image, snippet, expanded_id)
            case [bytes(image), bytes(snippet), str(expanded_id), str(original_id)]:
                return CachedImage(image, snippet, expanded_id, original_id)
            case other:
                raise PayloadError(entry_location(image_id), "", other, "an image and a snippet")


def entry_location(image_id: str) -> str:
    """Return where an entry is stored, for error messages."""
    return f"compressor.db: {_ENTRY}{image_id}"
