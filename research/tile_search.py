"""`python -m research.tile_search`: the VQ encode search against FAISS `IndexFlatL2` on one core.

    python -m venv somewhere && somewhere/bin/pip install . faiss-cpu
    somewhere/bin/python -m research.tile_search

Both programs search the 15,992 tiles of `nominal-10`, in 70 coordinates, for the tiles of an image of 80 x 140 px
(112 tiles). They search for the nearest tile (as in the paper), and for the eight nearest (which the codec `vq` then
compares in all pixels). The time includes the projection of the tiles of the image. Each image is searched by both
programs, one after the other, in alternating order. Other load of the host therefore slows both, and the result is the
median of the ratio of the two times.

FAISS searches in single precision, so it may return the wrong one of two nearly equal tiles. The result of sonarpost is
compared with integer distances and must be exact. FAISS runs with the faster of its two methods (with and without a
matrix product), which is measured beforehand.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from research.common.patches import stretch
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.codec.vq.codebook import load_default
from sonarpost.codec.vq.tiles import BASIS_SCALE, SHORTLIST, TileDatabase, Tiles, cut_tiles
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind

HEIGHT_PX, WIDTH_PX = 140, 80
Search = Callable[[Tiles], npt.NDArray[np.int64]]


def main() -> int:
    """Run; return 1 if a neighbour is not exact."""
    parser = argparse.ArgumentParser(description="VQ encode search against FAISS IndexFlatL2")
    parser.add_argument("--count", type=int, default=48, metavar="N", help="default: 48")
    parser.add_argument("--rounds", type=int, default=8, metavar="N", help="default: 8")
    args = parser.parse_args()
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":
        # The libraries read this when they are loaded, so the program restarts itself, on one core.
        os.environ.update({f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")})
        if hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
        os.execv(sys.executable, [sys.executable, "-m", "research.tile_search", *sys.argv[1:]])
    try:
        import faiss  # type: ignore[import-not-found,unused-ignore]  # noqa: PLC0415 - not a dependency
    except ImportError:
        print("tile_search: faiss is not installed here: pip install faiss-cpu", file=sys.stderr)
        return 2
    faiss.omp_set_num_threads(1)
    database = load_default(10).tiles
    images = [cut_tiles(image, 10) for image in _images(args.count)]
    index = faiss.IndexFlatL2(database.dims)
    index.add(_coordinates(database, database.tiles))
    _choose_method(faiss, index, database, images)
    print(f"{len(images)} images of {images[0].shape[0]} tiles, {len(database)} tiles, {database.dims} dimensions")
    passed = True
    for count in (1, SHORTLIST):
        passed &= _compare(f"{count} nearest", database, index, images, args.rounds, count)
    return 0 if passed else 1


def _compare(title: str, database: TileDatabase, index: object, images: list[Tiles], rounds: int, count: int) -> bool:
    def ours(tiles: Tiles) -> npt.NDArray[np.int64]:
        return database.nearest_in_basis(tiles, count)[0]

    def theirs(tiles: Tiles) -> npt.NDArray[np.int64]:
        found: npt.NDArray[np.int64] = index.search(_coordinates(database, tiles), count)[1]  # type: ignore[attr-defined]
        return found

    exact = [_exact(database, tiles, count) for tiles in images]
    sonarpost_inexact = sum(int((ours(t) != e).any(axis=1).sum()) for t, e in zip(images, exact, strict=True))
    faiss_inexact = sum(int((theirs(t) != e).any(axis=1).sum()) for t, e in zip(images, exact, strict=True))
    times = np.array([_pair(ours, theirs, tiles, turn) for turn in range(rounds) for tiles in images])
    ratios = times[:, 0] / times[:, 1]
    rng = np.random.default_rng(0)
    medians = [np.median(rng.choice(ratios, ratios.size)) for _ in range(2000)]
    low, high = np.percentile(medians, (2.5, 97.5))
    print(
        f"{title}: sonarpost {np.median(times[:, 0]) * 1e3:.2f} ms, FAISS {np.median(times[:, 1]) * 1e3:.2f} ms; "
        f"ratio {np.median(ratios):.3f} ({low:.3f} to {high:.3f}, 95 %, {ratios.size} pairs); "
        f"not exact: sonarpost {sonarpost_inexact}, FAISS {faiss_inexact} of {len(images) * images[0].shape[0]} tiles"
    )
    return sonarpost_inexact == 0


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
    """Return the exact neighbours from all distances in integers."""
    queries, stored = database.project(tiles).astype(np.int64), database.projections.astype(np.int64)
    found = np.empty((tiles.shape[0], count), dtype=np.int64)
    for row, query in enumerate(queries):
        difference = stored - query
        found[row] = np.argsort((difference * difference).sum(axis=1), kind="stable")[:count]
    return found


def _coordinates(database: TileDatabase, tiles: Tiles) -> npt.NDArray[np.float32]:
    return (database.project(tiles) / BASIS_SCALE).astype(np.float32)


def _choose_method(faiss: object, index: object, database: TileDatabase, images: list[Tiles]) -> None:
    """Select the faster search of FAISS: matrix product or loops."""
    settings = faiss.cvar  # type: ignore[attr-defined]
    times_s = {}
    for threshold in (1, 1 << 30):
        settings.distance_compute_blas_threshold = threshold
        queries = [_coordinates(database, tiles) for tiles in images]
        start = time.perf_counter()
        for query in queries:
            index.search(query, 1)  # type: ignore[attr-defined]
        times_s[threshold] = time.perf_counter() - start
    settings.distance_compute_blas_threshold = min(times_s, key=lambda threshold: times_s[threshold])


def _images(count: int) -> list[npt.NDArray[np.uint8]]:
    """Return images of 80 x 140 px, parts of simulated lines."""
    cut: list[npt.NDArray[np.uint8]] = []
    for number in range(count):
        if number % 8 == 0:
            kind = list(SeabedKind)[number // 8 % len(SeabedKind)]
            survey = simulate_survey(SurveySpec(seed=910_000 + number, pings=600, seabed=kind)).survey
        line = survey.waterfall(survey.sides()[number % 2])
        top, left = 140 * (number % 8 // 2), 300 + 100 * (number % 4)
        cut.append(stretch(line[top : top + HEIGHT_PX, left : left + WIDTH_PX].astype(np.float64)))
    return cut


if __name__ == "__main__":
    with ProgressDisplay(step="tile_search"):
        sys.exit(main())
