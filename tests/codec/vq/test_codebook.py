"""The codebook file: round trip, damage, the shipped ones."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarpost.codec.vq.codebook import (
    DEFAULT_TILE_PX,
    Codebook,
    default_for_tag,
    from_bytes,
    load,
    load_default,
    open_codebook,
    save,
    to_bytes,
)
from sonarpost.codec.vq.codec import VqCodec, codebook_tag
from sonarpost.codec.vq.tiles import TileDatabase
from sonarpost.errors import CodebookError


def small() -> Codebook:
    tiles = np.random.default_rng(0).integers(0, 256, (7, 16), dtype=np.uint8)
    return Codebook(TileDatabase.from_tiles(4, tiles, 3), {"name": "klein", "source": "Rauschen, für den Test"})


def test_saved_and_loaded_it_is_the_same(tmp_path: Path) -> None:
    path = tmp_path / "a.tiles"
    save(path, small())
    loaded = load(path)
    assert loaded.tiles.identity == small().tiles.identity
    assert loaded.notes == small().notes
    assert to_bytes(loaded) == path.read_bytes()
    assert [p.name for p in tmp_path.iterdir()] == ["a.tiles"]
    assert open_codebook(str(path)).tiles.identity == loaded.tiles.identity


def test_the_layout_is_the_documented_one() -> None:
    codebook = small()
    data = to_bytes(codebook)
    notes = json.dumps(dict(codebook.notes), sort_keys=True, ensure_ascii=False).encode()
    tiles = codebook.tiles
    header = b"SPTILES\n" + (1).to_bytes(2, "big") + (4).to_bytes(2, "big") + (7).to_bytes(4, "big")
    header += (3).to_bytes(2, "big") + len(notes).to_bytes(4, "big")
    content = header + notes + tiles.mean.tobytes() + tiles.basis.astype(">i2").tobytes() + tiles.tiles.tobytes()
    assert data == content + hashlib.sha256(content).digest()


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_any_damage_is_a_codebook_error(data: st.DataObject) -> None:
    good = to_bytes(small())
    damaged = bytearray(good)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(good) - 1))] ^= data.draw(st.integers(1, 255))
    damaged = damaged[: data.draw(st.integers(0, len(good)))] + data.draw(st.binary(max_size=9))
    if bytes(damaged) != good:
        with pytest.raises(CodebookError):
            from_bytes(bytes(damaged), "damaged")


@pytest.mark.parametrize("length", [0, 1, 8, 21, 22, 53, 54, 100, -33, -1])
def test_a_cut_file_is_refused(length: int) -> None:
    with pytest.raises(CodebookError):
        from_bytes(to_bytes(small())[:length], "cut")


def with_right_hash(data: bytes) -> bytes:
    return data[:-32] + hashlib.sha256(data[:-32]).digest()


@pytest.mark.parametrize(
    ("offset", "value", "field"),
    [
        (0, b"PK", "magic"),
        (8, b"\x00\x02", "version"),
        (10, b"\x00\x03", "tile_px"),
        (10, b"\x00\x21", "tile_px"),
        (12, b"\x00\x00\x00\x00", "tiles"),
        (12, b"\xff\xff\xff\xff", "length"),
        (16, b"\x00\x00", "dims"),
        (16, b"\x00\x11", "dims"),
        (18, b"\xff\xff\xff\xff", "length"),
        (22, b"[", "notes"),
        (22, b"\xff", "notes"),
    ],
)
def test_a_wrong_field_is_named_even_under_a_right_hash(offset: int, value: bytes, field: str) -> None:
    data = bytearray(to_bytes(small()))
    data[offset : offset + len(value)] = value
    with pytest.raises(CodebookError) as caught:
        from_bytes(with_right_hash(bytes(data)), "x.tiles")
    assert caught.value.field == field
    assert caught.value.where == "x.tiles"


@pytest.mark.parametrize("notes", [b"[1]", b'{"a": 1}', b"null", b"[" * 9999])
def test_notes_that_are_not_strings_by_name_are_refused(notes: bytes) -> None:
    data = to_bytes(Codebook(small().tiles, {}))
    changed = data[:18] + len(notes).to_bytes(4, "big") + notes + data[24:]
    with pytest.raises(CodebookError, match="notes"):
        from_bytes(with_right_hash(changed), "x")


def test_notes_beyond_bounds_are_refused() -> None:
    with pytest.raises(CodebookError, match="notes"):
        to_bytes(Codebook(small().tiles, {"a": "x" * (1 << 20)}))


def test_a_file_that_cannot_be_read_or_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(CodebookError, match=r"absent\.tiles"):
        load(tmp_path / "absent.tiles")
    with pytest.raises(CodebookError):
        load(tmp_path)
    with pytest.raises(CodebookError, match="nowhere"):
        save(tmp_path / "nowhere" / "a.tiles", small())


def test_a_failed_write_leaves_the_old_codebook(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.tiles"
    save(path, small())
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(CodebookError, match="No space"):
        save(path, Codebook(small().tiles, {}))
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.tiles"]


@pytest.mark.parametrize("tile_px", DEFAULT_TILE_PX)
def test_the_shipped_codebooks_are_whole_and_fit_14_bits(tile_px: int) -> None:
    codebook = load_default(tile_px)
    assert codebook.tiles.tile_px == tile_px
    assert 1000 <= len(codebook.tiles) <= 15_992
    assert codebook.tiles.dims == 70
    assert "public domain" in codebook.notes["source"]
    assert len(np.unique(codebook.tiles.tiles, axis=0)) == len(codebook.tiles)
    assert VqCodec(codebook.tiles).model_hash == codebook.tiles.identity
    assert open_codebook(f"nominal-{tile_px}") is codebook


def test_a_shipped_codebook_is_found_by_the_tag_in_a_stream() -> None:
    tags = {tile_px: codebook_tag(load_default(tile_px).tiles) for tile_px in DEFAULT_TILE_PX}
    assert len(set(tags.values())) == len(tags)
    for tile_px, tag in tags.items():
        assert default_for_tag(tag) is load_default(tile_px)
    unknown = next(tag for tag in range(9) if tag not in tags.values())
    with pytest.raises(CodebookError, match="nominal-10"):
        default_for_tag(unknown)


def test_there_is_no_other_nominal_size() -> None:
    with pytest.raises(CodebookError, match="10 or 20"):
        load_default(15)
