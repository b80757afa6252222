"""Forge frames in large numbers: `PYTHONPATH=tests python -m builders.authentication_forge --frames 1000000`.

The receiver has a window of the vehicle, so far before the end of the key's lifetime that it tries `--farther` counters
for each frame. Forged are changed payloads with recorded tags, guessed tags, and recorded tags with other counters.
"""

import argparse
import contextlib
import random
import sys
import time
from dataclasses import replace

from builders.authentication_world import VEHICLE, vehicle_authenticator, vessel_authenticator
from sonarpost.errors import FrameError
from sonarpost.link.auth.key import AuthenticationSettings


def forge(rng: random.Random, recorded: list[bytes], added: int) -> bytes:
    """Return a frame that the vehicle most probably never sent."""
    protected, kind = bytearray(rng.choice(recorded)), rng.randrange(3)
    if kind == 0:
        protected[rng.randrange(1, len(protected) - added)] ^= rng.randrange(1, 256)
    elif kind == 1:
        protected[1 - added :] = rng.randbytes(added - 1)
    else:
        protected[-added] ^= rng.randrange(1, 256)
    return bytes(protected)


def main() -> None:
    """Print how the receiver counted the forged frames; the exit status is 1 if one passes."""
    parser = argparse.ArgumentParser(description="Forge authenticated frames and count those that pass.")
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--encrypt", action="store_true")
    parser.add_argument("--farther", type=int, default=16, help="counters beyond the window to try for each frame (16)")
    parsed = parser.parse_args()
    rng, settings = random.Random(parsed.seed), AuthenticationSettings(encrypt=parsed.encrypt)
    start = settings.lifetime_frames - settings.counter_step * (parsed.farther + 1)
    vehicle, vessel = vehicle_authenticator(settings, first_counter=start), vessel_authenticator(settings)
    recorded = [vehicle.protect(b"\x80" + rng.randbytes(56)) for _ in range(100)]
    with contextlib.suppress(FrameError):  # the first frame waits for confirmation
        vessel.verify(VEHICLE, recorded[0])
    for protected in recorded[1:]:
        vessel.verify(VEHICLE, protected)
    before, began, passed, genuine = replace(vessel.counts), time.process_time(), 0, set(recorded)
    for _ in range(parsed.frames):
        if (forged := forge(rng, recorded, settings.overhead_bytes)) not in genuine:
            with contextlib.suppress(FrameError):
                vessel.verify(VEHICLE, forged)
                passed += 1
    seconds, counts = time.process_time() - began, vessel.counts
    replays, unconfirmed = counts.replayed - before.replayed, counts.unconfirmed - before.unconfirmed
    print(f"forged {counts.forged - before.forged}, passed {passed}, {1000 * seconds / parsed.frames:.3f} ms a frame")
    print(f"counted as replays: {replays}, as unconfirmed: {unconfirmed}")
    sys.exit(bool(passed))


if __name__ == "__main__":
    main()
