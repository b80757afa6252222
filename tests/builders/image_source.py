"""Outbox of a test that sends coded images to the relay, and images for it."""

from functools import cache, lru_cache

import numpy as np

from sonarpost import keys, wire
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.config import ServiceConfig
from sonarpost.messages import CodedImage, Pixels
from sonarpost.runtime.service import Service, UnitOfWork

VESSEL = "vessel-1"
MAX_STREAM_BYTES = 60_000


RECEIVED_BYTES = 60
"""Byte of the stream that is lost; the decoder does not use those after it, so that long streams decode fast too."""


@cache
def _emb():
    return default_registry().create("emb", CodecResources(strength=0.0))


@cache
def _stream_start(shape):
    """Return the header and the first bytes of the body; any bytes can follow."""
    return _emb().encode(np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8), 24)


def make_image(number, shape=(24, 32), mission=0, version=1):
    """Return a coded image of about one byte for each pixel, unique for number, mission and version."""
    rng = np.random.default_rng([mission, number, version])
    start = _stream_start(shape)
    length = min(shape[0] * shape[1], MAX_STREAM_BYTES)
    stream = start + rng.bytes(RECEIVED_BYTES - len(start)) + b"\0" + rng.bytes(length - RECEIVED_BYTES - 1)
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
        missing=((RECEIVED_BYTES, RECEIVED_BYTES + 1),),
        missing_halves=(),
        complete=False,
        bytes_received=len(stream) - 1,
        bytes_total=len(stream),
        frames_received=1,
        conflicts=0,
        first_frame_utc_s=at_s,
        last_frame_utc_s=at_s,
        authenticated=True,
        codec="emb",
        model="",
    )


def pixels_sha256(image):
    """Return the digest of the pixels of a coded image."""
    return _pixels_sha256(image.stream)


@lru_cache(maxsize=1024)
def _pixels_sha256(stream):
    return Pixels.from_array(_emb().decode(stream[:RECEIVED_BYTES]).image).sha256


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
