"""Check the packages of the container image.

Fails if a module of sonarpost cannot be imported or a codec does not work. Prints a digest of the streams and pixels of
compiled codecs.
"""

import hashlib
import importlib
import pkgutil

import numpy as np

import sonarpost
from sonarpost.cli.parsing.commands import all_extras
from sonarpost.codec import codec_names, decode, encode
from sonarpost.codec.jit import COMPILE_S

OPTIONAL = ("matplotlib", "numba", *all_extras())
"""Packages that the image need not have."""


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


def try_every_codec() -> str:
    """Encode and decode 8 and 16 bits with every codec; return the digest of the results of compiled ones."""
    digest = hashlib.sha256()
    image = np.random.default_rng(1).gamma(4.0, 25.0, size=(80, 140)).clip(0, 255).astype(np.uint8)
    for snippet in (image, image.astype(np.uint16) * 257):
        for name in codec_names():
            stream = encode(snippet, name, None if name == "vq" else 2048)  # the length of vq streams is fixed
            pixels = decode(stream)
            assert pixels.shape == image.shape, name
            if name in COMPILE_S:
                digest.update(stream + pixels.tobytes())
    return digest.hexdigest()


def main() -> None:
    """Check, and print the digest."""
    import_everything()
    print(try_every_codec())


if __name__ == "__main__":
    main()
