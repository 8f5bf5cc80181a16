"""What the belief made of a file: ground, coverage, frontiers, breadcrumbs and the driven path, in `map`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from planning.grid import GridSpec, overlap
from schemas.world import CoverageWindow

_COLOURS = ["#ffffff", "#f5d6a8", "#a9d5b5", "#1f2933", "#9aa5b1"]
_LABELS = ("", "ground, not covered", "covered", "obstacle", "free, out of reach")
_GROUND, _COVERED, _OUT_OF_REACH = 1, 2, 4
_LONGEST_IN = 12.0


class Canvas:
    """The windows around the robot, laid over one another as they come: the newest word on each cell.

    A cell that the newest window does not know keeps what was known of it before. So does ground that the newest
    window calls out of reach: the way to it lies outside of that window.
    """

    def __init__(self) -> None:
        self.spec: GridSpec | None = None
        self.cell: NDArray[np.uint8] = np.zeros((0, 0), dtype=np.uint8)

    def add(self, window: CoverageWindow) -> None:
        """Lay one window over what there is."""
        g = window.grid
        spec = GridSpec(g.resolution_m, g.ix0, g.iy0, g.width, g.height)
        self._grow(spec)
        assert self.spec is not None
        common = overlap(self.spec, spec)
        assert common is not None  # the canvas has just grown over the window
        here, there = self.cell[common[0]], window.cell[common[1]]
        was_ground = (here == _GROUND) | (here == _COVERED)
        keeps = (there == 0) | ((there == _OUT_OF_REACH) & was_ground)
        self.cell[common[0]] = np.where(keeps, here, there)

    def _grow(self, spec: GridSpec) -> None:
        if self.spec is None:
            self.spec, self.cell = spec, np.zeros(spec.shape, dtype=np.uint8)
            return
        a = self.spec
        ix0, iy0 = min(a.ix0, spec.ix0), min(a.iy0, spec.iy0)
        width = max(a.ix0 + a.width, spec.ix0 + spec.width) - ix0
        height = max(a.iy0 + a.height, spec.iy0 + spec.height) - iy0
        grown = GridSpec(a.resolution_m, ix0, iy0, width, height)
        if grown == a:
            return
        cell = np.zeros(grown.shape, dtype=np.uint8)
        cell[a.iy0 - iy0 : a.iy0 - iy0 + a.height, a.ix0 - ix0 : a.ix0 - ix0 + a.width] = self.cell
        self.spec, self.cell = grown, cell

    def areas_m2(self) -> dict[str, float]:
        """Area of each kind of cell, m2."""
        if self.spec is None:
            return {}
        counts = np.bincount(self.cell.ravel(), minlength=len(_LABELS)) * self.spec.resolution_m**2
        return {label: round(float(counts[k]), 2) for k, label in enumerate(_LABELS) if label}


def feed_picture(
    path: Path,
    canvas: Canvas,
    driven: NDArray[np.float64],
    breadcrumbs: NDArray[np.float64],
    frontiers: NDArray[np.float64],
    title: str,
) -> None:
    """Draw the canvas. driven: (n, 2), breaks as NaN. breadcrumbs, frontiers: (n, 2). All in `map`, m."""
    low, high = _bounds(canvas, driven)
    width, height = high[0] - low[0], high[1] - low[1]
    scale = _LONGEST_IN / max(width, height)
    star = min(9.0, max(3.0, 360.0 / max(width, height)))
    figure = Figure(figsize=(max(5.0, width * scale), max(5.0, height * scale)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    if canvas.spec is not None:
        s = canvas.spec
        left, bottom = s.ix0 * s.resolution_m, s.iy0 * s.resolution_m
        extent = (left, left + s.width * s.resolution_m, bottom, bottom + s.height * s.resolution_m)
        axes.imshow(
            canvas.cell, origin="lower", extent=extent, cmap=ListedColormap(_COLOURS), vmin=0,
            vmax=len(_COLOURS) - 1, interpolation="nearest",
        )  # fmt: skip
    handles: list[object] = [Patch(color=c, label=n) for c, n in zip(_COLOURS, _LABELS, strict=True) if n]
    handles += axes.plot(driven[:, 0], driven[:, 1], color="#c2410c", linewidth=0.7, label="driven")
    handles += axes.plot(*breadcrumbs.T, ".", color="#1d4ed8", markersize=star / 2.0, label="breadcrumbs")
    handles += axes.plot(
        *frontiers.T, "*", color="#be185d", markersize=star, markeredgecolor="white", markeredgewidth=0.4,
        label="frontiers",
    )  # fmt: skip
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.set_title(title)
    axes.legend(handles=handles, loc="best", fontsize="small")
    figure.savefig(path, dpi=110)


def _bounds(canvas: Canvas, driven: NDArray[np.float64]) -> tuple[list[float], list[float]]:
    """Lower and upper corner of what there is to see, with a margin, m."""
    low, high = np.nanmin(driven, axis=0), np.nanmax(driven, axis=0)
    rows, columns = np.nonzero(canvas.cell)
    if canvas.spec is not None and len(rows):
        s = canvas.spec
        corner = np.array([columns.min() + s.ix0, rows.min() + s.iy0]) * s.resolution_m
        other = np.array([columns.max() + 1 + s.ix0, rows.max() + 1 + s.iy0]) * s.resolution_m
        low, high = np.minimum(low, corner), np.maximum(high, other)
    return (low - 1.0).tolist(), (high + 1.0).tolist()
