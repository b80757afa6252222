"""The pre-shared key that authenticates acoustic frames, and the keys derived from it.

One key of 32 random bytes serves a vehicle and a vessel, or a fleet. It is never used directly: HKDF-SHA256 (RFC 5869)
derives one AES-256 key for every transmitter, direction and combination of settings. So a frame of one vehicle cannot
pass as another's, as a reply to itself, or as a frame with other settings.
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
MAX_ADDRESS: Final = 255
"""The key derivation has one byte for the address."""
COUNTER_BYTES: Final = (1, 2)
TAG_BYTES: Final = (4, 6, 8)

_LABEL: Final = b"sonarpost acoustic v1 "
_LEAST_DIFFERENT_BYTES: Final = 16
_HEX_KEY: Final = re.compile(rf"[0-9A-Fa-f]{{{2 * KEY_BYTES}}}")


class Direction(IntEnum):
    """Direction of a frame. Its number is an input of the key derivation."""

    FROM_VEHICLE = 0
    TO_VEHICLE = 1

    @property
    def opposite(self) -> Direction:
        """The other direction."""
        return Direction(1 - self)


@dataclass(frozen=True, slots=True)
class AuthenticationSettings:
    """Settings that both stations must share, in addition to the key.

    Attributes:
        counter_bytes: Low bytes of the counter in a frame, 1 or 2. With 1, a key lasts for 2^20 frames of each
            transmitter, and a receiver bridges 192 lost frames; with 2, 2^28 frames and 65,472 lost ones.
        tag_bytes: 4, 6 or 8; one forged frame in 2^(8 x tag_bytes) passes.
        encrypt: Whether frames are also encrypted. This adds no byte.

    Raises:
        ConfigError: Another number of bytes.
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
                raise ConfigError("acoustic authentication", name, value, " or ".join(map(str, allowed)))

    @property
    def overhead_bytes(self) -> int:
        """Bytes that protection adds to a frame."""
        return self.counter_bytes + self.tag_bytes

    @property
    def counter_step(self) -> int:
        """Number of counters after which the bytes in the frame repeat."""
        return 1 << 8 * self.counter_bytes

    @property
    def lifetime_frames(self) -> int:
        """Number of frames that a transmitter can protect with one key; a receiver can search all of them."""
        return self.counter_step << 12


@dataclass(frozen=True, slots=True)
class AcousticKey:
    """A pre-shared key. Its `repr` does not contain the secret.

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
        """Eight hexadecimal digits to compare keys; they do not reveal the key."""
        return self._derive(b"fingerprint", 4).hex()

    def cipher(self, source: int, direction: Direction, settings: AuthenticationSettings) -> AESCCM:
        """Return AES-256-CCM with the key of one transmitter.

        Args:
            source: The transmitter's modem address, 0..255.
            direction: Direction of its frames.
            settings: The settings.
        """
        inputs = (direction, source, settings.counter_bytes, settings.tag_bytes, settings.encrypt)
        return AESCCM(self._derive(b"seal" + bytes(inputs), KEY_BYTES), tag_length=settings.tag_bytes)

    def _derive(self, purpose: bytes, length: int) -> bytes:
        return HKDF(algorithm=SHA256(), length=length, salt=None, info=_LABEL + purpose).derive(self.secret)


def parse_key(text: str, where: str) -> AcousticKey:
    """Parse a key: 64 hexadecimal digits, with or without a line end.

    Args:
        text: Content of a key file.
        where: Name of the file in errors. The key never appears there.

    Raises:
        ConfigError: Invalid text, or a key that is not random.
    """
    written = text.strip()
    if not _HEX_KEY.fullmatch(written):
        raise ConfigError(where, "key", f"{len(written)} characters", f"{2 * KEY_BYTES} hexadecimal digits")
    secret = bytes.fromhex(written)
    different = len(set(secret))
    if different < _LEAST_DIFFERENT_BYTES:
        # Only one of 10^16 random keys has fewer different bytes than this.
        raise ConfigError(where, "key", f"{different} different bytes", "32 random bytes (openssl rand -hex 32)")
    return AcousticKey(secret)
