"""Configuration of c2: the `[c2]` table."""

from pathlib import Path

from sonarpost.runtime.config import ServiceConfig


class C2Config(ServiceConfig):
    """Where accepted pictures and decisions are kept.

    Attributes:
        out_dir: Folder of the accepted records, one folder a vessel in it.
    """

    out_dir: Path = Path("out")
