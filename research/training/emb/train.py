"""Train the context networks and write the model file.

    python -m research.training.emb.train --pool /tmp/emb/pool.npz --out /tmp/emb/contexts.model

Requires jax and optax (CPU), which are not dependencies of the package.
"""

import argparse
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
import optax

from sonarpost.codec.emb import contexts, kernel, range_coder, transform
from sonarpost.codec.emb.bitplanes import START_THRESHOLDS, code_planes, extra_planes
from sonarpost.codec.emb.coder import UNIT_SCALE, Coder, CoefficientState
from sonarpost.codec.emb.model import FORMAT_2, FORMAT_3, Model, model_of, parse, read_arrays
from sonarpost.codec.emb.rate_distortion_opt import TargetCoefficients, target_coefficients
from sonarpost.codec.emb.side_info import MEAN_STEP, SideInfo, region_weights
from sonarpost.codec.emb.transform import layout_of

SEED = 7
BATCH = 8192
Params = dict[str, jax.Array]
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


def layer(x: jax.Array) -> jax.Array:
    """Limit to the range of a hidden unit: 0..4095 in 1/256."""
    return jnp.clip(x, 0, 15.99)


def network(p: Params, x: jax.Array) -> jax.Array:
    """Return the logit of a decision; the integer version is `kernel._logit`."""
    return layer(layer(x / 16 @ p["w1"] + p["b1"]) @ p["w2"] + p["b2"]) @ p["w3"] + p["b3"]


def sign_network(p: Params, x: jax.Array) -> jax.Array:
    """Return the logit of a positive sign, odd in the odd features; the integer version is `kernel._sign_logit`."""
    odd = x[:, : contexts.SIGN_ODD] / 16 @ p["w1"][: contexts.SIGN_ODD]
    even = x[:, contexts.SIGN_ODD :] / 16 @ p["w1"][contexts.SIGN_ODD :] + p["b1"]
    return (layer(even + odd) - layer(even - odd)) @ p["w2"]


def start(rng: np.random.Generator, features: int) -> Params:
    """Return initial weights (He initialisation)."""
    shapes = ((features, kernel.HIDDEN_1), (kernel.HIDDEN_1, kernel.HIDDEN_2), (kernel.HIDDEN_2,))
    out: Params = {"b1": jnp.zeros(kernel.HIDDEN_1), "b2": jnp.zeros(kernel.HIDDEN_2), "b3": jnp.zeros(())}
    for i, shape in enumerate(shapes):
        scale = (1.0 if i else 0.5) * np.sqrt(2 / shape[0])
        out[f"w{i + 1}"] = jnp.asarray(rng.normal(0, scale, shape) * (0.3 if i == 2 else 1))
    return out


