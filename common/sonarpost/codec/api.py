"""The public functions of `sonarpost.codec`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TypedDict, Unpack

from sonarpost.codec.interface import Codec, DecodedImage, Image, Mask, SnippetPixels, StreamHeader
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.codec.vq.codebook import find_codebook, open_codebook
from sonarpost.codec.vq.codec import IndexPacking
from sonarpost.errors import ConfigError


class CodecOptions(TypedDict, total=False):
    """Options of `get_codec` and `encode`.

    Attributes:
        model: Model of emb: "standard" (least squared error, the default) or "structure" (structural similarity).
        strength: Strength of despeckling of emb, 0 (code the image as it is) to 1 (the default), in steps of 1/16.
        codebook: Codebook of vq: "nominal-10" (the default), "nominal-20" or a file.
        packing: Index format of vq: "14bit" (the default), "2byte", "3byte" or "ascii5".
    """

    model: str
    strength: float
    codebook: str | Path
    packing: str


def codec_names() -> tuple[str, ...]:
    """Return the names of the available codecs, sorted."""
    return default_registry().names()


def get_codec(name: str = "emb", **options: Unpack[CodecOptions]) -> Codec:
    """Return a codec.

    Args:
        name: One of `codec_names()`.
        **options: `model` and `strength` of emb; `codebook` and `packing` of vq, as for `sonarpost encode`.

    Raises:
        ConfigError: No codec has this name, or it does not have this option or value.
        CodebookError: The codebook cannot be read.
    """
    registry = default_registry()
    spec = registry.spec(name)
    allowed = ["model", "strength"] * spec.has_models + ["codebook", "packing"] * spec.needs_tiles
    for option in options:
        if option not in allowed:
            raise ConfigError(f"codec {name}", "option", option, " or ".join(allowed) or "no options")
    tiles = open_codebook(options.get("codebook", "nominal-10")).tiles if spec.needs_tiles else None
    packing = options.get("packing", IndexPacking.BITS14.value)
    packings = {one.value: one for one in IndexPacking}
    if packing not in packings:
        raise ConfigError(f"codec {name}", "packing", packing, " or ".join(packings))
    return registry.create(
        name, CodecResources(tiles, packings[packing], options.get("model"), options.get("strength"))
    )


def encode(
    image: SnippetPixels, codec: str = "emb", budget: int | None = None, **options: Unpack[CodecOptions]
) -> bytes:
    """Encode a snippet.

    Args:
        image: Shape (16..512, 16..512), uint8 or uint16; uint16 is mapped to 8 bits over its own range.
        codec: One of `codec_names()`.
        budget: Maximum length of the stream in bytes; None: the codec's default size or quality.
        **options: `model` and `strength` of emb; `codebook` and `packing` of vq, as for `sonarpost encode`.

    Returns:
        The stream, header included.

    Raises:
        StreamError: Size or dtype is not supported, or the budget is too small.
        ConfigError: No codec has this name, or it does not have this option or value.
        CodebookError: The codebook cannot be read.
    """
    return get_codec(codec, **options).encode(image, budget)


def decode(stream: bytes, *, codebooks: Sequence[str | Path] = ()) -> Image:
    """Decode a stream of any codec and model.

    Args:
        stream: The stream, or a prefix of it if the codec is embedded.
        codebooks: See `decode_image`.

    Returns:
        Shape (height_px, width_px), uint8. Missing pixels are black; `decode_image` returns their mask.

    Raises:
        StreamError: The stream cannot be decoded, or its codec or model is unknown.
        CodebookError: No codebook has the tag in the stream. The message names the tag and the places searched.
    """
    return decode_image(stream, codebooks=codebooks).image


def decode_image(stream: bytes, received: Mask | None = None, *, codebooks: Sequence[str | Path] = ()) -> DecodedImage:
    """Decode a stream of any codec and model; return the image and its missing pixels.

    The codebook of a stream is found by the tag of its identity in the header: first in `codebooks`, then among the
    shipped ones, then in the files and folders of the environment variable SONARPOST_CODEBOOKS (separated by `:`).

    Args:
        stream: The stream, or a prefix of it if the codec is embedded.
        received: Shape (body bytes,), False for each body byte that did not arrive and was replaced by zero.
        codebooks: Names, files or folders of codebooks.

    Raises:
        StreamError: The stream cannot be decoded, or its codec or model is unknown.
        CodebookError: No codebook has the tag in the stream. The message names the tag and the places searched.
    """
    registry = default_registry()
    header = StreamHeader.unpack(stream)
    tiles = None
    if registry.spec_for_id(header.codec_id).needs_tiles:
        tiles = find_codebook(header.model_tag, codebooks).tiles
    return registry.create_for_stream(stream, CodecResources(tiles)).decode(stream, received)
