"""Train the enhancer of the decoder on decoded images, and write its weights.

    python -m research.training.emb.enhancer --pool /tmp/emb/pool.npz \
        --model /tmp/emb/contexts.model --out /tmp/emb/emb.model --steps 12000

Loss: squared error relative to that before enhancement, minus the weighted multi-scale structural similarity.
"""

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from research.common.emb_estimate import decode_before_enhancer
from research.training.emb.train import write_model
from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.codec.emb.model import CHANNELS, DILATIONS, IMAGE_FEATURES, Model, parse, read_arrays

SEED = 11
BATCH = 10
MIN_BYTES, MAX_BYTES = 18, 640
Params = dict[str, jax.Array]


def coded(codec: EmbCodec, images: np.ndarray, rng: np.random.Generator, streams: int) -> tuple[np.ndarray, ...]:
    """Decode random lengths of each image; return planes without enhancement (1/64 grey), means, features.

    Every other stream is the beginning of a longer one, like a partly received stream.
    """
    planes, means, features = [], [], []
    for image in images:
        for i, size in enumerate(np.exp(rng.uniform(np.log(MIN_BYTES), np.log(MAX_BYTES), streams))):
            length = int(size * image.size / 6400)
            full_length = length if i % 2 == 0 else int(length * rng.uniform(1, 4))
            stream = EmbCodec(codec.network, start_steps=(int(rng.integers(8)),)).encode(image, full_length)
            plain = decode_before_enhancer(codec, stream[:length])
            low, high = -64 * plain.mean, 64 * (255 - plain.mean)
            planes.append(np.clip(plain.plane, low, high).astype(np.int16))
            means.append(plain.mean)
            features.append(plain.features)
    return np.stack(planes), np.array(means), np.array(features)


def start(rng: np.random.Generator) -> Params:
    """Return initial weights (He initialisation); the last layer starts near zero."""
    out: Params = {"s": jnp.zeros((IMAGE_FEATURES, CHANNELS))}
    for i in range(len(DILATIONS)):
        inputs, outputs = (4 if i == 0 else CHANNELS), (4 if i == len(DILATIONS) - 1 else CHANNELS)
        scale = np.sqrt(2 / (9 * inputs)) * (0.02 if outputs == 4 else 1)
        out[f"w{i}"] = jnp.asarray(rng.normal(0, 1, (9, inputs, outputs)) * scale)
        out[f"b{i}"] = jnp.zeros(outputs)
    return out


def resumed(model: Model) -> Params:
    """Return the weights of a model file as floating-point numbers."""
    out: Params = {"s": jnp.asarray(model.image_weights / (1 << 14))}
    for i, (taps, bias) in enumerate(model.layers):
        out[f"w{i}"], out[f"b{i}"] = jnp.asarray(taps / (1 << 12)), jnp.asarray(bias / (1 << 20))
    return out


def enhance(p: Params, blocks: jax.Array, features: jax.Array) -> jax.Array:
    """Return the corrections in grey; the integer version is `enhance.enhanced`. `blocks` is in 64 grey."""
    x = blocks
    for i, d in enumerate(DILATIONS):
        w = p[f"w{i}"].reshape(3, 3, *p[f"w{i}"].shape[1:])
        padded = jnp.pad(x, ((0, 0), (d, d), (d, d), (0, 0)), mode="edge")
        x = jax.lax.conv_general_dilated(
            padded, w, (1, 1), "VALID", rhs_dilation=(d, d), dimension_numbers=("NHWC", "HWIO", "NHWC")
        )
        x = x + p[f"b{i}"]
        if i == 0:
            x = x + (features / 64 @ p["s"])[:, None, None, :]
        if i < len(DILATIONS) - 1:
            x = jnp.clip(jnp.maximum(x, x / 8), -15.99, 15.99)
    return x * 16


def to_pixels(b: jax.Array) -> jax.Array:
    """Convert blocks of 2 x 2 to pixels."""
    n, r, c, _ = b.shape
    return b.reshape(n, r, c, 2, 2).transpose(0, 1, 3, 2, 4).reshape(n, 2 * r, 2 * c)


