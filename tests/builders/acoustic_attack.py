"""Attack an op_modem that was set up by the documentation: `PYTHONPATH=tests python -m builders.acoustic_attack`.

Runs the set-up commands of docs/how-to/certificates.md in a temporary folder, and uses the key with config/vessel.toml.
Frames without the key, and replays of genuine frames, must change nothing. The exit status is 1 if one is accepted.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from random import Random

from builders.authentication_world import VEHICLE
from builders.common import REPOSITORY
from sonarpost.codec.interface import StreamHeader
from sonarpost.config import PlatformConfig, load
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import AcousticKey, Direction
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.config import SenderConfig
from sonarpost.link.downlink.messages import CommandOutcome as Outcome
from sonarpost.link.downlink.messages import ConfirmationMessage, DataMessage, image_of_number, pack
from sonarpost.link.downlink.vessel_endpoint import ReceivedContent
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.frame import ContactFrame
from sonarpost.link.frames.v1.frame import Segment, SegmentKind, checksum, pack_segments
from sonarpost.link.frames.v1.payload_objects import ENTRY_HEAD_BYTES, Feedback, Preview
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.security.acoustic_key import link_key
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.vessel_endpoint import VesselLink

PAGE = REPOSITORY / "docs" / "how-to" / "certificates.md"
VESSEL_TOML = REPOSITORY / "config" / "vessel.toml"
LONDON = ContactSummary(
    height_px=512, width_px=512, lat_deg=51.5, lon_deg=-0.1, time_utc_s=1_475_568_000.0, confidence=2.0
)
PREFIX = StreamHeader(0x20, 1, 512, 512).pack()
PREFIX += bytes(27 - len(PREFIX))


def set_up(folder: Path) -> Path:
    """Run the documented set-up of a fleet in a folder, word for word; return the acoustic key."""
    [block] = re.findall(r"^```sh\n(sonarpost pki init.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    subprocess.run(["bash", "-euc", block], cwd=folder, env={**os.environ, "PATH": path}, check=True)
    return folder / "fleet" / "acoustic.key"


def shipped(key_file: Path, **environment: str) -> tuple[PlatformConfig, OpModemConfig]:
    """Return the shipped configuration of op_modem; only the place of the key is another one."""
    overrides = {"SONARPOST_PLATFORM__ACOUSTIC_KEY_FILE": str(key_file), **environment}
    return load(VESSEL_TOML, "op_modem", OpModemConfig, overrides)


def forged_contact(number: int, protection: FrameAuthenticator | None = None, frame_bytes: int = 60) -> bytes:
    """Return a frame that announces an image of 512 x 512 px, with 27 bytes of its stream."""
    entry = Preview(number, replace(LONDON, time_utc_s=1e9 + number), PREFIX, ended=False)
    packed = entry.pack(ENTRY_HEAD_BYTES + len(PREFIX))
    return pack_segments([Segment(SegmentKind.PREVIEW, packed)], frame_bytes + 8 * bool(protection), protection)


def forgeries(rng: Random) -> Iterator[bytes]:
    """Yield frames of an attacker without the key, all of them with a correct checksum except the random ones."""
    other = FrameAuthenticator(AcousticKey(rng.randbytes(32)), VEHICLE, Direction.FROM_VEHICLE)
    other.grant(other.settings.lifetime_frames)
    number = 0
    while True:
        number = number % 60_000 + 1
        message = pack(DataMessage(rng.randbytes(12)))
        confirmed = pack(ConfirmationMessage(((rng.randrange(2**32), Outcome.ACCEPTED),)))
        yield forged_contact(number)
        yield forged_contact(number, other)
        yield ContactFrame(image_of_number(number), LONDON).pack()
        yield pack_segments([Segment(SegmentKind.MESSAGE, bytes([number % 256]) + message)], 32)
        yield pack_segments([Segment(SegmentKind.MESSAGE, bytes([number % 256]) + confirmed)], 32, other)
        yield pack_segments([Segment(SegmentKind.FEEDBACK, Feedback(number % 32, 1, (0,) * 16).pack())], 32)
        body = bytes([0x80 | rng.randrange(128)]) + rng.randbytes(61)
        yield checksum(body).to_bytes(2, "big") + body
        yield rng.randbytes(64)


def genuine_frames(key: AcousticKey, images: int, first_counter: int = 0) -> list[bytes]:
    """Return the frames of a vehicle that has the key."""
    authenticator = FrameAuthenticator(key, VEHICLE, Direction.FROM_VEHICLE, first_counter=first_counter)
    authenticator.grant(authenticator.settings.lifetime_frames)
    config = SenderConfig(frame_bytes=64, channels=(LossChannel(0.3),), frames_per_image=6)
    sender = V1Sender(config, protection=authenticator)
    for number in range(1, images + 1):
        sender.add_image(number, replace(LONDON, time_utc_s=1e9 + number), PREFIX + bytes([number] * 120), 0.0)
    frames: list[bytes] = []
    while (data := sender.next_frame(0.0)) is not None:
        frames.append(data)
    return frames


def changes(content: ReceivedContent) -> bool:
    """Return whether a frame had any effect."""
    return bool(content.images or content.messages or content.commands or not content.rejected)


def attack(link: VesselLink, frames: int, replays: Sequence[bytes], seed: int = 0) -> dict[str, float]:
    """Send frames without the key and replays to the vessel's link; return how many were accepted."""
    began = time.process_time()
    forged = forgeries(Random(seed))
    accepted = sum(changes(link.endpoint.accept(VEHICLE, next(forged), 2e9)) for _ in range(frames))
    replayed = sum(
        changes(link.endpoint.accept(address, data, 2e9)) for data in replays for address in (VEHICLE, VEHICLE + 1)
    )
    return {
        "forged": frames,
        "forged_accepted": accepted,
        "replays": 2 * len(replays),
        "replays_accepted": replayed,
        "cpu_s": round(time.process_time() - began, 1),
    }


def run(key_file: Path, frames: int, *, used_counters: int = 0, seed: int = 0) -> dict[str, float]:
    """Receive a vehicle's images, then attack.

    Args:
        key_file: The acoustic key of the deployment.
        frames: Number of frames without the key.
        used_counters: Frames that the vehicle has sent before. The receiver tries all later counters for each forged
            frame, so a high number makes it faster.
        seed: Seed of the attacker.
    """
    platform, config = shipped(key_file)
    key = link_key(platform)
    assert key is not None
    link = VesselLink(platform.id, config, FrameAuthenticator(key, config.address, Direction.TO_VEHICLE))
    genuine = genuine_frames(key, 40, used_counters)
    taken = sum(changes(link.endpoint.accept(VEHICLE, data, 1e9)) for data in genuine)
    assert taken >= len(genuine) - 1  # the first frame far ahead waits for confirmation
    return attack(link, frames, genuine, seed)


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description="Send frames without the key to a receiver set up as documented.")
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--used-counters", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parsed = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = run(set_up(Path(folder)), parsed.frames, used_counters=parsed.used_counters, seed=parsed.seed)
    print(json.dumps(found))
    sys.exit(bool(found["forged_accepted"] or found["replays_accepted"]))


if __name__ == "__main__":
    main()
