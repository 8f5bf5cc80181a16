"""Curves of a mission as SVG: text stays text, and a page of them stays small."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

_STYLE: Any = {"svg.fonttype": "none", "svg.hashsalt": "plgrim", "font.family": "sans-serif"}
_MOST_POINTS = 800


def curves(
    title: str,
    unit: str,
    series: Sequence[tuple[str, Sequence[float], Sequence[float]]],
    events: Sequence[float] = (),
) -> str:
    """An SVG of series (label, seconds, values) over mission time; events: times of thin marks."""
    figure = Figure(figsize=(7.2, 3.0), layout="constrained")
    FigureCanvasSVG(figure)
    axes = figure.add_subplot()
    for label, times, values in series:
        every = max(1, len(times) // _MOST_POINTS)
        axes.plot(list(times[::every]), list(values[::every]), label=label, linewidth=1.4)
    for at in events:
        axes.axvline(at, color="#9aa5b1", linewidth=0.5, alpha=0.6, zorder=0)
    axes.set_xlabel("mission time [s]")
    axes.set_ylabel(unit)
    axes.set_title(title, fontsize=10)
    axes.grid(visible=True, alpha=0.25)
    if len(series) > 1:
        axes.legend(loc="best", fontsize=8)
    out = io.StringIO()
    with rc_context(_STYLE):
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None})
    text = out.getvalue()
    return text[text.index("<svg") :]


def mission_curves(track: dict[str, list[float]], result: dict[str, Any]) -> list[tuple[str, str]]:
    """Coverage, speed and pose error of a mission as (title, SVG)."""
    if not track or len(track["t_s"]) < 2:
        return []
    t = track["t_s"]
    targets = [e["t_s"] for e in result.get("events", ()) if e["kind"] == "target"]
    coverage = [("judge", t, [100 * c for c in track["coverage"]])]
    belief = result.get("coverage_by_belief") or []
    if belief:
        coverage.append(("belief", [b[0] for b in belief], [100 * b[1] for b in belief]))
    seconds = np.asarray(t)
    passed = np.maximum(np.diff(seconds), 1e-3)
    speed = np.diff(np.asarray(track["distance_m"])) / passed
    width = min(len(speed), max(1, round(5.0 / float(np.median(passed)))))
    smooth = np.convolve(speed, np.ones(width) / width, mode="same")
    error = np.hypot(
        np.asarray(track["x_m"]) - np.asarray(track["true_x_m"]),
        np.asarray(track["y_m"]) - np.asarray(track["true_y_m"]),
    )
    return [
        ("Coverage", curves("Coverage; marks: a new target", "% of reachable ground", coverage, targets)),
        ("Distance", curves("Driven distance", "m", [("driven", t, track["distance_m"])])),
        ("Speed", curves("Speed, mean of 5 s", "m/s", [("speed", t[1:], smooth.tolist())])),
        ("Pose error", curves("Estimated less true position", "m", [("error", t, error.tolist())])),
    ]
