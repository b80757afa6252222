"""The trained model: integer weights of the networks, reconstruction points and tables.

The file, `data/emb.model`, is a magic word and then arrays of fixed shapes and types, little-endian, one after
the other (`ARRAYS`). Its sha256 is the model's identity. `training/emb` makes it.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb import kernel as k
from sonarpost.errors import StreamError

I32 = npt.NDArray[np.int32]
MAGIC = b"SPEMB1\n"

CHANNELS: Final = 24
GLOBALS: Final = 3
LAYERS: Final = ((4, CHANNELS), *((CHANNELS, CHANNELS),) * 2, (CHANNELS, 4))
"""Channels in and out of the enhancer's layers."""

# Name, shape and type in the file, in order.
ARRAYS: tuple[tuple[str, tuple[int, ...], str], ...] = (
    ("w1", (2, k.FEATURES, k.HIDDEN_1), "<i2"),
    ("b1", (2, k.HIDDEN_1), "<i4"),
    ("w2", (2, k.HIDDEN_1, k.HIDDEN_2), "<i2"),
    ("b2", (2, k.HIDDEN_2), "<i4"),
    ("w3", (2, k.HIDDEN_2), "<i2"),
    ("b3", (2,), "<i4"),
    ("sign_w1", (4, 11, k.SIGN_HIDDEN), "<i2"),
    ("sign_b1", (4, k.SIGN_HIDDEN), "<i4"),
    ("sign_w2", (4, k.SIGN_HIDDEN), "<i2"),
    ("chances", (2 * k.LOGIT_LIMIT + 1,), "<u2"),
    ("costs", (2 * k.LOGIT_LIMIT + 1,), "<u2"),
    ("centres", (4, k.CENTRE_COLUMNS), "<i2"),
    ("mean_tree", (64,), "<u2"),
    ("situation", (GLOBALS, CHANNELS), "<i4"),
    *(
        (f"{kind}{i}", shape, number)
        for i, (inputs, outputs) in enumerate(LAYERS)
        for kind, shape, number in (("taps", (9, inputs, outputs), "<i2"), ("bias", (outputs,), "<i4"))
    ),
)


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


def read_arrays(raw: bytes, where: str = "emb model") -> dict[str, I32]:
    """Read the arrays of a model file.

    Raises:
        StreamError: It is not one, or its length is wrong.
    """
    if not raw.startswith(MAGIC):
        raise StreamError(where, "magic", raw[: len(MAGIC)], repr(MAGIC))
    expected = len(MAGIC) + sum(int(np.prod(shape)) * np.dtype(kind).itemsize for _, shape, kind in ARRAYS)
    if len(raw) != expected:
        raise StreamError(where, "length", len(raw), f"{expected} bytes")
    arrays, at = {}, len(MAGIC)
    for name, shape, kind in ARRAYS:
        count = int(np.prod(shape))
        arrays[name] = np.frombuffer(raw, kind, count, at).reshape(shape).astype(np.int32)
        at += count * np.dtype(kind).itemsize
    return arrays


def model_of(arrays: dict[str, I32], identity: str = "") -> Model:
    """Make a model of its arrays."""
    plain = {name: array for name, array in arrays.items() if name[:4] not in ("taps", "bias")}
    layers = tuple((arrays[f"taps{i}"], arrays[f"bias{i}"]) for i in range(len(LAYERS)))
    return Model(identity=identity, layers=layers, **plain)


def parse(raw: bytes, where: str = "emb model") -> Model:
    """Read a model file.

    Raises:
        StreamError: It is not one, or its length is wrong.
    """
    return model_of(read_arrays(raw, where), hashlib.sha256(raw).hexdigest())


@cache
def shipped() -> Model:
    """Return the model that comes with the package."""
    return parse(files("sonarpost.codec").joinpath("data", "emb.model").read_bytes())
