"""Classifier of candidates: a compact convolutional network that runs on numpy.

Two branches of 3 x 3 convolutions with ReLU and 2 x 2 maximum pooling process the fine and the coarse plane of a chip.
Their outputs and the geometry values enter two fully connected layers with three outputs: seabed, other object,
mine-like. The outputs of a chip and of its mirror image are averaged. Slope and offsets fitted to simulated surveys
turn them into probabilities (`research/training/detection/calibrate.py`).

The weights are float32 arrays in an npz file. Their identity is the first 16 hexadecimal digits of the SHA-256 of
names, shapes and values, so that a copy of the file with other compression has the same identity.
"""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.resources import files
from pathlib import Path
from typing import IO, Final

import numpy as np
import numpy.typing as npt

from sonarpost.detection.chips import COARSE_PLANES, FINE_PLANES, GEOMETRY_VALUES, ChipBatch
from sonarpost.errors import ConfigError

Array = npt.NDArray[np.float32]

SEABED, OTHER_OBJECT, MINE_LIKE_OBJECT = 0, 1, 2
"""Indices of the classes."""
CLASSES: Final = 3
FINE_CHANNELS: Final = (12, 24, 32, 24)
"""Outputs of the convolutions of the fine branch; pooling after each but the last."""
COARSE_CHANNELS: Final = (12, 24, 32)
"""Outputs of the convolutions of the coarse branch; pooling after each."""
HIDDEN: Final = 64
_FINE_OUTPUT: Final = 5 * 7 * FINE_CHANNELS[-1]
_COARSE_OUTPUT: Final = 3 * 5 * COARSE_CHANNELS[-1]
_MAX_WEIGHT: Final = 1e4
_MAX_FILE_BYTES: Final = 1 << 24
_BATCH: Final = 48


def weight_shapes() -> dict[str, tuple[int, ...]]:
    """Return the shape of each array of a network, in order: convolutions are (3, 3, inputs, outputs)."""
    shapes: dict[str, tuple[int, ...]] = {}
    for branch, planes, channels in (("fine", FINE_PLANES, FINE_CHANNELS), ("coarse", COARSE_PLANES, COARSE_CHANNELS)):
        for number, (inputs, outputs) in enumerate(zip((planes, *channels[:-1]), channels, strict=True)):
            shapes[f"{branch}{number}"] = (3, 3, inputs, outputs)
            shapes[f"{branch}{number}_bias"] = (outputs,)
    shapes["hidden"] = (_FINE_OUTPUT + _COARSE_OUTPUT + GEOMETRY_VALUES, HIDDEN)
    shapes["hidden_bias"] = (HIDDEN,)
    shapes["output"] = (HIDDEN, CLASSES)
    shapes["output_bias"] = (CLASSES,)
    shapes["calibration"] = (CLASSES + 1,)
    return shapes


@dataclass(frozen=True)
class Classifier:
    """A network with its calibration.

    Attributes:
        weights: Arrays by name, as in `weight_shapes`. `calibration` holds the slope and an offset for each class.

    Raises:
        ValueError: An array is missing, unknown, of another shape, not finite or beyond 10,000 in magnitude.
    """

    weights: Mapping[str, Array]

    def __post_init__(self) -> None:
        shapes = weight_shapes()
        if set(self.weights) != set(shapes):
            raise ValueError(f"arrays: got {sorted(self.weights)}, expected {sorted(shapes)}")
        for name, shape in shapes.items():
            array = self.weights[name]
            if array.shape != shape:
                raise ValueError(f"{name}: got shape {array.shape}, expected {shape}")
            if array.dtype != np.float32:
                raise ValueError(f"{name}: got {array.dtype}, expected float32")
            if not np.isfinite(array).all() or np.abs(array).max() > _MAX_WEIGHT:
                raise ValueError(f"{name}: got a value that is not finite or too large, expected up to {_MAX_WEIGHT:g}")

    @property
    def identity(self) -> str:
        """First 16 hexadecimal digits of the SHA-256 of names, shapes and values."""
        digest = hashlib.sha256()
        for name in weight_shapes():
            array = self.weights[name]
            digest.update(f"{name}{array.shape}".encode() + array.astype("<f4").tobytes())
        return digest.hexdigest()[:16]

    def outputs(self, chips: ChipBatch) -> Array:
        """Return the outputs before calibration, mean of each chip and its mirror image, shape (chips, 3)."""
        return np.asarray((self._network(chips) + self._network(chips.mirrored())) * np.float32(0.5))

    def probabilities(self, chips: ChipBatch) -> Array:
        """Return the probability of each class, shape (chips, 3); each row has the sum 1."""
        return self.calibrated(self.outputs(chips))

    def calibrated(self, outputs: Array) -> Array:
        """Return the probabilities that correspond to outputs of the network, same shape."""
        slope, offsets = self.weights["calibration"][0], self.weights["calibration"][1:]
        odds = outputs * slope + offsets
        odds = np.exp(odds - odds.max(axis=1, keepdims=True))
        return np.asarray(odds / odds.sum(axis=1, keepdims=True))

    def _network(self, chips: ChipBatch) -> Array:
        parts = [self._forward(chips, start) for start in range(0, len(chips), _BATCH)]
        return np.concatenate(parts) if parts else np.zeros((0, CLASSES), dtype=np.float32)

    def _forward(self, chips: ChipBatch, start: int) -> Array:
        w, part = self.weights, slice(start, start + _BATCH)
        fine = chips.fine[part]
        for number in range(len(FINE_CHANNELS)):
            fine = _convolution(fine, w[f"fine{number}"], w[f"fine{number}_bias"])
            fine = _pooled(fine) if number < len(FINE_CHANNELS) - 1 else fine
        coarse = chips.coarse[part]
        for number in range(len(COARSE_CHANNELS)):
            coarse = _pooled(_convolution(coarse, w[f"coarse{number}"], w[f"coarse{number}_bias"]))
        inputs = (fine.reshape(len(fine), -1), coarse.reshape(len(coarse), -1), chips.geometry[part])
        hidden = np.maximum(np.concatenate(inputs, axis=1) @ w["hidden"] + w["hidden_bias"], np.float32(0.0))
        return np.asarray(hidden @ w["output"] + w["output_bias"])


