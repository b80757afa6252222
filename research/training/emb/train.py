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
import optax

from research.training.emb.examples import Rows, blank_model, list_examples, measure_centres
from sonarpost.codec.emb import contexts
from sonarpost.codec.emb import kernel as k
from sonarpost.codec.emb.model import FORMAT_2, FORMAT_3, Model, model_of, parse, read_arrays

SEED = 7
BATCH = 8192
Params = dict[str, jax.Array]


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
    shapes = ((features, k.HIDDEN_1), (k.HIDDEN_1, k.HIDDEN_2), (k.HIDDEN_2,))
    out: Params = {"b1": jnp.zeros(k.HIDDEN_1), "b2": jnp.zeros(k.HIDDEN_2), "b3": jnp.zeros(())}
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
    logit = np.arange(-k.LOGIT_LIMIT, k.LOGIT_LIMIT + 1) / 256
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
            "w1": jnp.asarray(rng.normal(0, 0.15, (f, k.SIGN_HIDDEN))),
            "b1": jnp.zeros(k.SIGN_HIDDEN) + 0.2,
            "w2": jnp.asarray(rng.normal(0, 0.1, k.SIGN_HIDDEN)),
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
