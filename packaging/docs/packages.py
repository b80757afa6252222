"""The drawing of the packages of `sonarpost` and their imports, on the page of the architecture."""

import tomllib
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import mean
from textwrap import wrap

import grimp

REPOSITORY = Path(__file__).resolve().parents[2]

WIDTH_PX = 640
ROW_PX = 68
BOX_HEIGHT_PX = 30
BOX_PADDING_PX = 20
BOX_GAP_PX = 24
CHARACTER_PX = 8
LANE_PX = 24
LINE_PX = 18
SWEEPS = 20
# The layers from this package down are one box: every package above imports them.
GROUND = "config"

Arrow = tuple[str, str]
# A package, or an arrow that passes through a row.
Place = str | Arrow


def drawing(_: str = "") -> str:
    """Return an SVG: a box for each package, in the rows of the layers, and arrows to the packages that it imports."""
    rows, found = layers(), imports()
    ground = next(number for number, names in enumerate(rows) if GROUND in names)
    row_of = {name: row for row, names in enumerate(rows[:ground]) for name in names}
    upper = {name: found[name] & row_of.keys() for name in row_of}
    x_px = _positions(row_of, arrows(upper))
    drawn = [_arrow(arrow, row_of, x_px) for arrow in arrows(upper)]
    drawn += [_box(name, row, x_px[row][name], found[name]) for name, row in row_of.items()]
    names = ", ".join(name for below in rows[ground:] for name in below)
    lines = ["ground floor, which every package above may import:", *wrap(names, WIDTH_PX // CHARACTER_PX)]
    top_px = _y(ground) - BOX_HEIGHT_PX / 2
    height_px = top_px + len(lines) * LINE_PX + BOX_PADDING_PX
    drawn.append(
        f'<rect x="1" y="{top_px}" width="{WIDTH_PX - 2}" height="{height_px - top_px - 1}" rx="4"/>'
        + "".join(
            f'<text x="{WIDTH_PX / 2}" y="{top_px + (number + 1) * LINE_PX + 4}">{line}</text>'
            for number, line in enumerate(lines)
        )
    )
    return (
        f'<svg class="packages" viewBox="0 0 {WIDTH_PX} {height_px}" role="img" aria-label="packages and imports">'
        '<defs><marker id="head" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        f'<path d="M0 0 8 4 0 8z"/></marker></defs>{"".join(drawn)}</svg>'
    )


def layers() -> list[list[str]]:
    """Return the packages of each layer from the contract of import-linter in `pyproject.toml`, highest layer first."""
    linter = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
    rows = next(contract["layers"] for contract in linter["contracts"] if contract["type"] == "layers")
    return [[name.strip().removeprefix("sonarpost.") for name in row.replace("|", ":").split(":")] for row in rows]


def imports() -> dict[str, set[str]]:
    """Return which packages each package imports directly."""
    graph = grimp.build_graph("sonarpost")
    found: dict[str, set[str]] = {name: set() for row in layers() for name in row}
    for module in graph.modules - {"sonarpost"}:
        package = module.split(".")[1]
        others = graph.find_modules_directly_imported_by(module) - {"sonarpost"}
        found[package] |= {other.split(".")[1] for other in others} - {package}
    return found


def arrows(found: Mapping[str, set[str]]) -> list[Arrow]:
    """Return the imports that no path of others replaces; packages that import each other are one step of a path."""
    reached = {name: _reached(name, found) for name in found}

    def follows(name: str, other: str) -> bool:
        between = (n for n in found[name] if name not in reached[n] and n not in reached[other])
        return any(other in reached[n] for n in between)

    return sorted((name, other) for name in found for other in found[name] if not follows(name, other))


def _reached(start: str, found: Mapping[str, set[str]]) -> set[str]:
    seen: set[str] = set()
    waiting = [start]
    while waiting:
        new = found[waiting.pop()] - seen
        seen |= new
        waiting.extend(new)
    return seen


def _positions(row_of: Mapping[str, int], drawn: Sequence[Arrow]) -> list[dict[Place, float]]:
    """Return the horizontal centre of each place in each row, in px, near the places that it is connected with."""
    x_px: list[dict[Place, float]] = [{} for _ in set(row_of.values())]
    for name, row in row_of.items():
        x_px[row][name] = len(x_px[row]) * LANE_PX
    links: list[tuple[int, Place, int, Place]] = []
    for start, end in drawn:
        passed = range(row_of[start] + 1, row_of[end])
        for row in passed:
            x_px[row][start, end] = len(x_px[row]) * LANE_PX
        path: list[tuple[int, Place]] = [
            (row_of[start], start),
            *((r, (start, end)) for r in passed),
            (row_of[end], end),
        ]
        links += [(*a, *b) for a, b in pairwise(path)]
    down = range(len(x_px))
    for row in [*down, *reversed(down)] * SWEEPS:
        near: dict[Place, list[float]] = {place: [] for place in x_px[row]}
        for r, a, s, b in links:
            if r == row:
                near[a].append(x_px[s][b])
            if s == row:
                near[b].append(x_px[r][a])
        x_px[row] = _spread({place: mean(near[place]) for place in x_px[row]})
    used_px = [x for places in x_px for x in places.values()]
    margin_px = (WIDTH_PX - min(used_px) - max(used_px)) / 2
    return [{place: x + margin_px for place, x in places.items()} for places in x_px]


def _spread(wanted_px: Mapping[Place, float]) -> dict[Place, float]:
    """Return centres in the order of the wanted ones, near them and without overlap."""
    order = sorted(wanted_px, key=lambda place: (wanted_px[place], str(place)))
    half = {p: (_width(p) + BOX_GAP_PX if isinstance(p, str) else LANE_PX) / 2 for p in order}
    x_px = dict(wanted_px)
    edge = 0.0
    for place in order:
        x_px[place] = max(x_px[place], edge + half[place])
        edge = x_px[place] + half[place]
    edge = WIDTH_PX
    for place in reversed(order):
        x_px[place] = min(x_px[place], edge - half[place])
        edge = x_px[place] - half[place]
    return x_px


def _width(name: str) -> float:
    return len(name) * CHARACTER_PX + BOX_PADDING_PX


def _y(row: int) -> float:
    return (row + 0.5) * ROW_PX


def _arrow(arrow: Arrow, row_of: Mapping[str, int], x_px: Sequence[Mapping[Place, float]]) -> str:
    start, end = arrow
    first, last = row_of[start], row_of[end]
    half = BOX_HEIGHT_PX / 2
    if first == last:
        left_px, right_px = x_px[first][start], x_px[first][end]
        sign = 1 if right_px > left_px else -1
        left_px, right_px = left_px + sign * _width(start) / 2, right_px - sign * _width(end) / 2
        return f'<path d="M{left_px:.0f} {_y(first):.0f}H{right_px:.0f}" marker-end="url(#head)"/>'
    x, y = x_px[first][start], _y(first) + half
    path = f"M{x:.0f} {y:.0f}"
    for row in range(first + 1, last + 1):
        to_x, to_y = x_px[row][end if row == last else arrow], _y(row) - half
        path += f"C{x:.0f} {(y + to_y) / 2:.0f} {to_x:.0f} {(y + to_y) / 2:.0f} {to_x:.0f} {to_y:.0f}"
        x, y = to_x, to_y + BOX_HEIGHT_PX
        path += f"V{y:.0f}" if row < last else ""
    return f'<path d="{path}" marker-end="url(#head)"/>'


def _box(name: str, row: int, x_px: float, others: set[str]) -> str:
    width = _width(name)
    return (
        f"<g><title>{name} imports {', '.join(sorted(others))}</title>"
        f'<rect x="{x_px - width / 2:.0f}" y="{_y(row) - BOX_HEIGHT_PX / 2:.0f}" width="{width}" '
        f'height="{BOX_HEIGHT_PX}" rx="4"/><text x="{x_px:.0f}" y="{_y(row) + 5:.0f}">{name}</text></g>'
    )
