"""Sender's side of blocks: a group of images becomes a preview block, then blocks of detail, with or without layers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Annotated, Final

import numpy as np

from sonarpost.errors import FrameError
from sonarpost.link.coding import erasure_code
from sonarpost.link.coding.byte_ranges import Ranges
from sonarpost.link.coding.channel_capacity import Values
from sonarpost.link.coding.erasure_code import Layering, layered_symbols
from sonarpost.link.coding.redundancy_plan import (
    GroupDistortion,
    arrivals,
    plan_layers,
    plan_unlayered,
    preview_frames,
    symbols_to_send,
)
from sonarpost.link.config import SenderConfig
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.frame import BLOCKS, Symbol, SymbolKind
from sonarpost.link.frames.v1.payload_objects import (
    CHECK_BYTES,
    MAX_STREAM_BYTES,
    MESSAGE_OVERHEAD_BYTES,
    ImageNumber,
    MessageObject,
    PieceEnd,
    PieceList,
    Preview,
    StreamPiece,
    StreamPosition,
    contact_link,
    entry_shape,
)
from sonarpost.link.state import PROGRESS, SEPARATE, Bounds, Byte, Count

StreamSpan = tuple[ImageNumber, Byte, StreamPosition, StreamPosition]
"""Number and link of an image, and a part of its stream, [start, stop)."""
TakeNumber = Callable[[], int]

_AHEAD: Final = 32
"""Symbols to compute at a time: a matrix product of several costs little more than one."""
_PREVIEW_URGENCY: Final = 2.0
_MESSAGE_URGENCY: Final = 8.0
_MAX_GROUP: Final = 60
_PREVIEW_SHARE: Final = 0.6
"""Greatest share of a group's frames for previews."""


@dataclass(eq=False)
class OutgoingImage:
    """An image to send.

    Attributes:
        number: Number of its contact.
        contact: The contact record.
        stream: The codec's stream. All of it may be sent; its most valuable bytes go first.
        curve: PSNR in dB by the number of bytes, see `quality_curve`.
        added_s: Time when it was added.
        image_id: Identifier on the vehicle.
        contact_id: Identifier of the contact on the vehicle.
        order: Rises with every image that is added.
        sent: Bytes of the stream that blocks hold so far.
        goal: Bytes of the stream to send, if they were requested; 0 for the configured number.
        delivered: Ranges of the stream that all receivers have. A range from 0 on includes the record.
        announced: Whether the record was sent ahead of the image's group.
    """

    number: ImageNumber
    contact: ContactSummary
    stream: bytes
    curve: Values
    added_s: float
    image_id: str = "0000"
    contact_id: str = "?"
    order: Count = 0
    sent: StreamPosition = field(default=0, metadata=PROGRESS)
    goal: StreamPosition = field(default=0, metadata=PROGRESS)
    delivered: Ranges = field(default=(), metadata=PROGRESS)
    announced: bool = field(default=False, metadata=PROGRESS)

    def __post_init__(self) -> None:
        if not 1 <= len(self.stream) <= MAX_STREAM_BYTES or self.curve.shape != (len(self.stream) + 1,):
            expected = f"1..{MAX_STREAM_BYTES} bytes, and a curve with a value for each length"
            raise FrameError("outgoing image", "stream", f"{len(self.stream)} bytes", expected)
        position = 0
        for start, stop in self.delivered:
            if not position <= start < stop <= len(self.stream):
                raise FrameError("outgoing image", "delivered", self.delivered, f"ranges within {len(self.stream)}")
            position = stop + 1
        self.sent = min(self.sent, len(self.stream))

    def goal_bytes(self, usual: int) -> int:
        """Return how many bytes of the stream to send: `usual`, unless more were requested."""
        return min(len(self.stream), max(self.goal or usual, self.sent))

    @property
    def link(self) -> int:
        """See `contact_link`."""
        return contact_link(self.number, self.contact.pack())

    def preview(self, prefix_bytes: int) -> Preview:
        """Return the preview with the first bytes of the stream."""
        return Preview(self.number, self.contact, self.stream[:prefix_bytes], ended=len(self.stream) < prefix_bytes)

    def span(self, start: int, stop: int) -> StreamSpan:
        """Return a part of the stream as a block lists it."""
        return self.number, self.link, start, stop

    def piece(self, start: int, stop: int) -> StreamPiece:
        """Return a piece of the stream."""
        return StreamPiece(self.number, self.link, start, self.stream[start:stop])


