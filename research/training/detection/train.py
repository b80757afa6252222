"""Train the network of the classifier.

    python -m research.training.detection.train --examples /tmp/detection/examples.npz --out /tmp/detection/network.npz

Requires PyTorch (CPU), which is not a dependency of the package. Each step draws the same number of examples of each
class, by source in the shares of `SOURCE_SHARES`, and changes them at random: mirror along-track, gain, contrast,
noise, unknown borders, unknown geometry. The loss is the cross-entropy with smoothed labels. The result is an
exponential moving average of the weights. `--start` continues from weights that exist.
"""

import argparse
import time
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch
from torch import nn
from torch.nn import functional

from research.training.detection.calibrate import write_classifier
from research.training.detection.examples import Examples
from sonarpost.detection.chips import COARSE_CENTRE, COARSE_STEP, FINE_CENTRE
from sonarpost.detection.classifier import (
    CLASSES,
    COARSE_CHANNELS,
    FINE_CHANNELS,
    Classifier,
    load_classifier,
    weight_shapes,
)

STEPS: Final = 14_000
BATCH: Final = 96
LEARNING_RATE: Final = 2e-3
AVERAGE: Final = 0.998
SMOOTHING: Final = 0.02
CLASS_SHARES: Final = (0.5, 0.2, 0.3)
SOURCE_SHARES: Final = (0.45, 0.22, 0.05, 0.18, 0.1)
"""Share of the examples of each source: simulated, SDVD, recordings, simulated objects in real seabed, hard ones."""
_SCALE: Final = 1 / 30.0


class Network(nn.Module):  # type: ignore[misc]  # torch has no types here
    """The network of `sonarpost.detection.classifier`; planes are (examples, planes, rows, columns) here."""

    def __init__(self) -> None:
        super().__init__()
        self.parameters_by_name = nn.ParameterDict()
        for name, shape in weight_shapes().items():
            if name == "calibration":
                continue
            value = torch.zeros(shape)
            if not name.endswith("_bias"):
                fan_in = int(np.prod(shape[:-1]))
                value = torch.randn(shape) * (2.0 / fan_in) ** 0.5 * (0.1 if name == "output" else 1.0)
            self.parameters_by_name[name] = nn.Parameter(value)

    def forward(self, fine: torch.Tensor, coarse: torch.Tensor, geometry: torch.Tensor, drop: float) -> torch.Tensor:
        """Return the outputs, shape (examples, 3); `drop` is the share of hidden inputs that are left out."""
        for number in range(len(FINE_CHANNELS)):
            fine = self._convolution(fine, f"fine{number}")
            fine = functional.max_pool2d(fine, 2) if number < len(FINE_CHANNELS) - 1 else fine
        for number in range(len(COARSE_CHANNELS)):
            coarse = functional.max_pool2d(self._convolution(coarse, f"coarse{number}"), 2)
        p = self.parameters_by_name
        parts = [plane.permute(0, 2, 3, 1).flatten(1) for plane in (fine, coarse)]
        inputs = functional.dropout(torch.cat([*parts, geometry], dim=1), drop, self.training)
        return torch.relu(inputs @ p["hidden"] + p["hidden_bias"]) @ p["output"] + p["output_bias"]

    def _convolution(self, planes: torch.Tensor, name: str) -> torch.Tensor:
        p = self.parameters_by_name
        kernel = p[name].permute(3, 2, 0, 1)
        return torch.relu(functional.conv2d(planes, kernel, p[f"{name}_bias"], padding=1))


def indices_by_class_and_source(examples: Examples) -> list[list[npt.NDArray[np.int64]]]:
    """Return the examples of each class and source."""
    return [
        [np.flatnonzero((examples.label == label) & (examples.source == s)) for s in range(len(SOURCE_SHARES))]
        for label in range(CLASSES)
    ]


def drawn_batch(table: list[list[npt.NDArray[np.int64]]], rng: np.random.Generator) -> npt.NDArray[np.int64]:
    """Return the indices of a batch: classes by `CLASS_SHARES`, sources by `SOURCE_SHARES` where they have examples."""
    chosen = []
    present = np.array([any(map(len, parts)) for parts in table]) * np.array(CLASS_SHARES)
    for label in rng.choice(CLASSES, size=BATCH, p=present / present.sum()):
        shares = np.array(
            [share if len(part) else 0.0 for share, part in zip(SOURCE_SHARES, table[label], strict=True)]
        )
        part = table[label][int(rng.choice(len(shares), p=shares / shares.sum()))]
        chosen.append(int(part[rng.integers(len(part))]))
    return np.array(chosen)


