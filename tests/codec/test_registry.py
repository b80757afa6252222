"""The codec registry and its plug-ins."""

import sys
import types
from importlib.metadata import EntryPoint

import numpy as np
import pytest

from research.codebook.basis import database_of
from sonarpost.codec.registry import (
    BUILTINS,
    ENTRY_POINT_GROUP,
    CodecRegistry,
    CodecResources,
    CodecSpec,
    codec_plug_ins,
)
from sonarpost.codec.vq.codec import IndexPacking, VqCodec
from sonarpost.errors import ConfigError, StreamError

TILES = database_of(8, np.random.default_rng(0).integers(0, 256, (50, 64), dtype=np.uint8))


def make_nothing(resources: CodecResources) -> VqCodec:
    return VqCodec(TILES, IndexPacking.BYTES3)


PLUGIN = CodecSpec("plugin", (0x80, 0x81), make_nothing, "for the tests")
NOT_A_SPEC = 5


@pytest.fixture
def registry(monkeypatch: pytest.MonkeyPatch) -> CodecRegistry:
    module = types.ModuleType("sonarpost_test_plugin")
    module.PLUGIN, module.NOT_A_SPEC = PLUGIN, NOT_A_SPEC
    monkeypatch.setitem(sys.modules, "sonarpost_test_plugin", module)
    return CodecRegistry(BUILTINS)


def plugin(name: str, value: str) -> EntryPoint:
    return EntryPoint(name, f"sonarpost_test_plugin:{value}", ENTRY_POINT_GROUP)


def test_errors_for_unknown_names_and_ids_list_the_known_ones(registry: CodecRegistry) -> None:
    with pytest.raises(ConfigError, match="vq"):
        registry.create("jpg", CodecResources())
    with pytest.raises(StreamError, match=r"0x10 \(vq\)"):
        registry.spec_for_id(0xFE)
    with pytest.raises(StreamError):
        registry.create_for_stream(b"\x10", CodecResources(TILES))
    with pytest.raises(ConfigError, match="nominal-10"):
        registry.create("vq", CodecResources())


@pytest.mark.parametrize(
    ("name", "ids", "match"),
    [
        ("vq", (0x90,), "not taken"),
        ("other", (0x90, 0x12), "it is vq's"),
        ("other", (), "at least one"),
        ("other", (0x90, 0x90), "none twice"),
        ("other", (256,), "0..255"),
        ("other", (-1,), "0..255"),
    ],
)
def test_names_and_codec_ids_are_unique(registry: CodecRegistry, name: str, ids: tuple[int, ...], match: str) -> None:
    before = registry.names()
    with pytest.raises(ConfigError, match=match):
        registry.register(CodecSpec(name, ids, make_nothing))
    assert registry.names() == before
    if 0x90 in ids:
        with pytest.raises(StreamError):
            registry.spec_for_id(0x90)  # a rejected codec leaves no entry


@pytest.mark.parametrize("codec_id", [0x0F, 0x20, 0x7F])
def test_codec_with_a_codebook_needs_codec_ids_with_a_tag_of_two_bytes(registry: CodecRegistry, codec_id: int) -> None:
    with pytest.raises(ConfigError, match=r"0x10\.\.0x1f or 0x80\.\.0xff"):
        registry.register(CodecSpec("other", (0x90, codec_id), make_nothing, needs_tiles=True))
    assert "other" not in registry.names()
    with pytest.raises(StreamError):
        registry.spec_for_id(0x90)
    if codec_id != 0x20:  # emb's
        registry.register(CodecSpec("other", (0x90, codec_id), make_nothing))


def with_plug_ins(*points: EntryPoint) -> CodecRegistry:
    return CodecRegistry(BUILTINS, codec_plug_ins(points))


@pytest.mark.usefixtures("registry")
def test_plug_in_is_registered_by_name_and_by_codec_id() -> None:
    assert with_plug_ins(plugin("plugin", "PLUGIN")).create("plugin", CodecResources()).codec_id == 0x12
    registry = with_plug_ins(plugin("plugin", "PLUGIN"))
    assert registry.spec_for_id(0x81) is PLUGIN
    assert "plugin" in registry.names()


@pytest.mark.usefixtures("registry")
@pytest.mark.parametrize(
    ("name", "value", "match"),
    [
        ("plugin", "ABSENT", "an object that imports"),
        ("plugin", "NOT_A_SPEC", "CodecSpec"),
        ("another", "PLUGIN", "the name of the entry point"),
    ],
)
def test_invalid_plug_in_stops_only_who_uses_it(name: str, value: str, match: str) -> None:
    registry = with_plug_ins(plugin(name, value))
    assert registry.create("emb").codec_id in registry.spec_for_id(0x20).codec_ids
    assert registry.spec("vq").needs_tiles
    with pytest.raises(ConfigError, match=match) as caught:
        registry.create(name)
    assert name in caught.value.where
    # It may be the codec of the stream.
    with pytest.raises(StreamError, match=f"sonarpost.codecs:{name}"):
        registry.spec_for_id(0xFE)


@pytest.mark.usefixtures("registry")
@pytest.mark.parametrize(
    "find", [lambda registry: registry.spec("plugin"), lambda registry: registry.spec_for_id(0x81)]
)
def test_plug_in_that_another_thread_registers_meanwhile(find, monkeypatch) -> None:
    plug_ins = codec_plug_ins([plugin("plugin", "PLUGIN")])
    registry = CodecRegistry(BUILTINS, plug_ins)

    def get(_: str) -> CodecSpec:
        registry.register(PLUGIN)
        return PLUGIN

    monkeypatch.setattr(plug_ins, "get", get)
    assert find(registry) is PLUGIN


def test_prefixes_of_embedded_codecs_are_images(registry: CodecRegistry) -> None:
    assert {name for name in registry.names() if registry.is_embedded(name)} == {"emb"}
    assert not registry.is_embedded("nothing")
    image = np.random.default_rng(1).integers(0, 256, (32, 40), dtype=np.uint8)
    codec = registry.create("emb")
    stream = codec.encode(image, 120)
    errors = [np.abs(codec.decode(stream[:n]).image.astype(int) - image).mean() for n in (30, 120)]
    assert errors[1] < errors[0]
