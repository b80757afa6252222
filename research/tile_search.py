"""The VQ encode search against FAISS `IndexFlatL2`, on one core, alternately in one run.

    python -m venv somewhere && somewhere/bin/pip install . faiss-cpu
    somewhere/bin/python -m research.tile_search

Both search the 70 coordinates of the 15,992 tiles of `nominal-10` for the tiles of a 140 x 80 px picture (112 tiles):
the nearest (the paper's search), and the eight nearest (what the codec `vq` compares in all pixels afterwards).
Projecting the picture's tiles is part of both. Each picture is searched by one and then the other, in turns as to
which is first,
so a machine that others use slows both; what counts is the ratio of the two times of a pair.

FAISS searches in single precision, so of nearly equal tiles it may return the other; sonarpost is checked against
distances in integers and must be exact. FAISS is given the better of its two ways to search (with and without a
matrix product), tried beforehand.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sonarpost.codec.interface import to_uint8
from sonarpost.codec.vq.codebook import load_default
from sonarpost.codec.vq.patches import stretch
from sonarpost.codec.vq.tiles import BASIS_SCALE, SHORTLIST, TileDatabase, Tiles, cut_tiles
from sonarpost.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.image_files import read_image

HEIGHT_PX, WIDTH_PX = 140, 80
Search = Callable[[Tiles], npt.NDArray[np.int64]]


def main() -> int:
    """Run; return 1 if a neighbour is not exact or the median ratio is above 1."""
    parser = argparse.ArgumentParser(description="VQ encode search against FAISS IndexFlatL2")
    parser.add_argument("--pictures", type=int, default=48, metavar="N", help="default: 48")
    parser.add_argument("--rounds", type=int, default=8, metavar="N", help="default: 8")
    parser.add_argument("--images", type=Path, metavar="DIR", help="folder of pictures (default: simulated ones)")
    args = parser.parse_args()
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":
        # Libraries read this when they are loaded, so the program starts itself anew, on one core.
        os.environ.update({f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")})
        if hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
        os.execv(sys.executable, [sys.executable, "-m", "research.tile_search", *sys.argv[1:]])
    try:
        import faiss  # type: ignore[import-not-found,unused-ignore]  # noqa: PLC0415 - no dependency: its absence is explained
    except ImportError:
        print("tile_search: faiss is not installed here: pip install faiss-cpu", file=sys.stderr)
        return 2
    faiss.omp_set_num_threads(1)
    database = load_default(10).tiles
    pictures = [cut_tiles(picture, 10) for picture in _pictures(args.images, args.pictures)]
    if not pictures:
        print(f"tile_search: no picture of {HEIGHT_PX} x {WIDTH_PX} px or more in {args.images}", file=sys.stderr)
        return 2
    index = faiss.IndexFlatL2(database.dims)
    index.add(_coordinates(database, database.tiles))
    _choose_way(faiss, index, database, pictures)
    print(
        f"{len(pictures)} pictures of {pictures[0].shape[0]} tiles, {len(database)} tiles, {database.dims} dimensions"
    )
    good = True
    for count in (1, SHORTLIST):
        good &= _compare(f"{count} nearest", database, index, pictures, args.rounds, count)
    return 0 if good else 1


def _compare(title: str, database: TileDatabase, index: object, pictures: list[Tiles], rounds: int, count: int) -> bool:
    def ours(tiles: Tiles) -> npt.NDArray[np.int64]:
        return database.nearest_in_basis(tiles, count)[0]

    def theirs(tiles: Tiles) -> npt.NDArray[np.int64]:
        found: npt.NDArray[np.int64] = index.search(_coordinates(database, tiles), count)[1]  # type: ignore[attr-defined]
        return found

    exact = [_exact(database, tiles, count) for tiles in pictures]
    ours_wrong = sum(int((ours(t) != e).any(axis=1).sum()) for t, e in zip(pictures, exact, strict=True))
    theirs_other = sum(int((theirs(t) != e).any(axis=1).sum()) for t, e in zip(pictures, exact, strict=True))
    times = np.array([_pair(ours, theirs, tiles, turn) for turn in range(rounds) for tiles in pictures])
    ratios = times[:, 0] / times[:, 1]
    rng = np.random.default_rng(0)
    medians = [np.median(rng.choice(ratios, ratios.size)) for _ in range(2000)]
    low, high = np.percentile(medians, (2.5, 97.5))
    print(
        f"{title}: sonarpost {np.median(times[:, 0]) * 1e3:.2f} ms, FAISS {np.median(times[:, 1]) * 1e3:.2f} ms; "
        f"ratio {np.median(ratios):.3f} ({low:.3f} to {high:.3f}, 95 %, {ratios.size} pairs); "
        f"not exact: sonarpost {ours_wrong}, FAISS {theirs_other} of {len(pictures) * pictures[0].shape[0]} tiles"
    )
    return ours_wrong == 0 and float(np.median(ratios)) <= 1.0


def _pair(ours: Search, theirs: Search, tiles: Tiles, turn: int) -> tuple[float, float]:
    if turn % 2:
        second = _seconds(theirs, tiles)
        return _seconds(ours, tiles), second
    return _seconds(ours, tiles), _seconds(theirs, tiles)


def _seconds(search: Search, tiles: Tiles) -> float:
    start = time.perf_counter()
    search(tiles)
    return time.perf_counter() - start


def _exact(database: TileDatabase, tiles: Tiles, count: int) -> npt.NDArray[np.int64]:
    """Every distance in integers, sorted whole: slow and plain."""
    queries, stored = database.project(tiles).astype(np.int64), database.projections.astype(np.int64)
    found = np.empty((tiles.shape[0], count), dtype=np.int64)
    for row, query in enumerate(queries):
        difference = stored - query
        found[row] = np.argsort((difference * difference).sum(axis=1), kind="stable")[:count]
    return found


def _coordinates(database: TileDatabase, tiles: Tiles) -> npt.NDArray[np.float32]:
    return (database.project(tiles) / BASIS_SCALE).astype(np.float32)


def _choose_way(faiss: object, index: object, database: TileDatabase, pictures: list[Tiles]) -> None:
    """Let FAISS search by matrix product or by plain loops, whichever is faster here."""
    settings = faiss.cvar  # type: ignore[attr-defined]
    taken = {}
    for threshold in (1, 1 << 30):
        settings.distance_compute_blas_threshold = threshold
        queries = [_coordinates(database, tiles) for tiles in pictures]
        start = time.perf_counter()
        for query in queries:
            index.search(query, 1)  # type: ignore[attr-defined]
        taken[threshold] = time.perf_counter() - start
    settings.distance_compute_blas_threshold = min(taken, key=lambda threshold: taken[threshold])


def _pictures(folder: Path | None, wanted: int) -> list[npt.NDArray[np.uint8]]:
    """Pieces of 140 x 80 px: the middles of a folder's images, or of simulated lines over every kind of bottom."""
    if folder is not None:
        paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in (".png", ".tif", ".tiff"))
        images = (to_uint8(read_image(path)) for path in paths)
        return [_middle(image) for image in images if image.shape[0] >= HEIGHT_PX and image.shape[1] >= WIDTH_PX][
            :wanted
        ]
    pictures: list[npt.NDArray[np.uint8]] = []
    for number in range(wanted):
        if number % 8 == 0:
            kind = list(SeabedKind)[number // 8 % len(SeabedKind)]
            survey = simulate_survey(SurveySpec(seed=910_000 + number, pings=600, seabed=kind)).survey
        line = survey.waterfall(survey.sides()[number % 2])
        top, left = 140 * (number % 8 // 2), 300 + 100 * (number % 4)
        pictures.append(stretch(line[top : top + HEIGHT_PX, left : left + WIDTH_PX].astype(np.float64)))
    return pictures


def _middle(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    top, left = (image.shape[0] - HEIGHT_PX) // 2, (image.shape[1] - WIDTH_PX) // 2
    return image[top : top + HEIGHT_PX, left : left + WIDTH_PX]


if __name__ == "__main__":
    sys.exit(main())
