"""What the encoder of emb tells in place of the plain coefficients, and how it goes on with a stream."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sonarpost.codec.emb import rate_distortion_opt as fit
from sonarpost.codec.emb import transform
from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.codec.emb.coder import Coder
from sonarpost.codec.emb.layout import layout
from sonarpost.codec.emb.rate_distortion_opt import TargetCoefficients
from sonarpost.codec.emb.region import OUTSIDE, weights
from sonarpost.codec.emb.search import EncodedTrial, TrialEncoder, beside
from sonarpost.codec.emb.side_info import Box, SideInfo
from sonarpost.codec.interface import ExtensibleCodec, StreamHeader
from sonarpost.codec.quality import psnr_db
from sonarpost.errors import StreamError

CODEC = EmbCodec()


def contact(height_px: int = 80, width_px: int = 80, seed: int = 0) -> np.ndarray:
    """Speckled slope with a highlight and a shadow, that touch the border."""
    rng = np.random.default_rng(seed)
    image = (50 + 30 * np.linspace(0, 1, width_px)) * rng.gamma(6, 1 / 6, (height_px, width_px))
    image[: height_px // 5, width_px // 4 : width_px // 2] *= 3
    image[: height_px // 5, width_px // 2 : width_px * 3 // 4] *= 0.1
    return np.clip(image, 0, 255).astype(np.uint8)


def plane_of(image: np.ndarray) -> np.ndarray:
    return (image.astype(np.int64) - int(image.mean())) * transform.UNIT


@pytest.mark.parametrize("size", [(80, 80), (17, 33), (140, 80), (16, 512)])
def test_gathering_is_the_transpose_of_drawing(size: tuple[int, int]) -> None:
    """The scalar product of a drawn picture with another one is that of its coefficients with what is gathered."""
    lay, rng = layout(*size), np.random.default_rng(1)
    coefficients, other = (rng.integers(-8000, 8000, size) for _ in range(2))
    drawn, _ = transform.inverse(coefficients, lay)
    low_rows, low_columns = lay.sides[lay.levels]
    gathered = other.copy()
    fit._gather(gathered, lay.sides)
    rows, columns = (transform.cosine_matrix(int(n)) / 2**14 for n in (low_rows, low_columns))
    gathered = gathered.astype(float)
    gathered[:low_rows, :low_columns] = rows @ gathered[:low_rows, :low_columns] @ columns.T
    assert (drawn * other).sum() == pytest.approx(
        (coefficients * gathered).sum(), abs=2e-3 * np.linalg.norm(drawn) * np.linalg.norm(other) / np.sqrt(drawn.size)
    )


@pytest.mark.parametrize("size", [(80, 80), (17, 33)])
def test_the_reach_is_the_wavelets_own_norm(size: tuple[int, int]) -> None:
    lay, rng = layout(*size), np.random.default_rng(2)
    reach, strengths = fit._reach(lay), transform.strength_map(lay)
    for at in rng.choice(lay.position.ravel(), 60, replace=False):
        flat = np.zeros(lay.cells, np.int32)
        flat[at] = 64000
        drawn, _ = transform.inverse(transform.from_flat(flat, lay), lay)
        plain = int(transform.from_flat(flat, lay).sum())
        norm = float((drawn.astype(float) ** 2).sum()) / plain**2
        assert reach[at] / 2**14 == pytest.approx(strengths[at] / 1024 / norm, rel=0.01)


@pytest.mark.parametrize("body_bytes", [30, 120, 500])
def test_as_many_fitted_coefficients_show_more_of_the_picture(body_bytes: int) -> None:
    image = contact()
    plane, lay = plane_of(image), layout(*image.shape)
    wanted = fit.target_coefficients(plane, lay, weights(lay, None), body_bytes)
    error = []
    for coefficients in (wanted.plain, wanted.targets):
        least = np.partition(np.abs(coefficients), -body_bytes)[-body_bytes]
        kept = np.where(np.abs(coefficients) >= least, coefficients, 0)
        error.append(int(((plane - transform.inverse(transform.from_flat(kept, lay), lay)[0]) ** 2).sum()))
    assert error[1] < 0.999 * error[0]


def test_the_box_weighs_in_both() -> None:
    image = contact()
    plane, lay = plane_of(image), layout(*image.shape)
    halves = weights(lay, Box(4, 4, 7, 7))
    plain, boxed = (fit.target_coefficients(plane, lay, w, 60) for w in (weights(lay, None), halves))
    assert np.array_equal(boxed.plain, plain.plain.astype(np.int64) * halves // OUTSIDE)
    strong = (halves > OUTSIDE) & (np.abs(plain.plain) > 3000)
    assert np.abs(boxed.targets[strong]).mean() > 1.3 * np.abs(plain.targets[strong]).mean()


@pytest.mark.parametrize("short", [12, 22, 64, 100])
def test_a_stream_goes_on_as_it_began(short: int) -> None:
    assert isinstance(CODEC, ExtensibleCodec)
    for seed in range(4):
        image = contact(64, 56, seed)
        stream = CODEC.encode(image, short)
        longer = CODEC.extend(stream, image, 2 * short)
        assert longer.startswith(stream[:-1])
        assert len(longer) == 2 * short
        assert psnr_db(image, CODEC.decode(longer).image) > psnr_db(image, CODEC.decode(stream).image) + 0.1


def test_what_is_written_after_a_beginning_leaves_it_as_it_is() -> None:
    """Also where what comes next would lie beyond the number that the beginning ends in."""
    turned = 0
    for seed in range(600):
        rng = np.random.default_rng(seed)
        bits = rng.integers(0, 2, 200).tolist()
        chances = rng.integers(6, 65530, 200).tolist()
        short = Coder.writer(int(rng.integers(3, 9)))
        for bit, chance in zip(bits, chances, strict=True):
            if short.plain(bit, chance) < 0:
                break
        begin = short.finish()
        reader, said = Coder.reader(begin), []
        for chance in chances:
            said.append(reader.plain(0, chance))
            if said[-1] < 0:
                break
        known = len(said) - 1  # the bytes may happen to say more than was written
        longer = Coder.writer(40, begin[:-1])
        assert [longer.plain(bit, chance) for bit, chance in zip(said[:-1], chances, strict=False)] == said[:-1]
        wanted = rng.integers(0, 2, 60).tolist()
        after = [longer.plain(bit, chance) for bit, chance in zip(wanted, chances[known:], strict=False)]
        turned += sum(a != b for a, b in zip(after, wanted, strict=False) if a >= 0)
        body = longer.finish()
        assert body.startswith(begin[:-1])
        reader = Coder.reader(body)
        assert [reader.plain(0, chance) for chance in chances[:known]] == said[:-1]
        again = [reader.plain(0, chance) for chance, bit in zip(chances[known:], after, strict=False) if bit >= 0]
        assert again == [bit for bit in after if bit >= 0]
    assert turned >= 3


@pytest.mark.parametrize("budget", range(9, 16))
def test_the_least_budgets_with_a_box_hold(budget: int) -> None:
    """What is said before the first coefficient may be all there is room for."""
    image = contact(33, 48)
    stream = CODEC.encode_with_estimate(image, budget, box=Box(3, 3, 8, 9)).stream
    assert len(stream) <= budget
    assert CODEC.decode(stream).image.shape == image.shape


@given(seed=st.integers(0, 1000), short=st.integers(9, 60), more=st.integers(0, 60), box=st.booleans())
@settings(max_examples=12, deadline=None)
def test_going_on_never_takes_anything_back(seed: int, short: int, more: int, box: bool) -> None:
    image = contact(33, 48, seed)
    stream = CODEC.encode_with_estimate(image, short, box=Box(3, 3, 8, 9) if box else None).stream
    longer = CODEC.extend(stream, image, len(stream) + more)
    assert longer.startswith(stream[:-1])
    assert len(stream) <= len(longer) <= len(stream) + more


def test_what_cannot_go_on_stays_or_is_refused() -> None:
    image = contact(32, 32)
    stream = CODEC.encode(image, 40)
    size = StreamHeader.unpack(stream).size
    assert CODEC.extend(stream, image, 20) == stream
    assert CODEC.extend(stream, image, 40) == stream
    assert CODEC.extend(stream[:size], image, 80) == stream[:size]
    with pytest.raises(StreamError, match="shape"):
        CODEC.extend(stream, contact(32, 48), 80)
    with pytest.raises(StreamError, match="codec_id"):
        CODEC.extend(b"\x04" + stream[1:], image, 80)


def test_going_on_leaves_out_what_is_not_known() -> None:
    error = np.zeros(2)
    for seed in range(6):
        image = contact(64, 56, seed)
        known = np.ones(image.shape, np.bool_)
        known[:, 40:] = False
        holed = np.where(known, image, 0).astype(np.uint8)
        stream = CODEC.encode_with_estimate(holed, 60, known=known).stream
        for i, mask in enumerate((known, None)):
            longer = CODEC.extend(stream, holed, 120, known=mask)
            assert len(longer) == 120
            error[i] += ((CODEC.decode(longer).image.astype(float) - image)[known] ** 2).mean()
    assert error[0] < 0.97 * error[1]


def test_the_search_goes_to_the_better_side_of_the_best_step() -> None:
    """Steps are a circle: eight of them halve the threshold."""
    assert beside({0: 10, 2: 5, 4: 8, 6: 9}) == 3
    assert beside({0: 5, 2: 9, 4: 10, 6: 6}) == 7
    assert beside({0: 5, 4: 9}) in (1, 7)
    assert beside({0: 5, 1: 6, 7: 4, 4: 9}) == 6
    assert beside({step: 10 - step for step in range(7)}) == 7
    assert beside({step: abs(step - 3) for step in range(8)}) == 3


@pytest.mark.parametrize(
    ("budget", "size", "tries"),
    [
        (40, (80, 80), 5),
        (200, (80, 80), 4),
        (400, (80, 80), 4),
        (40, (140, 80), 5),
        (200, (140, 80), 3),
        (400, (140, 80), 3),
    ],
)
def test_a_searched_step_is_the_best_of_those_tried(
    budget: int, size: tuple[int, int], tries: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[tuple[int, int]] = []
    write = TrialEncoder.write

    def watched(self: TrialEncoder, wanted: TargetCoefficients, side: SideInfo) -> EncodedTrial:
        written = write(self, wanted, side)
        tried.append((written.error, side.step))
        return written

    monkeypatch.setattr(TrialEncoder, "write", watched)
    image = contact(*size)
    stream = EmbCodec().encode(image, budget)
    assert len({step for _, step in tried}) == len(tried) == tries
    assert EmbCodec().read_state(stream)[1].step == min(tried)[1]
    assert stream == EmbCodec(steps=(min(tried)[1],)).encode(image, budget)
