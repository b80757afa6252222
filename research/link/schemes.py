"""Transmission schemes over the same simulated channel: how much of each image arrives, and its quality."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from research.common.emb_estimate import encode_with_estimate
from research.common.quality import psnr_db, ssim
from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.codec.interface import Image, Mask
from sonarpost.codec.vq.codebook import DEFAULT_TILE_PX, load_default
from sonarpost.codec.vq.codec import IndexPacking, VqCodec
from sonarpost.link.coding.channel_capacity import LossChannel, received_distribution
from sonarpost.link.config import ReceiverConfig, SenderConfig
from sonarpost.link.downlink.messages import number_of_image
from sonarpost.link.frames.contact_record import RECORD_SIZE, ContactSummary
from sonarpost.link.frames.paper.frame import format_image_id
from sonarpost.link.frames.paper.receiver import PaperReceiver
from sonarpost.link.frames.paper.sender import plan_packets
from sonarpost.link.frames.v1.frame import Segment, SegmentKind, pack_segments
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.link.receiver import FeedbackReceived, ImageUpdate, received_mask

SEQUENTIAL_HEADER_BYTES: Final = 4
"""Header of a frame of the sequential scheme: checksum, image and position."""
FEEDBACK_OVERHEAD: Final = 1.14
"""Expected ratio of air time to the erasure bound, which determines the length of the streams."""
_SOURCE: Final = 3
_VESSEL: Final = 1
_FRAME_S: Final = 1.0
_MAX_STEPS: Final = 1_000_000
PSNR_LIMIT_DB: Final = 60.0
GREY: Final = 128
_MIN_ERROR: Final = 0.065  # 60 dB
_NO_IMAGE: Final = 3.0 * 55.0**2  # mean square error, against mid-grey, of an image that cannot be decoded at all
"""Grey level of an image of which nothing arrived."""


@dataclass(frozen=True, slots=True)
class Quality:
    """Quality of an image.

    Attributes:
        psnr: PSNR in dB, at most 60.
        ssim: SSIM, -1..1.
    """

    psnr: float
    ssim: float


def image_quality(original: Image, decoded: Image) -> Quality:
    """Compare a decoded image with the original."""
    return Quality(min(psnr_db(original, decoded), PSNR_LIMIT_DB), ssim(original, decoded))


def psnr_by_length(mean_square_error: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the PSNR in dB by the number of bytes from the mean square error, infinite where there is no image."""
    error = np.minimum.accumulate(np.clip(mean_square_error, _MIN_ERROR, _NO_IMAGE))
    return np.asarray(10.0 * np.log10(255.0**2 / error), np.float64)


@dataclass(eq=False)
class LinkImage:
    """An image to send. Its quality is computed once for each length.

    Attributes:
        pixels: The original.
        contact: The contact record.
        stream: Embedded stream, long enough for every scheme.
        mean_square_error: Estimate of the codec for each length.
        paper_stream: Stream of the paper's codec, 10 x 10 px tiles with 14-bit indices.
    """

    pixels: Image
    contact: ContactSummary
    stream: bytes
    mean_square_error: npt.NDArray[np.float64]
    paper_stream: bytes
    _qualities: dict[int, Quality] = field(default_factory=dict)

    def quality(self, codec: EmbCodec, length: int) -> Quality:
        """Return the quality of the image decoded from the first `length` bytes."""
        length = min(length, len(self.stream))
        if length not in self._qualities:
            is_decodable = np.isfinite(self.mean_square_error[length])
            decoded = codec.decode(self.stream[:length]).image if is_decodable else np.full_like(self.pixels, GREY)
            self._qualities[length] = image_quality(self.pixels, decoded)
        return self._qualities[length]


@dataclass(frozen=True, eq=False)
class Codecs:
    """The codecs of the schemes."""

    emb: EmbCodec
    paper: VqCodec

    @classmethod
    def shipped(cls) -> Codecs:
        """Return emb and vq with the models of the package."""
        return cls(EmbCodec(), VqCodec(load_default(DEFAULT_TILE_PX[0]).tiles, IndexPacking.BITS14))

    def code(self, pixels: Image, number: int, stream_bytes: int) -> LinkImage:
        """Encode an image with both codecs."""
        encoded = encode_with_estimate(self.emb, pixels, stream_bytes)
        height_px, width_px = pixels.shape
        contact = ContactSummary(
            height_px=int(height_px),
            width_px=int(width_px),
            lat_deg=44.0 + number * 1e-4,
            lon_deg=-63.0,
            time_utc_s=1.6e9 + number,
            confidence=1.0,
        )
        return LinkImage(pixels, contact, encoded.stream, encoded.mean_square_error, self.paper.encode(pixels))

    def paper_quality(self, image: LinkImage, stream: bytes, received: Mask | None) -> Quality:
        """Return the quality of the image from the paper's decoder: black where a half is missing."""
        return image_quality(image.pixels, self.paper.decode(stream, received).image)