@dataclass(eq=False)
class SendBlock:
    """A block that is being sent.

    Attributes:
        kind: Content of the block.
        number: 0..31.
        symbol_bytes: Length of a symbol.
        objects: One object, or one for each layer.
        layering: The layers of a layered block.
        contacts: Numbers of its images.
        urgency: Divides the progress of the block; the block with the least progress goes next.
        spans: Part of the stream of each image in it. A part from 0 on includes the record.
        planned: Symbols to send according to the current plan.
        sent: Symbols sent.
        reported: Whether feedback has mentioned the block.
        last_activity_s: Time of its last symbol or feedback.
        missing: Missing symbols by receiver, from the latest feedback.
        retired: Whether it was sent without feedback, and only feedback can continue it.
    """

    kind: SymbolKind
    number: Annotated[int, Bounds(0, BLOCKS - 1)]
    symbol_bytes: Byte
    objects: tuple[bytes, ...]
    layering: Layering | None
    contacts: tuple[ImageNumber, ...]
    urgency: Annotated[float, Bounds(1e-3, 1e3)]
    spans: tuple[StreamSpan, ...] = ()
    planned: Count = field(default=0, metadata=PROGRESS)
    sent: Count = field(default=0, metadata=PROGRESS)
    reported: bool = field(default=False, metadata=PROGRESS)
    last_activity_s: float = field(default=0.0, metadata=PROGRESS)
    missing: dict[int, Byte] = field(default_factory=dict, metadata=PROGRESS)
    retired: bool = field(default=False, metadata=PROGRESS)
    _symbols: dict[int, Symbol] = field(default_factory=dict, metadata=SEPARATE)

    def __post_init__(self) -> None:
        lengths = tuple(len(data) for data in self.objects)
        if self.layering is not None:
            fits = self.kind == SymbolKind.LAYERED and lengths == self.layering.lengths(self.symbol_bytes)
        else:
            count, rest = divmod(sum(lengths), self.symbol_bytes or 1)
            fits = self.kind != SymbolKind.LAYERED and len(lengths) == 1 and not rest
            fits = fits and 1 <= count <= erasure_code.MAX_SYMBOLS and self.symbol_bytes > 0
        if not fits:
            raise FrameError("block", "objects", lengths, "whole symbols of one object, or the object of each layer")

    @property
    def source_symbols(self) -> int:
        """Number of symbols from which the whole block can be recovered."""
        return self.layering.required_symbols[-1] if self.layering else len(self.objects[0]) // self.symbol_bytes

    @property
    def left(self) -> int:
        """Symbols still to send."""
        return self.planned - self.sent

    @property
    def progress(self) -> float:
        """Share of the plan that is sent, over the urgency."""
        return (self.sent + 0.5) / (max(self.planned, 1) * self.urgency)

    @property
    def is_fresh_preview(self) -> bool:
        """Whether some contacts of a preview block have not been sent once."""
        return self.kind == SymbolKind.PREVIEW and self.sent < self.source_symbols

    def next_symbol(self) -> Symbol:
        """Return the next symbol; the 256th is the first again."""
        index = self.sent % erasure_code.MAX_SYMBOLS
        self.sent += 1
        if index not in self._symbols:
            self._compute(range(index, min(index + _AHEAD, erasure_code.MAX_SYMBOLS)))
        return self._symbols.pop(index)

    def _compute(self, indices: Sequence[int]) -> None:
        if self.layering is not None:
            made = layered_symbols(self.layering, self.objects, indices)
            for index, (descriptor, data) in zip(indices, made, strict=True):
                self._symbols[index] = Symbol(self.kind, self.number, index, descriptor, data)
            return
        source = np.frombuffer(self.objects[0], np.uint8).reshape(-1, self.symbol_bytes)
        for index, row in zip(indices, erasure_code.encode(source, indices), strict=True):
            self._symbols[index] = Symbol(self.kind, self.number, index, source.shape[0], row.tobytes())


