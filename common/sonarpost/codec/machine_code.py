"""Preparation of the machine code of the codecs, so that the first image does not wait for the compiler."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sonarpost.codec.interface import Codec, ExtensibleCodec, Image
from sonarpost.codec.registry import CodecResources, default_registry


def prepare_machine_code(progress: Callable[[str], None] | None = None) -> None:
    """Compile all functions of emb that are not in the cache on disk; `jit.compilation_log` counts them.

    Folders: see `code_cache.code_folders`.

    Args:
        progress: Called with the name of each step before it starts.
    """
    registry = default_registry()
    for model in ("standard", "structure"):
        if progress is not None:
            progress(f"emb, model {model}")
        _run_all_paths(registry.create("emb", CodecResources(model=model)))


def _run_all_paths(codec: Codec) -> None:
    snippet = _sample_snippet()
    stream = codec.encode(snippet, 512)
    if isinstance(codec, ExtensibleCodec):
        codec.extend(stream, snippet, 600)
    codec.decode(stream)


def _sample_snippet() -> Image:
    """Return speckle with a highlight and a shadow."""
    image = np.random.default_rng(1).gamma(4.0, 25.0, size=(80, 140))
    image[30:36, 60:70] *= 3
    image[30:36, 70:100] *= 0.1
    return np.clip(image, 0, 255).astype(np.uint8)
