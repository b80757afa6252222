"""Classifier for targets in images: fixed random filters, pooling, and a logistic regression.

Filters without training cannot adapt to the artefacts of a codec, and the regression is trained on original images
only. The classifier therefore measures how much of a target a codec preserves. (Random convolution features: Jarrett
et al., "What is the best multi-stage architecture for object recognition?", ICCV 2009; Saxe et al., "On random weights
and unsupervised feature learning", ICML 2011.) Everything is deterministic.

Streams of `emb` may describe the texture of the bottom (grain). The decoder can add a synthetic texture of that
strength to the image; the pixelser chooses its share.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.optimize import minimize

from research.common.images import SampleImage
from research.common.statistics import Flags, Values
from sonarpost.codec import emb
from sonarpost.codec.interface import Codec, Image
from sonarpost.errors import ConfigError, StreamError

Features = npt.NDArray[np.float64]

FILTERS: Final = 48
FILTER_PX: Final = 7
HALVINGS: Final = (1, 2)
"""Features come from half and quarter resolution, at which a target is larger than the speckle."""
RIDGE: Final = 0.1
FOLDS: Final = 7
MIN_SIDE_PX: Final = FILTER_PX * 2 ** max(HALVINGS) + 8
SIMULATED_WEIGHT: Final = 0.25
"""Weight of all simulated images relative to all real ones: their targets and sonar differ."""
_CONTRAST_FLOOR: Final = 10.0
DEFAULT_GRAIN_STRENGTH: Final = 0.5
"""Share of the strength that restores the power of the texture."""


def features(images: Sequence[Image]) -> Features:
    """Return the features of images, shape (images, 576), float64.

    Each image is scaled to zero mean and unit spread, reduced to half and quarter resolution by block means, and
    filtered. The positive and the negative part of each response give their mean, their maximum, and their mean over
    the central third.

    Args:
        images: Each of shape (at least 36, at least 36), uint8; sizes may differ.

    Raises:
        ConfigError: An image is smaller.
    """
    filters = _filter_bank()
    return np.stack([_image_features(image, filters) for image in images])


def _image_features(image: Image, filters: Features) -> Features:
    if min(image.shape) < MIN_SIDE_PX:
        raise ConfigError("recognition", "crop", image.shape, f"at least {MIN_SIDE_PX} px a side")
    pixels = image.astype(np.float64)
    pixels = (pixels - pixels.mean()) / (pixels.std() + _CONTRAST_FLOOR)
    found = []
    for halving in range(1, max(HALVINGS) + 1):
        rows, columns = pixels.shape[0] // 2, pixels.shape[1] // 2
        pixels = pixels[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2).mean(axis=(1, 3))
        if halving in HALVINGS:
            windows = np.lib.stride_tricks.sliding_window_view(pixels, (FILTER_PX, FILTER_PX))
            responses = windows.reshape(*windows.shape[:2], -1) @ filters
            found += [part for sign in (1.0, -1.0) for part in _pooled(np.maximum(sign * responses, 0.0))]
    return np.concatenate(found)


def _pooled(responses: Features) -> list[Features]:
    down, right = responses.shape[0] // 3, responses.shape[1] // 3
    middle = responses[down : responses.shape[0] - down, right : responses.shape[1] - right]
    return [responses.mean(axis=(0, 1)), responses.max(axis=(0, 1)), middle.mean(axis=(0, 1))]


def _filter_bank() -> Features:
    """Return the filters, shape (49, 48): smoothed Gaussian noise of zero mean and unit length."""
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

    def scores(self, samples: Features) -> Values:
        return np.asarray((samples - self.mean) / self.spread @ self.slopes + self.offset)


def _fit(samples: Features, is_target: Flags, weights: Values) -> _Regression:
    """Fit a ridge-penalised logistic regression; targets and non-targets have the same total weight."""
    mean, spread = samples.mean(axis=0), samples.std(axis=0) + 1e-6
    scaled = (samples - mean) / spread
    balanced = weights.copy()
    for flag in (True, False):
        balanced[is_target == flag] *= 0.5 / weights[is_target == flag].sum()
    signs = np.where(is_target, 1.0, -1.0)

    def loss(parameters: Values) -> tuple[float, Values]:
        margins = signs * (scaled @ parameters[:-1] + parameters[-1])
        value = balanced @ np.logaddexp(0.0, -margins) + 0.5 * RIDGE * parameters[:-1] @ parameters[:-1]
        slope = -balanced * signs / (1.0 + np.exp(np.clip(margins, -50.0, 50.0)))
        return float(value), np.append(scaled.T @ slope + RIDGE * parameters[:-1], slope.sum())

    found = minimize(loss, np.zeros(samples.shape[1] + 1), jac=True, method="L-BFGS-B", options={"maxiter": 300})
    return _Regression(mean, spread, found.x[:-1], float(found.x[-1]))


class TargetClassifier:
    """Classifier with cross-fitting: no survey line is classified by a regression trained on it.

    Survey lines are assigned to seven folds. The images of a fold are classified by a regression trained on original
    images of the other folds and on all simulated images.

    Args:
        training: Original images with `is_target` and `group`.
        simulated: Simulated training images; may be empty.
        groups: Survey lines to be classified.

    Raises:
        ConfigError: The training images of a fold contain no target, or only targets.
    """

    def __init__(
        self, training: Sequence[SampleImage], simulated: Sequence[SampleImage], groups: Sequence[str]
    ) -> None:
        self._fold_of = _assign_folds(groups, training)
        images = [*training, *simulated]
        samples = features([image.pixels for image in images])
        is_target = np.array([bool(image.is_target) for image in images])
        real = np.arange(len(images)) < len(training)
        folds = np.array([self._fold_of[image.group] for image in training] + [-1] * len(simulated))
        share = SIMULATED_WEIGHT * len(training) / max(len(simulated), 1)
        weights = np.where(real, 1.0, share)
        self._regressions = []
        for fold in range(FOLDS):
            kept = folds != fold
            if not (is_target & kept & real).any() or not (~is_target & kept & real).any():
                expected = "targets and others on at least two survey lines each"
                raise ConfigError("recognition", "training images", f"{kept.sum()} in fold {fold}", expected)
            self._regressions.append(_fit(samples[kept], is_target[kept], weights[kept]))

    def scores(self, images: Sequence[Image], groups: Sequence[str]) -> Values:
        """Return the log odds of a target, shape (images,).

        Args:
            images: As for `features`.
            groups: Survey line of each, among those of the constructor.
        """
        samples = features(images)
        folds = np.array([self._fold_of[group] for group in groups])
        result = np.empty(len(images))
        for fold, regression in enumerate(self._regressions):
            result[folds == fold] = regression.scores(samples[folds == fold])
        return result


def _assign_folds(groups: Sequence[str], training: Sequence[SampleImage]) -> dict[str, int]:
    """Assign survey lines to folds, lines with and without targets separately, so that each fold has both."""
    with_targets = {image.group for image in training if image.is_target}
    names = sorted(set(groups) | {image.group for image in training})
    folds: dict[str, int] = {}
    for kind in (True, False):
        for number, name in enumerate(n for n in names if (n in with_targets) == kind):
            folds[name] = number % FOLDS
    return folds


def with_grain(codec: Codec, stream: bytes, image: Image, strength: float = DEFAULT_GRAIN_STRENGTH) -> Image | None:
    """Return a decoded image with synthetic texture; None if codec or stream do not support it.

    Args:
        codec: Decoder of the stream.
        stream: Header and body.
        image: The decoded image, shape (height, width), uint8.
        strength: Share of the texture that is added, 0..2.
    """
    # Imported lazily: it loads numba.
    from research.recognition.grain import GrainCodec  # noqa: PLC0415

    if not isinstance(codec, GrainCodec):
        return None
    try:
        layer = codec.speckle_layer(stream)
    except StreamError:
        return None
    added = np.floor(layer * strength).astype(np.int32)
    return np.asarray(np.clip(image + added, 0, 255), dtype=np.uint8)


def codec_with_grain(codec: Codec) -> Codec | None:
    """Return the codec with a description of the texture in its streams, within the same budget; None if not emb."""
    if codec.name != emb.NAME:
        return None
    from research.recognition.grain import GrainCodec  # noqa: PLC0415  imported lazily: it loads numba
    from sonarpost.codec.emb.codec import EmbCodec  # noqa: PLC0415

    return GrainCodec(codec.model, codec.strength) if isinstance(codec, EmbCodec) else None
