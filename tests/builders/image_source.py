"""Outbox of a test that sends coded images to the relay, and images for it."""

from functools import cache, lru_cache

import numpy as np

from sonarpost import keys, wire
from sonarpost.codec.interface import StreamHeader, model_tag
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.codec.vq.codebook import open_codebook
from sonarpost.config import ServiceConfig
from sonarpost.messages import CodedImage, Pixels
from sonarpost.runtime.service import Service, UnitOfWork

VESSEL = "vessel-1"
MAX_STREAM_BYTES = 60_000


@cache
def _codec():
    """Return vq: any bytes are indices of tiles, and long streams are decoded fast."""
    return default_registry().create("vq", CodecResources(open_codebook("nominal-10").tiles))


def make_image(number, shape=(24, 32), mission=0, version=1):
    """Return a coded image of about one byte for each pixel, unique for number, mission and version."""
    rng = np.random.default_rng([mission, number, version])
    codec_id = _codec().codec_id
    start = StreamHeader(codec_id, model_tag(codec_id, _codec().model_hash), *shape).pack()
    stream = start + rng.bytes(min(shape[0] * shape[1], MAX_STREAM_BYTES) - len(start))
    at_s = 1.0e9 + 86400.0 * mission + number
    return CodedImage(
        vessel_id=VESSEL,
        vehicle_id=f"uuv-{number % 3 + 1}",
        image_id=f"{number:04d}",
        version=version,
        contact=None,
        height_px=shape[0],
        width_px=shape[1],
        stream=stream,
        missing=(),
        missing_halves=(),
        complete=True,
        bytes_received=len(stream),
        bytes_total=len(stream),
        frames_received=1,
        conflicts=0,
        first_frame_utc_s=at_s,
        last_frame_utc_s=at_s,
        authenticated=True,
        codec="vq",
        model="",
    )


def pixels_sha256(image):
    """Return the digest of the pixels of a coded image."""
    return _pixels_sha256(image.stream)


@lru_cache(maxsize=1024)
def _pixels_sha256(stream):
    return Pixels.from_array(_codec().decode(stream).image).sha256


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
            self._on_stored(wire.decode(CodedImage, item.payload, item.key))

    def handle(self, key, record, effects):
        raise AssertionError("the source consumes nothing")

    def send(self, images):
        """Queue images for the relay."""
        effects = UnitOfWork()
        for image in images:
            effects.send(keys.image_coded(VESSEL), "relay", image, priority=5)
        self.commit(effects)
