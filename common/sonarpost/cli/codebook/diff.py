"""`sonarpost codebook diff`: how two codebooks differ."""

from __future__ import annotations

import argparse

from sonarpost.cli.codebook.info import print_facts
from sonarpost.codec.vq.codebook import open_codebook
from sonarpost.codec.vq.comparison import UnmatchedTiles, compare

EXIT_DIFFERENT = 1


def add_action(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action."""
    parser = actions.add_parser(
        "diff", help="show how two codebooks differ", description="Exit status 0: same identity; 1: different."
    )
    parser.add_argument("first", metavar="A", help="nominal-10, nominal-20 or a file")
    parser.add_argument("second", metavar="B", help="the other")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print the differences; return 0 if the identity is the same, else 1, as `diff` does.

    Raises:
        CodebookError: One cannot be read, or their tiles are of different size.
    """
    first, second = open_codebook(args.first).tiles, open_codebook(args.second).tiles
    difference = compare(first, second)
    print_facts(
        {
            "identity": "the same" if difference.same_identity else f"A {first.identity}, B {second.identity}",
            "tiles": f"A {difference.first.tiles}, B {difference.second.tiles}, {difference.common} in both",
            "same number": f"{difference.same_places} tiles have the same number in both",
            "only in A": _only(difference.first, "B"),
            "only in B": _only(difference.second, "A"),
            "bases": f"{first.dims} and {second.dims} dimensions; principal angles up to "
            f"{difference.angle_largest_deg:.2f} deg, {difference.angle_rms_deg:.2f} deg RMS",
            "variance of A": _variance(difference.first, "A", "B"),
            "variance of B": _variance(difference.second, "B", "A"),
        }
    )
    return 0 if difference.same_identity else EXIT_DIFFERENT


def _only(side: UnmatchedTiles, other: str) -> str:
    return (
        f"{side.only_here} tiles; from all to the nearest in {other}: median {side.rms_median:.2f}, "
        f"95 % within {side.rms_95:.2f}, at most {side.rms_largest:.2f} grey levels RMS"
    )


def _variance(side: UnmatchedTiles, own: str, other: str) -> str:
    own_part, other_part = 100 * side.variance_own, 100 * side.variance_other
    return f"{own_part:.2f} % seen by the basis of {own}, {other_part:.2f} % by that of {other}"
