"""Cache of recently encoded images, used to answer refine, resend, expand and original commands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import msgpack

from sonarpost import wire
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.messages import EncodedImage, Snippet

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
    """

    def __init__(self, store: Store, max_images: int) -> None:
        self._store = store
        self._max_images = max_images

    def _index(self) -> list[str]:
        index = self._store.read_state(_INDEX, _index, None)
        if index is None:
            index = [name.removeprefix(_ENTRY) for name in self._store.state_names(_ENTRY)]
        return index

    def put(self, effects: UnitOfWork, images: Mapping[str, CachedImage]) -> None:
        """Store entries, and delete those that are too many, in one transaction.

        Args:
            effects: Receives the writes; call `put` once for each unit of work.
            images: New entries by image identifier, the oldest first.
        """
        index = [image_id for image_id in self._index() if image_id not in images] + list(images)
        surplus = max(0, len(index) - self._max_images)
        for image_id in index[:surplus]:
            effects.delete_state(_ENTRY + image_id)
        index = index[surplus:]
        effects.put_state(_INDEX, msgpack.packb(index))
        for image_id, cached in images.items():
            if image_id in index:
                entry = msgpack.packb([cached.image, cached.snippet, cached.expanded_id, cached.original_id])
                effects.put_state(_ENTRY + image_id, entry)

    def get(self, image_id: str) -> CachedImage | None:
        """Return the entry of an image, None if there is none."""
        return self._store.read_state(_ENTRY + image_id, _entry, None)


def _index(packed: bytes) -> list[str]:
    """Return the identifiers of all entries, the oldest first."""
    names: list[str] = msgpack.unpackb(packed)
    if not all(isinstance(name, str) for name in names):
        raise TypeError("index of the cache: got another type, expected texts")
    return names


def _entry(packed: bytes) -> CachedImage:
    image, snippet, expanded_id, original_id = msgpack.unpackb(packed)
    # A damaged record is discarded with its entry.
    wire.decode(EncodedImage, image, "cached image")
    wire.decode(Snippet, snippet, "cached snippet")
    return CachedImage(image, snippet, str(expanded_id), str(original_id))


def entry_location(image_id: str) -> str:
    """Return where an entry is stored, for error messages."""
    return f"compressor.db: {_ENTRY}{image_id}"
