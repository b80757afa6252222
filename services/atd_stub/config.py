"""Configuration of the target detection: the `[atd_stub]` table."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from sonarpost.codec.interface import MAX_SIDE_PX, MIN_SIDE_PX
from sonarpost.runtime.config import ServiceConfig

SidePx = Annotated[int, Field(ge=MIN_SIDE_PX, le=MAX_SIDE_PX)]


class AtdStubConfig(ServiceConfig):
    """Where files come from and what becomes of them.

    Attributes:
        mode: "survey" looks for contacts in survey files; "snippets" sends the pictures of a folder as they are (the
            paper's talker).
        input_dir: Folder that is polled.
        quarantine_dir: Where bad files are moved, each with its reason; by default `quarantine` in `input_dir`.
        poll_s: Time between two looks at the folder.
        settle_s: A file counts when its size and date have not changed for this long.
        confidence_threshold: Least ATD confidence (0 to 2) of a contact that is sent.
        max_contacts: Most contacts a survey file may give, most confident first; 0 for no limit.
        snippet_height_px: Rows (along-track) of a snippet.
        snippet_width_px: Columns (across-track) of a snippet.
    """

    mode: Literal["survey", "snippets"] = "survey"
    input_dir: Path = Path("incoming")
    quarantine_dir: Path | None = None
    poll_s: Annotated[float, Field(gt=0, le=3600)] = 1.0
    settle_s: Annotated[float, Field(ge=0, le=3600)] = 3.0
    confidence_threshold: Annotated[float, Field(ge=0, le=2)] = 1.0
    max_contacts: Annotated[int, Field(ge=0)] = 0
    snippet_height_px: SidePx = 80
    snippet_width_px: SidePx = 140
