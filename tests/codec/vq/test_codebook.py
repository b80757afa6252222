"""The codebook file: round trip, damage, the shipped ones."""

import hashlib
import json
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from research.codebook.basis import database_of
from research.codebook.codebook_file import save
from sonarpost.codec.vq.codebook import (
    DEFAULT_TILE_PX,
    Codebook,
    find_codebook,
    from_bytes,
    load,
    load_default,
    open_codebook,
    to_bytes,
)
from sonarpost.codec.vq.codec import VqCodec, codebook_tag
from sonarpost.errors import CodebookError


def small() -> Codebook:
    tiles = np.random.default_rng(0).integers(0, 256, (7, 16), dtype=np.uint8)
    return Codebook(database_of(4, tiles, 3), {"name": "klein", "source": "Rauschen, für den Test"})


def test_codebook_round_trips_through_a_file(tmp_path: Path) -> None:
    path = tmp_path / "a.tiles"
    save(path, small())
    loaded = load(path)
    assert loaded.tiles.identity == small().tiles.identity
    assert loaded.notes == small().notes
    assert to_bytes(loaded) == path.read_bytes()
    assert [p.name for p in tmp_path.iterdir()] == ["a.tiles"]
    assert open_codebook(str(path)).tiles.identity == loaded.tiles.identity


def test_file_has_the_documented_layout() -> None:
    codebook = small()
    data = to_bytes(codebook)
    notes = json.dumps(dict(codebook.notes), sort_keys=True, ensure_ascii=False).encode()
    tiles = codebook.tiles
    header = b"SPTILES\n" + (1).to_bytes(2, "big") + (4).to_bytes(2, "big") + (7).to_bytes(4, "big")
    header += (3).to_bytes(2, "big") + len(notes).to_bytes(4, "big")
    content = header + notes + tiles.mean.tobytes() + tiles.basis.astype(">i2").tobytes() + tiles.tiles.tobytes()
    assert data == content + hashlib.sha256(content).digest()


@given(data=st.data())
def test_any_damage_is_a_codebook_error(data: st.DataObject) -> None:
    good = to_bytes(small())
    damaged = bytearray(good)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(good) - 1))] ^= data.draw(st.integers(1, 255))
    damaged = damaged[: data.draw(st.integers(0, len(good)))] + data.draw(st.binary(max_size=9))
    for bad in (bytes(damaged), good[:-1], good[:22]):
        if bad != good:
            with pytest.raises(CodebookError):
                from_bytes(bad, "damaged")


def with_valid_hash(data: bytes) -> bytes:
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
def test_error_names_the_invalid_field_under_a_valid_hash(offset: int, value: bytes, field: str) -> None:
    data = bytearray(to_bytes(small()))
    data[offset : offset + len(value)] = value
    with pytest.raises(CodebookError) as caught:
        from_bytes(with_valid_hash(bytes(data)), "x.tiles")
    assert caught.value.field == field
    assert caught.value.where == "x.tiles"


def test_invalid_and_long_notes_are_rejected() -> None:
    data = to_bytes(Codebook(small().tiles, {}))
    for notes in (b"[1]", b'{"a": 1}', b"null", b"[" * 9999):
        changed = data[:18] + len(notes).to_bytes(4, "big") + notes + data[24:]
        with pytest.raises(CodebookError, match="notes"):
            from_bytes(with_valid_hash(changed), "x")
    with pytest.raises(CodebookError, match="notes"):
        to_bytes(Codebook(small().tiles, {"a": "x" * (1 << 20)}))


def test_error_names_an_unreadable_or_unwritable_file(tmp_path: Path) -> None:
    with pytest.raises(CodebookError, match=r"absent\.tiles"):
        load(tmp_path / "absent.tiles")
    with pytest.raises(CodebookError):
        load(tmp_path)
    with pytest.raises(CodebookError, match="nowhere"):
        save(tmp_path / "nowhere" / "a.tiles", small())


