"""Prepare the machine code of the codecs while the container image is built.

Fails if a module of sonarpost cannot be imported, a codec does not work, or nothing was compiled.
"""

from __future__ import annotations

import importlib
import pkgutil

import numpy as np

import sonarpost
from sonarpost.cli.parsing.commands import EXTRAS
from sonarpost.codec import codec_names, decode, encode
from sonarpost.codec.jit import compilation_log
from sonarpost.codec.machine_code import prepare_machine_code

OPTIONAL = ("matplotlib", "pillow_jxl", *EXTRAS)
"""Packages of extras, which the image need not have."""


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


def try_every_codec() -> None:
    """Encode and decode 8 and 16 bits with every codec."""
    image = np.random.default_rng(1).gamma(4.0, 25.0, size=(80, 140)).clip(0, 255).astype(np.uint8)
    for snippet in (image, image.astype(np.uint16) * 257):
        for name in codec_names():
            # The comparison codecs do not reach small budgets; the length of vq streams is fixed.
            stream = encode(snippet, name, None if name == "vq" else 2048)
            assert decode(stream).shape == image.shape, name


def main() -> None:
    """Prepare, check, and print the size of the machine code."""
    import_everything()
    prepare_machine_code(print)
    try_every_codec()
    files = [path for folder in compilation_log.cache_folders for path in folder.glob("*.nb[ci]")]
    assert any(path.suffix == ".nbc" for path in files), "no machine code was stored"
    print(f"{len(files)} files of machine code, {sum(path.stat().st_size for path in files)} B")


if __name__ == "__main__":
    main()
