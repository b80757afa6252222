"""Train the network and write its integer weights.

    python -m research.training.despeckle.train --scenes /tmp/despeckle/scenes.npz --out /tmp/despeckle/network.pt

Requires PyTorch (CPU), which is not a dependency of the package. The loss is the squared error against the scene
without speckle, so that the network estimates the conditional mean.
"""

import argparse
import copy
import math
import multiprocessing
import time
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from research.training.despeckle.scenes import Examples
from sonarpost.codec.emb.despeckle import ACTIVATION_LIMIT, DILATIONS, INPUT_LIMIT

BATCH: Final = 16
HALF, QUARTER = 32, 64
"""Channels at half and at a quarter of the size."""
LAYERS: Final = (
    (4, HALF, 3),
    (HALF, HALF, 3),
    (4 * HALF, QUARTER, 1),
    *[(QUARTER, QUARTER, 3)] * 6,
    (QUARTER, 4 * HALF, 1),
    (HALF, HALF, 3),
    (HALF, HALF, 3),
    (HALF, 4, 3),
)
"""Inputs, outputs and side of each layer, in the order of `sonarpost.codec.emb.despeckle`."""
_INPUT_GAIN: Final = 4.0
_CALIBRATION: Final = 24 * BATCH


class Network(nn.Module):  # type: ignore[misc]  # torch has no types here
    """The network in floating point; see `sonarpost.codec.emb.despeckle` for the integer version."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            nn.Conv2d(inputs, outputs, side, dilation=dilation, padding=dilation * (side // 2))
            for (inputs, outputs, side), dilation in zip(LAYERS, DILATIONS, strict=True)
        )
        for i in range(2, 10):
            nn.init.kaiming_normal_(self.layers[i].weight, nonlinearity="relu")
            nn.init.zeros_(self.layers[i].bias)
        for i in (4, 6, 8, 9):  # what is added to a sum starts small
            self.layers[i].weight.data *= 0.1
        self.activations: list[torch.Tensor] = []

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the estimate for images of shape (n, height, width), 0..1, sides multiples of 4."""
        first, second, down, *pairs, up, third, fourth, last = self.layers
        mean = image.mean((1, 2), keepdim=True)
        a = functional.relu(first(functional.pixel_unshuffle((image - mean)[:, None] * _INPUT_GAIN, 2)))
        b = functional.relu(second(a))
        q = down(functional.pixel_unshuffle(b, 2))
        seen = [a, b, q]
        for inner, outer in zip(pairs[::2], pairs[1::2], strict=True):
            hidden = functional.relu(inner(q))
            q = q + outer(hidden)
            seen += [hidden, q]
        c = functional.relu(b + functional.pixel_shuffle(up(q), 2))
        d = functional.relu(third(c)) + c
        e = functional.relu(fourth(d))
        self.activations = [v.detach() for v in (*seen, c, d, e)]
        return image + functional.pixel_shuffle(last(e), 2)[:, 0] / _INPUT_GAIN


def batch_of(examples: Examples) -> tuple[torch.Tensor, ...]:
    """Return noisy images, clean images and weights."""
    drawn = zip(*(examples.draw() for _ in range(BATCH)), strict=True)
    return tuple(torch.from_numpy(np.asarray(part, np.float32)) for part in drawn)


def _feed(queue: Any, scenes: Path, seed: int) -> None:  # noqa: ANN401  multiprocessing has no type for it
    examples = Examples(scenes, seed)
    while True:
        queue.put(batch_of(examples))


def train(scenes: Path, start: Path | None, out: Path, steps: int, rate: float, seed: int) -> Network:
    """Train; write the averaged weights every 250 steps."""
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    queue: Any = multiprocessing.Queue(24)
    multiprocessing.Process(target=_feed, args=(queue, scenes, seed), daemon=True).start()
    network = Network()
    if start is not None:
        network.load_state_dict(torch.load(start))
    average = copy.deepcopy(network)
    optimiser = torch.optim.Adam(network.parameters(), rate)
    losses: list[float] = []
    started_s = time.monotonic()
    for step in range(steps):
        now = rate * min(1.0, (step + 1) / 400) * 0.5 * (1 + math.cos(math.pi * step / steps)) + 1e-6
        optimiser.param_groups[0]["lr"] = now
        noisy, clean, weight = queue.get()
        loss = (((network(noisy) - clean) ** 2).mean((1, 2)) * weight).mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        keep = min(0.998, step / (step + 20))
        with torch.no_grad():
            for mean, new in zip(average.parameters(), network.parameters(), strict=True):
                mean.mul_(keep).add_(new, alpha=1 - keep)
        losses.append(float(loss))
        if step % 250 == 249 or step == steps - 1:
            error = 255 * math.sqrt(float(np.mean(losses[-250:])))
            print(f"{step + 1}: {error:.2f} grey levels rms, {time.monotonic() - started_s:.0f} s", flush=True)
            torch.save(average.state_dict(), out)
    return average


def integer_arrays(network: Network, images: torch.Tensor) -> dict[str, np.ndarray]:
    """Return the arrays of the weights file; the activations' scales come from images."""
    with torch.no_grad():
        network(images)
    scales = [1.1 * float(seen.abs().max()) / ACTIVATION_LIMIT for seen in network.activations] + [1.0]
    out = {"activation_scales": np.array(scales)}
    blocks = {2: "inputs", 9: "outputs"}  # layers next to blocks of 2 x 2 cells, whose channels have another order
    order = np.array([channel * 4 + place for place in range(4) for channel in range(HALF)])
    for i, layer in enumerate(network.layers):
        weights = layer.weight.detach().numpy().transpose(2, 3, 1, 0).astype(np.float64)
        bias = layer.bias.detach().numpy().astype(np.float64)
        if blocks.get(i) == "inputs":
            weights = weights[:, :, order]
        elif blocks.get(i) == "outputs":
            weights, bias = weights[..., order], bias[order]
        limit, unit = (INPUT_LIMIT, _INPUT_GAIN / 255) if i == 0 else (ACTIVATION_LIMIT, scales[i - 1])
        room = 2**31 / limit - np.prod(weights.shape[:3])
        factor = np.minimum(room / np.abs(weights).sum((0, 1, 2)), 32000 / np.abs(weights).max((0, 1, 2)))
        grey = 255 / _INPUT_GAIN if i == len(LAYERS) - 1 else 1.0
        out[f"weights{i}"] = np.rint(weights * factor).astype(np.int16)
        out[f"scale{i}"] = unit / factor * grey
        out[f"bias{i}"] = bias * grey
    return out


def main() -> None:
    """Train, round, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=Path, required=True, help="file of research.training.despeckle.scenes")
    parser.add_argument("--start", type=Path, help="weights to continue from (default: random)")
    parser.add_argument("--steps", type=int, default=12000, help="0 writes the integers of --start")
    parser.add_argument("--rate", type=float, default=1.2e-3)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--out", type=Path, required=True, help="floating-point weights; integers beside it as .npz")
    args = parser.parse_args()
    network = train(args.scenes, args.start, args.out, args.steps, args.rate, args.seed)
    examples = Examples(args.scenes, args.seed + 1)
    noisy = torch.cat([batch_of(examples)[0] for _ in range(_CALIBRATION // BATCH)])
    np.savez_compressed(args.out.with_suffix(".npz"), allow_pickle=False, **integer_arrays(network, noisy))


if __name__ == "__main__":
    main()
