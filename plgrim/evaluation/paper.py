"""The paper's experiments: PLGRIM against next-best-view and frontier-based exploration in six worlds, in pairs.

The campaign is that of `plgrim evaluate missions`; here is what it consists of, and the one table that it ends in.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from planning.randomness import stream
from plgrim.evaluation.campaign_child import FINISHED
from plgrim.evaluation.campaign_plan import Overlay, Variant, World, merged
from plgrim.evaluation.campaign_rows import Row
from plgrim.evaluation.campaign_summary import Metric, markdown, paired
from plgrim.evaluation.statistics import DRAWS, LEVEL, Interval, bootstrap_mean, resampled_means, spread

BUDGETS_S: Mapping[str, float] = {
    "subway_1x": 900.0,
    "subway_2x": 1800.0,
    "subway_3x": 2700.0,
    "maze": 1800.0,
    "cave": 1800.0,
    "lava_tube": 1500.0,
}
"""The paper's worlds, and the mission time in each, s: that in which a full coverage is in sight."""

SUBWAYS = ("subway_1x", "subway_2x", "subway_3x")
FIRST_TUNING_SEED = 101
"""Seeds from here on are for tuning, those below are scored."""

NBV: Overlay = {
    "lcp": {"planner": "nbv"},
    "gcp": {"solver": "hfe", "hfe": {"scopes_m": [], "gain_weight": 0.0}},
}
"""Next best view on the Local IRM. Where nothing in the window is worth its way, it goes to the nearest frontier of the
Global IRM: the paper lets baselines search both roadmaps; without that it would stand still for good."""

HFE: Overlay = {
    "lcp": {"planner": "hfe"},
    "gcp": {"solver": "hfe"},
    "reconciler": {"profile": "always_new"},
}
"""Hierarchical frontiers of the Global IRM, the way to them over the Local IRM."""

PLANNERS: Mapping[str, Overlay] = {"plgrim": {}, "nbv": NBV, "hfe": HFE}

AREA_UNDER = Metric("coverage_mean", "AUC [%]", 100.0, 2)
"""Area under coverage over time, as a share of the budget times full coverage."""

_METRICS = (
    AREA_UNDER,
    Metric("covered_area_m2", "area at the budget [m2]", digits=0),
    Metric("coverage", "coverage [%]", 100.0),
    *(Metric(f"t{level}_s", f"{level} % at [s]", digits=0) for level in (50, 80, 90, 95, 99)),
    *(Metric(f"d{level}_m", f"{level} % after [m]", digits=0) for level in (50, 80, 90, 95, 99)),
    Metric("target_switches_per_100m", "switches per 100 m", digits=2),
    Metric("lcp_answer_p50_ms", "lcp p50 [ms]"),
    Metric("lcp_answer_p99_ms", "lcp p99 [ms]"),
    Metric("gcp_answer_p50_ms", "gcp p50 [ms]"),
    Metric("gcp_answer_p99_ms", "gcp p99 [ms]"),
)


def paper_worlds(names: Sequence[str], time_scale: float = 1.0) -> list[World]:
    """The worlds with their time budgets, times a factor. Raises KeyError for a world that is not the paper's."""
    return [World.built_in(name, time_scale * BUDGETS_S[name]) for name in names]


def paper_variants(own: Mapping[str, Overlay] | None = None) -> list[Variant]:
    """PLGRIM and the baselines. own: by planner, what is laid over it (tuned parameters)."""
    own = own or {}
    return [Variant(name, merged(overlay, own.get(name, {}))) for name, overlay in PLANNERS.items()]


def lead(table: Sequence[Row], world: str, other: str, metric: Metric = AREA_UNDER) -> list[float]:
    """PLGRIM minus another planner in a world, by seed, of runs with the same seed and budget."""
    mine, theirs = (_runs(table, world, name) for name in ("plgrim", other))
    return paired(metric, mine, theirs)


