"""Outcome of a run: what the channel delivered compared with the images at the vessel and at the shore site."""

import hashlib
import json
from collections import Counter
from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from sonarpost.errors import FrameError
from sonarpost.extensions.simulation.demo.settings import UUV_ADDRESS, ChainSettings
from sonarpost.link.frames.paper.frame import HalfFrame, parse_frame
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.receiver import ImageUpdate

MAX_RECOVERABLE_LOSS = 0.9
"""Frame loss up to which v1 must complete every image."""


@dataclass
class ChannelDelivery:
    """What the channel delivered from the vehicle to the vessel.

    Attributes:
        frames_sent: Frames with content that the vehicle sent.
        frames_lost: Of these, frames that the vessel's modem did not deliver intact.
        packets: Packets that the vehicle sent.
        acoustic_s: Airtime in simulated seconds.
        delivered_images: Images that can be shown: with the paper's format, one frame was delivered; with v1, an
            independent receiver reports them.
        delivered_frames: Delivered frames of the paper's format, by image and half.
    """

    frames_sent: int = 0
    frames_lost: int = 0
    packets: int = 0
    acoustic_s: float = 0.0
    delivered_images: set[str] = field(default_factory=set)
    delivered_frames: Counter[tuple[str, str]] = field(default_factory=Counter)
    _v1: V1Receiver = field(default_factory=V1Receiver)

    def add_frame(self, data: bytes, *, delivered: bool) -> None:
        """Count one frame; `data` is what the vessel's modem received."""
        self.frames_sent += 1
        self.frames_lost += not delivered
        if not delivered:
            return
        for event in self._v1.accept(UUV_ADDRESS, data, 0.0):
            if isinstance(event, ImageUpdate):
                self.delivered_images.add(event.image_id)
        with suppress(FrameError):
            frame = parse_frame(data)
            self.delivered_images.add(frame.image_id)
            self.delivered_frames[frame.image_id, frame.half if isinstance(frame, HalfFrame) else "contact"] += 1


def read_channel_log(path: Path) -> ChannelDelivery:
    """Read the log of the simulated channel; only frames of the vehicle count."""
    delivery, seen_packets = ChannelDelivery(), set[int]()
    for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else ():
        entry = json.loads(line)
        if entry.get("event") == "start":
            seen_packets.clear()  # a restarted emulator counts from 1 again
        if entry.get("event") != "packet" or entry["source"] != UUV_ADDRESS:
            continue
        if entry["packet"] not in seen_packets:
            seen_packets.add(entry["packet"])
            # At rate 0 a header precedes each packet: it takes airtime and holds no image data.
            delivery.packets += entry["kind"] == "data"
            delivery.acoustic_s += entry["airtime_s"]
        for frame in entry["frames"]:
            if frame["fate"] != "empty":
                delivered = entry["heard"] and frame["fate"] != "lost"
                delivery.add_frame(bytes.fromhex(frame["hex"]), delivered=delivered)
    return delivery


@dataclass(frozen=True)
class ImageFile:
    """An image on the disk of one platform; `has_pixels` is false if only its contact record was received."""

    name: str
    image_id: str
    complete: bool
    has_pixels: bool
    sha256: str


def read_images(folder: Path) -> dict[str, ImageFile]:
    """Return the images of a folder by name, every version."""
    images = {}
    for sidecar in sorted(folder.glob("*.json")):
        fields = json.loads(sidecar.read_text(encoding="utf-8"))
        has_pixels = fields["missing_fraction"] < 1
        digest = hashlib.sha256(sidecar.with_suffix(".tiff").read_bytes()).hexdigest()
        images[sidecar.stem] = ImageFile(sidecar.stem, fields["image_id"], fields["complete"], has_pixels, digest)
    return images


