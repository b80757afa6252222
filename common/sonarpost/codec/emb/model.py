"""The trained model: integer weights of the networks, reconstruction points and tables.

A model file is a magic word, which says which form it has, and then the form's arrays of fixed shapes and types,
little-endian, one after the other (`FORMS`). Its sha256 is the model's identity. `training/emb` makes it. Models of
earlier releases stay in the package, so that their streams decode for ever: what their networks do not have is zero.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb import kernel as k
from sonarpost.codec.emb.perceptual_weights import CONTRASTS, LEVELS, PerceptualWeights
from sonarpost.errors import StreamError

I32 = npt.NDArray[np.int32]
Arrays = tuple[tuple[str, tuple[int, ...], str], ...]

GLOBALS: Final = 3
CHANNELS: Final = 24
DILATIONS: Final = (1, 2, 3, 1)
SHIPPED: Final = ("emb-2.model", "emb.model")
"""Model files of `emb`; the first is the one that encodes."""
STRUCTURE: Final = ("emb-structure.model",)
"""Those of `emb-structure`."""


def _arrays(features: int, sign_features: int, sign_hidden: int, channels: int, layers: int) -> Arrays:
    """Name, shape and type in the file, in order."""
    sides = [4, *[channels] * (layers - 1), 4]
    return (
        ("w1", (2, features, k.HIDDEN_1), "<i2"),
        ("b1", (2, k.HIDDEN_1), "<i4"),
        ("w2", (2, k.HIDDEN_1, k.HIDDEN_2), "<i2"),
        ("b2", (2, k.HIDDEN_2), "<i4"),
        ("w3", (2, k.HIDDEN_2), "<i2"),
        ("b3", (2,), "<i4"),
        ("sign_w1", (4, sign_features, sign_hidden), "<i2"),
        ("sign_b1", (4, sign_hidden), "<i4"),
        ("sign_w2", (4, sign_hidden), "<i2"),
        ("chances", (2 * k.LOGIT_LIMIT + 1,), "<u2"),
        ("costs", (2 * k.LOGIT_LIMIT + 1,), "<u2"),
        ("centres", (4, k.CENTRE_COLUMNS), "<i2"),
        ("mean_tree", (64,), "<u2"),
        ("situation", (GLOBALS, channels), "<i4"),
        *(
            (f"{kind}{i}", shape, number)
            for i, (inputs, outputs) in enumerate(pairwise(sides))
            for kind, shape, number in (("taps", (9, inputs, outputs), "<i2"), ("bias", (outputs,), "<i4"))
        ),
    )


@dataclass(frozen=True)
class ModelFormat:
    """What a model file holds.

    Attributes:
        magic: How it begins.
        arrays: Name, shape and type of each array, in order.
        dilations: Of the enhancer's layers; see `enhance`.
    """

    magic: bytes
    arrays: Arrays
    dilations: tuple[int, ...]


_AIM_ARRAYS: Final[Arrays] = (("aim_levels", (LEVELS,), "<i2"), ("aim_contrast", (CONTRASTS,), "<i2"))
FIRST: Final = ModelFormat(b"SPEMB1\n", _arrays(50, 11, 8, channels=24, layers=4), (1, 2, 3, 1))
SECOND: Final = ModelFormat(
    b"SPEMB2\n",
    _arrays(k.FEATURES, k.SIGN_FEATURES, k.SIGN_HIDDEN, channels=CHANNELS, layers=len(DILATIONS)),
    DILATIONS,
)
AIMED: Final = ModelFormat(b"SPEMB3\n", SECOND.arrays + _AIM_ARRAYS, DILATIONS)
FORMS: Final = (FIRST, SECOND, AIMED)
_FIRST_LOCAL: Final = 40
"""Features of one coefficient in the first form; those of its band came after them."""


@dataclass(frozen=True, eq=False)
class Model:
    """Integer weights and tables, all int32; see `kernel.code_band` for what each is.

    Attributes:
        identity: Hex sha256 of the file.
        centres: Where in its interval a coefficient lies on the mean, in 1/256; by lower bound / width (1..4) and the
            logit of its last decision.
        mean_tree: Probability of 1 of each decision of the mean level, by node of the binary tree.
        situation: Shape (GLOBALS, CHANNELS): the enhancer's weights of the whole picture's features.
        layers: Taps (9, in, out) and bias (out,) of the enhancer's layers.
        dilations: Distance of the taps of each layer.
        aim: How it scales coefficients; None: it aims at the least squared error.
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
    chances: I32
    costs: I32
    centres: I32
    mean_tree: I32
    situation: I32
    layers: tuple[tuple[I32, I32], ...]
    dilations: tuple[int, ...]
    aim: PerceptualWeights | None = None


