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
from sonarpost.link.coding.channel_capacity import Values, frames_for
from sonarpost.link.coding.erasure_code import Layering, layered_symbols
from sonarpost.link.coding.redundancy_plan import (
    GroupDistortion,
    arrivals,
    plan_layers,
    plan_unlayered,
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
from sonarpost.link.state import PROGRESS, SEPARATE, Bounds, Byte, SavedCount

StreamSpan = tuple[ImageNumber, Byte, StreamPosition, StreamPosition]
"""Number and link of an image, and a part of its stream, [start, stop)."""

_AHEAD: Final = 32
"""Symbols to compute at a time: a matrix product of several costs little more than one."""
_PREVIEW_URGENCY: Final = 2.0
_MESSAGE_URGENCY: Final = 8.0
_MAX_GROUP: Final = 60
_MAX_SOURCE_SYMBOLS: Final = 96
"""Source symbols of a block with feedback."""
_PREVIEWS_UNSEEN: Final = 0.004
"""Share of previews that may stay unknown at the planned loss."""
_PREVIEW_SHARE: Final = 0.6
"""Greatest share of a group's frames for previews."""


@dataclass(eq=False)
class OutgoingImage:
    """An image to send.

    Attributes:
        number: Number of its contact.
        contact: The contact record.
        stream: The codec's stream. All of it may be sent; its most valuable bytes go first.
        curve: PSNR in dB by the number of bytes, see `usual_curve`.
        added_s: Time when it was added.
        image_id: Identifier on the vehicle.
        contact_id: Identifier of the contact on the vehicle.
        order: Rises with every image that is added.
        sent: Bytes of the stream that blocks hold so far.
        goal: Bytes of the stream to send, if they were requested; 0 for the configured number.
        delivered: Ranges of the stream that all receivers have. A range from 0 on includes the record.
        announced: Whether the record was sent ahead of the image's group.
        stopped: Whether nothing more of the image is sent until a command requests it.
    """

    number: ImageNumber
    contact: ContactSummary
    stream: bytes
    curve: Values
    added_s: float
    image_id: str = "0000"
    contact_id: str = "?"
    order: SavedCount = 0
    sent: StreamPosition = field(default=0, metadata=PROGRESS)
    goal: StreamPosition = field(default=0, metadata=PROGRESS)
    delivered: Ranges = field(default=(), metadata=PROGRESS)
    announced: bool = field(default=False, metadata=PROGRESS)
    stopped: bool = field(default=False, metadata=PROGRESS)

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
        """Return how many bytes of the stream to send: `usual`, unless more were requested or the image is stopped."""
        if self.stopped:
            return self.sent
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
    planned: SavedCount = field(default=0, metadata=PROGRESS)
    sent: SavedCount = field(default=0, metadata=PROGRESS)
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
        limit = max(limit, min(_MAX_GROUP, _MAX_SOURCE_SYMBOLS * symbol_bytes // config.stream_bytes))
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
    return 3 + total // (_MAX_SOURCE_SYMBOLS * symbol_bytes)


def _planned_previews(config: SenderConfig, source: int, images: int) -> int:
    if config.feedback:
        return symbols_to_send(source, config.worst)
    limit = min(round(_PREVIEW_SHARE * config.frames_per_image * images), erasure_code.MAX_SYMBOLS)
    spread = [channel.spread(config.depth + 1) for channel in config.channels]
    return max(frames_for(source, channel, _PREVIEWS_UNSEEN, limit) for channel in spread)


@dataclass(frozen=True)
class BlockBuilder:
    """Makes blocks of images and messages, and records in the images how much of them the blocks hold.

    Attributes:
        config: Configuration of the sender.
        symbol_bytes: Length of a symbol.
        take_number: Returns the number of the next block.
        now: Seconds.
    """

    config: SenderConfig
    symbol_bytes: int
    take_number: Callable[[], int]
    now: float

    def group(self, images: Sequence[OutgoingImage]) -> list[SendBlock]:
        """Return the blocks of a group, previews first."""
        shape = entry_shape(self.symbol_bytes)
        source = shape.source_symbols(len(images))
        planned = min(_planned_previews(self.config, source, len(images)), erasure_code.MAX_SYMBOLS)
        stops = [min(shape.prefix_bytes, len(image.stream)) for image in images]
        entries = [image.preview(shape.prefix_bytes).pack(shape.entry_bytes) for image in images]
        groups = [b"".join(entries[i : i + shape.entries]) for i in range(0, len(entries), shape.entries)]
        data = b"".join(group.ljust(self.symbol_bytes * shape.symbols, b"\0") for group in groups)
        previews = self._block(SymbolKind.PREVIEW, [data], images, [0] * len(images), stops, planned, _PREVIEW_URGENCY)
        for image in images:
            if image.sent == shape.prefix_bytes == image.goal_bytes(self.config.stream_bytes):
                image.sent -= 1  # a full entry has no mark of the stream's end; a piece of one byte has one
        if self.config.feedback:
            return [previews, *self.unlayered(images)]
        frames = min(round(self.config.frames_per_image * len(images)) - planned, erasure_code.MAX_SYMBOLS)
        detail = self._layered(images, frames)
        return [previews] if detail is None else [previews, detail]

    def unlayered(self, images: Sequence[OutgoingImage]) -> Iterator[SendBlock]:
        """Yield blocks without layers that continue each image from `sent` to its goal."""
        goals = {image.number: image.goal_bytes(self.config.stream_bytes) for image in images}
        rest = [image for image in images if image.sent < goals[image.number]]
        room = _MAX_SOURCE_SYMBOLS * self.symbol_bytes
        while rest:
            run = _run_that_fits(rest, goals, room)
            starts = [image.sent for image in run]
            stops = [goals[image.number] for image in run]
            if len(run) == 1:
                # Shortened to what a block holds, not extended: bytes beyond the goal only fill the last symbol.
                limits = _fitted_stops(run, starts, stops, room, None)
                stops = [min(a, b) for a, b in zip(limits, stops, strict=True)]
            size = _pieces(run, starts, stops).overhead_bytes() + sum(stops) - sum(starts)
            source = -(-size // self.symbol_bytes)
            stops = _fitted_stops(run, starts, stops, source * self.symbol_bytes, None)
            final = all(stop >= goals[image.number] for image, stop in zip(run, stops, strict=True))
            yield self._unlayered(run, stops, source, symbols_to_send(source, self.config.worst), final=final)
            rest = [image for image in rest if image.sent < goals[image.number]]

    def message(self, number: int, data: bytes) -> SendBlock:
        """Return a block without layers for a message that is longer than a frame."""
        source = -(-(len(data) + MESSAGE_OVERHEAD_BYTES) // self.symbol_bytes)
        packed = MessageObject(number, data).pack(source * self.symbol_bytes)
        return self._block(SymbolKind.OBJECT, [packed], [], [], [], 0, _MESSAGE_URGENCY)

    def _layered(self, images: Sequence[OutgoingImage], frames: int) -> SendBlock | None:
        """Return a block with the layers of the greatest expected gain, or without layers if that is better."""
        starts = [image.sent for image in images]
        distortion = GroupDistortion.of([image.curve for image in images], starts)
        if frames < 1 or distortion.total_bytes == 0:
            return None
        # Lengths of 128 bytes and more take two bytes; most pieces are shorter or longer together.
        guess = _pieces(images, starts, [min(s + 128, len(i.stream)) for i, s in zip(images, starts, strict=True)])
        first, later = guess.overhead_bytes(), 1 + len(images) + CHECK_BYTES
        arrive = arrivals(frames, self.config.planned_channels, self.config.depth)
        plan = plan_layers(distortion, self.symbol_bytes, arrive, first, later)
        unlayered = plan_unlayered(distortion, self.symbol_bytes, arrive, first)
        if unlayered is not None and (plan is None or unlayered[1] >= plan[1]):
            source = unlayered[0]
            room = source * self.symbol_bytes
            stops = _fitted_stops(images, starts, distortion.stops(room - first), room, None)
            return self._unlayered(images, stops, source, frames, final=True)
        if plan is None or plan[1] <= 0:
            return None
        layering = plan[0]
        lengths = layering.lengths(self.symbol_bytes)
        objects: list[bytes] = []
        begins, total = starts, 0
        below: Sequence[PieceEnd] | None = None
        for number, length in enumerate(lengths):
            total += length - (later if objects else first)
            stops = _fitted_stops(images, begins, distortion.stops(total), length, below)
            layer = _pieces(images, begins, stops, final=number == len(lengths) - 1)
            objects.append(layer.pack(length, below))
            begins, below = stops, layer.ends
        return self._block(SymbolKind.LAYERED, objects, images, starts, begins, frames, layering=layering)

    def _unlayered(
        self, images: Sequence[OutgoingImage], stops: Sequence[int], source: int, planned: int, *, final: bool
    ) -> SendBlock:
        """Return a block of `source` source symbols without layers that continues images to their stops."""
        starts = [image.sent for image in images]
        data = _pieces(images, starts, stops, final=final).pack(source * self.symbol_bytes)
        return self._block(SymbolKind.OBJECT, [data], images, starts, stops, planned)

    def _block(
        self,
        kind: SymbolKind,
        objects: Sequence[bytes],
        images: Sequence[OutgoingImage],
        starts: Sequence[int],
        stops: Sequence[int],
        planned: int,
        urgency: float = 1.0,
        layering: Layering | None = None,
    ) -> SendBlock:
        spans = tuple(image.span(a, b) for image, a, b in zip(images, starts, stops, strict=True))
        for image, stop in zip(images, stops, strict=True):
            image.sent = stop
        return SendBlock(
            kind=kind,
            number=self.take_number(),
            symbol_bytes=self.symbol_bytes,
            objects=tuple(objects),
            layering=layering,
            contacts=tuple(image.number for image in images),
            urgency=urgency,
            spans=spans,
            planned=planned,
            last_activity_s=self.now,
        )


def _pieces(
    images: Sequence[OutgoingImage], starts: Sequence[int], stops: Sequence[int], *, final: bool = True
) -> PieceList:
    return PieceList(tuple(image.piece(a, b) for image, a, b in zip(images, starts, stops, strict=True)), final)


def _run_that_fits(rest: Sequence[OutgoingImage], goals: Mapping[int, int], room: int) -> list[OutgoingImage]:
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
    return run


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
