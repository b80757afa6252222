"""Codecs to compare with: those of the paper, and formats of today. `comparison_registry` lists all codecs."""

from functools import cache

from research.codecs.baselines.huffman import HuffmanCodec
from research.codecs.baselines.jpeg2000 import Jpeg2000Codec
from research.codecs.baselines.spiht import SpihtCodec
from research.codecs.baselines.still_images import StillImageCodec, StillImageFormat
from sonarpost.codec.registry import BUILTINS, ENTRY_POINT_GROUP, CodecRegistry, CodecSpec, codec_plug_ins
from sonarpost.registry import installed_points


def _still_image_spec(image_format: StillImageFormat) -> CodecSpec:
    summary = f"{image_format.name} at the best quality that fits"
    return CodecSpec(image_format.value, (image_format.codec_id,), lambda _: StillImageCodec(image_format), summary)


BASELINES = (
    CodecSpec("huffman", (0x01,), lambda _: HuffmanCodec(), "quantised grey levels in a Huffman code (in the paper)"),
    CodecSpec("jpeg2000", (0x02,), lambda _: Jpeg2000Codec(), "JPEG 2000, raw codestream (in the paper)"),
    CodecSpec("jpeg2000-packets", (0x03,), lambda _: Jpeg2000Codec(packets_only=True), "JPEG 2000 without its headers"),
    CodecSpec(
        "spiht",
        (0x04,),
        lambda _: SpihtCodec(),
        "set partitioning of a 9/7 wavelet, embedded (in the paper)",
        is_embedded=True,
    ),
    *(_still_image_spec(image_format) for image_format in StillImageFormat),
)


@cache
def comparison_registry() -> CodecRegistry:
    """Return the registry with the codecs of sonarpost, of installed plug-ins, and `BASELINES`."""
    return CodecRegistry((*BUILTINS, *BASELINES), codec_plug_ins(installed_points(ENTRY_POINT_GROUP)))
