"""Coverage over mission time of a campaign: a panel a world, a line a variant, with the interval of the mean."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from planning.randomness import stream
from plgrim.evaluation.campaign_rows import Finished
from plgrim.evaluation.campaign_summary import ordered_variants
from plgrim.evaluation.statistics import LEVEL, resampled_means

_COLOURS = ("#0f766e", "#c2410c", "#1d4ed8", "#7e22ce", "#a16207", "#475569", "#be185d", "#15803d")
_SAMPLES = 400
_DRAWS = 2000
_COLUMNS = 3


def campaign_plot(path: Path, runs: Sequence[Finished], variants: Sequence[str]) -> None:
    """Draw coverage.png. A mission that has ended keeps its coverage; a cross marks where a robot was lost."""
    driven = [run for run in runs if run.curve.time_s.size]
    worlds = list(dict.fromkeys(str(run.task["world"]) for run in driven))
    if not worlds:
        return
    columns = min(_COLUMNS, len(worlds))
    rows = -(-len(worlds) // columns)
    figure = Figure(figsize=(6.4 * columns, 4.2 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    names = ordered_variants((str(run.task["variant"]) for run in driven), variants)
    for place, world in enumerate(worlds, 1):
        axes = figure.add_subplot(rows, columns, place)
        here = [run for run in driven if run.task["world"] == world]
        end_s = max(max(run.mission_s, float(run.curve.time_s[-1])) for run in here)
        for index, name in enumerate(names):
            of_variant = [run for run in here if run.task["variant"] == name]
            if of_variant:
                _draw_variant(axes, of_variant, name, _COLOURS[index % len(_COLOURS)], end_s)
        _label(axes, world)
    figure.savefig(path, dpi=110)


def _draw_variant(axes: Any, runs: Sequence[Finished], name: str, colour: str, end_s: float) -> None:
    times = np.linspace(0.0, end_s, _SAMPLES)
    curves = 100.0 * np.stack([run.curve.at(times) for run in runs])
    lost = [run for run in runs if run.result["lost"]]
    note = f"{name} (n = {len(runs)}" + (f", {len(lost)} lost)" if lost else ")")
    axes.plot(times, curves.mean(axis=0), color=colour, label=note)
    if len(runs) > 1:
        means = resampled_means(curves, stream(0, "coverage_plot", name), _DRAWS)
        low, high = np.quantile(means, [(1.0 - LEVEL) / 2.0, (1.0 + LEVEL) / 2.0], axis=0)
        axes.fill_between(times, low, high, color=colour, alpha=0.2, linewidth=0)
    for run in lost:
        axes.plot(run.curve.time_s[-1], 100.0 * run.curve.coverage[-1], "x", color=colour)


def _label(axes: Any, world: str) -> None:
    axes.set_title(world)
    axes.set_xlabel("mission time [s]")
    axes.set_ylabel("coverage by the judge [%]")
    axes.set_ylim(0, 102)
    axes.set_xlim(left=0)
    axes.grid(visible=True, alpha=0.3)
    axes.legend(loc="best", fontsize="small")
