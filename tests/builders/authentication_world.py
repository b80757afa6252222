"""A vehicle and a vessel with one key, for the tests of seals."""

from __future__ import annotations

import hashlib

from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import AcousticKey, AuthenticationSettings, Direction

VEHICLE, VESSEL = 3, 1


def key(name: str) -> AcousticKey:
    return AcousticKey(hashlib.sha256(name.encode()).digest())


def vehicle_seal(
    settings: AuthenticationSettings | None = None,
    *,
    name: str = "fleet",
    address: int = VEHICLE,
    first_counter: int = 0,
) -> FrameAuthenticator:
    seal = FrameAuthenticator(key(name), address, Direction.FROM_VEHICLE, settings, first_counter=first_counter)
    seal.grant(seal.settings.lifetime_frames)
    return seal


def vessel_seal(
    settings: AuthenticationSettings | None = None, *, name: str = "fleet", address: int = VESSEL
) -> FrameAuthenticator:
    return FrameAuthenticator(key(name), address, Direction.TO_VEHICLE, settings)


def skip(seal: FrameAuthenticator, frames: int) -> None:
    """Let so many frames be lost."""
    for _ in range(frames):
        seal.protect(b"\x80lost")
