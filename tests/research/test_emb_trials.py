"""The core functions of the trials of changes to `emb`."""

import numpy as np
import numpy.typing as npt
import pytest

from research.training.emb.trials import contact_contexts, learned_lifting, tile_predictors
from research.training.emb.trials.contact_contexts import BUDGETS, EXTRAS, Contact
from sonarpost.codec.emb import contexts, transform
from sonarpost.codec.emb.model import shipped_model
from sonarpost.codec.emb.transform import layout_of


def scene(seed: int = 1) -> npt.NDArray[np.uint8]:
    """Return speckle with a highlight and a shadow, 80 x 80 px."""
    image = np.random.default_rng(seed).gamma(4.0, 20.0, (80, 80))
    image[35:42, 36:42] *= 3
    image[35:42, 42:60] *= 0.1
    return np.clip(image, 0, 255).astype(np.uint8)


def bits_of_decisions(rows: npt.NDArray[np.int16]) -> float:
    """Return the code length of listed decisions by the shipped networks, without learning."""
    model, total = shipped_model(), 0.0
    for net in range(2):
        own = rows[rows[:, -1] == net]
        x = own[:, : contexts.FEATURES].astype(np.int64)
        first = np.clip((x @ model.w1[net] + model.b1[net]) >> 6, 0, 4095)
        second = np.clip((first @ model.w2[net].astype(np.int64) + model.b2[net]) >> 12, 0, 4095)
        logit = (second @ model.w3[net] / 4096 + model.b3[net] / 4096) / 256
        total += float(np.logaddexp(0, logit * (1 - 2 * own[:, -2])).sum()) / np.log(2)
    return total


@pytest.mark.parametrize("budget", BUDGETS)
def test_listed_decisions_are_those_of_the_stream(budget: int) -> None:
    contact = Contact(scene(), side=-1, has_object=True)
    rows, signs = contact_contexts.decisions_of(contact, budget, np.random.default_rng(0))
    assert rows.shape[1] == contexts.FEATURES + EXTRAS + 2
    assert signs.shape[1] == contexts.SIGN_FEATURES + EXTRAS + 2
    became_significant = (rows[:, -1] == 0) & (rows[:, -2] == 1)
    assert len(signs) == became_significant.sum()
    # A sign costs about a bit; the networks of the stream learn, and speckle alone is not what they know.
    assert bits_of_decisions(rows) + 0.95 * len(signs) == pytest.approx(8 * budget, rel=0.15)


@pytest.mark.parametrize("shape", [(80, 80), (33, 17)])
def test_learned_steps_are_inverted(shape: tuple[int, int]) -> None:
    rng, layout = np.random.default_rng(0), layout_of(*shape)
    image = rng.integers(-100, 100, shape) * transform.UNIT
    taps = {(level, orient): rng.normal(0, 0.02, 36) for level in range(1, 5) for orient in range(1, 4)}
    plain = transform.forward(image, layout)
    with learned_lifting.learned_steps(taps):
        own = transform.forward(image, layout)
        decoded, _ = transform.inverse(own, layout)
    assert np.abs(own - plain).max() > transform.UNIT
    assert np.abs(decoded - image).max() < transform.UNIT / 2
    assert np.array_equal(transform.forward(image, layout), plain)


def test_best_corrections_remove_the_stated_error() -> None:
    rng = np.random.default_rng(4)
    units = rng.normal(size=(300, 100)).astype(np.float32)
    units /= np.linalg.norm(units, axis=1, keepdims=True)
    original = tile_predictors.to_blocks(scene(), 10)
    assert np.array_equal(tile_predictors.from_blocks(original, (80, 80), 10), scene())
    residual = original - original.mean(1, keepdims=True)
    correction, gain = tile_predictors.best_corrections(residual, units)
    removed = (residual**2).sum(1) - ((residual - correction) ** 2).sum(1)
    assert removed == pytest.approx(gain, rel=1e-3)
    _, of_nearest = tile_predictors.best_corrections(residual, units, original)
    assert (of_nearest <= gain).all()
    assert (of_nearest >= 0).all()
    changed = tile_predictors.corrected(np.zeros_like(residual), correction, gain, 3)
    assert (changed.any(1)).sum() == 3
    assert tile_predictors.bytes_of(4, 64, 16384) == 11
