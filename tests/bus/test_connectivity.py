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


@pytest.mark.parametrize("change", [{"v": 2}, {"v": True}, {"platform": 3}, {"service": "b" * 41}, {"platform": ""}])
def test_invalid_presence_reply_is_rejected(change):
    with pytest.raises(PayloadError):
        parsed(msgpack.packb({"v": 1, "platform": "a", "service": "b"} | change))
    with pytest.raises(PayloadError):
        parsed(b"junk")
