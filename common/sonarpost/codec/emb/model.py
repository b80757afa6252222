"""The trained models of `emb`: integer weights of the networks, reconstruction points and tables.

A model file is a magic word for its format, then the arrays of that format in order, little-endian (`FORMATS`). Its
SHA-256 is the identity of the model. `training/emb` makes model files.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from sonarpost.codec.emb import DEFAULT_MODEL, MODEL_FILES, contexts
from sonarpost.codec.emb import kernel as k
from sonarpost.codec.emb.kernel import I32
from sonarpost.errors import ConfigError, StreamError

Arrays = tuple[tuple[str, tuple[int, ...], str], ...]

IMAGE_FEATURES: Final = 3
CHANNELS: Final = 24
DILATIONS: Final = (1, 2, 3, 1)
SCALE_LEVELS: Final = 7
"""Perceptual scales of the lowest band and of levels 1 to 6."""
CONTRASTS: Final = 128
"""Entries of the table of perceptual scales by contrast, in eighths of octaves."""


_LAYER_SIDES: Final = (4, *(CHANNELS,) * (len(DILATIONS) - 1), 4)
"""Channels between the layers of the enhancer."""
_NETWORK_ARRAYS: Final[Arrays] = (
    ("w1", (2, contexts.FEATURES, k.HIDDEN_1), "<i2"),
    ("b1", (2, k.HIDDEN_1), "<i4"),
    ("w2", (2, k.HIDDEN_1, k.HIDDEN_2), "<i2"),
    ("b2", (2, k.HIDDEN_2), "<i4"),
    ("w3", (2, k.HIDDEN_2), "<i2"),
    ("b3", (2,), "<i4"),
    ("sign_w1", (4, contexts.SIGN_FEATURES, k.SIGN_HIDDEN), "<i2"),
    ("sign_b1", (4, k.SIGN_HIDDEN), "<i4"),
    ("sign_w2", (4, k.SIGN_HIDDEN), "<i2"),
    ("probabilities", (2 * k.LOGIT_LIMIT + 1,), "<u2"),
    ("costs", (2 * k.LOGIT_LIMIT + 1,), "<u2"),
    ("centres", (4, k.CENTRE_COLUMNS), "<i2"),
    ("mean_tree", (64,), "<u2"),
    ("image_weights", (IMAGE_FEATURES, CHANNELS), "<i4"),
    *(
        (f"{kind}{i}", shape, number)
        for i, (inputs, outputs) in enumerate(pairwise(_LAYER_SIDES))
        for kind, shape, number in (("taps", (9, inputs, outputs), "<i2"), ("bias", (outputs,), "<i4"))
    ),
)


class ModelFormat(NamedTuple):
    """Format of a model file: its first bytes; name, shape and type of each array, in order."""

    magic: bytes
    arrays: Arrays


_PERCEPTUAL_ARRAYS: Final[Arrays] = (
    ("perceptual_levels", (SCALE_LEVELS,), "<i2"),
    ("perceptual_contrast", (CONTRASTS,), "<i2"),
)
FORMAT_2: Final = ModelFormat(b"SPEMB2\n", _NETWORK_ARRAYS)
FORMAT_3: Final = ModelFormat(b"SPEMB3\n", FORMAT_2.arrays + _PERCEPTUAL_ARRAYS)
FORMATS: Final = (FORMAT_2, FORMAT_3)


@dataclass(frozen=True, eq=False)
class PerceptualWeights:
    """Scales that a perceptual model applies to coefficients before coding, in 1/256; see `perceptual_weights`.

    Attributes:
        levels: Shape (SCALE_LEVELS,), int32: scale of the lowest band, then of the bands of levels 1 to 6.
        contrast: Shape (CONTRASTS,), int32: scale by 8 log2 of the local variance in grey squared and VARIANCE_OFFSET.
    """

    levels: I32
    contrast: I32


@dataclass(frozen=True, eq=False)
class Model:
    """Integer weights and tables, all int32; see `kernel.code_band`.

    Attributes:
        identity: Hex SHA-256 of the file.
        centres: Reconstruction points in 1/256 of the interval, by lower bound / width (1..4) and the logit of the last
            decision.
        mean_tree: Probability of 1 at each node of the binary tree of the mean level.
        image_weights: Shape (IMAGE_FEATURES, CHANNELS): the enhancer's weights of the features of the whole image.
        layers: Taps (9, in, out) and bias (out,) of the enhancer's layers.
        perceptual: Scales of the coefficients; None for a model trained for the least squared error.
        sends_strength: Whether the side information has the strength of despeckling.
    """

    identity: str
    w1: I32
    b1: I32
    w2: I32
    b2: I32
    w3: I32
    b3: I32
    sign_w1: I32
    sign_b1: I32
    sign_w2: I32
    probabilities: I32
    costs: I32
    centres: I32
    mean_tree: I32
    image_weights: I32
    layers: tuple[tuple[I32, I32], ...]
    perceptual: PerceptualWeights | None = None
    sends_strength: bool = False


def read_arrays(raw: bytes, where: str = "emb model") -> dict[str, I32]:
    """Read the arrays of a model file.

    Raises:
        StreamError: It is not a model file, or its length is wrong.
    """
    for model_format in FORMATS:
        if raw.startswith(model_format.magic):
            break
    else:
        expected = " or ".join(repr(one.magic) for one in FORMATS)
        raise StreamError(where, "magic", raw[: len(FORMAT_2.magic)], expected)
    position = len(model_format.magic)
    sizes = [int(np.prod(shape)) * np.dtype(kind).itemsize for _, shape, kind in model_format.arrays]
    if len(raw) != position + sum(sizes):
        raise StreamError(where, "length", len(raw), f"{position + sum(sizes)} bytes")
    arrays = {}
    for (name, shape, kind), size in zip(model_format.arrays, sizes, strict=True):
        arrays[name] = np.frombuffer(raw[position : position + size], kind).reshape(shape).astype(np.int32)
        position += size
    return arrays


def model_of(arrays: dict[str, I32], identity: str = "") -> Model:
    """Build a model from the arrays of any format."""
    layers = tuple((arrays[f"taps{i}"], arrays[f"bias{i}"]) for i in range(len(DILATIONS)))
    perceptual = None
    if "perceptual_levels" in arrays:
        perceptual = PerceptualWeights(arrays["perceptual_levels"], arrays["perceptual_contrast"])
    own = {name: array for name, array in arrays.items() if not name.startswith(("taps", "bias", "perceptual_"))}
    return Model(identity=identity, layers=layers, perceptual=perceptual, sends_strength=False, **own)


def parse(raw: bytes, where: str = "emb model") -> Model:
    """Read a model file.

    Raises:
        StreamError: It is not a model file, or its length is wrong.
    """
    return model_of(read_arrays(raw, where), hashlib.sha256(raw).hexdigest())


@cache
def shipped_model(name: str = DEFAULT_MODEL, *, despeckled: bool = False) -> Model:
    """Return the shipped model of a name.

    Args:
        name: A name in `MODEL_FILES`.
        despeckled: Whether its streams have the strength of despeckling.

    Raises:
        ConfigError: No model has this name.
    """
    if name not in MODEL_FILES:
        raise ConfigError("codec emb", "model", name, " or ".join(MODEL_FILES))
    file = MODEL_FILES[name]
    raw = files("sonarpost.codec.emb").joinpath("data", file).read_bytes()
    return replace(parse(raw, file), sends_strength=despeckled)
