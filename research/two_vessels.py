"""`python -m research.two_vessels`: what a lead vessel gains that merges the frames of a second one, simulated.

A vehicle sends images of random streams in the `v1` format with authentication. Two vessels receive it over independent
channels. The frames of the second one reach the lead vessel later. Measured are the images that are complete without
feedback, and the air time until all images are complete with feedback: for each vessel alone, and merged.
"""

import argparse
import sys
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from research.common.command import command_parser, report_progress, run_command
from research.link.schemes import LossyChannel
from sonarpost.errors import ConfigError
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import AcousticKey, Direction
from sonarpost.link.auth.merging import FrameMerger
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.config import ReceiverConfig, SenderConfig
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.frame import Segment, SegmentKind, pack_segments
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.link.receiver import FeedbackReceived, ImageUpdate
from sonarpost.modem.micromodem import RATES

_VEHICLE: Final = 3
_LEAD: Final = 1
_OTHER: Final = "vessel-2"
_KEY: Final = AcousticKey(bytes(range(32)))
_RATE: Final = RATES[1]
_FEEDBACK_RATE: Final = RATES[0]
_STREAM_BYTES: Final = 500
_MAX_FRAMES: Final = 100_000
WAYS: Final = ("vessel-1", "vessel-2", "merged")


@dataclass(frozen=True, slots=True)
class TwoVesselsSpec:
    """Parameters of a measurement.

    Attributes:
        loss: Share of frames lost on the way to each vessel, and of feedback.
        burst: Mean number of frames lost in a row.
        planned_loss: Loss for which the vehicle plans without feedback; the default is that of a vehicle.
        images: Number of images.
        delay_frames: Delay of the frames of the second vessel, as a number of frames of the vehicle.

    Raises:
        ConfigError: A value out of range.
    """

    loss: float = 0.4
    burst: float = 1.0
    planned_loss: float = 0.2
    images: int = 24
    delay_frames: int = 20

    def __post_init__(self) -> None:
        limits = (
            ("loss", 0, 0.9),
            ("burst", 1, 1000),
            ("planned_loss", 0, 0.9),
            ("images", 1, 200),
            ("delay_frames", 0, 1000),
        )
        for name, low, high in limits:
            if not low <= getattr(self, name) <= high:
                raise ConfigError("two_vessels", name, getattr(self, name), f"{low}..{high}")


@dataclass(frozen=True, slots=True)
class TwoVesselsResult:
    """Result of one seed, by way: each vessel alone, and merged.

    Attributes:
        complete: Share of images that are complete without feedback.
        received_bytes: Mean number of bytes of an image without feedback.
        air_s: Air time until all images are complete with feedback, feedback included.
        feedback: Feedback messages sent until then.
    """

    complete: dict[str, float] = field(default_factory=dict)
    received_bytes: dict[str, float] = field(default_factory=dict)
    air_s: dict[str, float] = field(default_factory=dict)
    feedback: dict[str, float] = field(default_factory=dict)


class _Water:
    """The channels to both vessels, the link between them, and the receiver of the lead vessel.

    Args:
        spec: Parameters.
        way: A vessel alone, or "merged".
        seed: Seed of the losses; the losses of a vessel do not depend on `way`.
    """

    def __init__(self, spec: TwoVesselsSpec, way: str, seed: int) -> None:
        channel = LossChannel(spec.loss, spec.burst)
        self._channels = {name: LossyChannel(channel, 2 * seed + n) for n, name in enumerate(("vessel-1", _OTHER))}
        self._ways = ("vessel-1", _OTHER) if way == "merged" else (way,)
        self._merges = way == "merged"
        self._delay_frames = spec.delay_frames
        self._on_the_way: deque[tuple[int, bytes]] = deque()
        own = _verifier()
        merger = FrameMerger(own, {_OTHER: _verifier()}) if self._merges else None
        self.receiver = V1Receiver(ReceiverConfig(max_contacts=65535), protection=own, merger=merger)
        self.latest: dict[str, ImageUpdate] = {}
        self.frames = 0

    def send(self, frame: bytes | None, now: float) -> None:
        """Let a frame of the vehicle arrive or get lost, and frames of the second vessel arrive at the lead vessel."""
        self.frames += frame is not None
        for name in self._ways if frame is not None else ():
            if not self._channels[name].receives():
                continue
            if self._merges and name == _OTHER:
                self._on_the_way.append((self.frames + self._delay_frames, frame or b""))
            else:
                self._add(self.receiver.accept(_VEHICLE, frame or b"", now))
        while self._on_the_way and (frame is None or self._on_the_way[0][0] <= self.frames):
            self._add(self.receiver.accept_from(_OTHER, _VEHICLE, self._on_the_way.popleft()[1], now))

    def _add(self, events: Sequence[object]) -> None:
        self.latest |= {event.image_id: event for event in events if isinstance(event, ImageUpdate)}

    @property
    def complete(self) -> int:
        """Number of complete images."""
        return sum(update.complete for update in self.latest.values())


def _verifier() -> FrameAuthenticator:
    return FrameAuthenticator(_KEY, _LEAD, Direction.TO_VEHICLE)


