"""The pre-shared key that authenticates acoustic frames, and the keys derived from it.

One key of 32 random bytes serves a vehicle and a vessel, or a fleet. It is never used itself: HKDF-SHA256 (RFC 5869)
derives one AES-256 key for every transmitter, direction and way of sealing, so that a frame of one vehicle cannot be
passed off as another's, as its own echo from the other end, or as one sealed in another way.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final

from cryptography.hazmat.primitives.ciphers.aead import AESCCM
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from sonarpost.errors import ConfigError

KEY_BYTES: Final = 32
MAX_ADDRESS: Final = 127
COUNTER_BYTES: Final = (1, 2)
TAG_BYTES: Final = (4, 6, 8)

_LABEL: Final = b"sonarpost acoustic v1 "
_LEAST_DIFFERENT_BYTES: Final = 16
_HEX_KEY: Final = re.compile(rf"[0-9A-Fa-f]{{{2 * KEY_BYTES}}}")


class Direction(IntEnum):
    """Who sends a frame. The number goes into the derivation of keys."""

    FROM_VEHICLE = 0
    TO_VEHICLE = 1

    @property
    def opposite(self) -> Direction:
        """The other one."""
        return Direction(1 - self)


@dataclass(frozen=True, slots=True)
class AuthenticationSettings:
    """What both ends must agree on besides the key.

    Attributes:
        counter_bytes: Low bytes of the counter in a frame, 1 or 2. With 1, a key is good for 2^20 frames of each
            transmitter and 192 lost frames in a row cost nothing; with 2, for 2^28 frames and 65,472.
        tag_bytes: 4, 6 or 8; one forged frame in 2^(8 x tag_bytes) passes.
        encrypt: Whether frames are encrypted too. It costs no byte.

    Raises:
        ConfigError: Another number.
    """

    counter_bytes: int = 1
    tag_bytes: int = 4
    encrypt: bool = False

    def __post_init__(self) -> None:
        for name, value, allowed in (
            ("counter_bytes", self.counter_bytes, COUNTER_BYTES),
            ("tag_bytes", self.tag_bytes, TAG_BYTES),
        ):
            if value not in allowed:
                raise ConfigError("acoustic seal", name, value, " or ".join(map(str, allowed)))

    @property
    def size(self) -> int:
        """Bytes that a seal adds to a frame."""
        return self.counter_bytes + self.tag_bytes

    @property
    def counter_step(self) -> int:
        """How many counters there are until the bytes on the wire repeat."""
        return 1 << 8 * self.counter_bytes

    @property
    def lifetime_frames(self) -> int:
        """How many frames one transmitter may seal with one key: what a receiver can search through."""
        return self.counter_step << 12


@dataclass(frozen=True, slots=True)
class AcousticKey:
    """A pre-shared key. It is not shown when printed.

    Attributes:
        secret: 32 bytes.

    Raises:
        ConfigError: Another length.
    """

    secret: bytes = field(repr=False)

    def __post_init__(self) -> None:
        if len(self.secret) != KEY_BYTES:
            raise ConfigError("acoustic key", "", f"{len(self.secret)} bytes", f"{KEY_BYTES} bytes")

    @property
    def fingerprint(self) -> str:
        """Eight hexadecimal digits by which people compare keys; the key does not follow from them."""
        return self._derive(b"fingerprint", 4).hex()

    def cipher(self, source: int, direction: Direction, settings: AuthenticationSettings) -> AESCCM:
        """Return AES-256-CCM with the key of one transmitter.

        Args:
            source: The transmitter's modem address, 0..127.
            direction: Who sends.
            settings: Of the seal.
        """
        way = (direction, source, settings.counter_bytes, settings.tag_bytes, settings.encrypt)
        return AESCCM(self._derive(b"seal" + bytes(way), KEY_BYTES), tag_length=settings.tag_bytes)

    def _derive(self, purpose: bytes, length: int) -> bytes:
        return HKDF(algorithm=SHA256(), length=length, salt=None, info=_LABEL + purpose).derive(self.secret)


def parse_key(text: str, where: str) -> AcousticKey:
    """Read a key: 64 hexadecimal digits, with or without a line end.

    Args:
        text: What a key file holds.
        where: Names it in errors. The value never appears there.

    Raises:
        ConfigError: Something else, or a key that nobody has drawn by chance.
    """
    written = text.strip()
    if not _HEX_KEY.fullmatch(written):
        raise ConfigError(where, "key", f"{len(written)} characters", f"{2 * KEY_BYTES} hexadecimal digits")
    secret = bytes.fromhex(written)
    different = len(set(secret))
    if different < _LEAST_DIFFERENT_BYTES:
        # 32 bytes drawn by chance have fewer than this once in 10^16 keys.
        raise ConfigError(where, "key", f"{different} different bytes", "32 random bytes (openssl rand -hex 32)")
    return AcousticKey(secret)
