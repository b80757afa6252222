"""Pictures that were encoded of late, kept for as long as the vessel may ask for more of them."""

from __future__ import annotations

import msgpack

from sonarpost.errors import PayloadError
from sonarpost.runtime.effects import Effects
from sonarpost.runtime.store import Store

_INDEX = "kept"
_PICTURE = "kept/"


class KeptPictures:
    """Encoded images and the snippets they were made of, by image identifier.

    Args:
        store: The service's.
        most: How many are kept; the oldest go first.
        keep_s: How long.
    """

    def __init__(self, store: Store, most: int, keep_s: float) -> None:
        self._store = store
        self._most = most
        self._keep_s = keep_s

    def _index(self) -> dict[str, float]:
        packed = self._store.get_state(_INDEX)
        return {} if packed is None else {str(name): float(at) for name, at in msgpack.unpackb(packed)}

    def keep(self, effects: Effects, image_id: str, image: bytes, snippet: bytes, now_utc_s: float) -> None:
        """Keep a picture, and forget with the same transaction what is too old or too much.

        Args:
            effects: What the picture's record leads to.
            image_id: Of the picture.
            image: Its `encoded_image` record, packed.
            snippet: Its `snippet` record, packed.
            now_utc_s: The time.
        """
        index = self._index()
        index.pop(image_id, None)
        index[image_id] = now_utc_s
        oldest = [name for name, at in index.items() if now_utc_s - at > self._keep_s]
        oldest += [name for name in index if name not in oldest][: max(0, len(index) - len(oldest) - self._most)]
        for name in oldest:
            del index[name]
            effects.delete_state(_PICTURE + name)
        effects.put_state(_INDEX, msgpack.packb(list(index.items())))
        if image_id in index:
            effects.put_state(_PICTURE + image_id, msgpack.packb([image, snippet]))

    def find(self, image_id: str) -> tuple[bytes, bytes] | None:
        """Return the `encoded_image` and the `snippet` record of a picture, None where it is not kept.

        Raises:
            PayloadError: What is there was not written by `keep`.
        """
        packed = self._store.get_state(_PICTURE + image_id)
        if packed is None:
            return None
        match msgpack.unpackb(packed):
            case [bytes(image), bytes(snippet)]:
                return image, snippet
            case other:
                raise PayloadError(f"compressor.db: {_PICTURE}{image_id}", "", other, "an image and a snippet")
