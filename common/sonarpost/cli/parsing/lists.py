"""Lists that `OPTION help` prints instead of running the command: `encode --codec help`."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Final

from sonarpost.errors import ConfigError

# Imported lazily in every function: the codecs load numpy.


def _codecs() -> list[str]:
    from sonarpost.codec.registry import default_registry  # noqa: PLC0415

    registry = default_registry()

    def summary(name: str) -> str:
        try:
            return registry.spec(name).summary
        except ConfigError as error:  # a plug-in that cannot be used
            return str(error)

    return [f"{name:16} {summary(name)}" for name in registry.names()]


def _codebooks() -> list[str]:
    from sonarpost.codec.vq.codebook import DEFAULT_TILE_PX, load_default  # noqa: PLC0415

    books = ((tile_px, load_default(tile_px).tiles) for tile_px in DEFAULT_TILE_PX)
    return [
        *(f"nominal-{tile_px:<9} {len(tiles)} tiles of {tile_px} × {tile_px} px" for tile_px, tiles in books),
        f"{'FILE':17} output of `python -m research.codebook build` or `adapt`",
    ]


def _models() -> list[str]:
    from sonarpost.codec import emb  # noqa: PLC0415

    return [f"{name}{' (default)' if name == emb.DEFAULT_MODEL else ''}" for name in emb.CODEC_IDS]


def _rates() -> list[str]:
    from sonarpost.modem.registry import modem_driver  # noqa: PLC0415

    return [
        f"{rate.number}  {rate.frames} x {rate.frame_bytes:3} B = {rate.packet_bytes:4} B in {rate.airtime_s:g} s, "
        f"{rate.modulation}"
        for rate in modem_driver().capabilities.rates.values()
    ]


_LISTS: Final[Mapping[str, Callable[[], Iterable[str]]]] = {
    "--codec": _codecs,
    "--codecs": _codecs,
    "--codebook": _codebooks,
    "--codebooks": _codebooks,
    "--core": _codebooks,
    "--model": _models,
    "--rate": _rates,
    "--rates": _rates,
}


def requested_list(options: Mapping[str, argparse.Action], arguments: Sequence[str]) -> list[str] | None:
    """Return the lines of the list that `OPTION help` or `OPTION=help` requests; None if there is no such request.

    Args:
        options: Options of the command.
        arguments: Its arguments.
    """
    pairs = [*pairwise(arguments), *((option, value) for option, _, value in (a.partition("=") for a in arguments))]
    for option, value in pairs:
        action = options.get(option)
        if value == "help" and action is not None:
            if option in _LISTS:
                return list(_LISTS[option]())
            if action.choices is not None:
                return [str(choice) for choice in action.choices]
    return None
