"""Huffman codec: code, choice of levels, budgets, truncation, damage."""

import itertools
import math

import numpy as np
import pytest
from builders.common import GOLDEN_FOLDER
from builders.images import snippet
from hypothesis import given
from hypothesis import strategies as st

from research.codecs.baselines.huffman import HuffmanCodec, canonical_codes, code_lengths
from sonarpost.codec.interface import StreamHeader
from sonarpost.errors import StreamError

GOLDEN = GOLDEN_FOLDER / "huffman"
COUNTS = st.lists(st.integers(0, 5000), min_size=1, max_size=256).filter(any)


@pytest.mark.parametrize("name", ["80x80-None", "49x113-900", "17x31-4000", "49x113-671", "80x80-22"])
def test_golden_streams_are_reproduced_and_decoded(name: str) -> None:
    size, budget = name.split("-")
    golden = bytes.fromhex((GOLDEN / f"{name}.hex").read_text())
    decoded = HuffmanCodec().decode(golden)
    expected = np.frombuffer(bytes.fromhex((GOLDEN / f"{name}-image.hex").read_text()), np.uint8)
    scale = golden[StreamHeader.unpack(golden).size] + 1
    # Pillow enlarges a reduced image; its rounding may differ between versions.
    assert np.abs(decoded.image.ravel().astype(int) - expected).max() <= (0 if scale == 32 else 1)
    assert not decoded.missing.any()
    if scale == 32:
        image = snippet(*map(int, size.split("x")))
        assert HuffmanCodec().encode(image, None if budget == "None" else int(budget)).hex() == golden.hex()


@given(counts=COUNTS)
def test_code_is_complete_prefix_free_and_within_one_bit_of_the_entropy(counts: list[int]) -> None:
    lengths = code_lengths(counts)
    codes = canonical_codes(lengths)
    texts = sorted(f"{code:0{length}b}" for code, length in zip(codes, lengths, strict=True) if length)
    assert not any(after.startswith(before) for before, after in itertools.pairwise(texts))
    total, used = sum(counts), sum(1 for count in counts if count)
    assert all((length > 0) == (count > 0) for length, count in zip(lengths, counts, strict=True)) or used == 1
    if used == 1:
        assert not any(lengths)
        return
    assert sum(2.0**-length for length in lengths if length) == 1.0
    entropy = -sum(count / total * math.log2(count / total) for count in counts if count)
    mean = sum(count * length for count, length in zip(counts, lengths, strict=True)) / total
    assert entropy - 1e-9 <= mean < entropy + 1


@given(size=st.tuples(st.integers(16, 40), st.integers(16, 40)), seed=st.integers(0, 999), spread=st.integers(1, 256))
def test_large_budget_is_lossless(size: tuple[int, int], seed: int, spread: int) -> None:
    image = np.random.default_rng(seed).integers(0, spread, size, dtype=np.uint8)
    codec = HuffmanCodec()
    stream = codec.encode(image, 4000)
    assert np.array_equal(codec.decode(stream).image, image)
    assert len(stream) <= 4000


@given(greys=st.lists(st.integers(0, 255), min_size=2, max_size=7, unique=True), data=st.data())
def test_chosen_levels_minimise_the_error(greys: list[int], data: st.DataObject) -> None:
    shares = data.draw(st.lists(st.integers(1, 60), min_size=len(greys), max_size=len(greys)))
    levels = data.draw(st.integers(2, 4))
    ordered, counts = zip(*sorted(zip(greys, shares, strict=True)), strict=True)
    pixels = np.sort(np.resize(np.repeat(np.array(ordered, np.uint8), counts), 400))
    image = pixels.reshape(20, 20)
    rebuilt = HuffmanCodec(levels).decode(HuffmanCodec(levels).encode(image)).image
    actual = ((image.astype(int) - rebuilt) ** 2).sum()
    distinct = np.unique(image)
    least = math.inf
    for edges in itertools.combinations(range(1, len(distinct)), min(levels, len(distinct)) - 1):
        groups = np.split(distinct, edges)
        error = 0
        for group in groups:
            members = pixels[(pixels >= group[0]) & (pixels <= group[-1])].astype(int)
            error += ((members - math.floor(members.mean() + 0.5)) ** 2).sum()
        least = min(least, error)
    # Levels are integers: a group chosen by its exact mean may round worse than another, by at most 1/4 a pixel.
    assert actual <= least + 100


@pytest.mark.parametrize("budget", [None, 30, 400])
def test_truncated_stream_decodes_only_the_pixels_it_holds(budget: int | None) -> None:
    codec, image = HuffmanCodec(), snippet(33, 40)
    stream = codec.encode(image, budget)
    size = StreamHeader.unpack(stream).size
    complete = codec.decode(stream).image
    before = image.size
    for length in sorted({*range(size, min(size + 30, len(stream))), *range(size, len(stream), 11)}):
        decoded = codec.decode(stream[:length])
        assert np.array_equal(decoded.image[~decoded.missing], complete[~decoded.missing])
        assert not decoded.image[decoded.missing].any()
        assert decoded.missing.any()
        assert decoded.missing.sum() <= before
        assert decoded.notes
        before = decoded.missing.sum()
    assert before < image.size / 2


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ("2001", "scale"),
        ("1f1f", "kind"),
        ("1fff", "kind"),
        ("1f010505", "levels"),
        ("1f020504ff", "levels"),
        ("1f0201020378", "code lengths"),  # 1, 1, 1: too many for a prefix code
        ("1f02010203" + "ff" * 4, "code lengths"),  # all unused
        ("1f02010203" + "0a", "code length"),  # 1 0100: 0 and then -1, below zero
        ("1f02010203" + "00ff", "code length"),
    ],
)
def test_error_names_the_invalid_field(body: str, field: str) -> None:
    header = StreamHeader(0x01, 0, 16, 16).pack()
    with pytest.raises(StreamError) as caught:
        HuffmanCodec().decode(header + bytes.fromhex(body) + bytes(64))
    assert caught.value.field == field
