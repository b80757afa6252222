"""Configuration of the decompressor: the `[decompressor]` table."""

from pathlib import Path
from typing import Annotated

from pydantic import Field
from typing_extensions import override

from sonarpost.codec.vq.codebook import open_codebook
from sonarpost.config import ConsumerName, PlatformConfig
from sonarpost.runtime.retention import RetentionConfig


class DecompressorConfig(RetentionConfig):
    """Configuration of the decoder and of its outputs.

    Attributes:
        out_dir: Folder of the image files.
        max_bytes: Maximum size of the image files; above it the vehicle with the most bytes loses images: versions that
            a later one has replaced first, then the others, each the oldest first. Records that wait for delivery are
            in the store and stay.
        codebooks: Tile codebooks that vehicles may use: nominal-10, nominal-20 or files.
        image_consumers: Services on the vessel that receive the images; name only services that run. `relay` receives
            the coded stream, every other service the pixels.
    """

    out_dir: Path = Path("out")
    codebooks: Annotated[tuple[str, ...], Field(min_length=1)] = ("nominal-10", "nominal-20")
    image_consumers: tuple[ConsumerName, ...] = ("relay",)

    @override
    def check_with(self, platform: PlatformConfig) -> None:
        """Check that the codebooks can be read.

        Raises:
            CodebookError: One cannot be read.
        """
        for name in self.codebooks:
            open_codebook(name)
