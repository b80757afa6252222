"""Codes and decodes with every codec, so that what is compiled on first use is compiled while the image is built.

Fails where a codec does not work, where something of sonarpost cannot be imported, or where nothing was compiled: an
image that was trimmed too far is not to be made.
"""

from __future__ import annotations

import importlib
import os
import pkgutil
from collections.abc import Iterable
from pathlib import Path

import numpy as np

import sonarpost
from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.codec.interface import Image
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.codec.vq.codebook import open_codebook

# Nobody installs plots on a vehicle.
OPTIONAL = ("matplotlib", "pillow_jxl")


def pictures() -> Iterable[Image]:
    """Return pictures that lead through every path: texture, a target and its shadow, an area without data."""
    noise = np.random.default_rng(1)
    for bits in (8, 16):
        picture = noise.gamma(4.0, 25.0, size=(80, 140))
        picture[30:36, 60:70] *= 3
        picture[30:36, 70:100] *= 0.1
        scaled = np.clip(picture, 0, 255) * (257 if bits == 16 else 1)
        yield scaled.astype(np.uint16 if bits == 16 else np.uint8)
        empty = scaled.copy()
        empty[:, :20] = 0
        yield empty.astype(np.uint16 if bits == 16 else np.uint8)


def code(picture: Image) -> None:
    """Encode and decode with all codecs of the registry that are installed."""
    registry = default_registry()
    tiles = open_codebook("nominal-10").tiles
    for name in registry.names():
        codec = registry.create(name, CodecResources(tiles))
        # The comparison codecs cannot always squeeze a picture into a small budget.
        stream = codec.encode(picture, 2048 if name != "vq" else None)
        assert codec.decode(stream).image.shape == picture.shape, name
    emb = EmbCodec(grain=True)
    stream = emb.encode(picture, 128)
    emb.decode_with_grain(stream)
    emb.decode(stream[:40])


def import_everything() -> None:
    """Import every module of the library and the services."""
    for module in pkgutil.walk_packages(sonarpost.__path__, "sonarpost."):
        if module.name.endswith("__main__"):
            continue
        try:
            importlib.import_module(module.name)
        except ModuleNotFoundError as error:
            if error.name is None or not error.name.startswith(OPTIONAL):
                raise


def main() -> None:
    """Do all of it and say how much machine code there is."""
    import_everything()
    for picture in pictures():
        code(picture)
    kept = [path for path in Path(os.environ["NUMBA_CACHE_DIR"]).rglob("*") if path.is_file()]
    assert any(path.suffix == ".nbc" for path in kept), "nothing was compiled"
    print(f"{len(kept)} files of machine code, {sum(path.stat().st_size for path in kept)} B")


if __name__ == "__main__":
    main()
