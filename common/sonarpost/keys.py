"""Every Zenoh key expression of sonarpost. No other module spells one.

Grammar: `sonarpost/v1/{platform}/…`. One prefix a platform, so that access control is a rule on a prefix; identifiers
of contacts and images stay in the payloads.
"""

from __future__ import annotations

import re

from sonarpost.errors import BadInputError

ROOT = "sonarpost/v1"
SHORE = "shore"
_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,39}")


def _name(field: str, value: str) -> str:
    if not _NAME.fullmatch(value):
        raise BadInputError(
            "key expression", field, value, "1 to 40 of a-z, 0-9, '-' and '_', the first a letter or digit"
        )
    return value


def _of(platform: str, rest: str) -> str:
    return f"{ROOT}/{_name('platform', platform)}/{rest}"


def contact_detected(vehicle: str) -> str:
    """Contact and snippet, atd_stub to compressor (the paper's imgToCompress)."""
    return _of(vehicle, "contact/detected")


def image_encoded(vehicle: str) -> str:
    """Encoded image, compressor to uuv_modem (imgToDecompress, UUV side)."""
    return _of(vehicle, "image/encoded")


def acoustic_tx(platform: str) -> str:
    """Frames that left through this platform's modem."""
    return _of(platform, "acoustic/tx")


def acoustic_rx(platform: str) -> str:
    """Frames that this platform's modem received, op_modem to decompressor."""
    return _of(platform, "acoustic/rx")


def image_reconstructed(vessel: str) -> str:
    """Rebuilt picture, decompressor to relay and console (imgToDecompress, operator side)."""
    return _of(vessel, "image/reconstructed")


def contact_decision(vessel: str) -> str:
    """An operator's decision, to relay and op_modem."""
    return _of(vessel, "contact/decision")


def command(platform: str, kind: str) -> str:
    """A command: asked on the vessel, carried by sound, published on the vehicle."""
    return _of(platform, f"command/{_name('kind', kind)}")


def shore_inbox(vessel: str) -> str:
    """Records relayed from one vessel, relay to c2."""
    return _of(SHORE, f"inbox/{_name('vessel', vessel)}")


def shore_inbox_all() -> str:
    """Records relayed from every vessel."""
    return f"{ROOT}/{SHORE}/inbox/*"


def shore_image(vessel: str) -> str:
    """What c2 has accepted of one vessel's pictures, for every shore subscriber."""
    return _of(SHORE, f"contact/{_name('vessel', vessel)}/image")


def shore_decision(vessel: str) -> str:
    """What c2 has accepted of one vessel's decisions, for every shore subscriber."""
    return _of(SHORE, f"contact/{_name('vessel', vessel)}/decision")


def health(platform: str, service: str) -> str:
    """A service's health record."""
    return _of(platform, f"health/{_name('service', service)}")


def health_all(platform: str) -> str:
    """Health of every service of a platform."""
    return _of(platform, "health/*")


def alive(platform: str, service: str) -> str:
    """A service's liveliness token."""
    return _of(platform, f"alive/{_name('service', service)}")


def handoff(key: str, consumer: str) -> str:
    """Where the named consumer answers hand-over queries for the records of `key`."""
    return f"{key}/handoff/{_name('consumer', consumer)}"
