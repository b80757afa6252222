"""The encoder of emb: optimised targets, extension of streams, choice of the start step."""

import numpy as np
import pytest
from builders.images import contact
from hypothesis import given
from hypothesis import strategies as st

from research.common.emb_estimate import encode_with_estimate
from research.common.quality import psnr_db
from sonarpost.codec.emb import rate_distortion_opt, transform
from sonarpost.codec.emb.codec import EmbCodec, EncodedTrial, TrialEncoder, next_step
from sonarpost.codec.emb.coder import Coder
from sonarpost.codec.emb.decode import read_body
from sonarpost.codec.emb.rate_distortion_opt import TargetCoefficients
from sonarpost.codec.emb.side_info import UNIT_WEIGHT, RegionOfInterest, SideInfo, region_weights
from sonarpost.codec.emb.transform import layout_of
from sonarpost.codec.interface import ExtensibleCodec, StreamHeader
from sonarpost.errors import StreamError

CODEC = EmbCodec()


def plane_of(image: np.ndarray) -> np.ndarray:
    return (image.astype(np.int64) - int(image.mean())) * transform.UNIT


@pytest.mark.parametrize("size", [(80, 80), (17, 33), (16, 512)])
def test_correlation_is_the_transpose_of_synthesis(size: tuple[int, int]) -> None:
    layout, rng = layout_of(*size), np.random.default_rng(1)
    coefficients, other = (rng.integers(-8000, 8000, size) for _ in range(2))
    synthesised, _ = transform.inverse(coefficients, layout)
    assert (synthesised * other).sum() == pytest.approx(
        (coefficients * transform.correlate(other, layout)).sum(),
        abs=2e-3 * np.linalg.norm(synthesised) * np.linalg.norm(other) / np.sqrt(synthesised.size),
    )


@pytest.mark.parametrize("size", [(80, 80), (17, 33)])
def test_step_sizes_are_the_norms_of_the_wavelets(size: tuple[int, int]) -> None:
    layout, rng = layout_of(*size), np.random.default_rng(2)
    step_sizes, gains = rate_distortion_opt._step_sizes(layout), transform.gain_map(layout)
    for at in rng.choice(layout.position.ravel(), 30, replace=False):
        flat = np.zeros(layout.cells, np.int32)
        flat[at] = 64000
        synthesised, _ = transform.inverse(transform.from_flat(flat, layout), layout)
        plain = int(transform.from_flat(flat, layout).sum())
        norm = float((synthesised.astype(float) ** 2).sum()) / plain**2
        assert step_sizes[at] / 2**14 == pytest.approx(gains[at] / 1024 / norm, rel=0.01)


@pytest.mark.parametrize("body_bytes", [30, 120, 500])
def test_optimised_targets_reduce_the_error(body_bytes: int) -> None:
    image = contact()
    plane, layout = plane_of(image), layout_of(*image.shape)
    optimised = rate_distortion_opt.target_coefficients(plane, layout, region_weights(layout, None), body_bytes)
    error = []
    for coefficients in (optimised.originals, optimised.targets):
        least = np.partition(np.abs(coefficients), -body_bytes)[-body_bytes]
        sent = np.where(np.abs(coefficients) >= least, coefficients, 0)
        error.append(int(((plane - transform.inverse(transform.from_flat(sent, layout), layout)[0]) ** 2).sum()))
    assert error[1] < 0.999 * error[0]


