"""From waiting pictures to blocks: previews for all of a group, then its detail, in layers or whole."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Final

from sonarpost.link.coding import erasure_code as fec
from sonarpost.link.coding.blocks import OutgoingImage, SendBlock, fitted_stops, layer_objects, preview_object
from sonarpost.link.coding.rate_distortion import GroupDistortion
from sonarpost.link.coding.redundancy_plan import arrivals, plan_layers, plan_whole, preview_frames, symbols_to_send
from sonarpost.link.config import SenderConfig
from sonarpost.link.frames.v1.frame import SymbolKind
from sonarpost.link.frames.v1.layers import Layering
from sonarpost.link.frames.v1.payload_objects import CHECK_BYTES, PieceList
from sonarpost.link.frames.v1.preview import entry_shape

TakeNumber = Callable[[], int]
_PREVIEW_URGENCY: Final = 2.0
_MOST_GROUP: Final = 60
_PREVIEW_SHARE: Final = 0.6
"""Most of a group's frames that previews take."""


@lru_cache(maxsize=64)
def group_limit(config: SenderConfig, symbol_bytes: int) -> int:
    """Return how many pictures a group may have so that no block needs more than 255 symbols."""
    shape = entry_shape(symbol_bytes)
    most = config.group_size
    if config.feedback and not config.group_pictures:
        # Long frames hold more: at the fast rates a group of few symbols would fill the window with small blocks.
        most = max(most, min(_MOST_GROUP, config.block_symbols * symbol_bytes // config.stream_bytes))
    while most > 1 and (
        _planned_previews(config, shape.source_symbols(most), most) >= fec.MAX_SYMBOLS
        or (not config.feedback and most * config.frames_per_image > fec.MAX_SYMBOLS)
    ):
        most -= 1
    return most


def numbers_needed(pictures: Sequence[OutgoingImage], config: SenderConfig, symbol_bytes: int) -> int:
    """Return how many blocks a group makes at most."""
    if not config.feedback:
        return 2
    total = sum(p.goal_bytes(config.stream_bytes) + 8 for p in pictures)
    return 3 + total // (config.block_symbols * symbol_bytes)


def _planned_previews(config: SenderConfig, source: int, pictures: int) -> int:
    if config.feedback:
        return symbols_to_send(source, config.worst, config.caution)
    limit = round(_PREVIEW_SHARE * config.frames_per_image * pictures)
    return max(preview_frames(source, channel.spread(config.depth + 1), limit=limit) for channel in config.channels)


def make_group(
    pictures: Sequence[OutgoingImage], config: SenderConfig, symbol_bytes: int, take_number: TakeNumber, now: float
) -> list[SendBlock]:
    """Return the blocks of a group: previews first."""
    shape = entry_shape(symbol_bytes)
    numbers = tuple(p.number for p in pictures)
    planned = min(_planned_previews(config, shape.source_symbols(len(pictures)), len(pictures)), fec.MAX_SYMBOLS)
    previews = SendBlock(
        kind=SymbolKind.PREVIEW,
        number=take_number(),
        symbol_bytes=symbol_bytes,
        objects=(preview_object(pictures, symbol_bytes),),
        layering=None,
        contacts=numbers,
        urgency=_PREVIEW_URGENCY,
        planned=planned,
        asked_at=now,
    )
    for picture in pictures:
        picture.sent = min(shape.prefix_bytes, len(picture.stream))
    previews.spans = tuple(p.span(0, p.sent) for p in pictures)
    for picture in pictures:
        if picture.sent == shape.prefix_bytes == picture.goal_bytes(config.stream_bytes):
            picture.sent -= 1  # an entry that is just full cannot say that the stream ends: a piece of one byte does
    if config.feedback:
        return [previews, *whole_blocks(pictures, config, symbol_bytes, take_number, now)]
    frames = min(round(config.frames_per_image * len(pictures)) - planned, fec.MAX_SYMBOLS)
    return [previews, *_layered(pictures, config, symbol_bytes, frames, take_number, now)]


def _layered(
    pictures: Sequence[OutgoingImage],
    config: SenderConfig,
    symbol_bytes: int,
    frames: int,
    take_number: TakeNumber,
    now: float,
) -> Iterator[SendBlock]:
    starts = [p.sent for p in pictures]
    gain = GroupDistortion.of([p.curve for p in pictures], starts)
    if frames < 1 or gain.total_bytes == 0:
        return
    # Lengths of 128 bytes and more take two bytes; most pieces are shorter or longer together.
    guess = PieceList(
        tuple(p.piece(s, min(s + 128, len(p.stream))) for p, s in zip(pictures, starts, strict=True)), final=True
    )
    first, later = guess.overhead_bytes(), 1 + len(pictures) + CHECK_BYTES
    arrive = arrivals(frames, config.planned_channels, config.depth)
    plan = plan_layers(gain, symbol_bytes, arrive, first, later)
    whole = plan_whole(gain, symbol_bytes, arrive, first)
    if plan is None or (whole is not None and whole[1] >= plan.expected_db):
        if whole is not None:
            stops = fitted_stops(
                pictures, starts, gain.stops(whole[0] * symbol_bytes - first), whole[0] * symbol_bytes, None
            )
            yield _whole_block(pictures, stops, whole[0], symbol_bytes, take_number(), frames, now, final=True)
        return
    if plan.expected_db <= 0:
        return
    layer_stops = _layer_stops(pictures, starts, gain, plan.layering, symbol_bytes, first, later)
    yield SendBlock(
        kind=SymbolKind.LAYERED,
        number=take_number(),
        symbol_bytes=symbol_bytes,
        objects=layer_objects(pictures, plan.layering, symbol_bytes, starts, layer_stops),
        layering=plan.layering,
        contacts=tuple(p.number for p in pictures),
        urgency=1.0,
        planned=frames,
        asked_at=now,
        spans=tuple(p.span(a, b) for p, a, b in zip(pictures, starts, layer_stops[-1], strict=True)),
    )
    for picture, stop in zip(pictures, layer_stops[-1], strict=True):
        picture.sent = stop


def _layer_stops(
    pictures: Sequence[OutgoingImage],
    starts: Sequence[int],
    gain: GroupDistortion,
    layering: Layering,
    symbol_bytes: int,
    first: int,
    later: int,
) -> list[list[int]]:
    stops: list[list[int]] = []
    below: PieceList | None = None
    begins, total = list(starts), 0
    for length in layering.lengths(symbol_bytes):
        total += length - (later if stops else first)
        ends = fitted_stops(pictures, begins, gain.stops(total), length, below)
        below = PieceList(tuple(p.piece(a, b) for p, a, b in zip(pictures, begins, ends, strict=True)), final=False)
        stops.append(ends)
        begins = ends
    return stops


def whole_blocks(
    pictures: Sequence[OutgoingImage],
    config: SenderConfig,
    symbol_bytes: int,
    take_number: TakeNumber,
    now: float,
) -> Iterator[SendBlock]:
    """Yield blocks without layers that take pictures from what was sent to the length that is to be sent of each."""
    goals = {p.number: p.goal_bytes(config.stream_bytes) for p in pictures}
    rest = [p for p in pictures if p.sent < goals[p.number]]
    while rest:
        run, room = _run_that_fits(rest, goals, config.block_symbols * symbol_bytes)
        starts = [p.sent for p in run]
        stops = [goals[p.number] for p in run]
        if len(run) == 1:
            # Drawn back to what a block holds, not pushed on: what goes beyond the goal only fills the last symbol.
            most = fitted_stops(run, starts, stops, min(room, config.block_symbols * symbol_bytes), None)
            stops = [min(a, b) for a, b in zip(most, stops, strict=True)]
        source = -(-_object_bytes(run, starts, stops) // symbol_bytes)
        stops = fitted_stops(run, starts, stops, source * symbol_bytes, None)
        final = all(b >= goals[p.number] for p, b in zip(run, stops, strict=True))
        planned = symbols_to_send(source, config.worst, config.caution)
        yield _whole_block(run, stops, source, symbol_bytes, take_number(), planned, now, final=final)
        rest = [p for p in rest if p.sent < goals[p.number]]


def _whole_block(
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
    """Return a block without layers of the pictures from what was sent to their stops, and note that it is."""
    pieces = PieceList(tuple(p.piece(p.sent, stop) for p, stop in zip(run, stops, strict=True)), final)
    spans = tuple(p.span(p.sent, stop) for p, stop in zip(run, stops, strict=True))
    for picture, stop in zip(run, stops, strict=True):
        picture.sent = stop
    return SendBlock(
        kind=SymbolKind.OBJECT,
        number=number,
        symbol_bytes=symbol_bytes,
        objects=(pieces.pack(source * symbol_bytes),),
        layering=None,
        contacts=tuple(p.number for p in run),
        urgency=1.0,
        planned=planned,
        asked_at=now,
        spans=spans,
    )


def _object_bytes(run: Sequence[OutgoingImage], starts: Sequence[int], stops: Sequence[int]) -> int:
    pieces = PieceList(tuple(p.piece(a, b) for p, a, b in zip(run, starts, stops, strict=True)), final=True)
    return pieces.overhead_bytes() + sum(stops) - sum(starts)


def _run_that_fits(
    rest: Sequence[OutgoingImage], goals: Mapping[int, int], room: int
) -> tuple[list[OutgoingImage], int]:
    """Return pictures from the front whose rest fits one block (at least one), shared out evenly over the blocks."""
    sizes = [goals[p.number] - p.sent + 5 for p in rest]
    blocks = -(-(sum(sizes) + 16) // room)
    share = min(room, -(-sum(sizes) // blocks) + 16)
    run, used = [rest[0]], sizes[0] + 16
    for picture, size in zip(rest[1:], sizes[1:], strict=True):
        if used + size > share + size // 2 or used + size > room:
            break
        run.append(picture)
        used += size
    return run, room
