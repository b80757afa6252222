"""Contacts with previews through messages of 340 bytes, of which a part is lost, with a simulated clock.

    python -m research.short_messages --contacts 100 --loss 0.2

Encodes simulated contacts, sends them with the sender and receiver of `sonarpost.bearers`, and prints messages, bytes
and time. The exit status is 1 if a record is missing or arrived twice.
"""

from __future__ import annotations

import argparse
import random
import sys

import numpy as np

from sonarpost.bearers.receiver import ShortMessageReceiver
from sonarpost.bearers.sender import ShortMessageSender, image_items
from sonarpost.codec import encode
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.received_image import received_image
from sonarpost.link.receiver import ImageUpdate
from sonarpost.messages import ReceivedImage
from sonarpost.sonar.survey import Side

START_S = 1_700_000_000.0
STEP_S = 1.0
SESSION_S = 20.0
"""Time of one exchange of a terminal with the network."""


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


def main() -> int:
    """Print the figures; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--contacts", type=int, default=100, help="number of contacts")
    parser.add_argument("--loss", type=float, default=0.2, help="fraction of messages lost in each direction")
    parser.add_argument("--preview-bytes", type=int, default=260, help="longest preview")
    parser.add_argument("--stream-bytes", type=int, default=200, help="length of the coded images")
    parser.add_argument("--seed", type=int, default=1, help="seed of the random numbers")
    args = parser.parse_args()
    images = contacts(args.contacts, args.stream_bytes, args.seed)
    rng = random.Random(args.seed)
    sender, receiver = ShortMessageSender(args.seed), ShortMessageReceiver("vessel-1")
    for image in images:
        sender.insert(image_items(image, sender.next_number, args.preview_bytes, 0.0))
    now_s = free_s = 0.0
    sizes: list[int] = []
    acknowledgements: list[int] = []
    records: list[ReceivedImage] = []
    while sender.waiting or sender.unacknowledged:
        now_s += STEP_S
        message = sender.next_message(now_s) if now_s >= free_s else None
        if message is not None:
            free_s = now_s + SESSION_S
            sizes.append(len(message.data))
            if rng.random() >= args.loss:
                records += [r for r in receiver.receive(message.data, now_s) if isinstance(r, ReceivedImage)]
        for data in receiver.acknowledgements(now_s):
            acknowledgements.append(len(data))
            if rng.random() >= args.loss:
                sender.acknowledge(data, now_s)
    names = [record.image_id for record in records]
    whole = sum(record in images for record in records)
    previews = [record.bytes_received for record in records]
    print(f"contacts    {len(images)}, arrived {len(set(names))}, twice {len(names) - len(set(names))}")
    print(f"previews    {np.mean(previews):.0f} B each on average; {whole} hold the whole stream")
    print(
        f"messages    {len(sizes)} of at most {max(sizes)} B, {sum(sizes)} B; "
        f"{sum(sizes) / len(images):.0f} B a contact"
    )
    print(f"other way   {len(acknowledgements)} acknowledgements, {sum(acknowledgements)} B")
    print(f"time        {now_s / 60:.0f} min at {SESSION_S:g} s a message")
    return 0 if sorted(names) == sorted(image.image_id for image in images) else 1


if __name__ == "__main__":
    sys.exit(main())
