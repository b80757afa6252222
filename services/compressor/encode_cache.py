"""Cache of recently encoded images, used to answer refine, resend, expand and original commands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import msgpack

from sonarpost import wire
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.messages import Snippet

_INDEX = "kept"
_ENTRY = "kept/"


@dataclass(frozen=True, slots=True)
class CachedImage:
    """A cache entry.

    Attributes:
        codec: Name of the codec.
        model: Identity of its model or codebook.
        stream: The complete stream.
        payload: The `snippet` record that it was made of, encoded.
        snippet: The same, decoded.
        expanded_id: Identifier of the image that shows more seabed around it; empty where none was made.
        original_id: Identifier of the image without despeckling; empty where none was made.
    """

    codec: str
    model: str
    stream: bytes
    payload: bytes
    snippet: Snippet
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
                effects.put_state(_ENTRY + image_id, _packed(cached))

    def get(self, image_id: str) -> CachedImage | None:
        """Return the entry of an image, None if there is none."""
        return self._store.read_state(_ENTRY + image_id, lambda packed: _entry(packed, image_id), None)


def _index(packed: bytes) -> list[str]:
    """Return the identifiers of all entries, the oldest first."""
    names: list[str] = msgpack.unpackb(packed)
    if not all(isinstance(name, str) for name in names):
        raise TypeError("index of the cache: got another type, expected texts")
    return names


def _packed(cached: CachedImage) -> bytes:
    ids = (cached.expanded_id, cached.original_id)
    packed: bytes = msgpack.packb((cached.codec, cached.model, cached.stream, cached.payload, *ids))
    return packed


def _entry(packed: bytes, image_id: str) -> CachedImage:
    codec, model, stream, payload, *ids = msgpack.unpackb(packed)
    where = f"compressor.db: {_ENTRY}{image_id}"
    if not isinstance(stream, bytes) or not all(isinstance(text, str) for text in (codec, model, *ids)):
        raise TypeError(f"{where}: got another type, expected texts and a stream")
    return CachedImage(codec, model, stream, payload, wire.decode(Snippet, payload, where), *ids)
