"""Create the initial model for training `structure`: a `standard` model with perceptual weights.

    python -m research.training.emb.structure \
        --model common/sonarpost/codec/emb/data/emb-2.model --out /tmp/emb/structure.model

The scales were chosen on validation images; see docs/explanation/codecs.md.
"""

import argparse
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb.model import CONTRASTS, FORMAT_3, read_arrays
from sonarpost.codec.emb.perceptual_weights import VARIANCE_OFFSET

LEVELS = (0.9, 0.3, 0.6, 1.0, 1.0, 0.9, 0.9)
"""Weights of the lowest band, then of the other bands of level 1 (the finest) to 6."""
EVEN_GREY2 = 800
"""Local variance with weight 1."""
POWER = 0.25
"""Power of the local variance by which the weight decreases; 0.5 would make all errors relative."""


def perceptual_arrays() -> dict[str, npt.NDArray[np.int32]]:
    """Return the additional arrays of a model with perceptual weights."""
    total = 2.0 ** (np.arange(CONTRASTS) / 8)
    contrast = 256 * ((EVEN_GREY2 + VARIANCE_OFFSET) / np.maximum(total, VARIANCE_OFFSET)) ** POWER
    return {
        "perceptual_levels": np.rint(256 * np.array(LEVELS)).astype(np.int32),
        "perceptual_contrast": np.rint(contrast).astype(np.int32),
    }


def main() -> None:
    """Read the model, add the arrays, write the result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    arrays = read_arrays(args.model.read_bytes()) | perceptual_arrays()
    args.out.write_bytes(
        FORMAT_3.magic + b"".join(arrays[name].astype(kind).tobytes() for name, _, kind in FORMAT_3.arrays)
    )


if __name__ == "__main__":
    main()
