"""Pictures that were encoded of late, kept for as long as the vessel may ask for more of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import msgpack

from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.errors import PayloadError

_INDEX = "kept"
_PICTURE = "kept/"


@dataclass(frozen=True, slots=True)
class CachedImage:
    """What is kept of a picture.

    Attributes:
        image: Its `encoded_image` record, packed.
        snippet: The `snippet` record it was made of, packed.
        wider_id: Identifier of the picture that shows more around it; empty where none was made.
    """

    image: bytes
    snippet: bytes
    wider_id: str = ""


class EncodeCache:
    """Encoded images and the snippets they were made of, by image identifier.

    Args:
        store: The service's.
        most: How many are kept; the oldest go first.
        cache_s: How long.
    """

    def __init__(self, store: Store, most: int, cache_s: float) -> None:
        self._store = store
        self._most = most
        self._keep_s = cache_s

    def _index(self) -> dict[str, float]:
        packed = self._store.get_state(_INDEX)
        return {} if packed is None else {str(name): float(at) for name, at in msgpack.unpackb(packed)}

    def keep(self, effects: UnitOfWork, pictures: Mapping[str, CachedImage], now_utc_s: float) -> None:
        """Keep pictures, and forget with the same transaction what is too old or too much.

        Args:
            effects: What the record leads to that they come from; once for each.
            pictures: What is kept of them, by image identifier, the oldest first.
            now_utc_s: The time.
        """
        index = self._index()
        for image_id in pictures:
            index.pop(image_id, None)
            index[image_id] = now_utc_s
        oldest = [name for name, at in index.items() if now_utc_s - at > self._keep_s]
        oldest += [name for name in index if name not in oldest][: max(0, len(index) - len(oldest) - self._most)]
        for name in oldest:
            del index[name]
            effects.delete_state(_PICTURE + name)
        effects.put_state(_INDEX, msgpack.packb(list(index.items())))
        for image_id, kept in pictures.items():
            if image_id in index:
                packed = msgpack.packb([kept.image, kept.snippet, kept.wider_id])
                effects.put_state(_PICTURE + image_id, packed)

    def find(self, image_id: str) -> CachedImage | None:
        """Return what is kept of a picture, None where that is nothing.

        Raises:
            PayloadError: What is there was not written by `keep`.
        """
        packed = self._store.get_state(_PICTURE + image_id)
        if packed is None:
            return None
        match msgpack.unpackb(packed):
            case [bytes(image), bytes(snippet)]:  # of a version without wider pictures
                return CachedImage(image, snippet)
            case [bytes(image), bytes(snippet), str(wider_id)]:
                return CachedImage(image, snippet, wider_id)
            case other:
                raise PayloadError(f"compressor.db: {_PICTURE}{image_id}", "", other, "an image and a snippet")
