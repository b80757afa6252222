"""What the receiver tells the sender in the v1 format: how many more symbols of which blocks, in one short segment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from sonarpost.errors import FrameError
from sonarpost.link.frames.v1.frame import BLOCKS

WINDOW: Final = BLOCKS // 2
"""How many successive blocks may be under way."""
NEVER_RECEIVED: Final = 255
MAX_NEEDED: Final = 254
_HEAD_BYTES: Final = 3


@dataclass(frozen=True, slots=True)
class Feedback:
    """A report.

    Attributes:
        newest: Number of the newest block heard, 0..31.
        frames: Frames received from this sender since the beginning, modulo 65536: what the sender measures loss by.
        needs: Symbols lacking of the block `newest`, the one before it, and so on, at most 16: 0 complete, 1..254 so
            many (254: or more), 255 not one symbol came.
    """

    newest: int
    frames: int
    needs: tuple[int, ...]

    def pack(self) -> bytes:
        """Return the data of a FEEDBACK segment, 3 to 19 bytes."""
        return bytes([self.newest, self.frames >> 8 & 255, self.frames & 255, *self.needs])

    @classmethod
    def unpack(cls, data: bytes, where: str = "feedback") -> Feedback:
        """Parse the data of a FEEDBACK segment.

        Raises:
            FrameError: Too short or too long, or no block's number.
        """
        if not _HEAD_BYTES <= len(data) <= _HEAD_BYTES + WINDOW or data[0] >= BLOCKS:
            raise FrameError(where, "data", data, f"a block below {BLOCKS}, a count, and at most {WINDOW} needs")
        return cls(data[0], int.from_bytes(data[1:3], "big"), tuple(data[3:]))

    def need_of(self, block: int) -> int | None:
        """Return what is needed of a block, None where the report does not say."""
        back = (self.newest - block) % BLOCKS
        return self.needs[back] if back < len(self.needs) else None


@dataclass(frozen=True, slots=True)
class RefineRequest:
    """A wish for more detail of a contact than was planned.

    Attributes:
        number: Of the contact, 1..65535.
        stream_bytes: Length of the stream's beginning that is wanted, in bytes.
    """

    number: int
    stream_bytes: int

    def pack(self) -> bytes:
        """Return the data of a REQUEST segment, 4 bytes."""
        return self.number.to_bytes(2, "big") + self.stream_bytes.to_bytes(2, "big")

    @classmethod
    def unpack(cls, data: bytes, where: str = "request") -> RefineRequest:
        """Parse the data of a REQUEST segment.

        Raises:
            FrameError: Another length than 4 bytes, or contact 0.
        """
        request = cls(int.from_bytes(data[:2], "big"), int.from_bytes(data[2:], "big"))
        if len(data) != 4 or request.number == 0:
            raise FrameError(where, "data", data, "a contact 1..65535 and a length, 2 bytes each")
        return request


def pack_mini(block: int, needed: int) -> int:
    """Return 13 bits for a mini-packet: the least form of feedback, "so many more symbols of this block".

    Raises:
        FrameError: A number out of range.
    """
    if not 0 <= block < BLOCKS or not 0 <= needed <= NEVER_RECEIVED:
        raise FrameError("mini-packet", "block, needed", (block, needed), f"below {BLOCKS}, 0..{NEVER_RECEIVED}")
    return block << 8 | needed


def unpack_mini(bits: int) -> tuple[int, int]:
    """Return block and symbols needed.

    Raises:
        FrameError: More than 13 bits.
    """
    if not 0 <= bits < 1 << 13:
        raise FrameError("mini-packet", "bits", bits, "0..0x1FFF")
    return bits >> 8, bits & 255
