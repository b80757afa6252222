"""Training examples: the binary decisions of the coder with their contexts, listed by the coder itself."""

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb import contexts, kernel, range_coder, transform
from sonarpost.codec.emb.bitplanes import START_THRESHOLDS, code_planes, extra_planes
from sonarpost.codec.emb.coder import UNIT_SCALE, Coder, CoefficientState
from sonarpost.codec.emb.model import FORMAT_2, Model, model_of
from sonarpost.codec.emb.rate_distortion_opt import TargetCoefficients, target_coefficients
from sonarpost.codec.emb.side_info import MEAN_STEP, SideInfo, region_weights
from sonarpost.codec.emb.transform import layout_of

Rows = npt.NDArray[np.int16]

MIN_BYTES, MAX_BYTES = 18, 620
"""Length of a stream for 80 x 80 px; proportional to the number of pixels for larger images."""


def blank_model() -> Model:
    """Return a model without context networks; only the reconstruction points are set."""
    zeros = {name: np.zeros(shape, np.int32) for name, shape, _ in FORMAT_2.arrays}
    zeros["centres"][:] = np.array([104, 110, 118, 124])[:, None]
    return model_of(zeros)


def random_side_info(targets: npt.NDArray[np.int32], mean_index: int, rng: np.random.Generator) -> SideInfo:
    """Return side information with a random start step."""
    step = int(rng.integers(8))
    return SideInfo(mean_index, step, None, None, extra_planes(targets, step))


def random_target(
    model: Model, image: npt.NDArray[np.uint8], rng: np.random.Generator
) -> tuple[TargetCoefficients, int, int]:
    """Return target coefficients for a random number of bytes, the index of the mean level, and the bytes."""
    layout = layout_of(*image.shape)
    size = int(np.exp(rng.uniform(np.log(MIN_BYTES), np.log(MAX_BYTES))) * image.size / 6400)
    mean_index = min((int(image.astype(np.int64).sum()) // image.size + MEAN_STEP // 2) // MEAN_STEP, 63)
    plane = (image.astype(np.int64) - mean_index * MEAN_STEP) * transform.UNIT
    return target_coefficients(plane, layout, region_weights(layout, None), size, model.perceptual), mean_index, size


def list_examples(
    model: Model, images: npt.NDArray[np.uint8], rng: np.random.Generator, rows_per_image: int
) -> tuple[Rows, Rows]:
    """Return decisions (contexts, bit, net, share, weight) and signs (contexts, orientation, sign).

    Each image is listed at a random start step, with the target coefficients of a random number of bytes, down to the
    bit plane that those bytes reach. The model determines in which pass a coefficient is coded. The weight gives every
    stream the same influence.
    """
    decisions, signs = [], []
    rows = np.zeros((rows_per_image, contexts.FEATURES + 3), np.int16)
    sign_rows = np.zeros((rows_per_image // 8, contexts.SIGN_FEATURES + 2), np.int16)
    for image in images:
        target, mean_index, size = random_target(model, image, rng)
        side = random_side_info(target.targets, mean_index, rng)
        writer, state = Coder.writer(size), CoefficientState(target.layout)
        code_planes(writer, state, model, target.targets, side)
        planes = (
            round(np.log2((START_THRESHOLDS[side.start_step] << side.extra_planes) / state.threshold))
            + 1
            - side.extra_planes
        )
        coder = Coder(range_coder.COLLECT, np.zeros(0, np.uint8))
        coder.decisions, coder.sign_decisions = rows, sign_rows
        coder.words[range_coder.CODER_CODE] = int(rng.integers(1 << 30))
        code_planes(coder, CoefficientState(target.layout), model, target.targets, side, planes=planes)
        used, used_signs = (int(coder.words[word]) for word in (range_coder.CODER_ROWS, range_coder.CODER_SIGN_ROWS))
        weight = np.full((used, 1), min(12500 // size, 32000), np.int16)
        decisions.append(np.concatenate([rows[:used], weight], axis=1))
        signs.append(sign_rows[:used_signs].copy())
    return np.concatenate(decisions), np.concatenate(signs)


def measure_centres(model: Model, images: npt.NDArray[np.uint8], rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """Return the mean reconstruction points, in 1/256 of the interval, by size and logit; see `kernel._reconstruct`.

    Each image is coded with random start step and length. Cells of the table with few coefficients are set by a
    straight line through the others.
    """
    total = np.zeros((4, kernel.CENTRE_COLUMNS, 2))
    for image in images:
        target, mean_index, size = random_target(model, image, rng)
        coder, state = Coder.writer(size), CoefficientState(target.layout)
        code_planes(coder, state, model, target.targets, random_side_info(target.targets, mean_index, rng))
        significant = state.lower > 0
        value, width = state.lower[significant], state.widths[significant]
        part = (np.abs(target.targets[significant]) * (state.scale[significant] / UNIT_SCALE) - value) / width
        row, column = (
            np.minimum(value // width, 4) - 1,
            np.clip((state.logits[significant] + 2304) >> 7, 0, kernel.CENTRE_COLUMNS - 1),
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
