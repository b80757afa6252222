"""The schemes of the link bench, each over the same simulated water: who gets how much of each picture."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from research.link.images import GREY, Codecs, LinkPicture, Quality, judge
from sonarpost.link.coding.channel_capacity import LossChannel, received_distribution
from sonarpost.link.config import ReceiverConfig, SenderConfig
from sonarpost.link.downlink.messages import number_of_image
from sonarpost.link.frames.contact_record import RECORD_SIZE
from sonarpost.link.frames.paper.frame import format_image_id
from sonarpost.link.frames.paper.receiver import PaperReceiver
from sonarpost.link.frames.paper.sender import plan_packets
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.link.receiver import FeedbackReceived, ImageUpdate

SEQUENTIAL_HEADER_BYTES: Final = 4
"""Checksum, picture and place: what a plain stream needs a frame."""
FEEDBACK_OVERHEAD: Final = 1.14
"""Air time over the erasure bound that the length of the streams is chosen by."""
_SOURCE: Final = 3
_VESSEL: Final = 1
_FRAME_S: Final = 1.0
_MOST_STEPS: Final = 1_000_000


class Water:
    """Loses frames as a channel does, in the order in which they are sent."""

    def __init__(self, channel: LossChannel, seed: int) -> None:
        self._channel = channel
        self._rng = np.random.default_rng(seed)
        self._lost = bool(self._rng.random() < channel.loss)

    def passes(self) -> bool:
        """Whether the next frame arrives."""
        loss, memory = self._channel.loss, self._channel.memory
        chance = loss - loss * memory + (memory if self._lost else 0.0)
        self._lost = bool(self._rng.random() < chance)
        return not self._lost


@dataclass(frozen=True, slots=True)
class Delivered:
    """What a scheme brought of one picture.

    Attributes:
        quality: Of what is shown.
        payload_bytes: Contact record and bytes of stream that were of use.
        has_preview: Whether the record and a picture, however coarse, are there.
        is_complete: Whether all is there that was meant to be.
    """

    quality: Quality
    payload_bytes: float
    has_preview: bool
    is_complete: bool


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a scheme brought and cost.

    Attributes:
        delivered: By picture.
        frames: Frames sent, both ways.
        reports: Of these, from the receiver.
    """

    delivered: tuple[Delivered, ...]
    frames: float
    reports: int = 0


@dataclass(frozen=True)
class Setting:
    """One condition.

    Attributes:
        frames: A picture may cost on average.
        frame_bytes: Of a frame.
        channel: The water.
        group: Pictures coded jointly by v1; 0 for its own choice.
        depth: Groups that v1 interleaves.
        seed: Of the losses.
    """

    frames: int
    frame_bytes: int
    channel: LossChannel
    group: int
    depth: int
    seed: int


def run_paper(pictures: Sequence[LinkPicture], codecs: Codecs, setting: Setting) -> Outcome:
    """The paper's halves; frames that are left over repeat them."""
    water, delivered = Water(setting.channel, setting.seed), []
    for number, picture in enumerate(pictures):
        stream = picture.paper_stream
        packets = plan_packets(format_image_id(number), stream, picture.contact, 3, setting.frame_bytes)
        planned = [frame for packet in packets for frame in packet]
        receiver = PaperReceiver(60.0)
        events = []
        for place in range(setting.frames):
            if water.passes():
                events += receiver.accept(_SOURCE, planned[place % len(planned)], 0.0)
        events += receiver.poll(1e6)
        updates = [event for event in events if isinstance(event, ImageUpdate)]
        last = next((update for update in reversed(updates) if update.stream), None)
        has_contact = any(update.contact for update in updates)
        if last is None:
            quality = judge(picture.pixels, np.zeros_like(picture.pixels))
            delivered.append(Delivered(quality, RECORD_SIZE if has_contact else 0, False, False))  # noqa: FBT003
            continue
        quality = codecs.paper_quality(picture, last.stream, last.received_mask())
        header_bytes = len(last.stream) - last.total_bytes
        payload = last.received_bytes + header_bytes + (RECORD_SIZE if has_contact else 0)
        delivered.append(Delivered(quality, payload, has_contact, last.complete))
    return Outcome(tuple(delivered), setting.frames * len(pictures))


def run_sequential(pictures: Sequence[LinkPicture], codecs: Codecs, setting: Setting) -> Outcome:
    """Record and embedded stream in order; what follows the first loss is of no use."""
    water, delivered = Water(setting.channel, setting.seed), []
    room = setting.frame_bytes - SEQUENTIAL_HEADER_BYTES
    for picture in pictures:
        fates = [water.passes() for _ in range(setting.frames)]
        whole = fates.index(False) if False in fates else setting.frames
        payload = whole * room
        quality = picture.quality(codecs.emb, max(payload - RECORD_SIZE, 0))
        delivered.append(Delivered(quality, payload, whole > 0, whole == setting.frames))
    return Outcome(tuple(delivered), setting.frames * len(pictures))


