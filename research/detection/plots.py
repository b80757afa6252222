"""Plots of `python -m research.detection`: ROC by seabed and shape, reliability, real tiles, codecs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from research.common.plots import new_figure, save_figure
from research.detection.codec_effect import CodecEffect
from research.detection.simulated import JudgedFile, reliability, roc
from research.detection.tiles import TileScore, tile_auc
from sonarpost.simulation.seabed.targets import MINE_LIKE_KINDS
from sonarpost.simulation.seabed.terrain import SeabedKind

_MOST_ALARMS: Final = 6.0


def plot_all(
    folder: Path, files: Sequence[JudgedFile], tiles: Sequence[TileScore], after: Sequence[CodecEffect]
) -> None:
    """Write roc.png and reliability.png, and where there is something to draw tiles.png and codecs.png.

    Raises:
        ConfigError: matplotlib is not installed.
        OSError: A file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    plot_roc(folder / "roc.png", files)
    plot_reliability(folder / "reliability.png", files)
    if tiles:
        plot_tiles(folder / "tiles.png", tiles)
    if after:
        plot_codecs(folder / "codecs.png", after)


def plot_roc(path: Path, files: Sequence[JudgedFile]) -> None:
    """Draw probability of detection over false alarms a file, by seabed and (on all of them) by shape."""
    figure = new_figure(10, 4.2)
    left, right = figure.subplots(1, 2)
    for kind in SeabedKind:
        left.step(*roc([f for f in files if f.seabed is kind]), where="post", label=kind.value)
    for shape in MINE_LIKE_KINDS:
        right.step(*roc(files, shape.value), where="post", label=shape.value.replace("_", " "))
    for axis, title in ((left, "by seabed"), (right, "by shape, all seabeds")):
        axis.set_xlim(0, _MOST_ALARMS)
        axis.set_ylim(0, 1.02)
        axis.set_xlabel("false alarms a file of 1000 pings")
        axis.set_ylabel("probability of detection, mine-like objects")
        axis.set_title(title)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8, loc="lower right")
    save_figure(figure, path)


def plot_reliability(path: Path, files: Sequence[JudgedFile]) -> None:
    """Draw the share of contacts that are objects over the share that their confidence claims."""
    figure = new_figure(5, 4.2)
    axis = figure.subplots()
    bins = reliability(files)
    axis.plot([0, 1], [0, 1], color="grey", linewidth=1)
    axis.plot([b.claimed for b in bins], [b.true_share for b in bins], "o-")
    for b in bins:
        axis.annotate(
            str(b.contacts), (b.claimed, b.true_share), fontsize=8, xytext=(4, -10), textcoords="offset points"
        )
    axis.set_xlabel("confidence / 2")
    axis.set_ylabel("share of contacts that are objects")
    axis.grid(alpha=0.3)
    save_figure(figure, path)


def plot_tiles(path: Path, tiles: Sequence[TileScore]) -> None:
    """Draw the ROC of tiles with a target against tiles of clutter, for each split."""
    figure = new_figure(5, 4.2)
    axis = figure.subplots()
    for split in sorted({t.split for t in tiles}):
        chosen = tuple(t for t in tiles if t.split == split)
        area, _ = tile_auc(chosen)
        ordered = sorted(chosen, key=lambda t: -t.confidence)
        hits = np.cumsum([0, *(t.is_target for t in ordered)])
        alarms = np.cumsum([0, *(not t.is_target for t in ordered)])
        axis.plot(alarms / alarms[-1], hits / hits[-1], label=f"{split}: AUC {area:.2f}, {len(chosen)} tiles")
    axis.plot([0, 1], [0, 1], color="grey", linewidth=1)
    axis.set_xlabel("share of clutter tiles")
    axis.set_ylabel("share of target tiles")
    axis.grid(alpha=0.3)
    axis.legend(loc="lower right")
    save_figure(figure, path)


def plot_codecs(path: Path, after: Sequence[CodecEffect]) -> None:
    """Draw the mean confidence after each codec over the budget, with that of the originals."""
    figure = new_figure(6, 4.2)
    axis = figure.subplots()
    for label in dict.fromkeys(e.label for e in after):
        line = [(e.budget_bytes, e.after) for e in after if e.label == label and e.budget_bytes is not None]
        if line:
            axis.plot(*zip(*line, strict=True), "o-", label=label)
    axis.axhline(max(e.before for e in after if e.pictures), color="grey", linewidth=1, label="originals")
    axis.set_xscale("log", base=2)
    axis.set_xlabel("budget in bytes")
    axis.set_ylabel("mean confidence after decoding")
    axis.set_ylim(0, 2)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)
    save_figure(figure, path)
