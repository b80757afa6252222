"""Codecs by name (to encode) and by the id in a stream's header (to decode).

Codecs of this package are listed in `BUILTINS`. Another distribution adds its own through the entry-point group
`sonarpost.codecs`: the entry point loads to a `CodecSpec` whose name equals the entry point's.

Codec ids are never reused. 0x01..0x0F have no model; 0x10..0x13 belong to vq (one for each packing); 0x80 and above are
left to other distributions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import EntryPoint, entry_points

from sonarpost.codec import emb
from sonarpost.codec.baselines.huffman import HuffmanCodec
from sonarpost.codec.baselines.jpeg2000 import Jpeg2000Codec
from sonarpost.codec.baselines.spiht import SpihtCodec
from sonarpost.codec.baselines.still_images import StillImageCodec, StillImageFormat
from sonarpost.codec.interface import Codec, StreamHeader, model_tag, tag_length
from sonarpost.codec.vq.codec import IndexPacking, VqCodec
from sonarpost.codec.vq.tiles import TileDatabase
from sonarpost.errors import ConfigError, StreamError

ENTRY_POINT_GROUP = "sonarpost.codecs"
CODEBOOK_TAG_BYTES = 2


@dataclass(frozen=True)
class CodecResources:
    """What a codec may need to be made. A codec ignores what it does not use.

    Attributes:
        tiles: The tile database, for codecs with a codebook.
        packing: How vq writes indices.
        codec_id: Which of its ids the codec is wanted for; None for the one that follows from the rest. Set when a
            stream is to be decoded.
    """

    tiles: TileDatabase | None = None
    packing: IndexPacking = IndexPacking.BITS14
    codec_id: int | None = None
    model_tag: int | None = None


@dataclass(frozen=True)
class CodecSpec:
    """A codec as the registry knows it.

    Attributes:
        name: Name in configurations.
        codec_ids: Every id its streams may carry.
        create: Makes the codec; raises ConfigError where a resource it needs is absent.
        summary: One line for people.
        needs_tiles: Whether `create` needs a tile database. A receiver finds it by the two bytes of its identity that a
            stream carries, so all ids must be of the class that carries two (`interface.tag_length`).
        is_embedded: Whether every beginning of a stream is a picture, and longer streams can begin as shorter ones do.
    """

    name: str
    codec_ids: tuple[int, ...]
    create: Callable[[CodecResources], Codec]
    summary: str = ""
    needs_tiles: bool = False
    is_embedded: bool = False


def _create_vq(resources: CodecResources) -> Codec:
    if resources.tiles is None:
        raise ConfigError("codec vq", "tiles", None, "a tile codebook, for example nominal-10")
    packing = resources.packing
    if resources.codec_id is not None:
        packing = IndexPacking.from_codec_id(resources.codec_id) or packing
    return VqCodec(resources.tiles, packing)


def _modern_spec(wanted: StillImageFormat) -> CodecSpec:
    summary = f"{wanted.name} at the best quality that fits, for comparison"
    return CodecSpec(wanted.value, (wanted.codec_id,), lambda _: StillImageCodec(wanted), summary)


def _what_is_absent(name_or_id: str | int) -> str:
    """Return what to install for a codec that is absent because its library is, as the end of a message."""
    absent = (
        wanted for wanted in StillImageFormat if name_or_id in (wanted.value, wanted.codec_id) and not wanted.available
    )
    return "".join(f" ({wanted.value} needs {wanted.needs})" for wanted in absent)


def _create_emb(resources: CodecResources, codec_id: int) -> Codec:
    # It brings a compiler, which nobody else waits for.
    from sonarpost.codec.emb.codec import EmbCodec  # noqa: PLC0415
    from sonarpost.codec.emb.model import all_shipped, all_structure  # noqa: PLC0415

    # The first encodes, and tells a stream of a strange model so.
    models = all_shipped() if codec_id == emb.CODEC_ID else all_structure()
    wanted = (model for model in models if model_tag(codec_id, model.identity) == resources.model_tag)
    return EmbCodec(next(wanted, models[0]))


def _emb_spec(name: str, codec_id: int, summary: str) -> CodecSpec:
    return CodecSpec(name, (codec_id,), lambda resources: _create_emb(resources, codec_id), summary, is_embedded=True)


BUILTINS = (
    _emb_spec(
        emb.NAME,
        emb.CODEC_ID,
        "embedded wavelet codec with learned contexts: a picture at every length, from 20 bytes up",
    ),
    _emb_spec(
        emb.STRUCTURE_NAME,
        emb.STRUCTURE_ID,
        "the same, made for likeness of structure (MS-SSIM) instead of the least squared error",
    ),
    CodecSpec(
        "vq",
        tuple(packing.codec_id for packing in IndexPacking),
        _create_vq,
        "vector quantisation with a shared tile codebook (the paper's codec)",
        needs_tiles=True,
    ),
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
    *(_modern_spec(wanted) for wanted in StillImageFormat if wanted.available),
)


class CodecRegistry:
    """Codecs by name and by id; neither can be taken twice."""

    def __init__(self, specs: Iterable[CodecSpec] = ()) -> None:
        self._by_name: dict[str, CodecSpec] = {}
        self._by_id: dict[int, CodecSpec] = {}
        for spec in specs:
            self.register(spec)

    def register(self, spec: CodecSpec) -> None:
        """Add a codec.

        Raises:
            ConfigError: Its name or one of its ids is taken, is outside 0..255, or it has no id; or it needs tiles and
                streams with one of its ids could not say which.
        """
        where = f"codec {spec.name}"
        if spec.name in self._by_name:
            raise ConfigError("codec registry", "name", spec.name, "a name that is not taken")
        if not spec.codec_ids or len(set(spec.codec_ids)) != len(spec.codec_ids):
            raise ConfigError(where, "codec_ids", spec.codec_ids, "at least one id, none twice")
        for codec_id in spec.codec_ids:
            if not 0 <= codec_id <= 0xFF:
                raise ConfigError(where, "codec_ids", codec_id, "0..255")
            if spec.needs_tiles and tag_length(codec_id) != CODEBOOK_TAG_BYTES:
                expected = "0x10..0x1f or 0x80..0xff, whose streams say in two bytes which codebook they need"
                raise ConfigError(where, "codec_ids", f"{codec_id:#04x}", expected)
            if codec_id in self._by_id:
                taken = self._by_id[codec_id].name
                raise ConfigError(where, "codec_ids", f"{codec_id:#04x}", f"an id that is not taken (it is {taken}'s)")
        self._by_name[spec.name] = spec
        self._by_id.update(dict.fromkeys(spec.codec_ids, spec))

    def names(self) -> tuple[str, ...]:
        """Return the names, sorted."""
        return tuple(sorted(self._by_name))

    def is_embedded(self, name: str) -> bool:
        """Return whether a codec's streams may be cut and continued; False of one that is not known."""
        return name in self._by_name and self._by_name[name].is_embedded

    def spec(self, name: str) -> CodecSpec:
        """Return a codec's entry.

        Raises:
            ConfigError: No codec has this name; the message lists those there are.
        """
        if name not in self._by_name:
            raise ConfigError(
                "codec registry", "name", name, "one of " + ", ".join(self.names()) + _what_is_absent(name)
            )
        return self._by_name[name]

    def create(self, name: str, resources: CodecResources) -> Codec:
        """Make the codec called `name`.

        Raises:
            ConfigError: No codec has this name, or a resource it needs is absent or does not suit it.
        """
        return self.spec(name).create(resources)

    def spec_for_id(self, codec_id: int) -> CodecSpec:
        """Return the entry of the codec whose streams carry `codec_id`.

        Raises:
            StreamError: No codec does.
        """
        if codec_id not in self._by_id:
            known = ", ".join(f"{number:#04x} ({self._by_id[number].name})" for number in sorted(self._by_id))
            raise StreamError("stream", "codec_id", f"{codec_id:#04x}", f"one of {known}{_what_is_absent(codec_id)}")
        return self._by_id[codec_id]

    def create_for_stream(self, stream: bytes, resources: CodecResources) -> Codec:
        """Make the codec that a stream (its header is enough) was encoded with.

        Raises:
            StreamError: The header is wrong or its codec unknown.
            ConfigError: A resource the codec needs is absent or does not suit it.
        """
        header = StreamHeader.unpack(stream)
        resources = replace(resources, codec_id=header.codec_id, model_tag=header.model_tag)
        return self.spec_for_id(header.codec_id).create(resources)


def load_plugins(registry: CodecRegistry, found: Iterable[EntryPoint]) -> None:
    """Register the codecs that other distributions offer, in the order of their names.

    Raises:
        ConfigError: An entry point does not load, is not a `CodecSpec`, has another name, or takes a name or id again.
    """
    for point in sorted(found, key=lambda p: (p.name, p.value)):
        where = f"entry point {ENTRY_POINT_GROUP}:{point.name}"
        try:
            spec = point.load()
        except Exception as error:  # whatever foreign code raises while it is imported, this names the culprit
            raise ConfigError(where, "value", f"{point.value} ({error!r})", "an object that imports") from error
        if not isinstance(spec, CodecSpec):
            raise ConfigError(where, "value", repr(spec), "a sonarpost.codec.registry.CodecSpec")
        if spec.name != point.name:
            raise ConfigError(where, "name", spec.name, f"{point.name!r}, the entry point's name")
        registry.register(spec)


@cache
def default_registry() -> CodecRegistry:
    """Return the registry of this package's codecs and installed plug-ins, made on first use.

    Raises:
        ConfigError: A plug-in is wrong.
    """
    registry = CodecRegistry(BUILTINS)
    load_plugins(registry, entry_points(group=ENTRY_POINT_GROUP))
    return registry
