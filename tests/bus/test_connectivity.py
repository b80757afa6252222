"""Presence replies."""

import msgpack
import pytest

from sonarpost import wire
from sonarpost.bus.connectivity import PresenceReply
from sonarpost.errors import PayloadError


def parsed(payload):
    return wire.validated(PresenceReply, wire.unpack_map(payload, "key"), "key")


def test_presence_reply_round_trip():
    reply = PresenceReply(v=1, platform="shore-1", service="c2")
    assert parsed(reply.pack()) == reply
    assert msgpack.unpackb(reply.pack()) == {"v": 1, "platform": "shore-1", "service": "c2"}


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"platform": "a", "service": "b"},
        {"v": 2, "platform": "a", "service": "b"},
        {"v": True, "platform": "a", "service": "b"},
        {"v": 1, "platform": 3, "service": "b"},
        {"v": 1, "platform": "a", "service": "b" * 41},
        {"v": 1, "platform": "", "service": "b"},
    ],
)
def test_invalid_presence_reply_is_rejected(fields):
    with pytest.raises(PayloadError):
        parsed(msgpack.packb(fields))
    with pytest.raises(PayloadError):
        parsed(b"junk")
