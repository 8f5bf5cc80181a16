"""The picture of one map: what was seen, and the way that was driven."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from plgrim.evaluation.grid_kernels import OPEN, SOLID
from plgrim.evaluation.grid_rules import GridMap

_SHADES = ((SOLID, 0.25), (OPEN, 1.0))
_HIDDEN = 0.85


def grid_picture(
    path: Path, grid: GridMap, belief: NDArray[np.uint8], track: NDArray[np.int64], title: str
) -> None:
    """Write a PNG: walls dark, free ground white, what was not seen gray; the way from blue to red, moves numbered."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    shade = np.full(belief.shape, 0.6)
    shade[grid.truth == OPEN] = _HIDDEN
    for value, gray in _SHADES:
        shade[belief == value] = gray
    figure = Figure(figsize=(10.0, 10.0 * belief.shape[0] / belief.shape[1] + 0.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.imshow(shade, cmap="gray", vmin=0.0, vmax=1.0, interpolation="nearest")
    points = track.astype(float)
    pieces = np.stack([points[:-1], points[1:]], axis=1)
    axes.add_collection(
        LineCollection(list(pieces), array=np.arange(len(pieces)), cmap="turbo", linewidths=1.8)
    )
    for i in range(0, len(points), 5):
        axes.annotate(str(i), tuple(points[i]), fontsize=7)
    axes.plot(*points[0], "o", color="tab:blue")
    axes.plot(*points[-1], "s", color="tab:red")
    axes.set_title(title, fontsize=9)
    axes.set_axis_off()
    figure.savefig(path, dpi=80)
