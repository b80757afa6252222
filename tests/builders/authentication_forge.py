"""Forge frames in large numbers: `PYTHONPATH=tests python -m builders.authentication_forge --frames 1000000`.

The receiver has a window of the vehicle, in the middle of the key's lifetime. The attacker has recorded genuine frames.
Forged frames are changed payloads with recorded tags, guessed tags, and recorded tags with other counters.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import time
from dataclasses import replace

from builders.authentication_world import VEHICLE, vehicle_authenticator, vessel_authenticator
from builders.link_state import group
from sonarpost.errors import FrameError
from sonarpost.link.auth.key import AuthenticationSettings


def forge(rng: random.Random, recorded: list[bytes], added: int) -> bytes:
    """Return a frame that the vehicle never sent."""
    protected = rng.choice(recorded)
    covered, ending = protected[:-added], protected[-added:]
    match rng.randrange(3):
        case 0:
            at = rng.randrange(1, len(covered))
            covered = covered[:at] + bytes([covered[at] ^ rng.randrange(1, 256)]) + covered[at + 1 :]
        case 1:
            ending = ending[:1] + rng.randbytes(added - 1)
        case _:
            ending = bytes([ending[0] ^ rng.randrange(1, 256)]) + ending[1:]
    return covered + ending


def run(frames: int, seed: int, *, encrypt: bool, farther: int) -> dict[str, float]:
    """Forge frames; return how the receiver counted them.

    Args:
        frames: Number of forged frames.
        seed: Seed of the attacker.
        encrypt: Whether frames are encrypted.
        farther: Counters beyond the window that the receiver tries for each frame.
    """
    rng = random.Random(seed)
    settings = AuthenticationSettings(encrypt=encrypt)
    start = settings.lifetime_frames - settings.counter_step * (farther + 1)
    vehicle, vessel = vehicle_authenticator(settings, first_counter=start), vessel_authenticator(settings)
    recorded = [vehicle.protect(b"\x80" + rng.randbytes(56)) for _ in range(100)]
    for n, protected in enumerate(recorded):
        try:
            vessel.verify(VEHICLE, protected)
        except FrameError:
            assert n == 0  # the first frame waits for confirmation
    before, began = replace(vessel.counts), time.process_time()
    windows = group(vessel.parts(), "window")
    genuine = {protected[-5:]: protected for protected in recorded}
    passed = 0
    for _ in range(frames):
        forged = forge(rng, recorded, settings.overhead_bytes)
        if genuine.get(forged[-5:]) == forged:
            continue
        try:
            vessel.verify(VEHICLE, forged)
        except FrameError:
            continue
        passed += 1
    seconds = time.process_time() - began
    after = vessel.counts
    assert passed or group(vessel.parts(), "window") == windows
    return {
        "forged": after.forged - before.forged,
        "passed": passed,
        "counted_as_replays": after.replayed - before.replayed,
        "unconfirmed": after.unconfirmed - before.unconfirmed,
        "ms_a_frame": round(1000 * seconds / frames, 3),
    }


def main() -> None:
    """Run from the command line; the exit status is 1 if a forged frame passes."""
    parser = argparse.ArgumentParser(description="Forge authenticated frames and count those that pass.")
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--encrypt", action="store_true")
    parser.add_argument("--farther", type=int, default=16, help="counters beyond the window to try for each frame (16)")
    parsed = parser.parse_args()
    found = run(parsed.frames, parsed.seed, encrypt=parsed.encrypt, farther=parsed.farther)
    print(json.dumps(found))
    sys.exit(bool(found["passed"]))


if __name__ == "__main__":
    main()
