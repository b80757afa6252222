"""Presence replies."""

from __future__ import annotations

import msgpack
import pytest

from sonarpost.bus.connectivity import PresenceReply
from sonarpost.errors import PayloadError


def test_presence_reply_round_trip():
    assert PresenceReply.unpack(PresenceReply("shore-1", "c2").pack(), "key") == PresenceReply("shore-1", "c2")


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"v": 2, "platform": "a", "service": "b"},
        {"v": 1, "platform": 3, "service": "b"},
        {"v": 1, "platform": "a", "service": "b" * 41},
        {"v": 1, "platform": "", "service": "b"},
    ],
)
def test_invalid_presence_reply_is_rejected(fields):
    with pytest.raises(PayloadError):
        PresenceReply.unpack(msgpack.packb(fields), "key")
    with pytest.raises(PayloadError):
        PresenceReply.unpack(b"junk", "key")
