"""Content of tests/golden/acoustic-v1/sealed.json.

`PYTHONPATH=tests python -m builders.authentication_golden` writes it.
"""

from __future__ import annotations

import json
from dataclasses import asdict

from builders.v1_golden import FOLDER
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import AuthenticationSettings, Direction, parse_key
from sonarpost.link.frames.v1.frame import Segment, SegmentKind, Symbol, SymbolKind, pack_segments, pack_symbol

KEY = "7d0a4c1fe2b39586a1c4d7f00918273645546372819fa0becdacebfa1d2e3f40"
CASES = (
    (AuthenticationSettings(), 3, Direction.FROM_VEHICLE, 0),
    (AuthenticationSettings(), 3, Direction.FROM_VEHICLE, 1000),
    (AuthenticationSettings(), 1, Direction.TO_VEHICLE, 5),
    (AuthenticationSettings(encrypt=True), 3, Direction.FROM_VEHICLE, 255),
    (AuthenticationSettings(2, 8), 127, Direction.FROM_VEHICLE, 65537),
    (AuthenticationSettings(2, 6, encrypt=True), 0, Direction.TO_VEHICLE, 2**28 - 1),
)


def make() -> dict[str, object]:
    """Return the content of the file."""
    key = parse_key(KEY, "golden")
    frames = []
    for settings, source, direction, counter in CASES:
        authenticator = FrameAuthenticator(key, source, direction, settings, first_counter=counter)
        authenticator.grant(counter + 1)
        if direction == Direction.FROM_VEHICLE:
            symbol = Symbol(SymbolKind.OBJECT, 5, 17, 40, bytes(range(59 - settings.overhead_bytes)))
            frame = pack_symbol(symbol, authenticator)
        else:
            frame = pack_segments([Segment(SegmentKind.MESSAGE, b"\x09go to 12")], 32, authenticator)
        frames.append(
            asdict(settings) | {"source": source, "direction": int(direction), "counter": counter, "frame": frame.hex()}
        )
    return {"key": KEY, "fingerprint": key.fingerprint, "frames": frames}


if __name__ == "__main__":
    (FOLDER / "sealed.json").write_text(json.dumps(make(), indent=1) + "\n", encoding="utf-8")
