"""The encoder's choice of the start step: it writes the picture with several and takes the one that shows it best."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb import transform
from sonarpost.codec.emb.bitplanes import STEPS, code_planes, extra_planes, known_plane
from sonarpost.codec.emb.coder import Coder, State
from sonarpost.codec.emb.decode import grey_of
from sonarpost.codec.emb.model import Model
from sonarpost.codec.emb.rate_distortion_opt import TargetCoefficients
from sonarpost.codec.emb.side_info import Box, SideInfo, write_side
from sonarpost.codec.emb.similarity import structural_similarity
from sonarpost.codec.interface import MAX_SIDE_PX

I64 = npt.NDArray[np.int64]

MAX_BODY_BYTES: Final = 0xFFFF
MAX_PIXELS: Final = MAX_SIDE_PX * MAX_SIDE_PX
_SMALL_PX: Final = 8000
SEARCHES: Final[tuple[tuple[int, int, tuple[int, ...], int], ...]] = (
    (96, MAX_PIXELS, (0, 2, 4, 6), 1),
    (319, _SMALL_PX, (0, 2, 4, 6), 0),
    (319, MAX_PIXELS, (0, 4), 1),
    (MAX_BODY_BYTES, _SMALL_PX, (0, 4), 2),
    (MAX_BODY_BYTES, MAX_PIXELS, (0, 4), 1),
)
"""Up to which length of the body and size of the picture which start steps are tried, and how many more beside the best
of them (`beside`): as many as keep the time for 140 x 80 px to about 100 ms."""


AIMED_SEARCHES: Final = (*SEARCHES[:-2], SEARCHES[-1])
"""The same of models with an aim: their longer streams go through more planes."""


@dataclass(frozen=True, eq=False)
class EncodedTrial:
    """A body.

    Attributes:
        error: What to make small. Squared error that stays, in the transform's units; of the coefficients where there
            is a region of interest, whose own error weighs more, else of the picture. Of a model with an aim, where
            there is no region of interest: minus the likeness of the pictures.
        body: The bytes.
        curve: See `Coder.curve`.
    """

    error: int
    body: bytes
    curve: I64


@dataclass(frozen=True)
class TrialEncoder:
    """Writes bodies of at most so many bytes.

    Attributes:
        model: The networks.
        limit: Most bytes of a body.
        price: See `kernel.code_band`.
        begin: What bodies shall begin with: all but the last byte of one that says what is written first.
    """

    model: Model
    limit: int
    price: int
    begin: bytes = b""

    def write(self, wanted: TargetCoefficients, side: SideInfo) -> EncodedTrial:
        """Write a body with the start step of `side`."""
        coder, state = Coder.writer(self.limit, self.begin), State(wanted.lay)
        coder.curve[0] = int((wanted.plain.astype(np.int64) ** 2).sum())
        write_side(coder, self.model, side)
        coder.record()
        code_planes(coder, state, self.model, wanted.targets, side, self.price, plain=wanted.plain)
        if side.box is not None:
            return EncodedTrial(int(coder.curve[0]), coder.finish(), coder.curve)
        shown, _ = transform.inverse(known_plane(state, self.model), wanted.lay)
        if self.model.aim is not None:
            error = -structural_similarity(
                *(grey_of(plane, side.mean).astype(np.int64) for plane in (wanted.plane, shown))
            )
        else:
            error = int(((wanted.plane - shown) ** 2).sum())
        return EncodedTrial(error, coder.finish(), coder.curve)

    def best(
        self,
        wanted: TargetCoefficients,
        mean_index: int,
        box: Box | None,
        grain: tuple[int, ...] | None,
        steps: tuple[int, ...] = (),
    ) -> EncodedTrial:
        """Write bodies with several start steps and return the one with the least error.

        Args:
            wanted: What to encode.
            mean_index: See `SideInfo`.
            box: Region of interest.
            grain: See `SideInfo`.
            steps: Start steps to try; none: as many as the time allows, see `SEARCHES`.
        """
        pixels = wanted.plane.size
        searches = SEARCHES if self.model.aim is None else AIMED_SEARCHES
        first, more = next(
            (first, more) for longest, largest, first, more in searches if self.limit <= longest and pixels <= largest
        )
        if steps:
            first, more = steps, 0
        found: dict[int, EncodedTrial] = {}
        for i in range(len(first) + more):
            step = first[i] if i < len(first) else beside({at: written.error for at, written in found.items()})
            side = SideInfo(mean_index, step, box, grain, extra_planes(wanted.targets, step))
            found[step] = self.write(wanted, side)
        return min(found.values(), key=lambda written: written.error)


def beside(errors: dict[int, int]) -> int:
    """Return the step to try next: beside the best so far, on the side where the error is less, if known.

    The error is much like a wave over the steps: eight of them halve the threshold, and so come back to the first.
    """
    count = len(STEPS)
    for step in sorted(errors, key=lambda tried: (errors[tried], tried)):
        sides = [(step + way) % count for way in (-1, 1) if (step + way) % count not in errors]
        if sides:
            return min(sides, key=lambda side: _mean([errors[n] for n in _neighbours(side, count) if n in errors]))
    return min(errors, key=lambda tried: (errors[tried], tried))  # all have been tried


def _neighbours(step: int, count: int) -> tuple[int, int]:
    return (step - 1) % count, (step + 1) % count


def _mean(values: list[int]) -> int:
    return sum(values) // len(values)
