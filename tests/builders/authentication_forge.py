"""Forged frames by the million: `PYTHONPATH=tests python -m builders.authentication_forge --frames 1000000`.

The receiver is at the middle of its key's life and knows the vehicle. Frames are forged as an attacker would who has
recorded genuine ones: changed payloads under recorded tags, guessed tags, recorded tags under other counters.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import time

from builders.authentication_world import VEHICLE, vehicle_seal, vessel_seal
from builders.link_state import group
from sonarpost.errors import FrameError
from sonarpost.link.auth.key import AuthenticationSettings


def forge(rng: random.Random, recorded: list[bytes], added: int) -> bytes:
    """One frame that was never sealed."""
    sealed = rng.choice(recorded)
    covered, ending = sealed[:-added], sealed[-added:]
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
    """Forge frames; return what became of them.

    Args:
        frames: How many.
        seed: Of the attacker.
        encrypt: Whether frames are encrypted.
        farther: How many counters farther ahead the receiver has left to try for each frame.
    """
    rng = random.Random(seed)
    settings = AuthenticationSettings(encrypt=encrypt)
    start = settings.lifetime_frames - settings.counter_step * (farther + 1)
    vehicle, vessel = vehicle_seal(settings, first_counter=start), vessel_seal(settings)
    recorded = [vehicle.protect(b"\x80" + rng.randbytes(56)) for _ in range(100)]
    for n, sealed in enumerate(recorded):
        try:
            vessel.verify(VEHICLE, sealed)
        except FrameError:
            assert n == 0  # the first waits to be confirmed
    before, began = vessel.counts, time.process_time()
    windows = group(vessel.parts(), "window")
    genuine = {sealed[-5:]: sealed for sealed in recorded}
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
        "taken_for_replays": after.replayed - before.replayed,
        "unconfirmed": after.unconfirmed - before.unconfirmed,
        "ms_a_frame": round(1000 * seconds / frames, 3),
    }


def main() -> None:
    """Run from the command line; the exit status is 1 when a forged frame passed."""
    parser = argparse.ArgumentParser(description="Forge sealed frames and count what passes.")
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--encrypt", action="store_true")
    parser.add_argument("--farther", type=int, default=16, help="counters farther ahead to try for each frame (16)")
    parsed = parser.parse_args()
    found = run(parsed.frames, parsed.seed, encrypt=parsed.encrypt, farther=parsed.farther)
    print(json.dumps(found))
    sys.exit(bool(found["passed"]))


if __name__ == "__main__":
    main()