class LossyChannel:
    """Frame losses of a channel with memory (Gilbert-Elliott), in order of transmission."""

    def __init__(self, channel: LossChannel, seed: int) -> None:
        self._channel = channel
        self._rng = np.random.default_rng(seed)
        self._lost = bool(self._rng.random() < channel.loss)

    def receives(self) -> bool:
        """Return whether the next frame is received."""
        loss, memory = self._channel.loss, self._channel.memory
        probability = loss - loss * memory + (memory if self._lost else 0.0)
        self._lost = bool(self._rng.random() < probability)
        return not self._lost


@dataclass(frozen=True, slots=True)
class Delivered:
    """Result of a scheme for one image.

    Attributes:
        quality: Quality of the decoded image.
        payload_bytes: Contact record and decodable bytes of the stream.
        has_preview: Whether the record and an image of any quality arrived.
        is_complete: Whether everything arrived.
    """

    quality: Quality
    payload_bytes: float
    has_preview: bool
    is_complete: bool


@dataclass(frozen=True, slots=True)
class SchemeResult:
    """Result and cost of a scheme.

    Attributes:
        delivered: Results of the images.
        frames: Frames sent in both directions.
        reports: Feedback frames among them.
    """

    delivered: tuple[Delivered, ...]
    frames: float
    reports: int = 0


@dataclass(frozen=True)
class Setting:
    """Condition of a comparison.

    Attributes:
        frames: Mean number of frames for each image.
        frame_bytes: Size of a frame.
        channel: Losses of the channel.
        group: Number of images that v1 codes jointly; 0 for its default.
        depth: Number of groups that v1 interleaves.
        seed: Seed of the losses.
    """

    frames: int
    frame_bytes: int
    channel: LossChannel
    group: int
    depth: int
    seed: int


def run_paper(images: Sequence[LinkImage], codecs: Codecs, setting: Setting) -> SchemeResult:
    """Send the halves of the paper's format; remaining frames repeat them."""
    channel, delivered = LossyChannel(setting.channel, setting.seed), []
    for number, image in enumerate(images):
        stream = image.paper_stream
        packets = plan_packets(format_image_id(number), stream, image.contact, 3, setting.frame_bytes)
        planned = [frame for packet in packets for frame in packet]
        receiver = PaperReceiver(60.0)
        events = []
        for number_sent in range(setting.frames):
            if channel.receives():
                events += receiver.accept(_SOURCE, planned[number_sent % len(planned)], 0.0)
        events += receiver.poll(1e6)
        updates = [event for event in events if isinstance(event, ImageUpdate)]
        last = next((update for update in reversed(updates) if update.stream), None)
        has_contact = any(update.contact for update in updates)
        if last is None:
            quality = image_quality(image.pixels, np.zeros_like(image.pixels))
            delivered.append(Delivered(quality, RECORD_SIZE if has_contact else 0, False, False))  # noqa: FBT003
            continue
        quality = codecs.paper_quality(image, last.stream, received_mask(last.stream, last.missing))
        header_bytes = len(last.stream) - last.total_bytes
        payload = last.received_bytes + header_bytes + (RECORD_SIZE if has_contact else 0)
        delivered.append(Delivered(quality, payload, has_contact, last.complete))
    return SchemeResult(tuple(delivered), setting.frames * len(images))


def run_sequential(images: Sequence[LinkImage], codecs: Codecs, setting: Setting) -> SchemeResult:
    """Send record and embedded stream in order; frames after the first loss are useless."""
    channel, delivered = LossyChannel(setting.channel, setting.seed), []
    frame_payload = setting.frame_bytes - SEQUENTIAL_HEADER_BYTES
    for image in images:
        received = [channel.receives() for _ in range(setting.frames)]
        usable = received.index(False) if False in received else setting.frames
        payload = usable * frame_payload
        quality = image.quality(codecs.emb, max(payload - RECORD_SIZE, 0))
        delivered.append(Delivered(quality, payload, usable > 0, usable == setting.frames))
    return SchemeResult(tuple(delivered), setting.frames * len(images))