def test_failed_write_keeps_the_old_codebook(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
def test_shipped_codebooks_are_valid_and_fit_14_bits(tile_px: int) -> None:
    codebook = load_default(tile_px)
    assert codebook.tiles.tile_px == tile_px
    assert 1000 <= len(codebook.tiles) <= 15_992
    assert codebook.tiles.dims == 70
    assert "public domain" in codebook.notes["source"]
    assert len(np.unique(codebook.tiles.tiles, axis=0)) == len(codebook.tiles)
    assert VqCodec(codebook.tiles).model_hash == codebook.tiles.identity
    assert open_codebook(f"nominal-{tile_px}") is codebook


def test_shipped_codebook_is_found_by_its_tag() -> None:
    tags = {tile_px: codebook_tag(load_default(tile_px).tiles) for tile_px in DEFAULT_TILE_PX}
    assert len(set(tags.values())) == len(tags)
    for tile_px, tag in tags.items():
        assert find_codebook(tag).tiles.identity == load_default(tile_px).tiles.identity
    with pytest.raises(CodebookError, match="10 or 20"):
        load_default(15)


def codebook_file(folder: Path, seed: int) -> tuple[Path, int]:
    """Write a codebook of random tiles; return its path and tag."""
    tiles = np.random.default_rng(seed).integers(0, 256, (7, 16), dtype=np.uint8)
    codebook = Codebook(database_of(4, tiles, 3), {})
    path = folder / f"{seed}.tiles"
    save(path, codebook)
    return path, codebook_tag(codebook.tiles)


def test_codebook_is_found_in_the_search_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, tag = codebook_file(tmp_path, 1)
    with pytest.raises(CodebookError, match="SONARPOST_CODEBOOKS"):
        find_codebook(tag)
    for search_path in ([path], [str(path)], [tmp_path], ["nominal-20", tmp_path]):
        assert find_codebook(tag, search_path).tiles.identity == load(path).tiles.identity
    monkeypatch.setenv("SONARPOST_CODEBOOKS", f"{tmp_path / 'absent'}{os.pathsep}{tmp_path}")
    assert find_codebook(tag).tiles.identity == load(path).tiles.identity


def test_error_for_an_unknown_tag_names_the_places_searched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (path, tag), (other_path, other_tag) = codebook_file(tmp_path, 1), codebook_file(tmp_path, 2)
    (tmp_path / "damaged.tiles").write_bytes(b"SPTILES")
    monkeypatch.setenv("SONARPOST_CODEBOOKS", str(other_path))
    unknown = next(number for number in range(99) if number not in (tag, other_tag))
    with pytest.raises(CodebookError) as caught:
        find_codebook(unknown, [tmp_path])
    assert (caught.value.field, caught.value.value) == ("model_tag", f"{unknown:#06x}")
    places = (f"{path} ({tag:#06x})", f"{other_path} ({other_tag:#06x})")
    for place in (*places, "damaged.tiles (unreadable)", "nominal-10 (0x"):
        assert place in caught.value.expected


def test_two_codebooks_with_the_same_tag_are_ambiguous(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    codebook_file(tmp_path, 1)
    codebook_file(tmp_path, 2)
    monkeypatch.setattr("sonarpost.codec.vq.codebook.codebook_tag", lambda _: 0x1234)
    with pytest.raises(CodebookError, match="one codebook with this tag"):
        find_codebook(0x1234, [tmp_path])


def test_replaced_codebook_file_is_read_again(tmp_path: Path) -> None:
    path, tag = codebook_file(tmp_path, 1)
    assert find_codebook(tag, [path]).tiles.identity == load(path).tiles.identity
    other_path, other_tag = codebook_file(tmp_path, 2)
    path.write_bytes(other_path.read_bytes())
    os.utime(path, ns=(1, 1))
    assert find_codebook(other_tag, [path]).tiles.identity == load(other_path).tiles.identity
