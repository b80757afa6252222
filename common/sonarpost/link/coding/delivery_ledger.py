"""What of every picture is known to have arrived, and what is therefore owed: the memory behind repairs. Pure.

A block that receivers report complete settles the parts of pictures that it held. Blocks that were given up (sent while
nobody reported, pushed out of the window, of another frame length) settle nothing: what they held is owed until
another block has brought it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from sonarpost.link.coding.blocks import OutgoingImage, SendBlock
from sonarpost.link.coding.byte_ranges import Ranges, add_range, gaps_within
from sonarpost.link.config import SenderConfig
from sonarpost.link.frames.v1.feedback import NEVER_RECEIVED, WINDOW, Feedback
from sonarpost.link.frames.v1.frame import BLOCKS


def record_delivered(pictures: Mapping[int, OutgoingImage], done: Iterable[SendBlock]) -> None:
    """Note that receivers have all of these blocks."""
    for block in done:
        for number, link, start, stop in block.spans:
            picture = pictures.get(number)
            if picture is not None and picture.link == link:
                picture.settled = add_range(picture.settled, start, min(stop, len(picture.stream)))


def missing_start(picture: OutgoingImage, config: SenderConfig, blocks: Sequence[SendBlock]) -> int | None:
    """Return the first byte of a picture that nobody is known to have and no block holds, None where there is none."""
    covered: Ranges = picture.settled
    for block in blocks:
        for number, link, start, stop in block.spans:
            if number == picture.number and link == picture.link:
                covered = add_range(covered, start, stop)
    gaps = gaps_within(covered, 0, picture.goal_bytes(config.stream_bytes))
    return gaps[0][0] if gaps else None


def missing(
    pictures: Mapping[int, OutgoingImage], config: SenderConfig, blocks: Sequence[SendBlock], most: int
) -> list[tuple[OutgoingImage, int]]:
    """Return pictures, at most `most`, the oldest first, of which something is owed, and from which byte on.

    Pictures whose record is owed do not mix with those of which only detail is: they are those of the first kind, or
    where there are none of the second.
    """
    found = [(p, at) for p in pictures.values() if (at := missing_start(p, config, blocks)) is not None]
    anew = [(p, at) for p, at in found if at == 0]
    return (anew or found)[:most]


def forgettable(pictures: Mapping[int, OutgoingImage], config: SenderConfig, needed: Iterable[int]) -> list[int]:
    """Return the numbers of pictures that are not needed in the order in which to forget them: what is owed last."""
    keep = set(needed)
    free = [p for n, p in pictures.items() if n not in keep]
    return [p.number for p in sorted(free, key=lambda p: missing_start(p, config, ()) is not None)]


def revived(past: list[SendBlock], report: Feedback) -> list[SendBlock]:
    """Take from `past` the blocks that a report tells of, and return those of which the receiver has something."""
    told = [block for block in past if report.need_of(block.number) is not None]
    past[:] = [block for block in past if block not in told]
    return [block for block in told if report.need_of(block.number) != NEVER_RECEIVED]


def within_window(past: list[SendBlock], next_block: int) -> list[SendBlock]:
    """Return the blocks of `past` that reports may still tell of, where `next_block` is the next number."""
    return [block for block in past if (next_block - block.number - 1) % BLOCKS < WINDOW]
