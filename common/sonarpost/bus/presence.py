"""`hello`: a process of a site answers each vessel that asks whether it is there.

A question on a key of the vessel's own passes exactly where its records pass, so an answer shows that routers,
certificates and access control let the vessel through; a query costs the radio link a few hundred bytes.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import msgpack
import zenoh

from sonarpost import keys, wire
from sonarpost.errors import BadInputError, PayloadError
from sonarpost.logs import kv

log = logging.getLogger(__name__)

VERSION = 1


@dataclass(frozen=True, slots=True)
class PresenceReply:
    """An answer: which process of which platform is there."""

    platform: str
    service: str

    def pack(self) -> bytes:
        """Return the answer as msgpack."""
        packed: bytes = msgpack.packb({"v": VERSION, "platform": self.platform, "service": self.service})
        return packed


def parse(payload: bytes, where: str) -> PresenceReply:
    """Read an answer.

    Raises:
        PayloadError: Not one; names the field.
    """
    fields = wire.unpack_map(payload, where)
    if fields.get("v") != VERSION:
        raise PayloadError(where, "v", fields.get("v"), str(VERSION))
    found = []
    for name in ("platform", "service"):
        value = fields.get(name)
        if not isinstance(value, str) or not 1 <= len(value) <= 40:
            raise PayloadError(where, name, value, "1 to 40 characters")
        found.append(value)
    return PresenceReply(*found)


def declare_presence(
    session: zenoh.Session, platform: str, service: str, site: str = keys.SHORE
) -> zenoh.Queryable[None]:
    """Answer every vessel that asks, until the session closes or the queryable is undeclared."""
    payload = PresenceReply(platform, service).pack()

    def on_query(query: zenoh.Query) -> None:
        # Of `…/inbox/{vessel}/hello/*` the vessel's part is certain, ours stands at the end.
        vessel = str(query.key_expr).split("/")[-3]
        try:
            with query:
                query.reply(keys.hello(vessel, service, site), payload)
        except (zenoh.ZError, BadInputError) as error:
            log.debug("A hello could not be answered", extra=kv(key=str(query.key_expr), error=str(error)))

    return session.declare_queryable(keys.hello_to_all(service, site), on_query)