def _sender(spec: TwoVesselsSpec, seed: int, *, feedback: bool) -> V1Sender:
    authenticator = FrameAuthenticator(_KEY, _VEHICLE, Direction.FROM_VEHICLE)
    authenticator.grant(authenticator.settings.lifetime_frames)
    config = SenderConfig(
        frame_bytes=_RATE.frame_bytes,
        channels=(LossChannel(spec.planned_loss, spec.burst),),
        feedback=feedback,
        stream_bytes=_STREAM_BYTES,
        kept_images=spec.images,
    )
    sender, rng = V1Sender(config, protection=authenticator), np.random.default_rng(seed)
    for number in range(1, spec.images + 1):
        contact = ContactSummary(height_px=80, width_px=80, lat_deg=44.0, lon_deg=-63.0, time_utc_s=1.6e9 + number)
        sender.add_image(number, contact, rng.bytes(_STREAM_BYTES), 0.0)
    return sender


def measure(spec: TwoVesselsSpec, seed: int) -> TwoVesselsResult:
    """Measure one seed; the same values give the same result."""
    result = TwoVesselsResult()
    for way in WAYS:
        water, sender = _Water(spec, way, seed), _sender(spec, seed, feedback=False)
        while (frame := sender.next_frame(float(water.frames))) is not None:
            water.send(frame, float(water.frames))
        water.send(None, float(water.frames))
        result.complete[way] = water.complete / spec.images
        result.received_bytes[way] = sum(u.received_bytes for u in water.latest.values()) / spec.images
        result.air_s[way], result.feedback[way] = _with_feedback(spec, way, seed)
    return result


def _with_feedback(spec: TwoVesselsSpec, way: str, seed: int) -> tuple[float, float]:
    """Return the air time until all images are complete, and the number of feedback messages."""
    water, sender = _Water(spec, way, seed), _sender(spec, seed, feedback=True)
    back, downlink, reports = V1Receiver(), LossyChannel(LossChannel(spec.loss, spec.burst), seed), 0
    for step in range(1, _MAX_FRAMES):
        now = step * _RATE.airtime_s / _RATE.frames
        water.send(sender.next_frame(now), now)
        if water.complete == spec.images:
            break
        report = water.receiver.feedback(_VEHICLE, now) if water.receiver.feedback_is_due(_VEHICLE, now) else None
        if report is None:
            continue
        reports += 1
        frame = pack_segments([Segment(SegmentKind.FEEDBACK, report.pack())], _FEEDBACK_RATE.frame_bytes)
        for event in back.accept(_LEAD, frame, now) if downlink.receives() else []:
            if isinstance(event, FeedbackReceived):
                sender.on_feedback(event.feedback, now)
    if water.complete < spec.images:
        raise AssertionError(f"{way}: only {water.complete} of {spec.images} images are complete")
    return water.frames * _RATE.airtime_s / _RATE.frames + reports * _FEEDBACK_RATE.airtime_s, float(reports)


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    default = TwoVesselsSpec()
    parser = command_parser(
        "two_vessels", "Measure images and air time of two vessels that receive one vehicle, alone and merged."
    )
    parser.add_argument("--loss", type=float, default=default.loss, metavar="P", help="share of frames lost (0.4)")
    parser.add_argument("--burst", type=float, default=default.burst, metavar="N", help="mean frames lost in a row (1)")
    parser.add_argument(
        "--planned-loss", type=float, default=default.planned_loss, metavar="P", help="loss the vehicle plans for (0.2)"
    )
    parser.add_argument("--images", type=int, default=default.images, metavar="N", help="number of images (24)")
    parser.add_argument(
        "--delay-frames", type=int, default=default.delay_frames, metavar="N", help="delay of the second vessel (20)"
    )
    parser.add_argument("--seeds", type=int, default=20, metavar="N", help="number of seeds, 1..1000 (20)")
    return parser


def run(args: argparse.Namespace) -> int:
    """Measure and print; return 0.

    Raises:
        ConfigError: An option out of range.
    """
    spec = TwoVesselsSpec(args.loss, args.burst, args.planned_loss, args.images, args.delay_frames)
    if not 1 <= args.seeds <= 1000:
        raise ConfigError("two_vessels", "--seeds", args.seeds, "1..1000")
    results: list[TwoVesselsResult] = []
    for seed in range(args.seeds):
        report_progress(f"seed {seed + 1} of {args.seeds}")
        results.append(measure(spec, seed))
    print(f"{args.seeds} seeds, {spec.images} images, {spec.loss:.0%} independent loss to each vessel")
    print(table({way: summary(results, way) for way in WAYS}))
    return 0


def summary(results: Sequence[TwoVesselsResult], way: str) -> dict[str, float]:
    """Return the means of a way over the seeds, and the worst completeness."""
    complete = [result.complete[way] for result in results]
    return {
        "complete": float(np.mean(complete)),
        "worst": min(complete),
        "bytes": float(np.mean([result.received_bytes[way] for result in results])),
        "air_s": float(np.mean([result.air_s[way] for result in results])),
        "feedback": float(np.mean([result.feedback[way] for result in results])),
    }


def table(rows: Mapping[str, Mapping[str, float]]) -> str:
    """Return the means as text; `ratio` is the air time divided by that of the merged vessels."""
    lines = [f"{'':8}  without feedback          with feedback, until complete"]
    lines.append(f"{'':8}  complete   worst  bytes   air time s  ratio  feedback")
    for way, row in rows.items():
        ratio = row["air_s"] / rows["merged"]["air_s"]
        without = f"{row['complete']:8.1%} {row['worst']:7.1%} {row['bytes']:6.0f}"
        lines.append(f"{way:8}  {without}   {row['air_s']:10.1f} {ratio:6.2f} {row['feedback']:9.1f}")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
