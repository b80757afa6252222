"""Make the model that training for `emb-structure` begins with: one of `emb`, and the aim beside it.

    python -m research.training.emb.structure \
        --model common/sonarpost/codec/emb/data/emb-2.model --out /tmp/emb/structure.model

The scales were chosen on validation pictures; see docs/explanation/codecs.md.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb.model import AIMED, read_arrays
from sonarpost.codec.emb.perceptual_weights import CONTRASTS, STILL_GREY2

LEVELS = (0.9, 0.3, 0.6, 1.0, 1.0, 0.9, 0.9)
"""Of the lowest band, then of the other bands of level 1 (the finest) to 6."""
EVEN_GREY2 = 800
"""Local variance whose scale is 1."""
POWER = 0.25
"""The scale falls with this power of the local variance: half of what would make all errors relative ones."""


def aim_arrays() -> dict[str, npt.NDArray[np.int32]]:
    """The arrays that a model with an aim has beside the others."""
    total = 2.0 ** (np.arange(CONTRASTS) / 8)
    contrast = 256 * ((EVEN_GREY2 + STILL_GREY2) / np.maximum(total, STILL_GREY2)) ** POWER
    return {
        "aim_levels": np.rint(256 * np.array(LEVELS)).astype(np.int32),
        "aim_contrast": np.rint(contrast).astype(np.int32),
    }


def main() -> None:
    """Read, add, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    arrays = read_arrays(args.model.read_bytes()) | aim_arrays()
    args.out.write_bytes(AIMED.magic + b"".join(arrays[name].astype(kind).tobytes() for name, _, kind in AIMED.arrays))


if __name__ == "__main__":
    main()
