"""`sonarpost codebook info`: what a codebook holds."""

from __future__ import annotations

import argparse

from sonarpost.codec.vq.codebook import Codebook, open_codebook
from sonarpost.codec.vq.codec import codebook_tag


def add_action(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action."""
    parser = actions.add_parser("info", help="show what a codebook holds")
    parser.add_argument("codebook", metavar="NAME_OR_FILE", help="nominal-10, nominal-20 or a file")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print what a codebook holds; return 0.

    Raises:
        CodebookError: It cannot be read.
    """
    show(open_codebook(args.codebook))
    return 0


def show(codebook: Codebook) -> None:
    """Print size, identity and notes."""
    tiles = codebook.tiles
    print_facts(
        {
            "tiles": f"{len(tiles)} of {tiles.tile_px} x {tiles.tile_px} px",
            "dimensions": f"{tiles.dims} of {tiles.tile_px**2}",
            "identity": tiles.identity,
            "tag in streams": f"{codebook_tag(tiles):#06x}",
            **codebook.notes,
        }
    )


def print_facts(facts: dict[str, str]) -> None:
    """Print names and values in two columns."""
    width = max(len(name) for name in facts)
    for name, value in facts.items():
        print(f"{name:{width}}  {value}")
