"""Pictures for the benches: noise, so that nothing on the way can make them smaller, and none twice."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sonarpost.messages import Pixels, ReconstructedImage

SHAPE = (100, 300)
"""Height and width in pixels: 30 kB."""


def noise_picture(
    vessel_id: str, vehicle_id: str, image_id: str, seed: int | Sequence[int], first_frame_utc_s: float
) -> ReconstructedImage:
    """Return a picture that has arrived whole; the same seed gives the same pixels."""
    raster = Pixels.from_array(np.random.default_rng(seed).integers(0, 256, SHAPE, dtype=np.uint8))
    return ReconstructedImage(
        vessel_id=vessel_id,
        vehicle_id=vehicle_id,
        image_id=image_id,
        version=1,
        contact=None,
        codec="vq",
        model="",
        picture=raster,
        picture_sha256=raster.sha256,
        complete=True,
        missing_fraction=0.0,
        missing_mask=b"",
        missing_halves=(),
        bytes_received=232,
        bytes_total=232,
        frames_received=6,
        first_frame_utc_s=first_frame_utc_s,
        last_frame_utc_s=first_frame_utc_s,
    )
