"""Configuration of the decompressor: the `[decompressor]` table."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from sonarpost.config import ServiceConfig
from sonarpost.link.receiver import WireFormat
from sonarpost.messages import PlatformId

ConsumerName = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,39}$")]


class DecompressorConfig(ServiceConfig):
    """What is understood, how halves are paired, what they are decoded with, where pictures go.

    Attributes:
        out_dir: Folder of the pictures.
        wire_formats: Wire formats that are understood; each frame tells which it is of.
        pairing_timeout_s: How long an image waits for what it lacks after its last frame.
        codebooks: Tile codebooks (nominal-10, nominal-20 or files) that vehicles may use.
        image_consumers: Services on the vessel that are owed every picture.
        vehicles: Names of the vehicles by the modem addresses they send from; an address that is not listed gets
            the name modem-{address}.
    """

    out_dir: Path = Path("out")
    wire_formats: Annotated[tuple[WireFormat, ...], Field(min_length=1)] = ("v1", "paper")
    pairing_timeout_s: Annotated[float, Field(gt=0, le=86400)] = 120.0
    codebooks: Annotated[tuple[str, ...], Field(min_length=1)] = ("nominal-10", "nominal-20")
    image_consumers: tuple[ConsumerName, ...] = ("relay",)
    vehicles: dict[Annotated[str, Field(pattern=r"^[0-9]{1,3}$")], PlatformId] = Field(default_factory=dict)
