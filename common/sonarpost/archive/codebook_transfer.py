"""Codebooks by their identity: the vessel's decompressor replies to queries, c2 fetches what it lacks in pieces.

A vessel replies below its own key only. c2 accepts a codebook if its identity is the one that the image names, and
keeps the codebooks of each vessel apart, at most `MAX_CODEBOOKS`. docs/specifications/zenoh.md specifies the query.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Final

import msgpack
import zenoh
from pydantic import BaseModel, ConfigDict, Field

from sonarpost import keys, wire
from sonarpost.archive.decoder import MODEL_DIGITS, Decoder
from sonarpost.codec.vq import codebook
from sonarpost.delivery.protocol import CHUNK_BYTES
from sonarpost.errors import BadInputError, CodebookError, PayloadError
from sonarpost.files import write_atomically
from sonarpost.logs import kv

log = logging.getLogger(__name__)

MAX_CODEBOOK_BYTES: Final = 16 * 1024 * 1024
MAX_CODEBOOKS: Final = 8
"""Codebooks that c2 keeps of one vessel."""
REPLY_TIMEOUT_S: Final = 10.0
RETRY_S: Final = 60.0
"""Interval of the attempts to fetch what is missing."""


class _Piece(BaseModel):
    """Reply to a query: a piece of a codebook file."""

    model_config = ConfigDict(strict=True)

    v: Annotated[int, Field(ge=1, le=1)]
    size: Annotated[int, Field(ge=1, le=MAX_CODEBOOK_BYTES)]
    data: Annotated[bytes, Field(min_length=1, max_length=CHUNK_BYTES)]


def declare_codebooks(session: zenoh.Session, vessel: str, decoder: Decoder) -> zenoh.Queryable[None]:
    """Reply to queries for the codebooks of a decoder until the session closes."""

    @lru_cache(1)
    def content(model: str) -> bytes:
        found = decoder.codebook(model)
        return b"" if found is None else codebook.to_bytes(found)

    def on_query(query: zenoh.Query) -> None:
        with query:
            model = str(query.key_expr).rpartition("/")[2]
            text = str(query.parameters.get("offset", "0"))
            data = content(model)
            try:
                if not text.isdecimal() or len(text) > len(str(MAX_CODEBOOK_BYTES)) or int(text) >= len(data):
                    query.reply_err(b"no such codebook, or offset beyond its end")
                    return
                piece = data[int(text) : int(text) + CHUNK_BYTES]
                query.reply(query.key_expr, msgpack.packb({"v": 1, "size": len(data), "data": piece}))
            except zenoh.ZError as error:
                log.debug("Codebook not sent", extra=kv(model=model, error=str(error)))

    return session.declare_queryable(keys.codebook_all(vessel), on_query)


class CodebookFetcher:
    """Fetches the codebooks that images wait for.

    Args:
        folder: Folder of the codebooks, with a folder for each vessel.
        missing: Returns (model, vessel) of all that images wait for.
        added: Called after a codebook was stored.
        stopping: Set when the service stops.

    Attributes:
        faults: Why a codebook cannot be fetched, by (model, vessel).
    """

    def __init__(
        self,
        folder: Path,
        missing: Callable[[], Sequence[tuple[str, str]]],
        added: Callable[[], None],
        stopping: threading.Event,
    ) -> None:
        self._folder = folder
        self._missing = missing
        self._added = added
        self._stopping = stopping
        self._received: dict[tuple[str, str], bytearray] = {}
        self._wake = threading.Event()
        self.faults: dict[tuple[str, str], str] = {}

    def wake(self) -> None:
        """Look for missing codebooks now."""
        self._wake.set()

    def run(self, session: zenoh.Session) -> None:
        """Fetch until the service stops."""
        while not self._stopping.is_set():
            self._wake.clear()
            wanted = self._missing()
            self.faults = {pair: fault for pair, fault in self.faults.items() if pair in wanted}
            self._received = {pair: data for pair, data in self._received.items() if pair in wanted}
            stored = [self._fetched(session, model, vessel) for model, vessel in wanted if not self._stopping.is_set()]
            if any(stored):
                self._added()
            self._wake.wait(RETRY_S)

    def _fetched(self, session: zenoh.Session, model: str, vessel: str) -> bool:
        """Fetch and store a codebook; return whether it is there."""
        try:
            data = self._fetch(session, model, vessel)
            self._store(model, vessel, data)
        except (BadInputError, OSError, zenoh.ZError) as error:
            if self.faults.get((model, vessel)) != str(error):
                log.warning("Codebook not fetched", extra=kv(vessel=vessel, model=model, reason=str(error)))
            self.faults[model, vessel] = str(error)
            return False
        self.faults.pop((model, vessel), None)
        log.info("Codebook fetched", extra=kv(vessel=vessel, model=model, bytes=len(data)))
        return True

    def _fetch(self, session: zenoh.Session, model: str, vessel: str) -> bytes:
        """Return the file; what has arrived is kept for the next attempt.

        Raises:
            PayloadError: The vessel does not reply, or with something else.
            CodebookError: The vessel has too many codebooks here.
        """
        if len(list((self._folder / vessel).glob(f"*{codebook.SUFFIX}"))) >= MAX_CODEBOOKS:
            raise CodebookError(f"codebooks of {vessel}", "", f"{MAX_CODEBOOKS} files", "fewer, before a further one")
        key = keys.codebook(vessel, model)
        received = self._received.setdefault((model, vessel), bytearray())
        while True:
            piece = _query(session, key, len(received))
            received += piece.data
            if len(received) > piece.size:
                del self._received[model, vessel]
                raise PayloadError(key, "data", f"{len(received)} bytes", f"at most the {piece.size} bytes of the file")
            if len(received) == piece.size:
                return bytes(self._received.pop((model, vessel)))
            if self._stopping.is_set():
                raise PayloadError(key, "data", f"{len(received)} bytes", f"{piece.size} bytes")

    def _store(self, model: str, vessel: str, data: bytes) -> None:
        """Store a codebook.

        Raises:
            CodebookError: It is not a codebook, or not the one that was requested.
            OSError: It cannot be written.
        """
        where = f"codebook of {vessel}"
        identity = codebook.from_bytes(data, where).tiles.identity
        if identity[:MODEL_DIGITS] != model:
            raise CodebookError(where, "identity", identity, f"{model}…, which was requested")
        path = self._folder / vessel / f"{model}{codebook.SUFFIX}"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, data)


def _query(session: zenoh.Session, key: str, offset: int) -> _Piece:
    for reply in session.get(f"{key}?offset={offset}", timeout=REPLY_TIMEOUT_S):
        if reply.ok is not None:
            return wire.validated(_Piece, wire.unpack_map(reply.ok.payload.to_bytes(), key), key)
        raise PayloadError(key, "reply", "an error", "a piece of the codebook: the vessel does not have it")
    raise PayloadError(key, "reply", "none", "a piece of the codebook")
