"""Golden authenticated frames, checked with an independent HKDF and CCM from hashes and AES blocks."""

import hashlib
import hmac
import json
from typing import Any

import pytest
from builders.common import GOLDEN_FOLDER
from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes

from sonarpost.link.auth.authentication import RESERVED, WINDOW, FrameAuthenticator, ReplayWindow, SavedWindow
from sonarpost.link.auth.key import AuthenticationSettings, Direction, parse_key
from sonarpost.link.config import SenderConfig
from sonarpost.link.frames.v1.frame import (
    Segment,
    SegmentKind,
    Symbol,
    checksum,
    pack_segments,
    pack_symbol,
    parse_frame,
)
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.link.state import pack_part
from sonarpost.modem.micromodem import RATES

GOLDEN: dict[str, Any] = json.loads((GOLDEN_FOLDER / "acoustic-v1" / "sealed.json").read_text(encoding="utf-8"))
KEY = parse_key(GOLDEN["key"], "golden")


def hkdf(secret: bytes, info: bytes, length: int) -> bytes:
    """RFC 5869 for at most 32 bytes."""
    drawn = hmac.digest(bytes(32), secret, "sha256")
    return hmac.digest(drawn, info + b"\x01", hashlib.sha256)[:length]


def ccm(key: bytes, nonce: bytes, head: bytes, data: bytes, tag_bytes: int) -> bytes:
    """RFC 3610 with a length field of two bytes."""
    block = Cipher(algorithms.AES(key), modes.ECB()).encryptor()

    def exclusive_or(left: bytes, right: bytes) -> bytes:
        return bytes(a ^ b for a, b in zip(left, right, strict=False))

    def stream(number: int) -> bytes:
        return block.update(bytes([1]) + nonce + number.to_bytes(2, "big"))

    flags = 0x40 | (tag_bytes - 2) // 2 << 3 | 1
    coded_head = len(head).to_bytes(2, "big") + head
    blocks = bytes([flags]) + nonce + len(data).to_bytes(2, "big")
    blocks += coded_head + bytes(-len(coded_head) % 16) + data + bytes(-len(data) % 16)
    state = bytes(16)
    for at in range(0, len(blocks), 16):
        state = block.update(exclusive_or(state, blocks[at : at + 16]))
    hidden = b"".join(exclusive_or(data[at : at + 16], stream(1 + at // 16)) for at in range(0, len(data), 16))
    return hidden + exclusive_or(state, stream(0))[:tag_bytes]


def test_fingerprint_of_the_key_equals_the_golden_file() -> None:
    assert KEY.fingerprint == GOLDEN["fingerprint"]
    assert hkdf(bytes.fromhex(GOLDEN["key"]), b"sonarpost acoustic v1 fingerprint", 4).hex() == GOLDEN["fingerprint"]


@pytest.mark.parametrize("case", GOLDEN["frames"], ids=str)
def test_sender_and_independent_implementation_give_the_golden_frames(case: dict[str, Any]) -> None:
    frame = bytes.fromhex(case["frame"])
    settings, direction = (
        AuthenticationSettings(case["counter_bytes"], case["tag_bytes"], case["encrypt"]),
        case["direction"],
    )
    authenticator = FrameAuthenticator(KEY, 99, Direction(direction).opposite, settings)
    # A receiver without a window accepts only counters near 0, so it gets a window near this one.
    newest = max(0, case["counter"] - 1)
    window = SavedWindow(case["source"], ReplayWindow(newest))
    assert not authenticator.restore({**authenticator.parts(), "window/0": pack_part(window)})
    content = parse_frame(frame, case["source"], authenticator)
    assert isinstance(content, Symbol) or content == (Segment(SegmentKind.MESSAGE, b"\x09go to 12"),)
    sender = FrameAuthenticator(KEY, case["source"], Direction(direction), settings, first_counter=case["counter"])
    sender.grant(case["counter"] + 1)
    assert frame == (
        pack_symbol(content, sender) if isinstance(content, Symbol) else pack_segments(content, 32, sender)
    )

    inputs = bytes([direction, case["source"], case["counter_bytes"], case["tag_bytes"], case["encrypt"]])
    key = hkdf(bytes.fromhex(GOLDEN["key"]), b"sonarpost acoustic v1 seal" + inputs, 32)
    plain = (
        bytes([0x80 | content.head()[0]]) + content.head()[1:] + content.data
        if isinstance(content, Symbol)
        else (b"\xc1\x09\x09go to 12").ljust(len(frame) - 2 - settings.overhead_bytes, b"\0")
    )
    head, data = (plain[:1], plain[1:]) if settings.encrypt else (plain, b"")
    made = ccm(key, case["counter"].to_bytes(13, "big"), head, data, settings.tag_bytes)
    low = (case["counter"] % 256**settings.counter_bytes).to_bytes(settings.counter_bytes, "big")
    covered = head + made[: len(data)] + low + made[len(data) :]
    assert frame == checksum(covered).to_bytes(2, "big") + covered


def test_sizes_and_forgery_probability_of_the_specification() -> None:
    one, two = AuthenticationSettings(), AuthenticationSettings(2)
    assert (one.overhead_bytes, one.tag_bytes, one.counter_bytes) == (5, 4, 1)
    assert (one.lifetime_frames, two.lifetime_frames) == (2**20, 2**28) == (4096 * 256, 4096 * 256**2)
    assert (WINDOW, RESERVED) == (64, 64)
    rate1, rate5 = (RATES[n].frames / RATES[n].airtime_s for n in (1, 5))
    for frames_per_s, years, percent in ((rate1, 138, 0.06), (rate5, 26, 0.4)):
        chance = 2.0 ** (1 - 8 * one.tag_bytes)
        assert years < 1 / (chance * frames_per_s) / (365.25 * 86400) < years + 1
        assert 0.7 * percent < 100 * chance * frames_per_s * 30 * 86400 < percent
    for frame_bytes, symbol_bytes in ((32, (22, 27)), (64, (54, 59)), (256, (246, 251))):
        protected, bare = (
            V1Sender(SenderConfig(frame_bytes=frame_bytes), protection=authenticator).symbol_bytes
            for authenticator in (FrameAuthenticator(KEY, 3, Direction.FROM_VEHICLE), None)
        )
        assert (protected, bare) == symbol_bytes