def last_versions(images: Mapping[str, ImageFile]) -> list[ImageFile]:
    """Return the last version of each image; an image with two sets of files, from two missions, has two."""
    last: dict[str, tuple[int, ImageFile]] = {}
    for name, image in images.items():
        base, _, version = name.rpartition("_v")
        if base not in last or int(version) > last[base][0]:
            last[base] = int(version), image
    return [image for _, image in last.values()]


@dataclass(frozen=True)
class Outcome:
    """Figures of a run; the fields up to `out` are the JSON object that `--json` prints.

    Attributes:
        images_vessel: Images at the vessel of which at least one pixel was received.
        images_shore: The same at the shore site.
        sha256_match: Whether the last version of each image of the vessel is at the shore site, and all images there
            are identical to those of the vessel. The relay may replace an earlier version that it has not sent yet.
        missing: Images that the channel delivered, at least in part, and that are not at the shore site.
        incomplete: Images at the shore site that v1 should have completed.
        not_sent: Contacts of which no image was encoded.
    """

    contacts: int
    frames_sent: int
    frames_lost: int
    images_vessel: int
    images_shore: int
    images_complete: int
    sha256_match: bool
    acoustic_s: float
    elapsed_s: float
    out: str
    missing: tuple[str, ...] = ()
    incomplete: tuple[str, ...] = ()
    not_sent: tuple[str, ...] = ()

    @property
    def succeeded(self) -> bool:
        """Whether everything that the channel can deliver is at the shore site, unchanged."""
        return self.sha256_match and not (self.missing or self.incomplete or self.not_sent)

    @property
    def failures(self) -> list[str]:
        """Lines with the contacts and images that should be at the shore site."""
        found = {
            "contacts without an encoded image": self.not_sent,
            "images missing at the shore site": self.missing,
            "images incomplete at the shore site": self.incomplete,
        }
        return [f"[red]FAILED: {len(names)} {text}: {', '.join(names)}" for text, names in found.items() if names]

    def as_json(self) -> str:
        """Return the JSON object of the last line."""
        internal = ("missing", "incomplete", "not_sent")
        return json.dumps({name: getattr(self, name) for name in self.__dataclass_fields__ if name not in internal})


def evaluate(
    settings: ChainSettings, contacts: Collection[str], encoded: Mapping[str, str], elapsed_s: float
) -> Outcome:
    """Compare what the channel delivered with the images at the vessel and at the shore site.

    With v1, lost frames are repeated: up to a frame loss of 0.9 every encoded image must be complete at the shore site.
    The paper's format repeats nothing: every image of which a frame was delivered must be there.

    Args:
        settings: Settings of the chain.
        contacts: Identifiers of the detected contacts.
        encoded: Contact identifier by image identifier, for each encoded image.
        elapsed_s: Real time that the run took.
    """
    channel = read_channel_log(settings.channel_log)
    vessel, shore = read_images(settings.vessel_images), read_images(settings.shore_images)
    at_shore = {image.image_id for image in shore.values()}
    complete = {image.image_id for image in shore.values() if image.complete}
    must_complete = settings.link == "v1" and settings.loss <= MAX_RECOVERABLE_LOSS
    expected = channel.delivered_images | (set(encoded) if must_complete else set())
    return Outcome(
        contacts=len(contacts),
        frames_sent=channel.frames_sent,
        frames_lost=channel.frames_lost,
        images_vessel=len({image.image_id for image in vessel.values() if image.has_pixels}),
        images_shore=len({image.image_id for image in shore.values() if image.has_pixels}),
        images_complete=len(complete),
        sha256_match=all(name in vessel and vessel[name].sha256 == image.sha256 for name, image in shore.items())
        and all(image.name in shore for image in last_versions(vessel)),
        acoustic_s=round(channel.acoustic_s, 1),
        elapsed_s=round(elapsed_s, 1),
        out=str(settings.folder),
        missing=tuple(sorted(expected - at_shore)),
        incomplete=tuple(sorted(at_shore - complete if must_complete else ())),
        not_sent=tuple(sorted(set(contacts) - set(encoded.values()))),
    )
