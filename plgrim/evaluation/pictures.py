"""The pictures of a result: coverage over time, and the world with what was covered and where the robot drove."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from schemas.operation import WorldPicture

_WORLD_COLOURS = ListedColormap(
    ["#1f2933", "#9aa5b1", "#f5d6a8", "#a9d5b5"]
)  # solid, free, reachable, covered
_LONGEST_IN = 12.0
Series = Sequence[tuple[float, float]]


def coverage_plot(path: Path, judge: Series, belief: Series) -> None:
    """Coverage (share) over mission time (s), by the judge and by the robot's belief."""
    figure = Figure(figsize=(8.0, 4.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for series, label, style in ((judge, "judge", "-"), (belief, "belief", "--")):
        if series:
            times, shares = zip(*series, strict=True)
            axes.plot(times, [100.0 * share for share in shares], style, label=label)
    axes.set_xlabel("mission time [s]")
    axes.set_ylabel("coverage [% of reachable ground]")
    axes.set_ylim(0, 102)
    axes.grid(visible=True, alpha=0.3)
    if judge or belief:
        axes.legend(loc="lower right")
    figure.savefig(path, dpi=110)


def map_picture(path: Path, picture: WorldPicture, driven: Series, title: str, stops: Series = ()) -> None:
    """The world (solid, free, reachable, covered) with the driven path and where it stopped; metres in `map`."""
    resolution, (rows, columns) = picture.resolution_m, picture.cell.shape
    left, bottom = picture.ix0 * resolution, picture.iy0 * resolution
    extent = (left, left + columns * resolution, bottom, bottom + rows * resolution)
    scale = _LONGEST_IN / max(rows, columns)
    figure = Figure(figsize=(max(4.0, columns * scale), max(4.0, rows * scale)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.imshow(
        picture.cell,
        origin="lower",
        extent=extent,
        cmap=_WORLD_COLOURS,
        vmin=0,
        vmax=3,
        interpolation="nearest",
    )
    if driven:
        line = np.asarray(driven)
        axes.plot(line[:, 0], line[:, 1], color="#c2410c", linewidth=1.2)
        if stops:
            axes.plot(*np.asarray(stops).T, ".", color="#1d4ed8", markersize=4, label="viewpoint seen from")
        axes.plot(*line[0], marker="o", color="#0f766e", markersize=7, label="start")
        axes.plot(*line[-1], marker="s", color="#7c2d12", markersize=7, label="end")
        axes.legend(loc="best")
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.set_title(title)
    figure.savefig(path, dpi=110)