@lru_cache(maxsize=64)
def group_limit(config: SenderConfig, symbol_bytes: int) -> int:
    """Return how many images a group may have so that no block needs more than 255 symbols."""
    shape = entry_shape(symbol_bytes)
    limit = config.group_size
    if config.feedback and not config.group_images:
        # Long frames hold more: at the fast rates a small group would fill the window with small blocks.
        limit = max(limit, min(_MAX_GROUP, config.block_symbols * symbol_bytes // config.stream_bytes))
    while limit > 1 and (
        _planned_previews(config, shape.source_symbols(limit), limit) >= erasure_code.MAX_SYMBOLS
        or (not config.feedback and limit * config.frames_per_image > erasure_code.MAX_SYMBOLS)
    ):
        limit -= 1
    return limit


def numbers_needed(images: Sequence[OutgoingImage], config: SenderConfig, symbol_bytes: int) -> int:
    """Return the greatest number of blocks that a group needs."""
    if not config.feedback:
        return 2
    total = sum(image.goal_bytes(config.stream_bytes) + 8 for image in images)
    return 3 + total // (config.block_symbols * symbol_bytes)


def _planned_previews(config: SenderConfig, source: int, images: int) -> int:
    if config.feedback:
        return symbols_to_send(source, config.worst, config.caution)
    limit = round(_PREVIEW_SHARE * config.frames_per_image * images)
    return max(preview_frames(source, channel.spread(config.depth + 1), limit=limit) for channel in config.channels)


def make_group(
    images: Sequence[OutgoingImage], config: SenderConfig, symbol_bytes: int, take_number: TakeNumber, now: float
) -> list[SendBlock]:
    """Return the blocks of a group, previews first."""
    shape = entry_shape(symbol_bytes)
    planned = min(_planned_previews(config, shape.source_symbols(len(images)), len(images)), erasure_code.MAX_SYMBOLS)
    for image in images:
        image.sent = min(shape.prefix_bytes, len(image.stream))
    previews = SendBlock(
        kind=SymbolKind.PREVIEW,
        number=take_number(),
        symbol_bytes=symbol_bytes,
        objects=(_preview_object(images, symbol_bytes),),
        layering=None,
        contacts=tuple(image.number for image in images),
        urgency=_PREVIEW_URGENCY,
        spans=tuple(image.span(0, image.sent) for image in images),
        planned=planned,
        last_activity_s=now,
    )
    for image in images:
        if image.sent == shape.prefix_bytes == image.goal_bytes(config.stream_bytes):
            image.sent -= 1  # a full entry cannot say that the stream ends; a piece of one byte does
    if config.feedback:
        return [previews, *unlayered_blocks(images, config, symbol_bytes, take_number, now)]
    frames = min(round(config.frames_per_image * len(images)) - planned, erasure_code.MAX_SYMBOLS)
    return [previews, *_layered(images, config, symbol_bytes, frames, take_number, now)]


def _preview_object(images: Sequence[OutgoingImage], symbol_bytes: int) -> bytes:
    """Return the source symbols of a preview block as one object."""
    shape = entry_shape(symbol_bytes)
    entries = [image.preview(shape.prefix_bytes).pack(shape.entry_bytes) for image in images]
    groups = [b"".join(entries[i : i + shape.entries]) for i in range(0, len(entries), shape.entries)]
    return b"".join(group.ljust(symbol_bytes * shape.symbols, b"\0") for group in groups)


def _layered(
    images: Sequence[OutgoingImage],
    config: SenderConfig,
    symbol_bytes: int,
    frames: int,
    take_number: TakeNumber,
    now: float,
) -> Iterator[SendBlock]:
    starts = [image.sent for image in images]
    distortion = GroupDistortion.of([image.curve for image in images], starts)
    if frames < 1 or distortion.total_bytes == 0:
        return
    # Lengths of 128 bytes and more take two bytes; most pieces are shorter or longer together.
    guess = _pieces(images, starts, [min(s + 128, len(i.stream)) for i, s in zip(images, starts, strict=True)])
    first, later = guess.overhead_bytes(), 1 + len(images) + CHECK_BYTES
    arrive = arrivals(frames, config.planned_channels, config.depth)
    plan = plan_layers(distortion, symbol_bytes, arrive, first, later)
    unlayered = plan_unlayered(distortion, symbol_bytes, arrive, first)
    if plan is None or (unlayered is not None and unlayered[1] >= plan.expected_db):
        if unlayered is not None:
            room = unlayered[0] * symbol_bytes
            stops = _fitted_stops(images, starts, distortion.stops(room - first), room, None)
            yield _unlayered_block(images, stops, unlayered[0], symbol_bytes, take_number(), frames, now, final=True)
        return
    if plan.expected_db <= 0:
        return
    layers = _layers(images, starts, distortion, plan.layering, symbol_bytes, first, later)
    stops = [piece.stop for piece in layers[-1].pieces]
    objects: list[bytes] = []
    below: Sequence[PieceEnd] | None = None
    for layer, length in zip(layers, plan.layering.lengths(symbol_bytes), strict=True):
        objects.append(layer.pack(length, below))
        below = layer.ends
    yield SendBlock(
        kind=SymbolKind.LAYERED,
        number=take_number(),
        symbol_bytes=symbol_bytes,
        objects=tuple(objects),
        layering=plan.layering,
        contacts=tuple(image.number for image in images),
        urgency=1.0,
        spans=tuple(image.span(a, b) for image, a, b in zip(images, starts, stops, strict=True)),
        planned=frames,
        last_activity_s=now,
    )
    for image, stop in zip(images, stops, strict=True):
        image.sent = stop


def _layers(
    images: Sequence[OutgoingImage],
    starts: Sequence[int],
    distortion: GroupDistortion,
    layering: Layering,
    symbol_bytes: int,
    first: int,
    later: int,
) -> list[PieceList]:
    """Return the pieces of each layer, the lowest first."""
    layers: list[PieceList] = []
    begins, total = list(starts), 0
    lengths = layering.lengths(symbol_bytes)
    for number, length in enumerate(lengths):
        total += length - (later if layers else first)
        below = layers[-1].ends if layers else None
        stops = _fitted_stops(images, begins, distortion.stops(total), length, below)
        layers.append(_pieces(images, begins, stops, final=number == len(lengths) - 1))
        begins = stops
    return layers


def unlayered_blocks(
    images: Sequence[OutgoingImage],
    config: SenderConfig,
    symbol_bytes: int,
    take_number: TakeNumber,
    now: float,
) -> Iterator[SendBlock]:
    """Yield blocks without layers that continue each image from `sent` to its goal."""
    goals = {image.number: image.goal_bytes(config.stream_bytes) for image in images}
    rest = [image for image in images if image.sent < goals[image.number]]
    while rest:
        run, room = _run_that_fits(rest, goals, config.block_symbols * symbol_bytes)
        starts = [image.sent for image in run]
        stops = [goals[image.number] for image in run]
        if len(run) == 1:
            # Shortened to what a block holds, not extended: bytes beyond the goal only fill the last symbol.
            limits = _fitted_stops(run, starts, stops, min(room, config.block_symbols * symbol_bytes), None)
            stops = [min(a, b) for a, b in zip(limits, stops, strict=True)]
        size = _pieces(run, starts, stops).overhead_bytes() + sum(stops) - sum(starts)
        source = -(-size // symbol_bytes)
        stops = _fitted_stops(run, starts, stops, source * symbol_bytes, None)
        final = all(stop >= goals[image.number] for image, stop in zip(run, stops, strict=True))
        planned = symbols_to_send(source, config.worst, config.caution)
        yield _unlayered_block(run, stops, source, symbol_bytes, take_number(), planned, now, final=final)
        rest = [image for image in rest if image.sent < goals[image.number]]


def _unlayered_block(
    run: Sequence[OutgoingImage],
    stops: Sequence[int],
    source: int,
    symbol_bytes: int,
    number: int,
    planned: int,
    now: float,
    *,
    final: bool,
) -> SendBlock:
    """Return a block without layers that continues images to their stops, and update `sent` of the images."""
    starts = [image.sent for image in run]
    for image, stop in zip(run, stops, strict=True):
        image.sent = stop
    return SendBlock(
        kind=SymbolKind.OBJECT,
        number=number,
        symbol_bytes=symbol_bytes,
        objects=(_pieces(run, starts, stops, final=final).pack(source * symbol_bytes),),
        layering=None,
        contacts=tuple(image.number for image in run),
        urgency=1.0,
        spans=tuple(image.span(a, b) for image, a, b in zip(run, starts, stops, strict=True)),
        planned=planned,
        last_activity_s=now,
    )


def message_block(message_number: int, message: bytes, symbol_bytes: int, number: int, now: float) -> SendBlock:
    """Return a block without layers for a message that is longer than a frame."""
    source = -(-(len(message) + MESSAGE_OVERHEAD_BYTES) // symbol_bytes)
    return SendBlock(
        kind=SymbolKind.OBJECT,
        number=number,
        symbol_bytes=symbol_bytes,
        objects=(MessageObject(message_number, message).pack(source * symbol_bytes),),
        layering=None,
        contacts=(),
        urgency=_MESSAGE_URGENCY,
        last_activity_s=now,
    )


def _pieces(
    images: Sequence[OutgoingImage], starts: Sequence[int], stops: Sequence[int], *, final: bool = True
) -> PieceList:
    return PieceList(tuple(image.piece(a, b) for image, a, b in zip(images, starts, stops, strict=True)), final)


def _run_that_fits(
    rest: Sequence[OutgoingImage], goals: Mapping[int, int], room: int
) -> tuple[list[OutgoingImage], int]:
    """Return images from the front whose rest fits one block (at least one), so that blocks become equally large."""
    sizes = [goals[image.number] - image.sent + 5 for image in rest]
    blocks = -(-(sum(sizes) + 16) // room)
    share = min(room, -(-sum(sizes) // blocks) + 16)
    run, used = [rest[0]], sizes[0] + 16
    for image, size in zip(rest[1:], sizes[1:], strict=True):
        if used + size > share + size // 2 or used + size > room:
            break
        run.append(image)
        used += size
    return run, room


def _fitted_stops(
    images: Sequence[OutgoingImage],
    starts: Sequence[int],
    stops: list[int],
    room: int,
    below: Sequence[PieceEnd] | None,
) -> list[int]:
    """Return `stops`, decreased or increased until the object fills `room` bytes as well as possible.

    The encoded lengths depend on the lengths, so the plan can be wrong by a few bytes in both directions.

    Raises:
        FrameError: Not even empty pieces fit.
    """
    ends = [max(a, b) for a, b in zip(starts, stops, strict=True)]

    def spare_bytes() -> int:
        return room - _pieces(images, starts, ends).overhead_bytes(below) - sum(ends) + sum(starts)

    while (spare := spare_bytes()) < 0:
        longest = max(range(len(ends)), key=lambda i: ends[i] - starts[i])
        if ends[longest] == starts[longest]:
            raise FrameError("image group", "room", f"{room} bytes", f"at least {room - spare}")
        ends[longest] -= min(-spare, ends[longest] - starts[longest])
    for i, image in enumerate(images):
        if spare < 3:  # a longer length may take a byte more itself
            break
        more = min(spare - 2, len(image.stream) - ends[i])
        if more > 0:
            ends[i] += more
            spare = spare_bytes()
    return ends
