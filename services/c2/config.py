"""Configuration of c2: the `[c2]` table."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from sonarpost.keys import SHORE
from sonarpost.messages import PlatformId
from sonarpost.runtime.retention import MaxBytes, RetentionConfig


class C2Config(RetentionConfig):
    """The `[c2]` table.

    Attributes:
        site: Name of this site in keys; relays name it in their upstreams.
        out_dir: Folder of the stored records, with a folder for each vessel and an index.
        max_bytes: Maximum size of the stored images; above it exported images are removed first, then those with a
            decision, then the others, each the oldest first. Decisions are never removed.
        verify_days: Time in which every stored file is compared with the index once; 0 disables the comparison.
    """

    site: PlatformId = SHORE
    out_dir: Path = Path("out")
    max_bytes: MaxBytes = 50_000_000_000
    verify_days: Annotated[float, Field(ge=0, le=36500)] = 1.0