def augmented(
    examples: Examples, chosen: npt.NDArray[np.int64], rng: np.random.Generator
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return fine plane, coarse plane and geometry of examples after random changes."""
    fine = examples.fine[chosen].astype(np.float32) * np.float32(_SCALE)
    coarse = examples.coarse[chosen].astype(np.float32) * np.float32(_SCALE)
    geometry = examples.geometry[chosen].copy()
    count = len(chosen)
    mirrored = rng.random(count) < 0.5
    fine[mirrored], coarse[mirrored] = fine[mirrored, ::-1], coarse[mirrored, ::-1]
    contrast = rng.uniform(0.75, 1.3, (count, 1, 1)).astype(np.float32)
    gain = (rng.standard_normal((count, 1, 1)) * 0.12).astype(np.float32)
    slope = (rng.standard_normal((count, 1, 1)) * 0.1).astype(np.float32)
    columns = np.linspace(-1, 1, fine.shape[2], dtype=np.float32)[None, None]
    noise = rng.standard_normal(fine.shape[:3]).astype(np.float32)
    noise *= (rng.random((count, 1, 1)) ** 2 * 0.35).astype(np.float32)
    fine[..., 0] = np.clip(fine[..., 0] * contrast + gain + slope * columns + noise, -2, 2) * (fine[..., 1] > 0)
    coarse[..., 0] = np.clip(coarse[..., 0] * contrast + gain, -2, 2) * (coarse[..., 2] > 0)
    coarse[..., 1] = np.clip(coarse[..., 1] * contrast + np.abs(noise).mean(axis=(1, 2))[:, None, None] * 0.3, 0, 2)
    coarse[..., 1] *= coarse[..., 2] > 0
    for index in np.flatnonzero(rng.random(count) < 0.25):  # the border of an image or of the recording
        _hide_border(fine[index], coarse[index], rng)
    geometry[rng.random(count) < 0.3, :4] = 0.0
    geometry[:, 4] *= rng.uniform(0.8, 1.25, count)
    planes = (torch.from_numpy(np.ascontiguousarray(plane.transpose(0, 3, 1, 2))) for plane in (fine, coarse))
    return next(planes), next(planes), torch.from_numpy(geometry)


def _hide_border(fine: npt.NDArray[np.float32], coarse: npt.NDArray[np.float32], rng: np.random.Generator) -> None:
    """Make the chip unknown beyond a line on one of its four sides, which may cut the object itself."""
    axis, is_before = int(rng.integers(2)), bool(rng.integers(2))
    # Distance of the line from the centre in fine pixels; before the object along-track, highlight and shadow remain.
    distance = int(rng.integers(1, 50)) if axis == 0 else int(rng.integers(10, 40))
    for plane, centre, step in ((fine, FINE_CENTRE, 1), (coarse, COARSE_CENTRE, COARSE_STEP)):
        offset = (np.arange(plane.shape[axis]) - centre[axis]) * step
        keep = (offset >= -distance if is_before else offset <= distance).astype(np.float32)
        np.multiply(plane, keep[:, None, None] if axis == 0 else keep[None, :, None], out=plane)


def train(
    examples: Examples, steps: int, seed: int, start: Classifier | None = None, rate: float = LEARNING_RATE
) -> Classifier:
    """Train a network and return it with a neutral calibration.

    Args:
        examples: The examples.
        steps: Number of batches.
        seed: Seed of all random draws.
        start: Weights to continue from; None for random ones.
        rate: Greatest learning rate.
    """
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    network = Network()
    if start is not None:
        for name, parameter in network.parameters_by_name.items():
            parameter.data = torch.tensor(start.weights[name])
    average = {name: parameter.detach().clone() for name, parameter in network.parameters_by_name.items()}
    optimiser = torch.optim.AdamW(network.parameters(), lr=rate, weight_decay=3e-3)
    table = indices_by_class_and_source(examples)
    started_s, total = time.monotonic(), 0.0
    network.train()
    for step in range(1, steps + 1):
        for group in optimiser.param_groups:
            group["lr"] = rate * min(1.0, step / 200) * 0.5 * (1 + np.cos(np.pi * step / steps))
        chosen = drawn_batch(table, rng)
        outputs = network(*augmented(examples, chosen, rng), 0.3)
        label = torch.tensor(examples.label[chosen].astype(np.int64))
        loss = functional.cross_entropy(outputs, label, label_smoothing=SMOOTHING)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        decay = min(AVERAGE, (1 + step) / (10 + step))
        for name, parameter in network.parameters_by_name.items():
            average[name].mul_(decay).add_(parameter.detach(), alpha=1 - decay)
        total += float(loss)
        if step % 500 == 0:
            print(f"step {step}: loss {total / 500:.4f}, {time.monotonic() - started_s:.0f} s", flush=True)
            total = 0.0
    return classifier_of(average)


def classifier_of(parameters: dict[str, Any]) -> Classifier:
    """Return parameters as a classifier with a neutral calibration."""
    weights = {name: np.array(value.numpy(), dtype=np.float32) for name, value in parameters.items()}
    return Classifier({**weights, "calibration": np.array([1, 0, 0, 0], dtype=np.float32)})


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--examples", type=Path, nargs="+", required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--start", type=Path, help="continue from these weights")
    arguments = parser.parse_args()
    start = None if arguments.start is None else load_classifier(arguments.start)
    examples = Examples.joined([Examples.load(path) for path in arguments.examples])
    classifier = train(examples, arguments.steps, arguments.seed, start)
    write_classifier(classifier, arguments.out)
    print(f"{arguments.out}: identity {classifier.identity}")


if __name__ == "__main__":
    main()
