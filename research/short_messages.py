"""Contacts with previews through messages of 340 bytes, of which a part is lost, with a simulated clock.

    python -m research.short_messages --contacts 100 --loss 0.2

Encodes simulated contacts, sends them with the sender and receiver of `sonarpost.extensions.satellite`, and prints
messages, bytes and time. The exit status is 1 if a record is missing or arrived twice.
"""

import argparse
import random
import sys

import numpy as np

from research.shore_bytes import contacts
from sonarpost.extensions.satellite.receiver import ShortMessageReceiver
from sonarpost.extensions.satellite.sender import ShortMessageSender, image_items
from sonarpost.messages import ReceivedImage

STEP_S = 1.0
SESSION_S = 20.0
"""Time of one exchange of a terminal with the network."""


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
