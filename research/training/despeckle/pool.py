r"""Create the training images of the model for despeckled images.

    python -m research.training.despeckle.pool --pool /tmp/emb/pool.npz --scenes /tmp/despeckle/scenes.npz \
        --out /tmp/despeckle/pool.npz

Replaces most images of a pool of `research.training.emb.pool` by simulated ones, and despeckles all. `truth_NAME` holds
the scene of each image: the simulated one, else the estimate. The enhancer of the decoder is trained against it.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from research.common.command import command_parser, run_command
from research.training.despeckle.scenes import Examples
from sonarpost.codec.emb.despeckle import despeckled

SEED: Final = 4
_SIMULATED: Final = 0.65

Grey = npt.NDArray[np.uint8]


def run(args: argparse.Namespace) -> int:
    """Write the pool."""
    rng, examples = np.random.default_rng(SEED), Examples(args.scenes, SEED)
    out: dict[str, Grey] = {}
    with np.load(args.pool) as pool:
        for name in pool.files:
            images, truths = [], []
            for image in pool[name]:
                if rng.random() < _SIMULATED:
                    noisy, clean = examples.simulated(image.shape)
                    images.append(despeckled(_grey(noisy)))
                    truths.append(_grey(clean))
                else:
                    images.append(despeckled(image))
                    truths.append(images[-1])
            out[name], out[f"truth_{name}"] = np.stack(images), np.stack(truths)
    np.savez(args.out, allow_pickle=False, **out)
    return 0


def _grey(image: npt.NDArray[np.float32]) -> Grey:
    return np.rint(255 * image).astype(np.uint8)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = command_parser("training.despeckle.pool", __doc__ or "")
    parser.add_argument("--pool", type=Path, required=True)
    parser.add_argument("--scenes", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    sys.exit(main())
