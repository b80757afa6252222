"""The plot of `research.sea_trial`: what arrives over range, with the paper's words behind it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from research.common.plots import new_figure
from research.sea_trial.__main__ import BOUNDARY_M, RATES_USED, Cell

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = ("#1b6ca8", "#d1661c", "#3a8f4d", "#8b5aa8")
_MARKS = ("o", "s", "^", "d")


def plot(cells: Sequence[Cell]) -> Figure:
    """Draw packets at each rate, and whole pictures at rate 1, over range.

    Raises:
        ConfigError: matplotlib is not installed.
    """
    figure = new_figure(13.0, 4.6)
    panels = [(f"whole packets, rate {rate}", rate, _packets) for rate in RATES_USED]
    panels.append((f"whole pictures, rate {RATES_USED[0]}", RATES_USED[0], _pictures))
    axes = figure.subplots(1, len(panels), sharey=True)
    for axis, (title, rate, share) in zip(axes, panels, strict=True):
        _draw(axis, [cell for cell in cells if cell.rate == rate], share)
        axis.set_title(title)
        if rate == RATES_USED[0]:
            _draw_words(axis, whole_pictures=share is _pictures)
        else:
            axis.text(295, 62, "the paper: in the tank only,\n3 m, a few packets lost", ha="right", fontsize=8)
    axes[0].set_ylabel("arrived, % of sent")
    axes[0].legend(fontsize=8, loc="lower left", title="pictures", title_fontsize=8)
    count = cells[0].delivered.pictures
    figure.suptitle(f"Sea trial, simulated: preset sea-trial, {count} pictures a point", fontsize=11)
    return figure


def _packets(cell: Cell) -> float:
    return cell.packets


def _pictures(cell: Cell) -> float:
    return cell.pictures


def _draw(axis: Axes, cells: Sequence[Cell], share: Callable[[Cell], float]) -> None:
    sizes = list(dict.fromkeys((cell.width_px, cell.height_px) for cell in cells))
    for size, colour, mark in zip(sizes, _COLOURS, _MARKS, strict=False):
        mine = [cell for cell in cells if (cell.width_px, cell.height_px) == size]
        axis.plot(
            [cell.range_m for cell in mine],
            [100 * share(cell) for cell in mine],
            color=colour,
            marker=mark,
            markersize=3.5,
            linewidth=1.2,
            label=f"{size[0]} x {size[1]} px",
        )
    axis.set_xlim(0, 305)
    axis.set_ylim(-3, 103)
    axis.set_xlabel("range, m")
    axis.grid(alpha=0.3)


def _draw_words(axis: Axes, *, whole_pictures: bool) -> None:
    """Shade where the paper's words put the curve."""
    axis.fill_between([0, BOUNDARY_M], 50, 103, color="#9ec9a5", alpha=0.35, linewidth=0)
    axis.fill_between([BOUNDARY_M, 305], -3, 50, color="#e3b0a8", alpha=0.35, linewidth=0)
    axis.axvline(BOUNDARY_M, color="#777777", linestyle="--", linewidth=1)
    if whole_pictures:
        axis.plot([0, BOUNDARY_M], [100, 100], color="#222222", linestyle=":", linewidth=1.5)
        words = "the paper (dotted):\nbelow 130 m all pictures\nof 140 x 80 px"
    else:
        words = "the paper (shaded): most\nreceived below 130 m,\nmost lost beyond"
    axis.text(295, 62, words, ha="right", fontsize=8)