def fit(
    function: Callable[[Params, jax.Array], jax.Array],
    params: Params,
    rows: np.ndarray,
    bits: np.ndarray,
    weight: np.ndarray,
    steps: int,
    rng: np.random.Generator,
    rate: float = 4e-3,
    decay: float = 0.0,
) -> Params:
    """Minimise the weighted code length; print it in bits."""
    optimiser = optax.adamw(optax.cosine_decay_schedule(rate, steps, 0.005), weight_decay=decay)

    def loss(p: Params, x: jax.Array, y: jax.Array, w: jax.Array) -> jax.Array:
        return (optax.sigmoid_binary_cross_entropy(function(p, x), y) * w).sum() / w.sum() / np.log(2)

    def take_step(
        p: Params, state: optax.OptState, x: jax.Array, y: jax.Array, w: jax.Array
    ) -> tuple[Params, optax.OptState, jax.Array]:
        value, grad = jax.value_and_grad(loss)(p, x.astype(jnp.float32), y, w)
        update, state = optimiser.update(grad, state, p)
        p = optax.apply_updates(p, update)
        return {n: jnp.clip(v, -7.9, 7.9) if n.startswith("w") else v for n, v in p.items()}, state, value

    step = jax.jit(take_step)
    state, history, started_s = optimiser.init(params), [], time.time()
    for i in range(steps):
        pick = rng.integers(len(rows), size=BATCH)
        params, state, value = step(params, state, rows[pick], bits[pick], weight[pick])
        history.append(float(value))
        if i % max(steps // 6, 1) == max(steps // 6, 1) - 1:
            print(f"  {i + 1}: {np.mean(history[-300:]):.5f} bit, {time.time() - started_s:.0f} s", flush=True)
    return params


def integers(nets: list[Params], signs: list[Params]) -> dict[str, np.ndarray]:
    """Round the weights; check that no sum can overflow."""
    scale = {"w1": 1 << 10, "b1": 1 << 14, "w2": 1 << 12, "b2": 1 << 20, "w3": 1 << 12, "b3": 1 << 20}
    out = {name: np.stack([np.rint(np.asarray(p[name], np.float64) * s) for p in nets]) for name, s in scale.items()}
    out["sign_w1"] = np.stack([np.rint(np.asarray(p["w1"], np.float64) * (1 << 10)) for p in signs])
    out["sign_b1"] = np.stack([np.rint(np.asarray(p["b1"], np.float64) * (1 << 14)) for p in signs])
    out["sign_w2"] = np.stack([np.rint(np.asarray(p["w2"], np.float64) * (1 << 12)) for p in signs])
    reach = np.abs(out["w1"]).sum(1) * 290 + np.abs(out["b1"])
    second = np.abs(out["w2"]).sum(1) * 4095 + np.abs(out["b2"])
    if max(reach.max(), second.max()) >= 2**31:
        raise SystemExit("a sum may exceed 32 bits")
    return out


def tables() -> dict[str, np.ndarray]:
    """Return the tables of probabilities and costs."""
    logit = np.arange(-kernel.LOGIT_LIMIT, kernel.LOGIT_LIMIT + 1) / 256
    chance = 1 / (1 + np.exp(-logit))
    whole = np.clip(np.rint(chance * 65536), 6, 65530)
    return {
        "probabilities": whole,
        "costs": np.rint(-256 * np.log2(whole / 65536)),
    }


def mean_tree(means: np.ndarray) -> np.ndarray:
    """Return the probability of 1 at each node of the tree of the six bits of a mean level, smoothed."""
    counts = np.zeros((64, 2)) + 3.0
    for level in np.minimum(means // 4, 63).astype(int):
        node = 1
        for place in range(5, -1, -1):
            bit = level >> place & 1
            counts[node, bit] += 1
            node = 2 * node + bit
    return np.asarray(np.rint(np.clip(counts[:, 1] / counts.sum(1), 0.02, 0.98) * 65536))


def write_model(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write the arrays in the order and types of the file."""
    form = FORMAT_3 if "perceptual_levels" in arrays else FORMAT_2
    raw = bytearray(form.magic)
    for name, shape, kind in form.arrays:
        array = np.asarray(arrays[name])
        stored = array.astype(kind)
        if array.shape != shape or not np.array_equal(stored, array):
            raise SystemExit(f"{name}: does not fit {shape} {kind}")
        raw += stored.tobytes()
    path.write_bytes(bytes(raw))


def listed(order: Model, pool: Mapping[str, np.ndarray], images: int, rng: np.random.Generator) -> tuple[Rows, Rows]:
    """Return decisions and signs of a number of images of 80 x 80 px and a seventh as many of each larger size."""
    parts = [
        list_examples(order, pool[name][: int(images * share)], rng, 20000 * pool[name][0].size // 6400)
        for name, share in (("tp80", 1.0), ("tp140", 1 / 7), ("tp112", 1 / 7))
    ]
    return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])


def trained_contexts(rows: Rows, steps: int, rng: np.random.Generator) -> list[Params]:
    """Train the networks of significance and refinement."""
    nets, f = [], contexts.FEATURES
    for net, count in ((0, steps), (1, steps // 3)):
        of_net = rows[:, f + 1] == net
        # Weight: number of decisions that a row represents, times the weight of its stream.
        weight = rows[of_net, f + 2].astype(np.float32) * rows[of_net, f + 3] / 100
        bits = rows[of_net, f].astype(np.float32)
        nets.append(fit(network, start(rng, f), rows[of_net][:, :f], bits, weight, count, rng))
    return nets


def trained_signs(rows: Rows, steps: int, rng: np.random.Generator) -> list[Params]:
    """Train the network of signs of each orientation."""
    signs, f = [], contexts.SIGN_FEATURES
    for orient in range(4):
        oriented = rows[rows[:, f] == orient]
        first = {
            "w1": jnp.asarray(rng.normal(0, 0.15, (f, kernel.SIGN_HIDDEN))),
            "b1": jnp.zeros(kernel.SIGN_HIDDEN) + 0.2,
            "w2": jnp.asarray(rng.normal(0, 0.1, kernel.SIGN_HIDDEN)),
        }
        even = np.ones(len(oriented), np.float32)
        bits = oriented[:, f + 1].astype(np.float32)
        signs.append(fit(sign_network, first, oriented[:, :f], bits, even, steps, rng, decay=1e-3))
    return signs


def main() -> None:
    """List the examples, train, write the model."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pool", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--images", type=int, default=1000)
    parser.add_argument("--steps", type=int, default=5000)
    parser.add_argument(
        "--order", type=Path, help="model whose contexts order the coefficients, and whose enhancer is kept"
    )
    args = parser.parse_args()
    rng = np.random.default_rng(SEED)
    pool = np.load(args.pool)
    started_s = time.time()
    order = parse(args.order.read_bytes()) if args.order else blank_model()
    rows, sign_rows = listed(order, pool, args.images, rng)
    print(f"listed {len(rows)} decisions, {len(sign_rows)} signs, {time.time() - started_s:.0f} s")
    nets, signs = trained_contexts(rows, args.steps, rng), trained_signs(sign_rows, args.steps // 5, rng)
    arrays = integers(nets, signs) | tables()
    arrays["mean_tree"] = mean_tree(np.concatenate([pool[n].mean((1, 2)) for n in ("tp80", "tp140", "tp112")]))
    kept = read_arrays(args.order.read_bytes()) if args.order else {}
    for name, shape, _ in (FORMAT_2 if order.perceptual is None else FORMAT_3).arrays:
        arrays.setdefault(name, kept.get(name, np.zeros(shape)))  # an enhancer of zeros has no effect
    arrays["centres"] = order.centres
    trained = model_of({name: np.asarray(array, np.int32) for name, array in arrays.items()})
    arrays["centres"] = measure_centres(trained, pool["tp80"][-500:], rng)
    write_model(args.out, arrays)


if __name__ == "__main__":
    main()
