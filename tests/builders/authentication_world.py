"""Authenticators of a vehicle and a vessel with one key."""

import hashlib

from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import AcousticKey, AuthenticationSettings, Direction

VEHICLE, VESSEL = 3, 1


def key(name: str) -> AcousticKey:
    return AcousticKey(hashlib.sha256(name.encode()).digest())


def vehicle_authenticator(
    settings: AuthenticationSettings | None = None,
    *,
    name: str = "fleet",
    address: int = VEHICLE,
    first_counter: int = 0,
) -> FrameAuthenticator:
    authenticator = FrameAuthenticator(
        key(name), address, Direction.FROM_VEHICLE, settings, first_counter=first_counter
    )
    authenticator.grant(authenticator.settings.lifetime_frames)
    return authenticator


def vessel_authenticator(
    settings: AuthenticationSettings | None = None, *, name: str = "fleet", address: int = VESSEL
) -> FrameAuthenticator:
    return FrameAuthenticator(key(name), address, Direction.TO_VEHICLE, settings)
