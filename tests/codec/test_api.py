"""The public functions of `sonarpost.codec`."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from builders.images import snippet

import sonarpost.codec as c
from research.codebook.basis import database_of
from research.codebook.codebook_file import save
from sonarpost.codec.vq.codebook import Codebook
from sonarpost.codec.vq.tiles import cut_tiles
from sonarpost.errors import CodebookError, ConfigError, StreamError


@pytest.fixture
def codebook(tmp_path: Path) -> Path:
    """Return the file of a codebook that is not shipped."""
    path = tmp_path / "own.tiles"
    save(path, Codebook(database_of(8, cut_tiles(snippet(80, 80), 8)), {}))
    return path


def test_three_lines_from_image_to_image() -> None:
    image = snippet(80, 80)
    stream = c.encode(image, budget=64)
    decoded = c.decode(stream)
    assert len(stream) == 64
    assert (decoded.shape, decoded.dtype) == (image.shape, np.uint8)
    assert np.abs(decoded.astype(float) - image).mean() < np.abs(image.mean() - image).mean()


# The library of JPEG XL is an optional extra.
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.system] * (name == "jpegxl")) for name in c.codec_names()]
)
def test_every_codec_is_encoded_and_decoded_by_name(name: str) -> None:
    image = snippet(32, 40)
    stream = c.encode(image, name)
    assert stream == c.get_codec(name).encode(image)
    assert c.StreamHeader.unpack(stream).codec_id == c.get_codec(name).codec_id
    decoded = c.decode_image(stream)
    assert isinstance(decoded, c.DecodedImage)
    assert np.array_equal(decoded.image, c.decode(stream))
    assert not decoded.missing.any()


def test_options_select_model_codebook_and_packing(codebook: Path) -> None:
    image = snippet(48, 64)
    assert [c.get_codec(model=model, strength=0.0).codec_id for model in ("standard", "structure")] == [0x20, 0x21]
    assert [c.get_codec(model=model).codec_id for model in ("standard", "structure")] == [0x22, 0x23]
    assert c.encode(image, model="structure", strength=0.0)[0] == 0x21
    assert c.get_codec("vq", codebook="nominal-20", packing="2byte").codec_id == 0x11
    assert c.decode(c.encode(image, "vq", codebook=codebook), codebooks=[codebook]).shape == image.shape


@pytest.mark.parametrize(
    ("name", "options", "match"),
    [
        ("vq", {"model": "structure"}, "codebook or packing"),
        ("emb", {"codebook": "nominal-10"}, "expected model"),
        ("emb", {"model": "texture"}, "standard or structure"),
        ("vq", {"packing": "13bit"}, "14bit"),
        ("zip", {}, "one of"),
    ],
)
def test_errors_name_the_valid_options(name: str, options: dict[str, str], match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        c.get_codec(name, **options)


def test_codebook_of_a_stream_is_found_by_its_tag(codebook: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    image = snippet(80, 80)
    shipped = c.encode(image, "vq", codebook="nominal-20")
    assert np.array_equal(c.decode(shipped), c.get_codec("vq", codebook="nominal-20").decode(shipped).image)
    own = c.encode(image, "vq", codebook=codebook)
    with pytest.raises(CodebookError, match=rf"model_tag: got '0x{own[1:3].hex()}'.*nominal-10.*SONARPOST_CODEBOOKS"):
        c.decode(own)
    # The codebook holds all tiles of the image.
    assert np.array_equal(c.decode(own, codebooks=[codebook]), image)
    monkeypatch.setenv("SONARPOST_CODEBOOKS", str(codebook.parent))
    assert np.array_equal(c.decode(own), image)


def test_decode_image_returns_the_missing_pixels() -> None:
    stream = c.encode(snippet(80, 80), "vq")
    received = np.ones(len(stream) - c.StreamHeader.unpack(stream).size, np.bool_)
    received[: len(received) // 2] = False
    decoded = c.decode_image(stream, received)
    assert decoded.missing[:40].all()
    assert not decoded.missing[50:].any()
    assert not decoded.image[decoded.missing].any()


def test_unknown_codec_ids_are_rejected() -> None:
    with pytest.raises(StreamError, match="codec_id"):
        c.decode(b"\xfe\0\0\0" + bytes(20))
    with pytest.raises(AttributeError, match="no attribute 'transcode'"):
        _ = c.transcode


def test_import_loads_neither_numba_nor_scipy() -> None:
    code = "import sys, sonarpost.codec.registry, sonarpost.codec.api, sonarpost.cli.encode; "
    code += "print(sorted({'numba', 'scipy'} & set(sys.modules)))"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert process.stdout.strip() == "[]"
