"""A waterfall with its contacts drawn in, for people."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

from sonarpost.detection.contacts import MINE_LIKE, Detection
from sonarpost.detection.snippet import to_grey
from sonarpost.sonar.survey import Side, Survey

_COLOURS = {MINE_LIKE: (255, 80, 60)}
_OTHER_COLOUR = (255, 210, 60)
_MARGIN_PX = 6


def annotated_waterfall(survey: Survey, detections: Sequence[Detection]) -> Image.Image:
    """Draw a survey as an operator sees it: port to the left, the vehicle's track in the middle, first ping on top.

    Each contact is framed from its highlight to its shadow's end, red when mine-like, yellow otherwise, with its place
    in `detections` (from 1) and its confidence.

    Returns:
        RGB picture, one row a ping, one column a sample; 1 x 1 for a survey without samples.
    """
    halves = {side: _grey(survey, side) for side in survey.sides()}
    if not halves or not survey.pings:
        return Image.new("RGB", (1, 1))
    track = halves[Side.PORT].shape[1] if Side.PORT in halves else 0
    pieces = [image[:, ::-1] if side is Side.PORT else image for side, image in halves.items()]
    picture = Image.fromarray(np.hstack(pieces)).convert("RGB")
    draw = ImageDraw.Draw(picture)
    for number, detection in enumerate(detections, start=1):
        near = detection.highlight_samples[0] - _MARGIN_PX
        far = detection.highlight_samples[1] + detection.shadow_samples + _MARGIN_PX
        left, right = (track - far, track - near) if detection.side is Side.PORT else (track + near, track + far)
        top, bottom = detection.highlight_pings[0] - _MARGIN_PX, detection.highlight_pings[1] + _MARGIN_PX
        colour = _COLOURS.get(detection.atd_class, _OTHER_COLOUR)
        draw.rectangle((left, top, right, bottom), outline=colour)
        draw.text((left, bottom + 1), f"{number}: {detection.confidence:.2f}", fill=colour)
    return picture


def _grey(survey: Survey, side: Side) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    image = survey.waterfall(side)
    known = np.isfinite(image)
    return to_grey(np.where(known, image, 0.0).astype(np.uint32), known)
