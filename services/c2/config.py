"""Configuration of c2: the `[c2]` table."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from sonarpost.config import ServiceConfig
from sonarpost.keys import SHORE
from sonarpost.messages import PlatformId


class C2Config(ServiceConfig):
    """The `[c2]` table.

    Attributes:
        site: Name of this site in keys; relays name it in their upstreams.
        out_dir: Folder of the stored records, with a folder for each vessel and an index.
        retain_days: Age above which images are removed; None keeps them.
        max_bytes: Maximum size of the stored images; above it exported ones are removed first, then the oldest. None
            for no limit. Decisions are never removed.
        verify_days: Time in which every stored file is compared with the index once; 0 disables the comparison.
    """

    site: PlatformId = SHORE
    out_dir: Path = Path("out")
    retain_days: Annotated[float, Field(gt=0, le=36500)] | None = None
    max_bytes: Annotated[int, Field(ge=0)] | None = None
    verify_days: Annotated[float, Field(ge=0, le=36500)] = 1.0