def form_of(raw: bytes, where: str = "emb model") -> ModelFormat:
    """Return what a model file holds.

    Raises:
        StreamError: It is not one.
    """
    for form in FORMS:
        if raw.startswith(form.magic):
            return form
    raise StreamError(where, "magic", raw[: len(SECOND.magic)], " or ".join(repr(form.magic) for form in FORMS))


def read_arrays(raw: bytes, where: str = "emb model") -> dict[str, I32]:
    """Read the arrays of a model file.

    Raises:
        StreamError: It is not one, or its length is wrong.
    """
    form = form_of(raw, where)
    expected = len(form.magic) + sum(int(np.prod(shape)) * np.dtype(kind).itemsize for _, shape, kind in form.arrays)
    if len(raw) != expected:
        raise StreamError(where, "length", len(raw), f"{expected} bytes")
    arrays, at = {}, len(form.magic)
    for name, shape, kind in form.arrays:
        count = int(np.prod(shape))
        arrays[name] = np.frombuffer(raw, kind, count, at).reshape(shape).astype(np.int32)
        at += count * np.dtype(kind).itemsize
    return arrays


def model_of(arrays: dict[str, I32], identity: str = "", dilations: tuple[int, ...] = DILATIONS) -> Model:
    """Make a model of its arrays, of any form."""
    plain = {name: array for name, array in arrays.items() if name[:4] not in ("taps", "bias", "aim_")}
    plain["w1"] = _with_rows(plain["w1"], _FIRST_LOCAL, k.FEATURES)
    plain["sign_w1"] = _with_rows(plain["sign_w1"], plain["sign_w1"].shape[1], k.SIGN_FEATURES)
    for name in ("sign_w1", "sign_b1", "sign_w2"):
        missing = k.SIGN_HIDDEN - plain[name].shape[-1]
        plain[name] = np.pad(plain[name], [(0, 0)] * (plain[name].ndim - 1) + [(0, missing)])
    layers = tuple((arrays[f"taps{i}"], arrays[f"bias{i}"]) for i in range(len(dilations)))
    aim = PerceptualWeights(arrays["aim_levels"], arrays["aim_contrast"]) if "aim_levels" in arrays else None
    return Model(identity=identity, layers=layers, dilations=dilations, aim=aim, **plain)


def _with_rows(weights: I32, at: int, rows: int) -> I32:
    """Insert weights of zero for features that the network does not have; its second axis is made `rows` long."""
    missing = np.zeros((weights.shape[0], rows - weights.shape[1], weights.shape[2]), np.int32)
    return np.concatenate([weights[:, :at], missing, weights[:, at:]], axis=1)


def parse(raw: bytes, where: str = "emb model") -> Model:
    """Read a model file.

    Raises:
        StreamError: It is not one, or its length is wrong.
    """
    dilations = form_of(raw, where).dilations
    return model_of(read_arrays(raw, where), hashlib.sha256(raw).hexdigest(), dilations)


def _read(names: tuple[str, ...]) -> tuple[Model, ...]:
    data = files("sonarpost.codec.emb").joinpath("data")
    return tuple(parse(data.joinpath(name).read_bytes(), name) for name in names)


@cache
def all_shipped() -> tuple[Model, ...]:
    """Return the models of `emb` that come with the package, the one that encodes first."""
    return _read(SHIPPED)


@cache
def all_structure() -> tuple[Model, ...]:
    """Return the models of `emb-structure` that come with the package, the one that encodes first."""
    return _read(STRUCTURE)


def shipped() -> Model:
    """Return the model with which `emb` encodes."""
    return all_shipped()[0]