def growth(smaller: Sequence[float], larger: Sequence[float], *names: str) -> Interval:
    """How much larger the mean of the second sample is, with a percentile bootstrap over both, of the names' stream."""
    if min(len(smaller), len(larger)) < 3:
        return Interval(spread(larger)[0] - spread(smaller)[0], math.nan, math.nan)
    rng = stream(0, "bootstrap", "growth", *names)
    means = [resampled_means(np.asarray(sample, np.float64), rng, DRAWS) for sample in (larger, smaller)]
    low, high = np.quantile(means[0] - means[1], [(1.0 - LEVEL) / 2.0, (1.0 + LEVEL) / 2.0])
    return Interval(float(np.mean(larger) - np.mean(smaller)), float(low), float(high))


def _runs(table: Sequence[Row], world: str, planner: str) -> list[Row]:
    return [
        row
        for row in table
        if row["world"] == world and row["variant"] == planner and row["status"] == FINISHED
    ]


def paper_text(table: Sequence[Row], title: str) -> str:
    """The result as Markdown: one table of all planners in all worlds, and how the lead grows with the subway."""
    worlds = [world for world in BUDGETS_S if any(row["world"] == world for row in table)]
    header = ["world", "budget [s]", "planner", "runs", "lost", "PLGRIM's lead in AUC [points]"]
    lines = [f"# {title}\n", _LEGEND]
    lines += markdown([*header, *(metric.title for metric in _METRICS)], _cells(table, worlds))
    grown = [text for other in ("nbv", "hfe") for text in _growth_lines(table, other)]
    return "\n".join([*lines, "", *grown]) + "\n"


_LEGEND = """\
Means over the seeds; (n/N): only n of N runs have the value. AUC: area under the judge's coverage over the time budget.
Lead: PLGRIM's AUC minus this planner's, mean over pairs of the same seed, with the 95 % interval of the paired
bootstrap. lcp, gcp: wall time of a planner's answer.
"""


def _cells(table: Sequence[Row], worlds: Sequence[str]) -> list[list[str]]:
    found = []
    for world in worlds:
        for planner in PLANNERS:
            rows = _runs(table, world, planner)
            if rows:
                budget = f"{rows[0]['budget_s']:.0f}"
                lost = str(sum(bool(row["lost"]) for row in rows))
                ahead = "" if planner == "plgrim" else lead_text(table, world, planner)
                shown = [_mean_text(metric, rows) for metric in _METRICS]
                found.append([world, budget, f"`{planner}`", str(len(rows)), lost, ahead, *shown])
    return found


def lead_text(table: Sequence[Row], world: str, other: str) -> str:
    """ "+3.10 [+1.20, +5.00]", or a dash without pairs."""
    pairs = lead(table, world, other)
    return interval_text(bootstrap_mean(pairs, world, other, "paper")) if pairs else "-"


def interval_text(found: Interval) -> str:
    """A difference with its interval, where there is one."""
    if math.isnan(found.low):
        return f"{found.mean:+.2f}"
    return f"{found.mean:+.2f} [{found.low:+.2f}, {found.high:+.2f}]"


def _mean_text(metric: Metric, rows: Sequence[Row]) -> str:
    values = metric.values(rows)
    some = "" if len(values) == len(rows) else f" ({len(values)}/{len(rows)})"
    return f"{metric.text(spread(values)[0])}{some}" if values else "-"


def _growth_lines(table: Sequence[Row], other: str) -> list[str]:
    leads = {world: lead(table, world, other) for world in SUBWAYS}
    if not all(leads.values()):
        return []
    shown = ", ".join(f"{world} {spread(values)[0]:+.2f}" for world, values in leads.items())
    grown = interval_text(growth(leads[SUBWAYS[0]], leads[SUBWAYS[-1]], other))
    return [f"Lead over `{other}` from subway 1x to 3x: {shown}; 3x minus 1x: {grown} points.", ""]


def best_of(table: Sequence[Row], worlds: Sequence[str], variants: Sequence[str]) -> list[tuple[str, float]]:
    """Variants by their mean AUC (every world weighs the same), best first; those without a run in some world last."""
    found: list[tuple[str, float]] = []
    for name in variants:
        means = [spread(AREA_UNDER.values(_runs(table, world, name)))[0] for world in worlds]
        found.append((name, float(np.mean(means)) if means else math.nan))
    return sorted(found, key=lambda pair: (math.isnan(pair[1]), -pair[1], pair[0]))