def run_bound(images: Sequence[LinkImage], codecs: Codecs, setting: Setting) -> SchemeResult:
    """Return the bound: any k of the n frames of an image give the first k frames of the stream, without headers.

    The results are expected values. Complete means that at least the mean number of frames arrived.
    """
    probabilities = received_distribution(setting.frames, setting.channel)
    mean = setting.frames * (1 - setting.channel.loss)
    delivered = []
    for image in images:
        qualities = [
            image.quality(codecs.emb, max(k * setting.frame_bytes - RECORD_SIZE, 0)) for k in range(setting.frames + 1)
        ]
        psnr = float(sum(c * q.psnr for c, q in zip(probabilities, qualities, strict=True)))
        mean_ssim = float(sum(c * q.ssim for c, q in zip(probabilities, qualities, strict=True)))
        delivered.append(Delivered(Quality(psnr, mean_ssim), mean * setting.frame_bytes, True, True))  # noqa: FBT003
    return SchemeResult(tuple(delivered), setting.frames * len(images))


def bound_rates(setting: Setting) -> tuple[float, float]:
    """Return the share of previews and of complete images of the bound."""
    probabilities = received_distribution(setting.frames, setting.channel)
    mean = setting.frames * (1 - setting.channel.loss)
    return float(1 - probabilities[0]), float(probabilities[np.arange(setting.frames + 1) >= mean - 1e-9].sum())


def pooled_bound_db(images: Sequence[LinkImage], codecs: Codecs, setting: Setting) -> float:
    """Return the PSNR if every image receives exactly the mean number of bytes: the limit of pooling many images."""
    length = round(setting.frames * setting.frame_bytes * (1 - setting.channel.loss)) - RECORD_SIZE
    return float(np.mean([image.quality(codecs.emb, max(length, 0)).psnr for image in images]))


def feedback_stream_bytes(setting: Setting) -> int:
    """Return the stream length with which feedback transmits about as many bytes as the other schemes."""
    received = setting.frames * setting.frame_bytes * (1 - setting.channel.loss)
    return max(64, round(received / FEEDBACK_OVERHEAD) - RECORD_SIZE)


def run_v1(images: Sequence[LinkImage], codecs: Codecs, setting: Setting, *, feedback: bool) -> SchemeResult:
    """Send with the v1 format, as one-way broadcast or with feedback (lost as often as frames)."""
    config = SenderConfig(
        frame_bytes=setting.frame_bytes,
        channels=(setting.channel,),
        feedback=feedback,
        frames_per_image=setting.frames,
        stream_bytes=feedback_stream_bytes(setting),
        group_images=setting.group,
        depth=setting.depth,
        kept_images=max(len(images), 1),
    )
    sender, receiver = V1Sender(config), V1Receiver(ReceiverConfig(max_contacts=65535))
    for number, image in enumerate(images, start=1):
        sender.add_image(number, image.contact, image.stream, 0.0, curve=psnr_by_length(image.mean_square_error))
    latest: dict[int, ImageUpdate] = {}
    frames, reports = 0, 0
    for now, frame, is_report in _exchange(
        sender, receiver, LossyChannel(setting.channel, setting.seed), feedback=feedback
    ):
        frames += 1
        reports += is_report
        for event in receiver.accept(_SOURCE, frame, now) if frame else []:
            if isinstance(event, ImageUpdate):
                latest[number_of_image(event.image_id)] = event
    delivered = tuple(_v1_delivered(p, latest.get(n), codecs) for n, p in enumerate(images, start=1))
    return SchemeResult(delivered, frames, reports)


def _exchange(
    sender: V1Sender, receiver: V1Receiver, channel: LossyChannel, *, feedback: bool
) -> Iterator[tuple[float, bytes, bool]]:
    """Yield time, received bytes (empty if lost) and whether it is feedback, for each frame in both directions."""
    back = V1Receiver()
    for step in range(1, _MAX_STEPS):
        now = step * _FRAME_S
        if sender.is_idle:
            return
        frame = sender.next_frame(now)
        if frame is not None:
            yield now, (frame if channel.receives() else b""), False
        due = feedback and receiver.feedback_is_due(_SOURCE, now)
        report = receiver.feedback(_SOURCE, now) if due else None
        if report is None:
            continue
        feedback_frame = pack_segments([Segment(SegmentKind.FEEDBACK, report.pack())], sender.config.frame_bytes)
        is_received = channel.receives()
        yield now, b"", True
        for event in back.accept(_VESSEL, feedback_frame, now) if is_received else []:
            if isinstance(event, FeedbackReceived):
                sender.on_feedback(event.feedback, now)


def _v1_delivered(image: LinkImage, update: ImageUpdate | None, codecs: Codecs) -> Delivered:
    if update is None:
        return Delivered(image_quality(image.pixels, np.full_like(image.pixels, GREY)), 0, False, False)  # noqa: FBT003
    if not image.stream.startswith(update.stream) or update.contact != image.contact.rounded():
        raise AssertionError("the receiver returned data that was not sent")
    quality = image.quality(codecs.emb, len(update.stream))
    return Delivered(quality, RECORD_SIZE + len(update.stream), bool(update.stream), update.complete)
