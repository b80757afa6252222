"""Outbox of a test that sends images to the relay, and images for it."""

import numpy as np

from builders.records import reconstructed_image
from sonarpost import keys, wire
from sonarpost.config import ServiceConfig
from sonarpost.messages import Pixels, ReconstructedImage
from sonarpost.runtime.service import Service, UnitOfWork

VESSEL = "vessel-1"


def make_image(number, shape=(24, 32), mission=0, version=1):
    """Return an image of noise, unique for number, mission and version."""
    rng = np.random.default_rng([mission, number, version])
    pixels = Pixels.from_array(rng.integers(0, 256, shape, dtype=np.uint8))
    return reconstructed_image(
        pixels,
        vehicle_id=f"uuv-{number % 3 + 1}",
        image_id=f"{number:04d}",
        version=version,
        first_frame_utc_s=1.0e9 + 86400.0 * mission + number,
        last_frame_utc_s=1.0e9 + 86400.0 * mission + number,
    )


class ImageSource(Service[ServiceConfig]):
    """Outbox of a test in place of the decompressor.

    Args:
        acknowledged: Called with each image that the relay has acknowledged.
    """

    NAME = "source"

    def __init__(self, platform, acknowledged):
        super().__init__(platform, ServiceConfig())
        self._on_stored = acknowledged

    def on_acknowledged(self, tx, item, reason):
        if reason is None:
            self._on_stored(wire.decode(ReconstructedImage, item.payload, item.key))

    def handle(self, key, record, effects):
        raise AssertionError("the source consumes nothing")

    def send(self, images):
        """Queue images for the relay."""
        effects = UnitOfWork()
        for image in images:
            effects.send(keys.image_reconstructed(VESSEL), "relay", image, priority=5)
        self.commit(effects)