def run_bound(pictures: Sequence[LinkPicture], codecs: Codecs, setting: Setting) -> Outcome:
    """Any k of a picture's n frames are worth the best k: record and stream without a byte of header.

    Expectations, not draws. Complete means that as much arrived as does on average.
    """
    chances = received_distribution(setting.frames, setting.channel)
    mean = setting.frames * (1 - setting.channel.loss)
    delivered = []
    for picture in pictures:
        found = [
            picture.quality(codecs.emb, max(k * setting.frame_bytes - RECORD_SIZE, 0))
            for k in range(setting.frames + 1)
        ]
        psnr = float(sum(c * q.psnr for c, q in zip(chances, found, strict=True)))
        likeness = float(sum(c * q.ssim for c, q in zip(chances, found, strict=True)))
        delivered.append(Delivered(Quality(psnr, likeness), mean * setting.frame_bytes, True, True))  # noqa: FBT003
    return Outcome(tuple(delivered), setting.frames * len(pictures))


def bound_rates(setting: Setting) -> tuple[float, float]:
    """Return the bound's share of previews and of complete pictures."""
    chances = received_distribution(setting.frames, setting.channel)
    mean = setting.frames * (1 - setting.channel.loss)
    return float(1 - chances[0]), float(chances[np.arange(setting.frames + 1) >= mean - 1e-9].sum())


def pooled_bound_db(pictures: Sequence[LinkPicture], codecs: Codecs, setting: Setting) -> float:
    """Return the PSNR where every picture gets exactly the mean of what arrives: what pooling many tends to."""
    length = round(setting.frames * setting.frame_bytes * (1 - setting.channel.loss)) - RECORD_SIZE
    return float(np.mean([p.quality(codecs.emb, max(length, 0)).psnr for p in pictures]))


def feedback_stream_bytes(setting: Setting) -> int:
    """Return the length of the streams with which feedback takes about as many bytes on the air as the others."""
    through = setting.frames * setting.frame_bytes * (1 - setting.channel.loss)
    return max(64, round(through / FEEDBACK_OVERHEAD) - RECORD_SIZE)


def run_v1(pictures: Sequence[LinkPicture], codecs: Codecs, setting: Setting, *, feedback: bool) -> Outcome:
    """The v1 format, as one-way broadcast or with the receiver's reports (lost as often as frames are)."""
    config = SenderConfig(
        frame_bytes=setting.frame_bytes,
        channels=(setting.channel,),
        feedback=feedback,
        frames_per_image=setting.frames,
        stream_bytes=feedback_stream_bytes(setting),
        group_images=setting.group,
        depth=setting.depth,
        kept_images=max(len(pictures), 1),
    )
    sender, receiver = V1Sender(config), V1Receiver(ReceiverConfig(max_contacts=65535))
    for number, picture in enumerate(pictures, start=1):
        sender.add_image(number, picture.contact, picture.stream, 0.0, picture.mean_square_error)
    latest: dict[int, ImageUpdate] = {}
    frames, reports = 0, 0
    for now, frame, is_report in _exchange(sender, receiver, Water(setting.channel, setting.seed), feedback=feedback):
        frames += 1
        reports += is_report
        for event in receiver.accept(_SOURCE, frame, now) if frame else []:
            if isinstance(event, ImageUpdate):
                latest[number_of_image(event.image_id)] = event
    delivered = tuple(_v1_delivered(p, latest.get(n), codecs) for n, p in enumerate(pictures, start=1))
    return Outcome(delivered, frames, reports)


def _exchange(
    sender: V1Sender, receiver: V1Receiver, water: Water, *, feedback: bool
) -> Iterator[tuple[float, bytes, bool]]:
    """Yield time, what arrives (empty where it is lost) and whether it is a report, of each frame sent either way."""
    vessel, back = V1Sender(replace(sender.config, feedback=False)), V1Receiver()
    for step in range(1, _MOST_STEPS):
        now = step * _FRAME_S
        if sender.is_idle:
            return
        frame = sender.next_frame(now)
        if frame is not None:
            yield now, (frame if water.passes() else b""), False
        due = feedback and receiver.feedback_is_due(_SOURCE, now)
        report = receiver.feedback(_SOURCE, now) if due else None
        if report is None:
            continue
        vessel.add_feedback(report)
        sent, passed = vessel.next_frame(now), water.passes()
        yield now, b"", True
        for event in back.accept(_VESSEL, sent, now) if sent and passed else []:
            if isinstance(event, FeedbackReceived):
                sender.on_feedback(event.feedback, now)


def _v1_delivered(picture: LinkPicture, update: ImageUpdate | None, codecs: Codecs) -> Delivered:
    if update is None:
        return Delivered(judge(picture.pixels, np.full_like(picture.pixels, GREY)), 0, False, False)  # noqa: FBT003
    if not picture.stream.startswith(update.stream) or update.contact != picture.contact.rounded():
        raise AssertionError("the receiver showed what was not sent")
    quality = picture.quality(codecs.emb, len(update.stream))
    return Delivered(quality, RECORD_SIZE + len(update.stream), bool(update.stream), update.complete)