def _convolution(planes: Array, weights: Array, bias: Array) -> Array:
    """Return a 3 x 3 convolution with zero padding, bias and ReLU of planes of shape (chips, rows, columns, inputs)."""
    count, rows, columns, inputs = planes.shape
    padded = np.zeros((count, rows + 2, columns + 2, inputs), dtype=np.float32)
    padded[:, 1:-1, 1:-1] = planes
    patches = np.empty((count, rows, columns, 9 * inputs), dtype=np.float32)
    for k in range(9):
        row, column = divmod(k, 3)
        patches[..., k * inputs : (k + 1) * inputs] = padded[:, row : row + rows, column : column + columns]
    out = patches.reshape(-1, 9 * inputs) @ weights.reshape(9 * inputs, -1)
    out += bias
    np.maximum(out, np.float32(0.0), out=out)
    return out.reshape(count, rows, columns, -1)


def _pooled(planes: Array) -> Array:
    """Return the maximum of each 2 x 2 block; an odd last row or column is left out."""
    rows, columns = planes.shape[1] // 2 * 2, planes.shape[2] // 2 * 2
    even = np.maximum(planes[:, 0:rows:2, :columns], planes[:, 1:rows:2, :columns])
    return np.asarray(np.maximum(even[:, :, 0::2], even[:, :, 1::2]))


@cache
def default_classifier() -> Classifier:
    """Return the classifier of `classifier.npz`."""
    with files("sonarpost.detection").joinpath("classifier.npz").open("rb") as file:
        return _parsed(file, "classifier.npz")


@lru_cache(maxsize=4)
def load_classifier_once(path: Path, identity: str | None = None) -> Classifier:
    """Return `load_classifier` of these arguments; a process reads a file once."""
    return load_classifier(path, identity)


def load_classifier(path: Path, identity: str | None = None) -> Classifier:
    """Read a classifier from an npz file.

    Args:
        path: The file.
        identity: Identity that it must have; None for any.

    Raises:
        ConfigError: The file cannot be read, is too large, has another identity, or does not hold valid weights.
    """
    try:
        size = path.stat().st_size
        if size > _MAX_FILE_BYTES:
            raise ConfigError(str(path), "size", f"{size} bytes", f"at most {_MAX_FILE_BYTES}")
        with path.open("rb") as file:
            classifier = _parsed(file, str(path))
    except OSError as error:
        raise ConfigError(str(path), "file", str(error.strerror or error), "a readable file") from error
    if identity is not None and classifier.identity != identity:
        raise ConfigError(str(path), "identity", classifier.identity, identity)
    return classifier


def _parsed(file: IO[bytes], where: str) -> Classifier:
    expected = "an npz file with the weights of a classifier"
    try:
        with zipfile.ZipFile(file) as archive:
            unpacked = sum(item.file_size for item in archive.infolist())
            if unpacked > _MAX_FILE_BYTES:
                raise ConfigError(where, "size", f"{unpacked} bytes unpacked", f"at most {_MAX_FILE_BYTES}")
        file.seek(0)
        with np.load(file, allow_pickle=False) as table:
            return Classifier({name: np.asarray(table[name]) for name in table.files})
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile, NotImplementedError) as error:
        raise ConfigError(where, "weights", str(error), expected) from error
