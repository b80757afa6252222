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
    zeros["centres"][:] = np.array([104, 110, 118, 124])[:, None]
    return model_of(zeros)


def list_examples(
    model: Model, pictures: npt.NDArray[np.uint8], planes: int, rng: np.random.Generator, rows_a_picture: int
) -> tuple[Rows, Rows]:
    """Return decisions (contexts, bit, net, weight) and signs (contexts, orientation, sign, level).

    Each picture is listed at a chance start step. The model decides in which pass a coefficient comes.
    """
    count = len(pictures)
    out = np.zeros((count * rows_a_picture, kernel.FEATURES + 3), np.int16)
    signs = np.zeros((count * 1200, kernel.SIGN_FEATURES), np.int16)
    used = used_signs = 0
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
    return out[:used], signs[:used_signs]


def measure_centres(model: Model, pictures: npt.NDArray[np.uint8], rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """Return where in their interval coefficients lie on the mean, in 1/256, by size and logit; see `kernel._guess`.

    Each picture is coded at a chance start step and length; cells of the table with few coefficients take the value of
    a straight line through the others.
    """
    total = np.zeros((4, kernel.CENTRE_COLUMNS, 2))
    for picture in pictures:
        lay = layout(*picture.shape)
        side = Side(int(picture.mean() / 4 + 0.5), int(rng.integers(8)))
        plane = (picture.astype(np.int64) - side.mean) * transform.UNIT
        targets = transform.to_flat(transform.forward(plane, lay), lay)
        coder, state = Coder.writer(int(np.exp(rng.uniform(np.log(19), np.log(640))))), State(lay)
        code_planes(coder, state, model, targets, side)
        known = state.values > 0
        value, width = state.values[known], state.widths[known]
        part = (np.abs(targets[known]) - value) / width
        row, column = (
            np.minimum(value // width, 4) - 1,
            np.clip((state.odds[known] + 2304) >> 7, 0, kernel.CENTRE_COLUMNS - 1),
        )
        inside = (part >= 0) & (part < 1)
        np.add.at(total, (row[inside], column[inside], 0), part[inside])
        np.add.at(total, (row[inside], column[inside], 1), 1)
    out = np.zeros((4, kernel.CENTRE_COLUMNS))
    columns = np.arange(kernel.CENTRE_COLUMNS)
    for row in range(4):
        enough = total[row, :, 1] > 60
        mean = total[row, enough, 0] / total[row, enough, 1]
        line = np.polyfit(columns[enough], mean, 1, w=np.sqrt(total[row, enough, 1]))
        out[row] = np.clip(np.polyval(line, columns), 0.12, 0.52)
        out[row, enough] = mean
    return np.rint(256 * out)
