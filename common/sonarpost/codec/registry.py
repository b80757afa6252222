"""Codecs by name, for encoding, and by the codec id in a stream header, for decoding.

`BUILTINS` lists the codecs of the core; for others see `sonarpost.registry`. The group of entry points is
`sonarpost.codecs`: an entry point loads a `CodecSpec` with its name.

Codec ids are never reused. 0x01..0x0F have no model; 0x01..0x07 are those of `research.codecs.baselines`. 0x10..0x13
belong to vq (one for each packing), 0x20 to 0x23 to emb (one for each kind of model, with and without despeckling).
0x80 and above are for other distributions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import EntryPoint

from sonarpost.codec import emb
from sonarpost.codec.interface import Codec, StreamHeader, tag_length
from sonarpost.codec.vq.codec import IndexPacking, VqCodec
from sonarpost.codec.vq.tiles import TileDatabase
from sonarpost.errors import ConfigError, StreamError
from sonarpost.registry import Registry, installed_points

ENTRY_POINT_GROUP = "sonarpost.codecs"
CODEBOOK_TAG_BYTES = 2


@dataclass(frozen=True)
class CodecResources:
    """Options and resources for the creation of a codec. A codec ignores those that it does not use.

    Attributes:
        tiles: The tile database, for codecs with a codebook.
        packing: Format of the indices of vq.
        model: Name of the model of emb; None: the default model.
        strength: Strength of despeckling of emb, 0..1; None: the default strength.
        codec_id: Codec id of the stream to decode; None for encoding.
    """

    tiles: TileDatabase | None = None
    packing: IndexPacking = IndexPacking.BITS14
    model: str | None = None
    strength: float | None = None
    codec_id: int | None = None


@dataclass(frozen=True)
class CodecSpec:
    """Entry of the registry.

    Attributes:
        name: Name in configuration files.
        codec_ids: All codec ids of its streams.
        create: Creates the codec. Raises ConfigError if a required resource is missing.
        summary: One line for people.
        needs_tiles: Whether `create` requires a tile database. A receiver finds it by the two bytes of its identity in
            the stream, so all codec ids must have a tag of two bytes (`interface.tag_length`).
        has_models: Whether the option `model` selects a trained model, and `strength` the strength of despeckling.
        is_embedded: Whether every prefix of a stream is an image, and longer streams can start with shorter ones.
    """

    name: str
    codec_ids: tuple[int, ...]
    create: Callable[[CodecResources], Codec]
    summary: str = ""
    needs_tiles: bool = False
    has_models: bool = False
    is_embedded: bool = False


def _create_vq(resources: CodecResources) -> Codec:
    if resources.tiles is None:
        raise ConfigError("codec vq", "tiles", None, "a tile codebook, for example nominal-10")
    packing = resources.packing
    if resources.codec_id is not None:
        packing = IndexPacking.from_codec_id(resources.codec_id) or packing
    return VqCodec(resources.tiles, packing)


def _create_emb(resources: CodecResources) -> Codec:
    # Imported lazily: it loads numba.
    from sonarpost.codec.emb.codec import EmbCodec  # noqa: PLC0415

    for despeckled, codec_ids in ((False, emb.CODEC_IDS), (True, emb.DESPECKLED_CODEC_IDS)):
        for name, codec_id in codec_ids.items():
            if codec_id == resources.codec_id:
                return EmbCodec(name, emb.DEFAULT_STRENGTH if despeckled else 0.0)
    strength = emb.DEFAULT_STRENGTH if resources.strength is None else resources.strength
    return EmbCodec(resources.model or emb.DEFAULT_MODEL, strength)


BUILTINS = (
    CodecSpec(
        emb.NAME,
        (*emb.CODEC_IDS.values(), *emb.DESPECKLED_CODEC_IDS.values()),
        _create_emb,
        "embedded wavelet codec with learned contexts: an image at every length from 20 bytes",
        has_models=True,
        is_embedded=True,
    ),
    CodecSpec(
        "vq",
        tuple(packing.codec_id for packing in IndexPacking),
        _create_vq,
        "vector quantisation with a shared tile codebook (the paper's codec)",
        needs_tiles=True,
    ),
)


class CodecRegistry:
    """Codecs by name and by codec id. Both are unique.

    Args:
        specs: Codecs.
        plug_ins: Codecs that are registered when they are asked for.
    """

    def __init__(self, specs: Iterable[CodecSpec] = (), plug_ins: Registry[CodecSpec] | None = None) -> None:
        self._by_name: dict[str, CodecSpec] = {}
        self._by_id: dict[int, CodecSpec] = {}
        self._plug_ins = codec_plug_ins(()) if plug_ins is None else plug_ins
        for spec in specs:
            self.register(spec)

    def register(self, spec: CodecSpec) -> None:
        """Add a codec; to add it again changes nothing, so that two threads can do it at once.

        Raises:
            ConfigError: The name or a codec id is taken, a codec id is outside 0..255, there is none, or the codec
                needs tiles and a codec id does not have a tag of two bytes.
        """
        where = f"codec {spec.name}"
        if self._by_name.get(spec.name, spec) is not spec:
            raise ConfigError("codec registry", "name", spec.name, "a name that is not taken")
        if not spec.codec_ids or len(set(spec.codec_ids)) != len(spec.codec_ids):
            raise ConfigError(where, "codec_ids", spec.codec_ids, "at least one id, none twice")
        for codec_id in spec.codec_ids:
            if not 0 <= codec_id <= 0xFF:
                raise ConfigError(where, "codec_ids", codec_id, "0..255")
            if spec.needs_tiles and tag_length(codec_id) != CODEBOOK_TAG_BYTES:
                expected = "0x10..0x1f or 0x80..0xff, which have a codebook tag of two bytes"
                raise ConfigError(where, "codec_ids", f"{codec_id:#04x}", expected)
            owner = self._by_id.get(codec_id, spec)
            if owner is not spec:
                expected = f"an id that is not taken (it is {owner.name}'s)"
                raise ConfigError(where, "codec_ids", f"{codec_id:#04x}", expected)
        self._by_id.update(dict.fromkeys(spec.codec_ids, spec))
        self._by_name[spec.name] = spec  # last: a thread that finds the name finds the ids

    def names(self) -> tuple[str, ...]:
        """Return the names, sorted."""
        return tuple(sorted({*self._by_name, *self._plug_ins.names()}))

    def is_embedded(self, name: str) -> bool:
        """Return whether the streams of a codec can be truncated and extended; False for an unknown name."""
        return name in self.names() and self.spec(name).is_embedded

    def spec(self, name: str) -> CodecSpec:
        """Return the entry of a codec.

        Raises:
            ConfigError: No codec has this name, or it is a plug-in that cannot be used. The message lists the names.
        """
        if name not in self._by_name and name in self._plug_ins.names():
            self.register(self._plug_ins.get(name))
        if name not in self._by_name:
            raise ConfigError("codec registry", "name", name, "one of " + ", ".join(self.names()))
        return self._by_name[name]

    def create(self, name: str, resources: CodecResources | None = None) -> Codec:
        """Create a codec.

        Raises:
            ConfigError: No codec has this name, or a required resource is missing or invalid.
        """
        return self.spec(name).create(resources or CodecResources())

    def spec_for_id(self, codec_id: int) -> CodecSpec:
        """Return the entry of the codec with this codec id.

        Raises:
            StreamError: No codec has it.
        """
        unusable = [] if codec_id in self._by_id else self._register_plug_ins()
        if codec_id not in self._by_id:
            known = ", ".join(f"{number:#04x} ({self._by_id[number].name})" for number in sorted(self._by_id))
            expected = "; ".join([f"one of {known}", *map(str, unusable)])
            raise StreamError("stream", "codec_id", f"{codec_id:#04x}", expected)
        return self._by_id[codec_id]

    def _register_plug_ins(self) -> list[ConfigError]:
        """Register all plug-ins; return the errors of those that cannot be used."""
        errors = []
        for name in self._plug_ins.names():
            try:
                self.spec(name)
            except ConfigError as error:
                errors.append(error)
        return errors

    def create_for_stream(self, stream: bytes, resources: CodecResources | None = None) -> Codec:
        """Create the codec that encoded a stream.

        The header of the stream is enough. A codec with a codebook needs the tile database.

        Raises:
            StreamError: The header is invalid or its codec is unknown.
            ConfigError: A required resource is missing or invalid.
        """
        header = StreamHeader.unpack(stream)
        resources = resources or CodecResources()
        return self.spec_for_id(header.codec_id).create(replace(resources, codec_id=header.codec_id))


def codec_plug_ins(points: Iterable[EntryPoint]) -> Registry[CodecSpec]:
    """Return the codecs of entry points."""
    return Registry(
        ENTRY_POINT_GROUP,
        "a sonarpost.codec.registry.CodecSpec with the name of the entry point",
        lambda found, name: isinstance(found, CodecSpec) and found.name == name,
        {},
        points,
    )


@cache
def default_registry() -> CodecRegistry:
    """Return the registry with the codecs of this package and of the installed plug-ins."""
    return CodecRegistry(BUILTINS, codec_plug_ins(installed_points(ENTRY_POINT_GROUP)))
