"""Trial: contexts that know what a contact record states: side, range, altitude, pixel size, an object in the middle.

    python -m research.training.emb.trials.contact_contexts --data DIR

The shipped networks are trained further with and without these features on the decisions of real streams. Printed are
the bits that each needs for the decisions of 64 and 128 B streams of other images: other simulated lines, and SDVD's
test split, which shares survey lines with its train split. Neither network learns during coding. Requires jax, optax.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

import numpy as np
import numpy.typing as npt

from research.common.command import command_parser, run_command
from research.common.images import sdvd_crops
from research.training.emb.examples import random_side_info
from sonarpost.codec.emb import contexts, kernel, transform
from sonarpost.codec.emb.bitplanes import code_planes
from sonarpost.codec.emb.coder import Coder, CoefficientState
from sonarpost.codec.emb.model import shipped_model
from sonarpost.codec.emb.rate_distortion_opt import target_coefficients
from sonarpost.codec.emb.side_info import MEAN_STEP, region_weights
from sonarpost.codec.emb.transform import HEIGHT, LL, OFFSET, ORIENT, STRIDE, WIDTH, layout_of
from sonarpost.codec.interface import Image
from sonarpost.codec.jit import jit
from sonarpost.detection.snippets import to_grey
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind

I16 = npt.NDArray[np.int16]
I32 = npt.NDArray[np.int32]
Weights = npt.NDArray[np.float32]
SIDE_PX: Final = 80
EXTRAS: Final = 10
BUDGETS: Final = (64, 128)
SIMULATED: Final = range(500, 590), range(600, 612)
"""Seeds of the simulated lines for training and for the figures."""
_THINNED: Final = 8
"""Of the zeros without a significant neighbour, one of this number is a training example."""
_CLUES: Final = (*range(8), 14, 22, 24)
"""Features: magnitudes of the neighbours, the parent and the siblings."""


@dataclass(frozen=True)
class Contact:
    """A snippet with its contact record.

    Attributes:
        pixels: Shape (80, 80), uint8.
        side: -1 port (range decreases with the column), 1 starboard, 0 unknown.
        has_object: Whether an object is in the middle.
        altitude_px: Altitude in columns; 0 unknown.
        nearest_px: Slant range of the nearest column, in columns; 0 unknown.
        pixel_m: Slant range of a column; 0 unknown.
    """

    pixels: Image
    side: int = 0
    has_object: bool = False
    altitude_px: float = 0.0
    nearest_px: float = 0.0
    pixel_m: float = 0.0


def simulated_contacts(seeds: range) -> Iterator[Contact]:
    """Yield the objects of simulated surveys of several ranges and altitudes, half of them seen from port."""
    for seed in seeds:
        rng = np.random.default_rng(seed)
        range_m, altitude_m, kinds = float(rng.choice((20, 30, 45, 60))), float(rng.uniform(3, 9)), tuple(SeabedKind)
        kind = kinds[seed % len(kinds)]
        spec = SurveySpec(seed, 500, 768, range_m, altitude_m, ping_rate_hz=10.0, seabed=kind, targets=8, clutter=8)
        simulated, pixel_m = simulate_survey(spec), range_m / 768
        for item in simulated.truth:
            sheet = simulated.survey.waterfall(item.side)
            corner = np.array([item.ping, item.sample_index]) + rng.integers(-8, 9, 2) - SIDE_PX // 2
            top, left = np.clip(corner, 0, np.array(sheet.shape) - SIDE_PX)
            window = sheet[top : top + SIDE_PX, left : left + SIDE_PX]
            grey = to_grey(window.astype(np.uint32), np.ones(window.shape, np.bool_))
            side = int(rng.choice((-1, 1)))
            pixels = grey[:, ::side].copy()
            yield Contact(
                pixels, side, has_object=True, altitude_px=altitude_m / pixel_m, nearest_px=left, pixel_m=pixel_m
            )


def sdvd_contacts(data: Path, split: str) -> Iterator[Contact]:
    """Yield the crops of a split of SDVD, with the side where the file name states it."""
    for crop in sdvd_crops(data / "snippets" / "sdvd", split).images:
        side = {"left": -1, "right": 1}.get(crop.name.partition("_")[0], 0)
        yield Contact(crop.pixels, side, has_object=bool(crop.is_target))


def contact_features(contact: Contact, band: Sequence[int], y: npt.NDArray[np.int64], x: npt.NDArray[np.int64]) -> I16:
    """Return the extra features of coefficients of a band, shape (count, EXTRAS), about -48..48."""
    out = np.zeros((len(y), EXTRAS))
    if band[ORIENT] != LL:
        down, right = (y + 0.5) / band[HEIGHT] - 0.5, (x + 0.5) / band[WIDTH] - 0.5
        distance = np.hypot(down, right)
        away = right * contact.side
        out[:, :5] = np.stack([2 * down, 2 * right, 2 * away, 1.4 * distance, contact.has_object * distance * 1.4], 1)
        out[:, 5] = contact.has_object * np.exp(-((distance / 0.2) ** 2))
        if contact.altitude_px > 0:
            column = (x if contact.side >= 0 else band[WIDTH] - 1 - x) * SIDE_PX / band[WIDTH]
            out[:, 6] = np.minimum(contact.altitude_px / (contact.nearest_px + column + 1), 1.5)
    out[:, 7:] = contact.has_object, contact.side, np.log2(contact.pixel_m / 0.04) / 3 if contact.pixel_m else 0
    return np.rint(40 * out).astype(np.int16)


@jit
def _replay(
    places: I32, before: tuple[I32, I32, I32, I32], after: tuple[I32, I32, I32, I32], lows: I32, bands: I32,
    low_width: int, threshold: int, row: int, f: I32, out: I16, sign_out: I16,
) -> int:  # fmt: skip
    """Compute the contexts of the coded cells in their order; the state advances cell by cell. Returns the signs."""
    lower, sizes, signed, insignificant = before
    f_sign, signs = np.zeros(contexts.SIGN_FEATURES, np.int32), 0
    inverse = (1 << contexts.INVERSE_BITS) // threshold + 1
    for n in range(places.shape[0]):
        y, x, at = contexts.int64(places[n, 0]), contexts.int64(places[n, 1]), contexts.int64(places[n, 2])
        contexts.coefficient_context(f, sizes, insignificant, lows, bands, low_width, threshold, inverse, row, y, x, at)
        for i in range(contexts.FEATURES):
            out[n, i] = f[i]
        out[n, contexts.FEATURES] = after[0][at] > lower[at]
        if lower[at] == 0 and after[0][at] > 0:
            contexts.sign_context(f_sign, signed, lows, bands, low_width, threshold, row, y, x, at)
            for i in range(contexts.SIGN_FEATURES):
                sign_out[signs, i] = f_sign[i]
            sign_out[signs, contexts.SIGN_FEATURES] = after[2][at] > 0
            sign_out[signs, contexts.SIGN_FEATURES + 1] = n
            signs += 1
        sizes[at], signed[at], insignificant[at] = after[1][at], after[2][at], after[3][at]
    return signs


def decisions_of(contact: Contact, size: int, rng: np.random.Generator) -> tuple[I16, I16]:
    """Return the decisions of a stream of `size` bytes, of a random start step, and their signs.

    Returns:
        Rows of contexts, extra features, bit, network; rows of sign contexts, extra features, bit, orientation.
    """
    model, layout = shipped_model(), layout_of(*contact.pixels.shape)
    mean = min((int(contact.pixels.astype(np.int64).sum()) // contact.pixels.size + MEAN_STEP // 2) // MEAN_STEP, 63)
    plane = (contact.pixels.astype(np.int64) - mean * MEAN_STEP) * transform.UNIT
    target = target_coefficients(plane, layout, region_weights(layout, None), size, None)
    decisions: list[I16] = []
    signs: list[I16] = []
    original: Callable[..., int] = kernel.code_band

    def code_band(*args: Any) -> int:  # noqa: ANN401  those of `kernel.code_band`
        _, kind, number, threshold, row, low_width, _, _, bands, _, lows, f, state, *_ = args
        band = bands[row]
        arrays = (state[0], state[3], state[4], state[7])
        earlier, planes = tuple(a.copy() for a in arrays), state[5].copy()
        end = original(*args)
        cells = band[OFFSET] + np.arange(band[HEIGHT])[:, None] * band[STRIDE] + np.arange(band[WIDTH])
        y, x = np.nonzero((state[5][cells] == number) & (planes[cells] != number))
        if len(y):
            places = np.stack([y, x, cells[y, x]], 1).astype(np.int32)
            rows, sign_rows = (np.zeros((len(y), n + 2), np.int16) for n in (contexts.FEATURES, contexts.SIGN_FEATURES))
            count = _replay(places, earlier, arrays, lows, bands, low_width, threshold, row, f.copy(), rows, sign_rows)
            rows[:, -1], own = kind == kernel.REFINE, contact_features(contact, band.tolist(), y, x)
            decisions.append(np.concatenate([rows[:, :-2], own, rows[:, -2:]], 1))
            at, sign_rows = sign_rows[:count, -1].copy(), sign_rows[:count]
            sign_rows[:, -1] = band[ORIENT]
            signs.append(np.concatenate([sign_rows[:, :-2], own[at], sign_rows[:, -2:]], 1))
        return end

    with patch.object(kernel, "code_band", code_band):
        coder = Coder.writer(size)
        side = random_side_info(target.targets, mean, rng)
        code_planes(coder, CoefficientState(layout), model, target.targets, side, 20)
    return np.concatenate(decisions), np.concatenate(signs)


def thinned(rows: I16, rng: np.random.Generator) -> tuple[I16, Weights]:
    """Drop most of the zeros that no significant neighbour surrounds; return the others with their weights."""
    likely = (rows[:, _CLUES] != 0).any(1) | (rows[:, -2] != 0)
    kept = likely | (rng.random(len(rows)) < 1 / _THINNED)
    return rows[kept], np.where(likely[kept], 1, _THINNED).astype(np.float32)


def measure(
    training: Sequence[tuple[I16, Weights]], held_out: Mapping[str, tuple[I16, I16]], steps: int
) -> dict[str, npt.NDArray[np.float64]]:
    """Train without and with the extra features; return the bits of each held-out set.

    Args:
        training: Rows and weights of decisions, then of signs.
        held_out: Rows of decisions and of signs, by name.
        steps: Steps of the network of significance; the others take a third and a sixth of them.

    Returns:
        By name, shape (2, 2): without and with the features; decisions and signs.
    """
    import jax  # noqa: PLC0415  not a dependency
    import jax.numpy as jnp  # noqa: PLC0415

    from research.training.emb.train import fit, layer, network, sign_network  # noqa: PLC0415

    def signs_with_bias(p: dict[str, jax.Array], x: jax.Array) -> jax.Array:
        return sign_network(p, x) + layer(x[:, -EXTRAS:] / 16 @ p["w4"] + p["b4"]) @ p["w5"]

    def shipped(names: str, group: int, extra: int) -> dict[str, jax.Array]:
        shifts = {"w1": 10, "b1": 14, "w2": 12, "b2": 20, "w3": 12, "b3": 20}
        params = {name[-2:]: getattr(model, name)[group] / (1 << shifts[name[-2:]]) for name in names.split()}
        params["w1"] = np.pad(params["w1"], ((0, extra), (0, 0)))
        params |= {
            "w4": np.random.default_rng(group).normal(0, 0.3, (EXTRAS, 16)),
            "b4": np.zeros(16),
            "w5": np.zeros(16),
        }
        return {name: jnp.asarray(value, jnp.float32) for name, value in params.items()}

    def cost(function: Callable[..., jax.Array], p: dict[str, jax.Array], rows: I16, width: int) -> float:
        parts = [rows[at : at + (1 << 16)] for at in range(0, len(rows), 1 << 16)]
        logits = [function(p, part[:, :width].astype(np.float32)) * (1 - 2 * part[:, -2]) for part in parts]
        return sum(float(jnp.logaddexp(0, part).sum()) for part in logits) / float(np.log(2))

    model, bits = shipped_model(), {name: np.zeros((2, 2)) for name in held_out}
    plans = [(0, net, "w1 b1 w2 b2 w3 b3", steps // (1 + 2 * net)) for net in range(2)]
    plans += [(1, orient, "sign_w1 sign_b1 sign_w2", steps // 6) for orient in range(4)]
    for has_extras, extra in enumerate((0, EXTRAS)):
        for kind, group, names, count in plans:
            width = (contexts.FEATURES, contexts.SIGN_FEATURES)[kind] + extra
            function = (network, signs_with_bias if extra else sign_network)[kind]
            rows, weights = training[kind]
            own, rng = rows[:, -1] == group, np.random.default_rng(group)
            first, decay = shipped(names, group, extra), 1e-3 * kind
            trained = fit(
                function, first, rows[own][:, :width], rows[own, -2], weights[own], count, rng, 1.5e-3, decay=decay
            )
            for name, parts in held_out.items():
                bits[name][has_extras, kind] += cost(function, trained, parts[kind][parts[kind][:, -1] == group], width)
    return bits


def run(args: argparse.Namespace) -> int:
    """List the decisions of training and held-out images, train, print the bits."""
    rng = np.random.default_rng(7)
    listed: list[tuple[I16, Weights, I16]] = []
    for contact in (*sdvd_contacts(args.data, "train"), *simulated_contacts(SIMULATED[0])):
        rows, signs = decisions_of(contact, int(np.exp(rng.uniform(np.log(40), np.log(160)))), rng)
        listed.append((*thinned(rows, rng), signs))
    rows, weights, signs = (np.concatenate([part[i] for part in listed]) for i in range(3))
    print(f"{len(listed)} training images, {len(rows)} decisions, {len(signs)} signs", flush=True)
    held_out = {}
    for label, contacts in (
        ("SDVD", list(sdvd_contacts(args.data, "test"))), ("simulated", list(simulated_contacts(SIMULATED[1])))
    ):  # fmt: skip
        for budget in BUDGETS:
            pairs = [decisions_of(contact, budget, rng) for contact in contacts]
            name = f"{label}, {len(contacts)} images, {budget} B"
            held_out[name] = (np.concatenate([p[0] for p in pairs]), np.concatenate([p[1] for p in pairs]))
    training = ((rows, weights), (signs, np.ones(len(signs), np.float32)))
    for name, bits in measure(training, held_out, args.steps).items():
        without, own = bits.sum(1)
        print(f"{name}: {100 * (own / without - 1):+.2f} % of the bits; decisions, signs: {bits.round().tolist()}")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    parser = command_parser("training.emb.trials.contact_contexts", __doc__ or "")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=9000)
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    sys.exit(main())
