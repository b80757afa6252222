"""From a body to a picture: what a stream says, its coefficients, and the picture before and after the enhancer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sonarpost.codec.emb import transform
from sonarpost.codec.emb.bitplanes import code_planes, known_plane, situation
from sonarpost.codec.emb.coder import Coder, State
from sonarpost.codec.emb.enhance import enhanced
from sonarpost.codec.emb.layout import Layout
from sonarpost.codec.emb.model import Model
from sonarpost.codec.emb.side_info import SideInfo, read_side
from sonarpost.codec.interface import Image, Mask
from sonarpost.errors import StreamError


@dataclass(frozen=True, eq=False)
class DecodedCoefficients:
    """A picture before the enhancer.

    Attributes:
        plane: Shape (height_px, width_px), int64, 1/64 grey, without the mean.
        mean: Grey.
        situation: See `planes.situation`.
    """

    plane: npt.NDArray[np.int64]
    mean: int
    situation: tuple[int, int, int]


def read_body(body: bytes, lay: Layout, model: Model) -> tuple[State, SideInfo]:
    """Return what a body says of the coefficients, and its side information.

    Args:
        body: Any bytes; as much of it as there is.
        lay: Layout of the picture's size.
        model: The one it was made with.
    """
    coder, state = Coder.reader(body), State(lay)
    side = read_side(coder, model)
    if side.step >= 0:
        code_planes(coder, state, model, np.zeros(lay.cells, np.int32), side)
    return state, side


def plain_of(state: State, side: SideInfo, model: Model) -> DecodedCoefficients:
    """Return the picture that the coefficients say."""
    plane, _ = transform.inverse(known_plane(state, model, side.box), state.lay)
    return DecodedCoefficients(plane, side.mean, situation(state, side.mean))


def grey_of(plane: npt.NDArray[np.int64], mean: int) -> Image:
    """Return a plane without its mean, 1/64 grey, as a picture."""
    return np.clip((plane + transform.UNIT // 2) // transform.UNIT + mean, 0, 255).astype(np.uint8)


def picture_of(state: State, side: SideInfo, model: Model) -> Image:
    """Return the picture with what the model knows of what the coefficients do not say."""
    plain = plain_of(state, side, model)
    plane = enhanced(plain.plane, plain.mean, plain.situation, model)
    return grey_of(plane, plain.mean)


def usable(body: bytes, received: Mask | None) -> tuple[bytes, tuple[str, ...]]:
    """Return the bytes before the first that did not arrive, and a note if there is one.

    Raises:
        StreamError: `received` has another shape than the body.
    """
    if received is None:
        return body, ()
    if received.shape != (len(body),):
        raise StreamError("stream", "received", received.shape, f"one value for each of {len(body)} body bytes")
    lost = np.flatnonzero(~received)
    if not lost.size:
        return body, ()
    return body[: lost[0]], (f"{len(body) - int(lost[0])} of {len(body)} bytes are lost or follow a lost one",)
