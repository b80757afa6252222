"""Bytes from vessel to shore for each contact of a demo whose images are refined.

    python -m research.demo_bytes --loss 0.3 --refinements 2 [--seed 1] [--dir DIR]

It runs the chain of `sonarpost demo` with a simulated survey. When all images are complete at the shore site and the
chain is idle, it sends a command `refine` for each image, and waits again; as often as `--refinements`. Printed for
each contact:

- versions: versions of the image that the shore site has acknowledged;
- received: bytes of the stream that the vessel has received acoustically, and the 25 bytes of the contact record;
- coded: payloads of the coded records that went to the shore site, those of all versions together, refused ones
  included. The relay of the chain is `research.recording_relay`, which records them;
- pixels: payloads of the records with decoded pixels of the same versions.

Keys, attachments and headers of the transport are not included. The exit status is 0 if every image is complete and
was refined that often.
"""

import argparse
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import zenoh
from typing_extensions import override

from research.fleet import open_session
from research.recording_relay import acknowledged
from sonarpost import keys, wire
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.delivery.client import deliver
from sonarpost.extensions.simulation.demo.chain import Chain
from sonarpost.extensions.simulation.demo.outcome import read_channel_log
from sonarpost.extensions.simulation.demo.settings import ROUTER_PORTS, UUV, VESSEL, ChainSettings, reserved_ports
from sonarpost.extensions.simulation.demo.watch import Watcher
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.extensions.simulation.seabed.xtf_writer import write_xtf
from sonarpost.link.frames.contact_record import RECORD_SIZE
from sonarpost.messages import Command, ReconstructedImage, Relayed

TIMEOUT_S = 600.0
IDLE_S = 3.0
REPORT_AGE_S = 5.0


class RecordedChain(Chain):
    """The chain of the demo with a relay that records acknowledgements."""

    @override
    def module(self, name: str) -> tuple[str, ...]:
        command = super().module(name)
        return ("research.recording_relay", *command[1:]) if name == "relay" else command


class PixelRecords:
    """Lengths of the records with decoded pixels, if they were sent to a shore site."""

    def __init__(self, session: zenoh.Session) -> None:
        self.lengths: dict[tuple[str, int], int] = {}
        self._lock = threading.Lock()
        session.declare_subscriber(keys.image_reconstructed(VESSEL), self._on_sample)

    def _on_sample(self, sample: zenoh.Sample) -> None:
        payload, key = sample.payload.to_bytes(), str(sample.key_expr)
        image = wire.decode(ReconstructedImage, payload, key)
        record = Relayed(vessel_id=VESSEL, key=key, payload=payload, relayed_utc_s=time.time())
        with self._lock:
            self.lengths[image.image_id, image.version] = len(wire.encode(record))


def wait_until(condition: Callable[[], bool], chain: Chain, what: str) -> None:
    """Wait until a condition has been true for `IDLE_S`; exit after `TIMEOUT_S`."""
    deadline_s = time.monotonic() + TIMEOUT_S
    since_s: float | None = None
    while since_s is None or time.monotonic() - since_s < IDLE_S:
        chain.check()
        if time.monotonic() > deadline_s:
            sys.exit(f"demo_bytes: {what}: not within {TIMEOUT_S:.0f} s")
        since_s = (since_s or time.monotonic()) if condition() else None
        time.sleep(0.1)


def refine(session: zenoh.Session, image_id: str, number: int) -> None:
    """Send a command for more detail of an image to the vessel's modem."""
    command = Command(
        command_id=f"refine-{number}-{image_id}",
        kind="refine",
        vehicle_id=UUV,
        image_id=image_id,
        issued_by="demo_bytes",
        issued_utc_s=time.time(),
    )
    deliver(session, keys.command(VESSEL, "refine"), "op_modem", command, TIMEOUT_S)


def run(settings: ChainSettings, refinements: int) -> bool:
    """Run the chain and print the figures; return whether all images are complete and refined."""
    with RecordedChain(settings) as chain, Watcher(settings, chain.check) as watcher:
        session = open_session(f"tcp/127.0.0.1:{settings.router_ports[1]}")
        pixels = PixelRecords(session)
        watcher.wait_until_started()
        survey = simulate_survey(SurveySpec(seed=settings.seed, seabed=SeabedKind.SAND, targets=6, clutter=6)).survey
        hidden = settings.incoming / ".simulated.xtf"
        write_xtf(survey, hidden)
        hidden.rename(settings.incoming / "simulated.xtf")
        received: dict[str, int] = {}

        def is_received() -> bool:
            """Whether all images are complete at the shore site, with more bytes than before."""
            if watcher.busy(1, time.time() - REPORT_AGE_S) or not watcher.encoded:
                return False
            shore = watcher.shore
            return all(shore[image_id].bytes_received > received.get(image_id, 0) for image_id in watcher.encoded)

        wait_until(is_received, chain, "every image complete at the shore site")
        for number in range(refinements):
            received = {image_id: image.bytes_received for image_id, image in watcher.shore.items()}
            for image_id in watcher.encoded:
                refine(session, image_id, number)
            wait_until(is_received, chain, f"refinement {number + 1} of every image")
        session.close()
        complete = watcher.all_complete
        received = {image_id: image.bytes_received + RECORD_SIZE for image_id, image in watcher.shore.items()}
    channel = read_channel_log(settings.channel_log)
    print(f"{len(received)} contacts, {channel.frames_lost} of {channel.frames_sent} acoustic frames lost")
    print_table(settings, received, pixels)
    return complete


def print_table(settings: ChainSettings, received: dict[str, int], pixels: PixelRecords) -> None:
    """Print the bytes of each contact, and of all."""
    coded: defaultdict[str, int] = defaultdict(int)
    versions: defaultdict[str, set[int]] = defaultdict(set)
    for entry in acknowledged(settings.folder / "state" / VESSEL):
        coded[entry["image_id"]] += entry["bytes"]
        versions[entry["image_id"]].add(entry["version"])
    rows = [
        (
            image_id,
            len(versions[image_id]),
            size,
            coded[image_id],
            sum(pixels.lengths[image_id, version] for version in versions[image_id]),
        )
        for image_id, size in sorted(received.items())
    ]
    rows.append(("all", *(sum(column) for column in list(zip(*rows, strict=True))[1:])))
    headings = ("contact", "versions", "received", "coded", "coded / received", "pixels", "pixels / coded")
    print("".join(f"{heading:>18}" for heading in headings))
    for name, count, size, coded_bytes, pixel_bytes in rows:
        cells = (name, count, size, coded_bytes, f"{coded_bytes / size:.2f}")
        print("".join(f"{cell:>18}" for cell in (*cells, pixel_bytes, f"{pixel_bytes / coded_bytes:.0f}")))


def main() -> int:
    """Run; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--loss", type=float, default=0.3, metavar="P", help="probability that a frame is lost")
    parser.add_argument("--refinements", type=int, default=2, metavar="N", help="commands `refine` for each image")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="seed of the survey and channel simulators")
    parser.add_argument("--dir", type=Path, metavar="DIR", help="folder for the chain (default: temporary)")
    args = parser.parse_args()
    with (
        ProgressDisplay(step="demo"),
        tempfile.TemporaryDirectory(dir=args.dir) as name,
        reserved_ports(*ROUTER_PORTS) as ports,
    ):
        settings = ChainSettings(
            folder=Path(name), loss=args.loss, seed=args.seed, router_ports=(ports[0], ports[1], ports[2])
        )
        return 0 if run(settings, args.refinements) else 1


if __name__ == "__main__":
    sys.exit(main())
