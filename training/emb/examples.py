"""List what the coder would have to decide, with contexts, for training pictures: the coder itself does it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb import kernel, transform
from sonarpost.codec.emb.coder import Coder, State
from sonarpost.codec.emb.layout import layout
from sonarpost.codec.emb.model import ARRAYS, Model, model_of
from sonarpost.codec.emb.planes import code_planes
from sonarpost.codec.emb.side import Side

Rows = npt.NDArray[np.int16]


def blank_model() -> Model:
    """A model that knows nothing but where in its interval a coefficient lies."""
    zeros = {name: np.zeros(shape, np.int32) for name, shape, _ in ARRAYS}
    zeros["centres"][:] = (104, 110, 118, 124, 126)
    return model_of(zeros)


def list_examples(
    pictures: npt.NDArray[np.uint8], planes: int, rng: np.random.Generator, rows_a_picture: int
) -> tuple[Rows, Rows, npt.NDArray[np.float64]]:
    """Return decisions (contexts, bit, net, weight), signs (contexts, orientation, sign, level), the centres.

    Each picture is listed at a chance start step.
    """
    model = blank_model()
    count = len(pictures)
    out = np.zeros((count * rows_a_picture, kernel.FEATURES + 3), np.int16)
    signs = np.zeros((count * 1200, kernel.SIGN_FEATURES), np.int16)
    used = used_signs = 0
    centre = np.zeros((5, 2))
    for picture in pictures:
        lay = layout(*picture.shape)
        side = Side(int(picture.mean() / 4 + 0.5), int(rng.integers(8)))
        plane = (picture.astype(np.int64) - side.mean) * transform.UNIT
        targets = transform.to_flat(transform.forward(plane, lay), lay)
        coder = Coder(kernel.LIST, np.zeros(0, np.uint8))
        coder.rows, coder.sign_rows = out[used:], signs[used_signs:]
        coder.words[kernel.CODER_CODE] = int(rng.integers(1 << 30))
        state = State(lay)
        depth = planes - int(rng.random() < 0.4)
        code_planes(coder, state, model, targets, side, planes=depth)
        used += int(coder.words[kernel.CODER_ROWS])
        used_signs += int(coder.words[kernel.CODER_SIGN_ROWS])
        known = state.values > 0
        width = state.widths[known]
        size = np.minimum(state.values[known] // width, 4)
        part = (np.abs(targets[known]) - state.values[known]) / width
        inside = part < 1
        centre[:, 0] += np.bincount(size[inside], part[inside], minlength=5)
        centre[:, 1] += np.bincount(size[inside], minlength=5)
    return out[:used], signs[:used_signs], centre[:, 0] / np.maximum(centre[:, 1], 1)
