"""What a run of the chain has come to, from the channel's own log and the files on both ends."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from sonarpost.cli.demo.settings import UUV_ADDRESS, ChainSettings
from sonarpost.errors import FrameError
from sonarpost.link.frames.paper.frame import ContactFrame, HalfFrame, parse_frame
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.receiver import ImageUpdate


@dataclass
class ChannelAccount:
    """What the water let through.

    Attributes:
        frames_sent: Frames with content that went into the water.
        frames_lost: Those of them that the receiving modem did not deliver whole.
        acoustic_s: Air time in simulated seconds.
        packets: Packets that the vehicle sent.
        images_through: Images of which enough came through to show something: with the paper's format one frame, with
            v1 what a receiver of its own makes of the frames.
        frames_through: By image and half, the paper's frames that came through.
    """

    frames_sent: int = 0
    frames_lost: int = 0
    packets: int = 0
    acoustic_s: float = 0.0
    images_through: set[str] = field(default_factory=set)
    frames_through: Counter[tuple[str, str]] = field(default_factory=Counter)
    _v1: V1Receiver = field(default_factory=V1Receiver)

    def add_frame(self, content: bytes, *, heard: bool) -> None:
        """Count one frame; `content` is what the receiver got."""
        self.frames_sent += 1
        if not heard:
            self.frames_lost += 1
            return
        for event in self._v1.accept(UUV_ADDRESS, content, 0.0):
            if isinstance(event, ImageUpdate):
                self.images_through.add(event.image_id)
        try:
            frame = parse_frame(content)
        except FrameError:
            return
        self.images_through.add(frame.image_id)
        part = frame.half if isinstance(frame, HalfFrame) else "contact"
        assert isinstance(frame, (HalfFrame, ContactFrame))
        self.frames_through[frame.image_id, part] += 1


def read_channel_log(path: Path) -> ChannelAccount:
    """Add up the channel's log; frames from the vehicle only."""
    account = ChannelAccount()
    if not path.is_file():
        return account
    seen_packets: set[int] = set()
    for line in path.read_text(encoding="utf-8").splitlines():
        entry = json.loads(line)
        if entry.get("event") == "start":
            seen_packets.clear()  # a restarted emulator counts from 1 again
        if entry.get("event") != "packet" or entry["source"] != UUV_ADDRESS:
            continue
        if entry["packet"] not in seen_packets:
            seen_packets.add(entry["packet"])
            # At rate 0 a header goes before each packet, which takes its time and is no packet of pictures.
            account.packets += entry["kind"] == "data"
            account.acoustic_s += entry["airtime_s"]
        for frame in entry["frames"]:
            if frame["fate"] != "empty":
                account.add_frame(bytes.fromhex(frame["hex"]), heard=entry["heard"] and frame["fate"] != "lost")
    return account


@dataclass(frozen=True)
class PictureFile:
    """A picture on the disk of one platform."""

    name: str
    image_id: str
    complete: bool
    sha256: str


def read_pictures(folder: Path) -> dict[str, PictureFile]:
    """Return the pictures of a folder by name, every version."""
    pictures = {}
    for sidecar in sorted(folder.glob("*.json")):
        fields = json.loads(sidecar.read_text(encoding="utf-8"))
        digest = hashlib.sha256(sidecar.with_suffix(".tiff").read_bytes()).hexdigest()
        pictures[sidecar.stem] = PictureFile(sidecar.stem, fields["image_id"], fields["complete"], digest)
    return pictures


@dataclass(frozen=True)
class Result:
    """The demo's last line, field by field as documented in the README."""

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
    missing_ashore: tuple[str, ...]

    def as_json(self) -> str:
        """Return the JSON object of the last line."""
        fields = {name: getattr(self, name) for name in self.__dataclass_fields__ if name != "missing_ashore"}
        return json.dumps(fields)


def settle(settings: ChainSettings, contacts: int, elapsed_s: float) -> Result:
    """Compare what the water let through with what is on the vessel and ashore."""
    channel = read_channel_log(settings.channel_log)
    vessel = read_pictures(settings.vessel_pictures)
    shore = read_pictures(settings.shore_pictures)
    ashore = {picture.image_id for picture in shore.values()}
    return Result(
        contacts=contacts,
        frames_sent=channel.frames_sent,
        frames_lost=channel.frames_lost,
        images_vessel=len({picture.image_id for picture in vessel.values()}),
        images_shore=len(ashore),
        images_complete=len({picture.image_id for picture in shore.values() if picture.complete}),
        sha256_match={n: p.sha256 for n, p in vessel.items()} == {n: p.sha256 for n, p in shore.items()},
        acoustic_s=round(channel.acoustic_s, 1),
        elapsed_s=round(elapsed_s, 1),
        out=str(settings.folder),
        missing_ashore=tuple(sorted(channel.images_through - ashore)),
    )