def test_region_weights_apply_to_originals_and_targets() -> None:
    image = contact()
    plane, layout = plane_of(image), layout_of(*image.shape)
    weights = region_weights(layout, RegionOfInterest(4, 4, 7, 7))
    plain, with_region = (
        rate_distortion_opt.target_coefficients(plane, layout, w, 60) for w in (region_weights(layout, None), weights)
    )
    assert np.array_equal(with_region.originals, plain.originals.astype(np.int64) * weights // UNIT_WEIGHT)
    strong = (weights > UNIT_WEIGHT) & (np.abs(plain.originals) > 3000)
    assert np.abs(with_region.targets[strong]).mean() > 1.3 * np.abs(plain.targets[strong]).mean()


@pytest.mark.parametrize("short", [12, 64])
def test_extended_stream_starts_with_the_original(short: int) -> None:
    assert isinstance(CODEC, ExtensibleCodec)
    for seed in range(2):
        image = contact(48, 40, seed)
        stream = CODEC.encode(image, short)
        longer = CODEC.extend(stream, image, 2 * short)
        assert longer.startswith(stream[:-1])
        assert len(longer) == 2 * short
        assert psnr_db(image, CODEC.decode(longer).image) > psnr_db(image, CODEC.decode(stream).image) + 0.1


def test_bits_written_after_a_prefix_do_not_change_it() -> None:
    """Also if the next bits would lead outside the interval of the prefix."""
    inverted = 0
    for seed in range(300):
        rng = np.random.default_rng(seed)
        bits = rng.integers(0, 2, 200).tolist()
        probabilities = rng.integers(6, 65530, 200).tolist()
        short = Coder.writer(int(rng.integers(3, 9)))
        for bit, probability in zip(bits, probabilities, strict=True):
            if short.code_bit(bit, probability) < 0:
                break
        prefix = short.finish()
        reader, decoded = Coder.reader(prefix), []
        for probability in probabilities:
            decoded.append(reader.code_bit(0, probability))
            if decoded[-1] < 0:
                break
        known = len(decoded) - 1  # the bytes may determine more bits than were written
        longer = Coder.writer(40, prefix[:-1])
        assert [longer.code_bit(*pair) for pair in zip(decoded[:-1], probabilities, strict=False)] == decoded[:-1]
        more_bits = rng.integers(0, 2, 60).tolist()
        written = [longer.code_bit(*pair) for pair in zip(more_bits, probabilities[known:], strict=False)]
        inverted += sum(a != b for a, b in zip(written, more_bits, strict=False) if a >= 0)
        body = longer.finish()
        assert body.startswith(prefix[:-1])
        reader = Coder.reader(body)
        assert [reader.code_bit(0, probability) for probability in probabilities[:known]] == decoded[:-1]
        pairs = zip(probabilities[known:], written, strict=False)
        again = [reader.code_bit(0, probability) for probability, bit in pairs if bit >= 0]
        assert again == [bit for bit in written if bit >= 0]
    assert inverted >= 3


def test_smallest_budgets_with_a_region_are_met() -> None:
    """The budget may end in the side information."""
    image = contact(33, 48)
    for budget in range(9, 16):
        stream = encode_with_estimate(CODEC, image, budget, region=RegionOfInterest(3, 3, 8, 9)).stream
        assert len(stream) <= budget
        assert CODEC.decode(stream).image.shape == image.shape


@given(seed=st.integers(0, 1000), short=st.integers(9, 60), more=st.integers(0, 60), with_region=st.booleans())
def test_extension_keeps_the_prefix_within_the_budget(seed: int, short: int, more: int, with_region: bool) -> None:
    image, region = contact(33, 48, seed), RegionOfInterest(3, 3, 8, 9) if with_region else None
    stream = encode_with_estimate(CODEC, image, short, region=region).stream
    longer = CODEC.extend(stream, image, len(stream) + more)
    assert longer.startswith(stream[:-1])
    assert len(stream) <= len(longer) <= len(stream) + more


def test_streams_that_cannot_be_extended_are_returned_or_rejected() -> None:
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


def test_next_step_is_on_the_better_side_of_the_best() -> None:
    """The steps form a circle: eight of them halve the threshold."""
    assert next_step({0: 10, 2: 5, 4: 8, 6: 9}) == 3
    assert next_step({0: 5, 2: 9, 4: 10, 6: 6}) == 7
    assert next_step({0: 5, 4: 9}) in (1, 7)
    assert next_step({0: 5, 1: 6, 7: 4, 4: 9}) == 6
    assert next_step({step: 10 - step for step in range(7)}) == 7
    assert next_step({step: abs(step - 3) for step in range(8)}) == 3


@pytest.mark.parametrize(("budget", "size", "tries"), [(40, (80, 80), 5), (200, (80, 80), 4), (200, (140, 80), 3)])
def test_best_tried_start_step_is_sent(budget, size, tries, monkeypatch):
    tried: list[tuple[int, int]] = []
    write = TrialEncoder.write

    def recording(self: TrialEncoder, targets: TargetCoefficients, side: SideInfo) -> EncodedTrial:
        trial = write(self, targets, side)
        tried.append((trial.error, side.start_step))
        return trial

    monkeypatch.setattr(TrialEncoder, "write", recording)
    image = contact(*size)
    stream = EmbCodec().encode(image, budget)
    assert len({step for _, step in tried}) == len(tried) == tries
    _, side = read_body(stream[StreamHeader.unpack(stream).size :], layout_of(*size), CODEC.network)
    assert side.start_step == min(tried)[1]
    assert stream == EmbCodec(start_steps=(min(tried)[1],)).encode(image, budget)
