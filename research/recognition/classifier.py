"""A judge of pictures: does this one show a target? Fixed random filters, pooled, and a logistic regression.

Filters that nobody trained cannot fit the marks one codec leaves, and the few numbers that are trained are trained on
original pictures only, so the judge measures what of the target a codec leaves to be seen. (Random convolution
features: Jarrett et al., "What is the best multi-stage architecture for object recognition?", ICCV 2009; Saxe et al.,
"On random weights and unsupervised feature learning", ICML 2011.) Everything is deterministic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.optimize import minimize

from research.common.images import BenchPicture
from research.common.statistics import Flags, Values
from sonarpost.codec.interface import Image
from sonarpost.errors import ConfigError

Features = npt.NDArray[np.float64]

FILTERS: Final = 48
FILTER_PX: Final = 7
HALVINGS: Final = (1, 2)
"""The picture is looked at in half and in quarter size: where a target of a snippet is larger than the speckle."""
RIDGE: Final = 0.1
FOLDS: Final = 7
LEAST_SIDE_PX: Final = FILTER_PX * 2 ** max(HALVINGS) + 8
SIMULATED_WEIGHT: Final = 0.25
"""Weight of all simulated pictures together against all real ones: other targets, other sonar."""
_CONTRAST_FLOOR: Final = 10.0


def features(pictures: Sequence[Image]) -> Features:
    """Return what the judge looks at, shape (pictures, 576), float64.

    Each picture is set to zero mean and unit spread, halved once and twice by block means, and filtered; the positive
    and the negative part of each filter's answer give their mean, their largest value, and their mean over the middle
    third.

    Args:
        pictures: Each of shape (at least 36, at least 36), uint8; they may differ in size.

    Raises:
        ConfigError: A picture is smaller than that.
    """
    bank = _bank()
    return np.stack([_features_of(picture, bank) for picture in pictures])


def _features_of(picture: Image, bank: Features) -> Features:
    if min(picture.shape) < LEAST_SIDE_PX:
        raise ConfigError("recognition bench", "crop", picture.shape, f"at least {LEAST_SIDE_PX} px a side")
    view = picture.astype(np.float64)
    view = (view - view.mean()) / (view.std() + _CONTRAST_FLOOR)
    found = []
    for halving in range(1, max(HALVINGS) + 1):
        rows, columns = view.shape[0] // 2, view.shape[1] // 2
        view = view[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2).mean(axis=(1, 3))
        if halving in HALVINGS:
            windows = np.lib.stride_tricks.sliding_window_view(view, (FILTER_PX, FILTER_PX))
            answers = windows.reshape(*windows.shape[:2], -1) @ bank
            found += [part for sign in (1.0, -1.0) for part in _pooled(np.maximum(sign * answers, 0.0))]
    return np.concatenate(found)


def _pooled(answers: Features) -> list[Features]:
    down, right = answers.shape[0] // 3, answers.shape[1] // 3
    middle = answers[down : answers.shape[0] - down, right : answers.shape[1] - right]
    return [answers.mean(axis=(0, 1)), answers.max(axis=(0, 1)), middle.mean(axis=(0, 1))]


def _bank() -> Features:
    """Return the filters, shape (49, 48): smoothed Gaussian noise without mean, of unit length."""
    noise = np.random.default_rng(1).standard_normal((FILTERS, FILTER_PX, FILTER_PX))
    smooth = np.stack([np.asarray(ndimage.gaussian_filter(each, 1.0)) for each in noise]).reshape(FILTERS, -1)
    smooth -= smooth.mean(axis=1, keepdims=True)
    return np.asarray((smooth / np.linalg.norm(smooth, axis=1, keepdims=True)).T)


@dataclass(frozen=True)
class _Regression:
    mean: Values
    spread: Values
    slopes: Values
    offset: float

    def scores(self, seen: Features) -> Values:
        return np.asarray((seen - self.mean) / self.spread @ self.slopes + self.offset)


def _fit(seen: Features, is_target: Flags, weights: Values) -> _Regression:
    """Fit a ridge-penalised logistic regression; targets and others weigh the same in all."""
    mean, spread = seen.mean(axis=0), seen.std(axis=0) + 1e-6
    scaled = (seen - mean) / spread
    balanced = weights.copy()
    for flag in (True, False):
        balanced[is_target == flag] *= 0.5 / weights[is_target == flag].sum()
    signs = np.where(is_target, 1.0, -1.0)

    def loss(parameters: Values) -> tuple[float, Values]:
        margins = signs * (scaled @ parameters[:-1] + parameters[-1])
        value = balanced @ np.logaddexp(0.0, -margins) + 0.5 * RIDGE * parameters[:-1] @ parameters[:-1]
        slope = -balanced * signs / (1.0 + np.exp(np.clip(margins, -50.0, 50.0)))
        return float(value), np.append(scaled.T @ slope + RIDGE * parameters[:-1], slope.sum())

    found = minimize(loss, np.zeros(seen.shape[1] + 1), jac=True, method="L-BFGS-B", options={"maxiter": 300})
    return _Regression(mean, spread, found.x[:-1], float(found.x[-1]))


class Judge:
    """Judges trained so that none has seen the survey line it judges (cross-fitting).

    Survey lines are dealt to seven folds; the pictures of a fold are judged by a regression trained on original
    pictures of the other folds' lines, and on all simulated ones.

    Args:
        training: Original pictures with `is_target` and `group` known.
        simulated: Simulated pictures to train on as well; may be empty.
        groups: Every survey line that will be judged or trained on.

    Raises:
        ConfigError: A fold leaves no target or nothing else to train on.
    """

    def __init__(
        self, training: Sequence[BenchPicture], simulated: Sequence[BenchPicture], groups: Sequence[str]
    ) -> None:
        self._fold_of = _deal(groups, training)
        pictures = [*training, *simulated]
        seen = features([picture.pixels for picture in pictures])
        is_target = np.array([bool(picture.is_target) for picture in pictures])
        real = np.arange(len(pictures)) < len(training)
        folds = np.array([self._fold_of[p.group] for p in training] + [-1] * len(simulated))
        share = SIMULATED_WEIGHT * len(training) / max(len(simulated), 1)
        weights = np.where(real, 1.0, share)
        self._regressions = []
        for fold in range(FOLDS):
            kept = folds != fold
            if not (is_target & kept & real).any() or not (~is_target & kept & real).any():
                expected = "targets and others on at least two survey lines each"
                raise ConfigError("recognition bench", "training pictures", f"{kept.sum()} in fold {fold}", expected)
            self._regressions.append(_fit(seen[kept], is_target[kept], weights[kept]))

    def scores(self, pictures: Sequence[Image], groups: Sequence[str]) -> Values:
        """Return how sure the judge is of a target, shape (pictures,), log odds.

        Args:
            pictures: As for `features`.
            groups: Survey line of each, among those given to the constructor.
        """
        seen = features(pictures)
        folds = np.array([self._fold_of[group] for group in groups])
        result = np.empty(len(pictures))
        for fold, regression in enumerate(self._regressions):
            result[folds == fold] = regression.scores(seen[folds == fold])
        return result


def _deal(groups: Sequence[str], training: Sequence[BenchPicture]) -> dict[str, int]:
    """Deal survey lines to folds, lines with targets and lines without by themselves, so each fold has both."""
    with_targets = {picture.group for picture in training if picture.is_target}
    names = sorted(set(groups) | {picture.group for picture in training})
    dealt: dict[str, int] = {}
    for kind in (True, False):
        for number, name in enumerate(n for n in names if (n in with_targets) == kind):
            dealt[name] = number % FOLDS
    return dealt
