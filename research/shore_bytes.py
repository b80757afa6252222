"""Bytes from vessel to shore for one contact: decoded images, and coded streams.

    python -m research.shore_bytes --contacts 20 --lengths 64,200,400,640

Each contact is received in versions of the given lengths, the first with the contact record, and each one later is a
refinement. Printed are the mean bytes of a payload for each version, and of payload, key and attachment of the delivery
query that carries it alone. Headers of the transport are not included.
"""

import argparse
import sys
from hashlib import sha256

import numpy as np

from sonarpost import keys, wire
from sonarpost.archive import image_parts
from sonarpost.archive.decoder import Decoder
from sonarpost.codec import encode
from sonarpost.delivery.protocol import attachment
from sonarpost.delivery.records import OutboxItem
from sonarpost.link.frames.contact_record import RECORD_SIZE, ContactSummary
from sonarpost.link.receiver import ImageUpdate, received_image
from sonarpost.messages import ReceivedImage, Record, Relayed
from sonarpost.sonar.survey import Side

ORIGIN = bytes(16)
START_S = 1_700_000_000.0
VESSEL = "vessel-1"


def contacts(number: int, stream_bytes: int, seed: int) -> list[ReceivedImage]:
    """Return received images of speckle with a target and its shadow."""
    rng = np.random.default_rng(seed)
    images = []
    for n in range(1, number + 1):
        pixels = rng.gamma(4.0, 20.0, (80, 140))
        row, column = rng.integers(20, 60), rng.integers(20, 70)
        pixels[row : row + 8, column : column + 10] *= 2.5
        pixels[row : row + 8, column + 10 : column + 40] *= 0.15
        stream = encode(pixels.clip(0, 255).astype(np.uint8), "emb", stream_bytes)
        summary = ContactSummary(
            height_px=80,
            width_px=140,
            lat_deg=50.0 + n / 1000,
            lon_deg=-1.0,
            time_utc_s=START_S + n,
            confidence=1.2,
            side=Side.PORT,
            ground_range_m=30.0,
            position_sigma_m=4.0,
            atd_class="mine_like",
            p_mine_like=0.7,
            p_other_object=0.2,
        )
        update = ImageUpdate(
            source=1,
            image_id=f"{n:04d}",
            version=1,
            contact=summary.rounded(),
            stream=stream,
            missing=(),
            complete=True,
            received_bytes=len(stream),
            total_bytes=len(stream),
            frames=3,
            conflicts=0,
            first_frame_s=START_S + n,
            last_frame_s=START_S + n + 60,
        )
        images.append(received_image(update, "vessel-1", "uuv-1"))
    return images


def delivery_bytes(record: Record, key: str) -> tuple[int, int]:
    """Return the length of a record's payload, and of payload, key and attachment together."""
    payload = wire.encode(record)
    encoding = wire.encoding_of(type(record))
    item = OutboxItem("c2", 100, key, encoding, 5, payload, sha256(payload).digest())
    return len(payload), len(payload) + len(key) + len(attachment(ORIGIN, item))


def versions(image: ReceivedImage, lengths: list[int]) -> list[ReceivedImage]:
    """Return the versions of an image with the first bytes of its stream."""
    total = len(image.stream)
    received = [min(length, total) for length in lengths]
    return [
        image.model_copy(
            update={
                "version": number,
                "stream": image.stream[:length],
                "bytes_received": length,
                "bytes_total": length,
                "last_frame_utc_s": image.first_frame_utc_s + 10 * number,
            }
        )
        for number, length in enumerate(received, start=1)
    ]


def main() -> int:
    """Print the figures; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--contacts", type=int, default=20, help="number of contacts")
    parser.add_argument("--lengths", default="64,200,400,640", help="received bytes of each version")
    parser.add_argument("--seed", type=int, default=1, help="seed of the images")
    args = parser.parse_args()
    lengths = [int(length) for length in args.lengths.split(",")]
    decoder = Decoder(("nominal-10",))
    rows = np.zeros((len(lengths), 4))
    received_bytes = np.diff([0, *lengths]) + np.eye(1, len(lengths), dtype=int)[0] * RECORD_SIZE
    for image in contacts(args.contacts, max(lengths), args.seed):
        base = None
        for n, received in enumerate(versions(image, lengths)):
            decoded = decoder.decode(received)
            key = keys.image_reconstructed(VESSEL)
            envelope = Relayed(vessel_id=VESSEL, key=key, payload=wire.encode(decoded), relayed_utc_s=1e9)
            whole = image_parts.whole_part(decoder.coded_image(received, decoded))
            part = whole if base is None else image_parts.difference(whole, base)
            base = whole
            rows[n, :2] += delivery_bytes(envelope, keys.shore_inbox(VESSEL, keys.SHORE))
            rows[n, 2:] += delivery_bytes(part, keys.shore_part(VESSEL, keys.SHORE))
    rows /= args.contacts
    print(f"{'version':8}{'received':>10}{'decoded':>20}{'coded':>20}{'coded / received':>20}")
    for n, row in enumerate(rows):
        print(_line(str(n + 1), int(received_bytes[n]), row))
    print(_line("all", int(received_bytes.sum()), rows.sum(axis=0)))
    print("Bytes of a payload; in brackets with key and attachment.")
    return 0


def _line(name: str, received: int, row: np.ndarray) -> str:
    pixels, pixels_all, coded, coded_all = row
    return (
        f"{name:8}{received:10}{f'{pixels:.0f} ({pixels_all:.0f})':>20}{f'{coded:.0f} ({coded_all:.0f})':>20}"
        f"{f'{coded / received:.2f} ({coded_all / received:.2f})':>20}"
    )


if __name__ == "__main__":
    sys.exit(main())
