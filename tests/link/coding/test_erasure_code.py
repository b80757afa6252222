"""The erasure code: equal to reedsolo, and recovery from any k symbols."""

import numpy as np
import pytest
import reedsolo
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.errors import FrameError
from sonarpost.link.coding import erasure_code as fec


@pytest.mark.parametrize("count", [1, 2, 16, 100, 223, 254])
def test_symbols_equal_reedsolo(count: int) -> None:
    source = np.random.default_rng(count).integers(0, 256, (count, 2), dtype=np.uint8)
    oracle = reedsolo.RSCodec(255 - count, nsize=255, fcr=1, prim=0x11D)
    symbols = fec.encode(source, range(255))
    for column in range(2):
        assert bytes(oracle.encode(source[:, column].tobytes())) == symbols[:, column].tobytes()


@pytest.mark.parametrize("count", [3, 40, 120])
def test_recovery_equals_reedsolo(count: int) -> None:
    rng = np.random.default_rng(count)
    source = rng.integers(0, 256, (count, 1), dtype=np.uint8)
    symbols = fec.encode(source, range(255))
    keep = sorted(int(i) for i in rng.permutation(255)[:count])
    word = bytearray(symbols[:, 0].tobytes())
    lost = sorted(set(range(255)) - set(keep))
    for place in lost:
        word[place] = 0
    oracle = reedsolo.RSCodec(255 - count, nsize=255, fcr=1, prim=0x11D)
    message, _, _ = oracle.decode(word, erase_pos=lost, only_erasures=True)
    assert bytes(message) == fec.recover(count, keep, symbols[keep]).tobytes() == source.tobytes()


@given(st.data())
def test_any_k_symbols_recover_the_source(data: st.DataObject) -> None:
    count = data.draw(st.integers(1, 60))
    indices = data.draw(st.lists(st.integers(0, 254), min_size=count, max_size=count, unique=True))
    source = np.frombuffer(data.draw(st.binary(min_size=2 * count, max_size=2 * count)), np.uint8).reshape(count, 2)
    assert (fec.recover(count, indices, fec.encode(source, indices)) == source).all()


@pytest.mark.parametrize(
    ("count", "indices"), [(0, []), (256, range(256)), (2, [1, 1]), (2, [1]), (2, [0, 255]), (2, [-1, 0])]
)
def test_invalid_symbols_are_rejected(count: int, indices: list[int]) -> None:
    with pytest.raises(FrameError, match="erasure code"):
        fec.recover(count, list(indices), np.zeros((len(indices), 1), np.uint8))
    with pytest.raises(FrameError, match="erasure code"):
        fec.encode(np.zeros((2, 1), np.uint8), [255])