def _halved(x: jax.Array) -> jax.Array:
    n, h, w = x.shape
    return x[:, : h // 2 * 2, : w // 2 * 2].reshape(n, h // 2, 2, w // 2, 2).mean((2, 4))


KERNEL = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
KERNEL /= KERNEL.sum()


def _blur(x: jax.Array) -> jax.Array:
    for axis in (1, 2):
        pad = [(0, 0), (0, 0), (0, 0)]
        pad[axis] = (5, 5)
        padded = jnp.pad(x, pad, mode="symmetric")
        n = x.shape[axis]
        x = sum(KERNEL[i] * jax.lax.slice_in_dim(padded, i, i + n, axis=axis) for i in range(11))
    return x


def similarity(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return the structural similarity over three scales, weights .0448, .2856, .3001 scaled to a sum of 1."""
    weights = np.array([0.0448, 0.2856, 0.3001])
    weights /= weights.sum()
    total = 1.0
    for scale in range(3):
        if scale:
            a, b = _halved(a), _halved(b)
        if weights[scale] < 0.1:
            continue  # four fifths of the computing time for a thirteenth of the weight
        ma, mb = _blur(a), _blur(b)
        va, vb, c = _blur(a * a) - ma * ma, _blur(b * b) - mb * mb, _blur(a * b) - ma * mb
        term = (2 * c + 58.5225) / (va + vb + 58.5225)
        if scale == 2:
            term = term * (2 * ma * mb + 6.5025) / (ma * ma + mb * mb + 6.5025)
        total = total * jnp.maximum(term.mean((1, 2)), 1e-3) ** weights[scale]
    return total


def main() -> None:  # noqa: PLR0915  a script
    """Code the images, train, write the model."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pool", type=Path, required=True)
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=12000)
    parser.add_argument("--streams", type=int, default=3, help="streams of each image")
    parser.add_argument("--images", type=int, default=3000)
    parser.add_argument("--resume", action="store_true", help="start with the enhancer of --model")
    parser.add_argument("--rate", type=float, default=1.5e-3)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--likeness", type=float, default=0.1, help="weight of structural similarity")
    parser.add_argument("--error", type=float, default=1.0, help="weight of the squared error's logarithm")
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    pool = np.load(args.pool)
    codec = EmbCodec(parse(args.model.read_bytes()))
    started_s = time.time()
    sets = {}
    for name, part in (("train", slice(-args.images, None)), ("check", slice(100))):
        key = "tp80" if name == "train" else "vp80"
        images = pool[key][part]
        plane, mean, features = coded(codec, images, rng, args.streams if name == "train" else 2)
        sets[name] = (images.repeat(len(plane) // len(images), 0), plane, mean, features)
    print(f"coded, {time.time() - started_s:.0f} s", flush=True)
    params = resumed(codec.network) if args.resume else start(rng)

    def parts(
        p: Params, image: jax.Array, plane: jax.Array, mean: jax.Array, features: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        decoded = plane / 64
        # Blocks are computed on the device, so that rotated images need no second copy.
        n, h, w = decoded.shape
        blocks = decoded.reshape(n, h // 2, 2, w // 2, 2).transpose(0, 1, 3, 2, 4).reshape(n, h // 2, w // 2, 4) / 64
        better = jnp.clip(decoded + to_pixels(enhance(p, blocks, features)), -mean[:, None, None] - 3, 258)
        truth = image - mean[:, None, None]
        before = ((decoded - truth) ** 2).mean((1, 2))
        after = ((better - truth) ** 2).mean((1, 2))
        level = mean[:, None, None]
        return before, after, similarity(truth + level, decoded + level), similarity(truth + level, better + level)

    def loss(p: Params, *batch: jax.Array) -> jax.Array:
        before, after, _, like = parts(p, *batch)
        return args.error * (jnp.log(after + 8) - jnp.log(before + 8)).mean() - args.likeness * like.mean()

    optimiser = optax.chain(optax.clip_by_global_norm(0.3), optax.inject_hyperparams(optax.adam)(2e-3))

    def take_step(p: Params, state: optax.OptState, *batch: jax.Array) -> tuple[Params, optax.OptState, jax.Array]:
        value, grad = jax.value_and_grad(loss)(p, *batch)
        update, state = optimiser.update(grad, state)
        return optax.apply_updates(p, update), state, value

    step, check = jax.jit(take_step), jax.jit(parts)
    state = optimiser.init(params)
    images, planes, means, features = sets["train"]
    started_s = time.time()
    for i in range(args.steps):
        rate = (args.rate * (1 - i / args.steps) ** 1.5 + 1e-5) * min(1, (i + 5) / 300)
        state[1].hyperparams["learning_rate"] = jnp.asarray(rate)
        pick = rng.integers(len(images), size=BATCH)
        x, y = images[pick].astype(np.float32), planes[pick].astype(np.float32)
        turn = int(rng.integers(8))
        if turn & 1:
            x, y = x[:, ::-1], y[:, ::-1]
        if turn & 2:
            x, y = x[:, :, ::-1], y[:, :, ::-1]
        if turn & 4:
            x, y = x.transpose(0, 2, 1), y.transpose(0, 2, 1)
        params, state, _ = step(params, state, x, y, means[pick], features[pick])
        if i % 250 == 249 or i == args.steps - 1:
            _report(check, params, sets["check"], i + 1, time.time() - started_s)
            write(args.out, args.model, params)


def write(out: Path, model: Path, params: Params) -> None:
    """Round the weights and write a model file with them and the other arrays of `model`."""
    arrays: dict[str, np.ndarray] = dict(read_arrays(model.read_bytes()))
    arrays["image_weights"] = np.rint(np.asarray(params["s"], np.float64) * (1 << 14))
    for i in range(len(DILATIONS)):
        taps = np.rint(np.asarray(params[f"w{i}"], np.float64) * (1 << 12))
        bias = np.rint(np.asarray(params[f"b{i}"], np.float64) * (1 << 20))
        if (np.abs(taps).sum((0, 1)) * 4095 + np.abs(bias)).max() >= 2**31:
            raise SystemExit("a sum may exceed 32 bits")
        arrays[f"taps{i}"], arrays[f"bias{i}"] = taps, bias
    write_model(out, arrays)


def _report(check: Callable[..., Any], params: Params, group: Sequence[np.ndarray], i: int, seconds: float) -> None:
    x, y, m, s = (np.asarray(a[:200], np.float32) for a in group)
    before, after, like, liker = (np.asarray(v) for v in check(params, x, y, m, s))
    gain = 10 * np.log10(before / after)
    print(
        f"  {i}: {gain.mean():+.3f} dB, similarity {like.mean():.4f} to {liker.mean():.4f}, {seconds:.0f} s", flush=True
    )


if __name__ == "__main__":
    main()
