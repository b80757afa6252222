"""Configuration of the decompressor: the `[decompressor]` table."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from sonarpost.config import ConsumerName, ServiceConfig


class DecompressorConfig(ServiceConfig):
    """Configuration of the decoder and of its outputs.

    Attributes:
        out_dir: Folder of the image files.
        codebooks: Tile codebooks that vehicles may use: nominal-10, nominal-20 or files.
        image_consumers: Services on the vessel that receive the decoded images; name only services that run.
    """

    out_dir: Path = Path("out")
    codebooks: Annotated[tuple[str, ...], Field(min_length=1)] = ("nominal-10", "nominal-20")
    image_consumers: tuple[ConsumerName, ...] = ("relay",)
