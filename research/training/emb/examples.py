"""List what the coder would have to decide, with contexts, for training pictures: the coder itself does it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb import kernel, transform
from sonarpost.codec.emb.bitplanes import START_THRESHOLDS, code_planes, extra_planes
from sonarpost.codec.emb.coder import UNIT_SCALE, Coder, CoefficientState
from sonarpost.codec.emb.model import FORMAT_2, Model, model_of
from sonarpost.codec.emb.rate_distortion_opt import TargetCoefficients, target_coefficients
from sonarpost.codec.emb.side_info import MEAN_STEP, SideInfo, region_weights
from sonarpost.codec.emb.transform import layout_of

Rows = npt.NDArray[np.int16]

LEAST_BYTES, MOST_BYTES = 18, 620
"""Of a stream of 80 x 80 px; larger pictures get more."""


def blank_model() -> Model:
    """A model that knows nothing but where in its interval a coefficient lies."""
    zeros = {name: np.zeros(shape, np.int32) for name, shape, _ in FORMAT_2.arrays}
    zeros["centres"][:] = np.array([104, 110, 118, 124])[:, None]
    return model_of(zeros)


def chance_side(targets: npt.NDArray[np.int32], mean_index: int, rng: np.random.Generator) -> SideInfo:
    """Side information with a chance start step."""
    step = int(rng.integers(8))
    return SideInfo(mean_index, step, None, None, extra_planes(targets, step))


def chance_wanted(
    model: Model, picture: npt.NDArray[np.uint8], rng: np.random.Generator
) -> tuple[TargetCoefficients, int, int]:
    """What the encoder would tell of a picture in a chance number of bytes, the mean level, and the bytes."""
    layout = layout_of(*picture.shape)
    size = int(np.exp(rng.uniform(np.log(LEAST_BYTES), np.log(MOST_BYTES))) * picture.size / 6400)
    mean_index = min((int(picture.astype(np.int64).sum()) // picture.size + MEAN_STEP // 2) // MEAN_STEP, 63)
    plane = (picture.astype(np.int64) - mean_index * MEAN_STEP) * transform.UNIT
    return target_coefficients(plane, layout, region_weights(layout, None), size, model.perceptual), mean_index, size


def list_examples(
    model: Model, pictures: npt.NDArray[np.uint8], rng: np.random.Generator, rows_a_picture: int
) -> tuple[Rows, Rows]:
    """Return decisions (contexts, bit, net, share, weight) and signs (contexts, orientation, sign).

    Each picture is listed at a chance start step, with the targets that the encoder would have for a chance number of
    bytes, and down to the plane that those bytes reach. The model decides in which pass a coefficient comes. The weight
    makes every stream count alike, however long it is.
    """
    decisions, signs = [], []
    rows = np.zeros((rows_a_picture, kernel.FEATURES + 3), np.int16)
    sign_rows = np.zeros((rows_a_picture // 8, kernel.SIGN_FEATURES + 2), np.int16)
    for picture in pictures:
        wanted, mean_index, size = chance_wanted(model, picture, rng)
        side = chance_side(wanted.targets, mean_index, rng)
        writer, state = Coder.writer(size), CoefficientState(wanted.layout)
        code_planes(writer, state, model, wanted.targets, side)
        planes = (
            round(np.log2((START_THRESHOLDS[side.start_step] << side.extra_planes) / state.threshold))
            + 1
            - side.extra_planes
        )
        coder = Coder(kernel.COLLECT, np.zeros(0, np.uint8))
        coder.decisions, coder.sign_decisions = rows, sign_rows
        coder.words[kernel.CODER_CODE] = int(rng.integers(1 << 30))
        code_planes(coder, CoefficientState(wanted.layout), model, wanted.targets, side, planes=planes)
        used, used_signs = (int(coder.words[word]) for word in (kernel.CODER_ROWS, kernel.CODER_SIGN_ROWS))
        weight = np.full((used, 1), min(12500 // size, 32000), np.int16)
        decisions.append(np.concatenate([rows[:used], weight], axis=1))
        signs.append(sign_rows[:used_signs].copy())
    return np.concatenate(decisions), np.concatenate(signs)


def measure_centres(model: Model, pictures: npt.NDArray[np.uint8], rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """Return the mean reconstruction points, in 1/256 of the interval, by size and logit; see `kernel._reconstruct`.

    Each picture is coded at a chance start step and length; cells of the table with few coefficients take the value of
    a straight line through the others.
    """
    total = np.zeros((4, kernel.CENTRE_COLUMNS, 2))
    for picture in pictures:
        wanted, mean_index, size = chance_wanted(model, picture, rng)
        coder, state = Coder.writer(size), CoefficientState(wanted.layout)
        code_planes(coder, state, model, wanted.targets, chance_side(wanted.targets, mean_index, rng))
        known = state.lower > 0
        value, width = state.lower[known], state.widths[known]
        part = (np.abs(wanted.targets[known]) * (state.scale[known] / UNIT_SCALE) - value) / width
        row, column = (
            np.minimum(value // width, 4) - 1,
            np.clip((state.logits[known] + 2304) >> 7, 0, kernel.CENTRE_COLUMNS - 1),
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
