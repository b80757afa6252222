"""Names in certificates: the common name (CN) is the platform, and from its second generation on `.g{n}` behind it.

Zenoh's access control knows a peer by its CN and by nothing else of its certificate; it checks no revocation list. A
revoked certificate must therefore lose its CN for ever, and the platform gets a new one: `vessel-1`, `vessel-1.g2`,
`vessel-1.g3`. A dot is in no platform's name, so the two never mix.
"""

from __future__ import annotations

import re

from sonarpost.errors import BadInputError
from sonarpost.keys import SHORE

_PLATFORM = re.compile(r"[a-z0-9][a-z0-9-]{0,31}")
_COMMON_NAME = re.compile(r"(?P<platform>[a-z0-9][a-z0-9-]{0,31})(?:\.g(?P<generation>[1-9][0-9]{0,5}))?")


def checked_platform(platform: str, where: str) -> str:
    """Return the name of a platform.

    Raises:
        BadInputError: Not a platform's name, or the word that every shore answers to.
    """
    if not _PLATFORM.fullmatch(platform):
        expected = "1 to 32 of a-z, 0-9 and '-', the first a letter or digit"
        raise BadInputError(where, "platform", platform, expected)
    if platform == SHORE:
        # Its prefix would be everybody's hand-off.
        raise BadInputError(where, "platform", platform, f"a name of its own, such as {SHORE}-1")
    return platform


def common_name(platform: str, generation: int) -> str:
    """Return the CN of a platform's certificate; generations count from 1."""
    return platform if generation == 1 else f"{platform}.g{generation}"


def platform_of(name: str) -> tuple[str, int]:
    """Return the platform and the generation that a CN stands for.

    Raises:
        BadInputError: No common name of this fleet's form.
    """
    match = _COMMON_NAME.fullmatch(name)
    if match is None or match["generation"] == "1":
        raise BadInputError("certificate", "common name", name, "a platform's name, from the second on with .g2, .g3 …")
    return match["platform"], int(match["generation"] or 1)
