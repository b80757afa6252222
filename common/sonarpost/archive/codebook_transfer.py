"""Codebooks by their identity: the vessel's decompressor replies to queries, c2 fetches what it lacks in pieces.

A vessel replies below its own key only. c2 queries the vessels in turn, for one piece each. It accepts a codebook if
its identity is the one that the image names, and keeps the codebooks of each vessel apart, at most `MAX_CODEBOOKS`.
docs/specifications/zenoh.md specifies the query.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
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
from sonarpost.limits import Turns, limit
from sonarpost.logs import kv

log = logging.getLogger(__name__)

SURFACE: Final = "codebooks of vessels"
MAX_CODEBOOK_BYTES: Final = limit(
    16 * 1024 * 1024, "bytes", "claims", SURFACE, "vessel", "incomplete codebook on the disk", "it is refused"
)
MAX_CODEBOOKS: Final = limit(
    8, "codebooks", "shares", SURFACE, "vessel", "stored codebooks", "no further codebook is fetched"
)
REPLY_TIMEOUT_S: Final = limit(
    10.0, "s", "deadlines", SURFACE, "vessel", "one piece: delay of others in a round", "the vessel pauses"
)
RETRY_S: Final = 60.0
"""First pause of a vessel from which a codebook cannot be fetched, and interval of the attempts."""
MAX_RETRY_S: Final = 3600.0
SLOW_S: Final = 1.0
PAUSE_FACTOR: Final = limit(
    4, "times its duration", "shares", SURFACE, "vessel", "pause after a reply of over 1 s", "other vessels are queried"
)
PARTIAL: Final = ".partial"


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


class _NoReplyError(PayloadError):
    """The vessel is silent: what has arrived is kept for the next attempt."""


@dataclass(slots=True)
class _Vessel:
    """Queries to one vessel.

    Attributes:
        failures: Consecutive failures.
        next_at_s: When it is queried next, by the monotonic clock.
        tried: Models that were refused or not available, in the order of their last failure.
    """

    failures: int = 0
    next_at_s: float = 0.0
    tried: list[str] = field(default_factory=list)


class CodebookFetcher:
    """Fetches the codebooks that images wait for: the vessels in turn, of each one codebook at a time.

    Args:
        folder: Folder of the codebooks, with a folder for each vessel. An incomplete one is in a file `*.partial`.
        missing: Returns the models that images wait for, by vessel.
        added: Called with the vessel after a codebook was stored.
        stopping: Set when the service stops.

    Attributes:
        faults: Why a codebook cannot be fetched, by (model, vessel).
    """

    def __init__(
        self,
        folder: Path,
        missing: Callable[[], Mapping[str, Sequence[str]]],
        added: Callable[[str], None],
        stopping: threading.Event,
    ) -> None:
        self._folder = folder
        self._missing = missing
        self._added = added
        self._stopping = stopping
        self._wake = threading.Event()
        self._turns = Turns()
        self._vessels: dict[str, _Vessel] = {}
        self.faults: dict[tuple[str, str], str] = {}

    def wake(self) -> None:
        """Look for missing codebooks now."""
        self._wake.set()

    def run(self, session: zenoh.Session) -> None:
        """Fetch until the service stops."""
        while not self._stopping.is_set():
            self._wake.clear()
            wanted = {vessel: models for vessel, models in self._missing().items() if models}
            self.faults = {pair: fault for pair, fault in self.faults.items() if pair[0] in wanted.get(pair[1], ())}
            self._vessels = {vessel: self._vessels.get(vessel, _Vessel()) for vessel in wanted}
            now_s = time.monotonic()
            due = {vessel: [vessel] for vessel, known in self._vessels.items() if known.next_at_s <= now_s}
            if due:
                [vessel] = self._turns.pick(due, 1)
                self._step(session, vessel, wanted[vessel])
            else:
                ends_s = [known.next_at_s for known in self._vessels.values()]
                self._wake.wait(min(ends_s) - now_s if ends_s else RETRY_S)

    def _step(self, session: zenoh.Session, vessel: str, models: Sequence[str]) -> None:
        """Fetch one piece of a codebook of a vessel; store the codebook if it is complete."""
        known = self._vessels[vessel]
        known.tried = [model for model in known.tried if model in models]
        model = next((model for model in models if model not in known.tried), (known.tried or models)[0])
        started_s = time.monotonic()
        try:
            is_complete = self._fetch(session, model, vessel)
        except Exception as error:
            if not isinstance(error, (BadInputError, OSError, zenoh.ZError)):
                log.exception("Codebook not fetched after an unexpected exception")
            if self.faults.get((model, vessel)) != str(error):
                log.warning("Codebook not fetched", extra=kv(vessel=vessel, model=model, reason=str(error)))
            self.faults[model, vessel] = str(error)
            if not isinstance(error, _NoReplyError):
                with suppress(OSError):  # the next attempt reports it
                    (self._folder / vessel / f"{model}{PARTIAL}").unlink()
                known.tried = [*(each for each in known.tried if each != model), model]
            known.next_at_s = time.monotonic() + min(RETRY_S * 2**known.failures, MAX_RETRY_S)
            known.failures = min(known.failures + 1, 10)
            return
        taken_s = time.monotonic() - started_s
        if taken_s > SLOW_S and len(self._vessels) > 1:
            known.next_at_s = time.monotonic() + PAUSE_FACTOR * taken_s
        if is_complete or not known.tried:
            known.failures = 0  # a piece after a silence shows that the vessel is back
        if is_complete:
            self.faults.pop((model, vessel), None)
            log.info("Codebook fetched", extra=kv(vessel=vessel, model=model))
            self._added(vessel)

    def _fetch(self, session: zenoh.Session, model: str, vessel: str) -> bool:
        """Fetch a piece; return whether the codebook is complete and stored.

        Raises:
            PayloadError: The vessel does not reply, or with something else.
            CodebookError: It is not the codebook that was requested, or the vessel has too many here.
            OSError: It cannot be written.
        """
        folder = self._folder / vessel
        path = folder / f"{model}{codebook.SUFFIX}"
        if len({*folder.glob(f"*{codebook.SUFFIX}")} - {path}) >= MAX_CODEBOOKS:
            raise CodebookError(f"codebooks of {vessel}", "", f"{MAX_CODEBOOKS} files", "fewer, before a further one")
        partial = folder / f"{model}{PARTIAL}"
        for other in folder.glob(f"*{PARTIAL}"):
            if other != partial:
                other.unlink()  # of each vessel, one incomplete codebook
        offset = partial.stat().st_size if partial.exists() else 0
        key = keys.codebook(vessel, model)
        piece = _query(session, key, offset)
        expected = min(CHUNK_BYTES, piece.size - offset)
        if len(piece.data) != expected:
            raise PayloadError(key, "data", f"{len(piece.data)} bytes", f"{expected} bytes from offset {offset}")
        folder.mkdir(parents=True, exist_ok=True)
        with partial.open("ab") as file:
            file.write(piece.data)
        if offset + expected < piece.size:
            return False
        data = partial.read_bytes()
        where = f"codebook of {vessel}"
        identity = codebook.from_bytes(data, where).tiles.identity
        if identity[:MODEL_DIGITS] != model:
            raise CodebookError(where, "identity", identity, f"{model}…, which was requested")
        write_atomically(path, data)
        partial.unlink()
        return True


def _query(session: zenoh.Session, key: str, offset: int) -> _Piece:
    for reply in session.get(f"{key}?offset={offset}", timeout=REPLY_TIMEOUT_S):
        if reply.ok is not None:
            return wire.validated(_Piece, wire.unpack_map(reply.ok.payload.to_bytes(), key), key)
        raise PayloadError(key, "reply", "an error", "a piece of the codebook: the vessel does not have it")
    raise _NoReplyError(key, "reply", "none", "a piece of the codebook")
